"""The text evaluation with published weights, against how the release computes it.

Files are as released, with numbers drawn here. The networks are PyTorch's layers.
"""

import dataclasses
import pickle
import types
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxmotion.data import text_motion
from jaxmotion.evaluation import frechet
from jaxmotion.evaluators import text_motion as text_motion_evaluator
from jaxmotion.systems.emdm import text as emdm_text
from jaxmotion.systems.emdm import text_evaluation as emdm_text_evaluation
from jaxmotion.text import encoder
from tests import tiny
from tests.reference import matching as oracle

SIZES = dict(movement_width=16, motion_width=12, text_width=10, embedding=8)
WIDTH = 263
FRAMES = np.array([48, 44, 20, 8])
TOKENS = (
    "a/DET person/NOUN walk/VERB slowly/ADV",
    "he/PRON raise/VERB his/DET left/ADJ hand/NOUN and/CCONJ zzz/NOUN",
    " ".join(["the/DET man/NOUN sit/VERB on/ADP a/DET chair/NOUN"] * 4),  # 24: cut
)
# By their numbers in the release: places 9, bodies 10, objects 11, acts 12, manners 13.
SPECIAL = dict(walk=12, slowly=13, left=9, hand=10, chair=11, sit=12, zzz=12)
SPECIAL["raise"] = 12
# "zzz" is not among them, and no mark is where its name would sort.
WORDS = (
    "unk a person walk slowly he sos raise his left hand and the man sit on chair eos"
).split()


def statistics(width, seed=0):
    """A data set's: groups share a deviation, that of contacts follows from means."""
    generator = np.random.default_rng(seed)
    joints = {263: 22, 251: 21}[width]
    sizes = (1, 2, 1, 3 * joints - 3, 6 * joints - 6, 3 * joints)
    std = np.repeat([0.013, 0.017, 0.15, 0.12, 0.3, 0.02], sizes)
    share = np.array([0.848, 0.861, 0.849, 0.861])
    implied = np.sqrt(share * (1 - share)).mean()
    mean = np.concatenate([generator.normal(0, 0.3, std.size), share])
    return mean, np.concatenate([std, np.full(4, implied)])


def evaluators(mean, std):
    """An evaluator's: of other clips, root and contacts twice divided by 5."""
    mean, std = mean.copy(), 1.002 * std
    mean[3] -= 0.02
    std[:4] /= 25
    std[-4:] = np.sqrt(mean[-4:] * (1 - mean[-4:])).mean() / 25
    return mean, std


def write_statistics(folder, mean, std, names=("mean.npy", "std.npy")):
    for name, values in zip(names, (mean, std), strict=True):
        np.save(folder / name, values)


def write_glove(folder, words=WORDS, rows=None, index=None):
    """Rows in another order than the words; returns what was written."""
    generator = np.random.default_rng(7)
    rows = generator.normal(0, 0.4, (len(words), 300)) if rows is None else rows
    if index is None:
        places = generator.permutation(len(words))
        index = {word: int(row) for word, row in zip(words, places, strict=True)}
    np.save(folder / "our_vab_data.npy", rows)
    for name, value in (("words", list(words)), ("idx", index)):
        (folder / f"our_vab_{name}.pkl").write_bytes(pickle.dumps(value))
    return rows, words, index


@pytest.fixture
def run():
    """Clips of HumanML3D's width and three captions."""
    generator = np.random.default_rng(1)
    mean, std = statistics(WIDTH)
    clips = [mean + std * generator.normal(size=(n, WIDTH)) for n in (48, 60, 50)]
    motions = text_motion.text_motions(
        [clip.astype(np.float32) for clip in clips],
        [[("some words", tokens)] for tokens in TOKENS],
        ["train", "train", "test"],
        ["a", "b", "c"],
        mean=mean,
        std=std,
        fps=20.0,
        source="made in the tests",
    )
    return emdm_text.TextRun(
        record=tiny.run_folder(Path(), "emdm"),
        motions=motions,
        encoder=encoder.hashed_encoder(dimensions=8),
        vectors=np.zeros((1, 8)),
        index=np.zeros(3, int),
        scale=1.0,
    )


@pytest.fixture
def published(run, tmp_path, monkeypatch):
    """The evaluator as read from its files, PyTorch's in float64, and the words."""
    torch = pytest.importorskip("torch")
    from tests.reference import matching_torch

    full = text_motion_evaluator.MatcherConfig
    monkeypatch.setattr(
        text_motion_evaluator, "MatcherConfig", lambda **given: full(**SIZES | given)
    )
    theirs = matching_torch.Evaluator(full(num_features=WIDTH - 4, **SIZES))
    torch.save(theirs.state_dicts(), tmp_path / "finest.tar")
    for part in (theirs.movement, theirs.motion, theirs.text):
        part.double()
    mean, std = evaluators(*statistics(WIDTH))
    write_statistics(tmp_path, mean, std)
    glove = write_glove(tmp_path)
    ours = emdm_text_evaluation.published_evaluator(
        run, tmp_path / "finest.tar", glove=tmp_path
    )
    return types.SimpleNamespace(
        ours=ours, theirs=theirs, glove=glove, mean=mean, std=std
    )


