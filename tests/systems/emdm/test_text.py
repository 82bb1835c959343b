"""The text condition as released and as ours, against CLIP's oracle."""

import numpy as np
import pytest

from jaxmotion.data import text_motion
from jaxmotion.systems.emdm import text as emdm_text
from tests.reference import clip as oracle
from tests.text import samples

# The context is 24: the longer one just fits it whole, and the release cuts it.
SHORT, LONG = "a person turns left", "a " * 21 + "left"


def ids(text):
    """Tokens of a whole text, by the tokenizer alone."""
    made = samples.tokenizer()
    made.no_padding()
    made.no_truncation()
    return made.encode(text).ids


@pytest.fixture
def folder(tmp_path):
    """A run folder without its form, and weights of CLIP's text tower."""
    clip = tmp_path / "clip"
    clip.mkdir()
    weights = samples.folder(clip)
    motions = text_motion.text_motions(
        [np.random.default_rng(0).normal(size=(40, 263)).astype(np.float32)],
        [[(SHORT, "a/DET"), (LONG, "a/DET")]],
        ["train"],
        ["clip"],
        mean=np.zeros(263),
        std=np.ones(263),
        fps=20.0,
        source="made in the tests",
    )
    data = tmp_path / "motions.npz"
    text_motion.save_text_motions(data, motions)

    def write(form):
        """A run folder with this text form."""
        emdm_text.prepare(
            tmp_path / "run",
            (data,),
            encoder=str(clip),
            form=form,
            unseen=(),
            least=1,
            fps=20.0,
            frames=40,
            held_out=0.1,
        )
        return tmp_path / "run"

    return write, weights


def vectors(weights, texts):
    """Vectors of lists of tokens; the first end is where a text ends."""
    end = samples.tokenizer().token_to_id(samples.END)
    return np.array([oracle.encode(weights, t, end, samples.HEADS) for t in texts])


def released(text):
    """Start, 20 tokens at most, end, and zeros up to the whole context."""
    start, *inner, end = ids(text)
    cut = [start, *inner[:20], end]
    return cut + [0] * (samples.SIZES["context"] - len(cut))


def test_released_texts_are_cut_and_not_scaled(folder):
    write, weights = folder
    assert len(ids(LONG)) > 22
    run = emdm_text.load_run(write("released"))
    want = vectors(weights, [released(SHORT), released(LONG)])
    whole = vectors(weights, [ids(SHORT), ids(LONG)])
    assert np.abs(want[1] - whole[1]).max() > 1e-2
    np.testing.assert_allclose(run.vectors[run.index], want, atol=1e-5)
    assert run.scale == 1.0
    # New sentences are read as the captions were.
    np.testing.assert_allclose(
        emdm_text.encode(run, (LONG, SHORT)), want[::-1], atol=1e-5
    )


def test_unit_texts_are_whole_and_scaled(folder):
    write, weights = folder
    run = emdm_text.load_run(write("unit"))
    whole = vectors(weights, [ids(SHORT), ids(LONG)])
    whole /= np.sqrt((whole**2).mean())
    np.testing.assert_allclose(run.vectors[run.index], whole, atol=1e-5)
    np.testing.assert_allclose(emdm_text.encode(run, (LONG,)), whole[1:], atol=1e-5)


def test_the_two_forms_have_folders_of_their_own(folder):
    write, _ = folder
    write("released")
    with pytest.raises(ValueError, match="text_form is 'released', given 'unit'; use"):
        write("unit")


def test_the_default_is_the_released_form_with_clip_alone():
    assert emdm_text.default_form("path/to/clip") == "released"
    for name in ("wordllama", "hashed"):
        assert emdm_text.default_form(name) == "unit"
        with pytest.raises(ValueError, match=f"'released'.*encoder is '{name}'"):
            emdm_text.make_encoder(name, "released")