def close(found, want, atol):
    """Equal but for rounding, and not because all rows are alike."""
    assert want.std(axis=0).mean() > 0.02
    error = np.abs(found - want).max()
    assert error < atol, error


def released_text(published):
    """Embeddings of the captions in float64."""
    found = []
    for tokens in TOKENS:
        rows, tags = oracle.read_sentence(tokens.split(), *published.glove, SPECIAL)
        coded = rows[None], np.eye(15)[None, tags], np.array([len(rows)])
        found.append(published.theirs.embed_text(*coded)[0])
    return np.array(found)


def released(published, run, x, frames):
    """Embeddings of generated motions in float64, by way of raw features."""
    raw = x.astype(np.float64) * run.motions.std + run.motions.mean
    again = (raw - published.mean) / published.std
    return published.theirs.embed_motion(again[..., :-4], frames)


def test_sentences_are_embedded_as_released(run, published):
    """GloVe's vectors, special words, unknown words and sentences that are cut."""
    coded = emdm_text_evaluation.sentences(run, published.ours.vocabulary)
    found = text_motion_evaluator.embed_text(
        published.ours.params,
        coded.vectors,
        coded.tags,
        coded.words,
        config=published.ours.config,
    )
    close(np.asarray(found)[coded.index], released_text(published), 1e-5)


@pytest.mark.slow
def test_the_scorer_reads_the_evaluators_words(run, published):
    """MM-Dist is that of the released embeddings; with other words it is not."""
    x = np.random.default_rng(2).normal(size=(64, 48, WIDTH)).astype(np.float32)
    frames, caption = jnp.full(64, 48), jnp.arange(64) % 3
    reference = frechet.moments(jnp.eye(8))
    motion = released(published, run, x, np.array(frames))
    want = oracle.matching_distance(released_text(published)[np.arange(64) % 3], motion)
    found = {}
    for name, evaluator in {
        "glove": published.ours,
        "hashed": dataclasses.replace(published.ours, vocabulary=None),
    }.items():
        score = emdm_text_evaluation.make_scorer(run, evaluator)
        key = jax.random.key(0)
        scores = score(key, jnp.asarray(x), frames, caption, reference)
        found[name] = float(scores["mm_dist"])
    np.testing.assert_allclose(found["glove"], want, rtol=1e-5)
    assert abs(found["hashed"] / want - 1) > 1e-2


def test_generated_motions_are_seen_as_released_or_with_zeros(run, published):
    x = np.random.default_rng(3).normal(size=(4, 48, WIDTH)).astype(np.float32)
    inside = np.arange(48)[None] < FRAMES[:, None]
    found = {
        padding: np.asarray(
            emdm_text_evaluation.embed(
                run,
                published.ours,
                jnp.asarray(x),
                jnp.asarray(FRAMES),
                padding=padding,
            )
        )
        for padding in ("zeros", "kept")
    }
    kept = released(published, run, x, FRAMES)
    close(found["kept"], kept, 1e-5)
    raw = x.astype(np.float64) * run.motions.std + run.motions.mean
    again = (raw - published.mean) / published.std * inside[..., None]
    zeros = published.theirs.embed_motion(again[..., :-4], FRAMES)
    close(found["zeros"], zeros, 1e-5)
    apart = np.linalg.norm(kept - zeros, axis=-1) / np.linalg.norm(zeros, axis=-1)
    assert apart[0] == 0.0 and apart[1:].min() > 1e-3


# --- statistics -----------------------------------------------------------------------


@pytest.mark.parametrize("width", [263, 251])
@pytest.mark.parametrize("names", emdm_text_evaluation._STATISTICS)
def test_the_evaluators_statistics_are_read(tmp_path, width, names):
    mean, std = evaluators(*statistics(width))
    write_statistics(tmp_path, mean, std, names)
    found = emdm_text_evaluation.read_statistics(tmp_path, width)
    np.testing.assert_allclose(found[0], mean, rtol=1e-6)
    np.testing.assert_allclose(found[1], std, rtol=1e-6)


@pytest.mark.parametrize("width", [263, 251])
@pytest.mark.parametrize("names", emdm_text_evaluation._STATISTICS)
def test_a_data_sets_statistics_are_refused(tmp_path, width, names):
    write_statistics(tmp_path, *statistics(width), names)
    message = f"{names[1]}: contact labels deviate 1 times.*expected 0.04: not the eval"
    with pytest.raises(ValueError, match=message) as error:
        emdm_text_evaluation.read_statistics(tmp_path, width)
    assert "\n" not in str(error.value)


@pytest.mark.parametrize(
    ("share", "deviation", "its_own"),
    [
        # Means of contact labels and their deviation, as published.
        ((0.8480543, 0.86073563, 0.84861388, 0.86106497), 0.01409494, True),
        ((0.01727899, 0.01801605, 0.01727995, 0.01801702), 0.00526644, True),
        ((0.84805804, 0.8607394, 0.84861696, 0.861069), 0.35593265, False),
    ],
    ids=["evaluator of HumanML3D", "evaluator of KIT-ML", "HumanML3D itself"],
)
def test_published_numbers_are_told_apart(tmp_path, share, deviation, its_own):
    mean, std = np.zeros(263), np.ones(263)
    mean[-4:], std[-4:] = share, deviation
    write_statistics(tmp_path, mean, std)
    if its_own:
        emdm_text_evaluation.read_statistics(tmp_path, 263)
    else:
        with pytest.raises(ValueError, match="deviate 1.01 times"):
            emdm_text_evaluation.read_statistics(tmp_path, 263)


def test_bad_statistics_are_named(tmp_path):
    def message(mean, std):
        write_statistics(tmp_path, mean, std)
        with pytest.raises(ValueError) as error:
            emdm_text_evaluation.read_statistics(tmp_path, WIDTH)
        return str(error.value).removeprefix(str(tmp_path))

    with pytest.raises(ValueError, match="expected mean.npy and std.npy of the eval"):
        emdm_text_evaluation.read_statistics(tmp_path, WIDTH)
    mean, std = evaluators(*statistics(WIDTH))
    assert "std.npy: channels [5] are not positive" in message(
        mean, np.where(np.arange(WIDTH) == 5, 0.0, std)
    )
    assert "mean.npy: expected 263 numbers, found shape (251,)" in message(
        mean[12:], std
    )
    assert "means of contact labels, should be between 0 and 1" in message(
        0 * mean, std
    )
    (tmp_path / "mean.npy").write_text("mean")
    with pytest.raises(ValueError, match="mean.npy: not a feature file, or a damaged"):
        emdm_text_evaluation.read_statistics(tmp_path, WIDTH)


# --- word vectors ---------------------------------------------------------------------


def test_glove_by_word(tmp_path):
    rows, words, index = write_glove(tmp_path)
    found = emdm_text_evaluation.load_glove(tmp_path)
    assert list(found) == words
    for word in words:
        np.testing.assert_array_equal(found[word], rows[index[word]].astype(np.float32))


class Code:
    """Unpickling it would print."""

    def __reduce__(self):
        return print, ("run",)


def test_code_in_the_word_list_is_not_run(tmp_path, capsys):
    write_glove(tmp_path)
    (tmp_path / "our_vab_words.pkl").write_bytes(pickle.dumps([Code()]))
    with pytest.raises(ValueError, match="our_vab_words.pkl: .*nothing of it was run"):
        emdm_text_evaluation.load_glove(tmp_path)
    assert capsys.readouterr().out == ""


MARKS = ["sos", "eos", "unk"]


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"rows": np.zeros((18, 299))}, r"data.npy: expected rows of 300.*\(18, 299\)"),
        ({"rows": np.full((18, 300), np.nan)}, "data.npy: row 0 is not finite"),
        ({"rows": np.zeros((17, 300))}, "idx.pkl: the row of .* is 17, expected one"),
        ({"words": ["sos", 3]}, "words.pkl: expected a list of words"),
        ({"words": ["sos", "eos"]}, "idx.pkl: the row of 'unk' is None"),
        (
            {"words": ["a"], "index": dict.fromkeys(["a", *MARKS], 0)},
            "no sos, eos, unk",
        ),
        ({"index": [1]}, "idx.pkl: expected a row for each word"),
        ({"words": MARKS, "index": dict.fromkeys(MARKS, -1)}, "row of 'sos' is -1"),
    ],
)
def test_bad_glove_is_named(tmp_path, changes, message):
    write_glove(tmp_path, **changes)
    with pytest.raises(ValueError, match=message):
        emdm_text_evaluation.load_glove(tmp_path)


@pytest.mark.parametrize("name", emdm_text_evaluation.GLOVE)
def test_missing_files_of_glove_are_named(tmp_path, name):
    write_glove(tmp_path)
    (tmp_path / name).unlink()
    with pytest.raises(ValueError, match=name):
        emdm_text_evaluation.load_glove(tmp_path)
