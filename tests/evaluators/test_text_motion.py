"""The contrastive loss against loops, sentences as arrays, and that training learns."""

import dataclasses
import hashlib
import struct

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxmotion.evaluation import matching as measures
from jaxmotion.evaluators import text_motion as text_motion_evaluator
from jaxmotion.learning import training
from tests import tiny
from tests.reference import matching as oracle

CONFIG = text_motion_evaluator.MatcherConfig(
    num_features=6, movement_width=16, motion_width=16, text_width=16, embedding=16
)
STYLES = ("walk/VERB", "run/VERB", "jump/VERB", "sit/VERB")
PLACES = ("left/ADV", "right/ADV", "up/ADV", "down/ADV")
NUM_PAIRS = 256


def motion(generator, style, place):
    """A wave whose rate is the style's and whose mean is the place's."""
    frames = int(generator.integers(8, 25))
    time = np.arange(frames)[:, None] + generator.uniform(0, 6)
    wave = np.sin(0.5 * (1 + style) * time + np.arange(6)[None])
    x = np.zeros((24, 6), np.float32)
    x[:frames] = wave + np.eye(6)[place] + generator.normal(0, 0.2, (frames, 6))
    return x, frames


def make_pairs(seed, count):
    """Pairs of 16 sentences in turn, so 16 rows on are the same sentences."""
    generator = np.random.default_rng(seed)
    rows = []
    for i in range(count):
        style, place = i % 4, i // 4 % 4
        tokens = ["someone/PRON", STYLES[style], "to/ADP", PLACES[place]]
        rows.append(
            (
                *motion(generator, style, place),
                *text_motion_evaluator.encode_tokens(tokens[i % 2 :]),
            )
        )
    features, frames, vectors, tags, words = (
        np.stack(x) for x in zip(*rows, strict=True)
    )
    return text_motion_evaluator.Pairs(
        features=jnp.asarray(features),
        frames=jnp.asarray(frames, jnp.int32),
        vectors=jnp.asarray(vectors),
        tags=jnp.asarray(tags),
        words=jnp.asarray(words, jnp.int32),
    )


def embed(params, pairs):
    return (
        text_motion_evaluator.embed_text(
            params, pairs.vectors, pairs.tags, pairs.words, config=CONFIG
        ),
        text_motion_evaluator.embed_motion(
            params, pairs.features, pairs.frames, config=CONFIG
        ),
    )


@pytest.mark.slow
def test_the_loss_is_the_loops():
    """Without dropout; the shift is one of 1..3, never 0."""
    config = dataclasses.replace(CONFIG, dropout=0.0)
    params = tiny.random_params(text_motion_evaluator.init_matcher, config)
    batch = make_pairs(0, 4)
    for tower in (params["text"]["sequence"], params["motion"]):
        tower["out"]["kernel"] *= 2.6  # distances on both sides of the margin
    text, motion = (np.asarray(x, np.float64) for x in embed(params, batch))
    matched, mismatched = zip(
        *(oracle.contrastive_loss(text, motion, shift) for shift in range(4)),
        strict=True,
    )
    assert np.diff(sorted(mismatched)).min() > 1e-2
    found = jax.jit(
        lambda params, key: text_motion_evaluator.matcher_loss(
            params, key, batch, config=config
        )
    )
    shifts = set()
    for seed in range(12):
        loss, info = found(params, jax.random.key(seed))
        shift = int(np.argmin(np.abs(np.array(mismatched) - info["mismatched"])))
        shifts.add(shift)
        np.testing.assert_allclose(info["matched"], matched[shift], rtol=1e-4)
        np.testing.assert_allclose(info["mismatched"], mismatched[shift], rtol=1e-4)
        np.testing.assert_allclose(loss, sum(info.values()), rtol=1e-6)
    assert shifts == {1, 2, 3}


@pytest.mark.slow
def test_equal_embeddings_have_finite_gradients():
    params = tiny.random_params(text_motion_evaluator.init_matcher, CONFIG)
    for tower in (params["text"]["sequence"], params["motion"]):
        tower["out"] = jax.tree.map(jnp.zeros_like, tower["out"])
    grad = jax.jit(
        jax.grad(
            lambda p, k: text_motion_evaluator.matcher_loss(p, k, batch, config=CONFIG)[
                0
            ]
        )
    )
    batch = make_pairs(0, 3)
    grads = grad(params, jax.random.key(0))
    assert all(np.isfinite(x).all() for x in jax.tree.leaves(grads))


def test_one_pair_is_refused():
    params = tiny.random_params(text_motion_evaluator.init_matcher, CONFIG)
    with pytest.raises(ValueError, match="a batch of 1, expected at least 2"):
        text_motion_evaluator.matcher_loss(
            params, jax.random.key(0), make_pairs(0, 1), config=CONFIG
        )


def sample_batch(key, data):
    chosen = jax.random.randint(key, (32,), 0, data.frames.shape[0])
    return jax.tree.map(lambda x: x[chosen], data)


@pytest.mark.slow
def test_it_learns_to_match_new_motions():
    """With 16 different sentences; chance is 1/16, 2/16, 3/16."""
    steps = 200
    params, info = text_motion_evaluator.train_matcher(
        jax.random.key(0),
        sample_batch,
        make_pairs(0, NUM_PAIRS),
        config=CONFIG,
        num_steps=steps,
        optimizer=training.make_optimizer("adamw", learning_rate=3e-3, num_steps=steps),
    )
    assert info["loss"].shape == (steps,)
    text, motion = embed(params, make_pairs(1, 128))
    found = measures.r_precision(text, motion, pool=16)
    assert found[0] > 0.4 and found[2] > 0.8, found
    shuffled = measures.matching_distance(text, jnp.roll(motion, 1, axis=0))
    assert measures.matching_distance(text, motion) < 0.7 * shuffled


@pytest.mark.slow
def test_the_default_optimizer_is_adam_at_1e_4():
    """Its first step moves every array by 1e-4 at most, and most by nearly as much."""
    params, _ = text_motion_evaluator.train_matcher(
        jax.random.key(0),
        sample_batch,
        make_pairs(0, 32),
        config=CONFIG,
        num_steps=1,
    )
    key_init, _ = jax.random.split(jax.random.key(0))
    start = text_motion_evaluator.init_matcher(key_init, CONFIG)
    # The moving average makes nine tenths of the first step.
    moved = jax.tree.map(lambda a, b: np.abs(a - b).max(), params, start)
    moved = np.array(jax.tree.leaves(moved)) / 0.9e-4
    assert moved.max() < 1.1 and np.median(moved) > 0.9, moved


def test_word_vectors_are_of_the_word_alone():
    words = ["walk", "run", "walk", "naïve"]
    found = text_motion_evaluator.word_vectors(words)
    assert found.shape == (4, 300) and found.dtype == np.float32
    np.testing.assert_array_equal(found[0], found[2])
    np.testing.assert_array_equal(
        found[1:2], text_motion_evaluator.word_vectors(["run"])
    )
    np.testing.assert_allclose(np.linalg.norm(found, axis=-1), 6.0, rtol=1e-5)
    whole = struct.unpack("<300H", hashlib.shake_256(b"walk").digest(600))
    direction = np.array([2 * x + 1 - 2**16 for x in whole], np.float64)
    want = 6.0 * direction / np.linalg.norm(direction)
    np.testing.assert_allclose(found[0], want, atol=1e-6)
    assert text_motion_evaluator.word_vectors([]).shape == (0, 300)


def test_word_vectors_point_in_all_directions():
    found = text_motion_evaluator.word_vectors([f"word{i}" for i in range(500)]) / 6.0
    cosines = (found @ found.T)[np.triu_indices(500, 1)]
    assert abs(cosines.mean()) < 5 / np.sqrt(300 * cosines.size)
    np.testing.assert_allclose(cosines.std(), 300**-0.5, rtol=0.05)
    np.testing.assert_allclose(found.mean(axis=0), 0.0, atol=5 * (300 * 500) ** -0.5)


def test_a_sentence_between_its_marks():
    vectors, tags, count = text_motion_evaluator.encode_tokens(
        ["a/DET", "and/or/CCONJ"]
    )
    assert vectors.shape == (22, 300) and tags.shape == (22, 15) and count == 4
    want = text_motion_evaluator.word_vectors(["sos", "a", "and/or", "eos"])
    np.testing.assert_array_equal(vectors[:4], want)
    np.testing.assert_array_equal(tags[:4].argmax(axis=-1), [14, 2, 14, 14])
    np.testing.assert_array_equal(tags[:4].sum(axis=-1), 1.0)
    assert not vectors[4:].any() and not tags[4:].any()


@pytest.mark.parametrize(("given", "kept"), [(0, 0), (19, 19), (20, 20), (21, 20)])
def test_long_sentences_are_cut(given, kept):
    tokens = [f"word{i}/NOUN" for i in range(given)]
    vectors, tags, count = text_motion_evaluator.encode_tokens(tokens)
    assert count == kept + 2
    np.testing.assert_array_equal(
        vectors[count - 1], text_motion_evaluator.word_vectors(["eos"])[0]
    )
    assert tags[:, 1].sum() == kept


def test_a_token_without_class_is_named():
    with pytest.raises(ValueError, match="token 'walk', expected 'word/CLASS'"):
        text_motion_evaluator.encode_tokens(["a/DET", "walk"])


def test_special_words_are_the_released_ones():
    """Their number, and SHA-256 of the words of the released lists, sorted."""
    released = {
        "Loc_VIP": (12, "47f1921d3164245b"),
        "Body_VIP": (13, "d35c4a105ef2da94"),
        "Obj_VIP": (10, "c68f35a2cf0a2175"),
        "Act_VIP": (34, "a2a974289ebe4295"),
        "Desc_VIP": (12, "cbb867b24694e7e9"),
    }
    found = {}
    for name, words in text_motion_evaluator.SPECIAL_WORDS.items():
        digest = hashlib.sha256(" ".join(sorted(words)).encode()).hexdigest()
        found[name] = len(words), digest[:16]
    assert found == released and tuple(found) == text_motion_evaluator.TAGS[9:14]


@pytest.mark.parametrize(
    ("token", "expected"),
    [
        ("walk/VERB", "Act_VIP"),
        ("walk/NOUN", "Act_VIP"),
        ("left/ADJ", "Loc_VIP"),
        ("feet/NOUN", "Body_VIP"),
        ("chair/NOUN", "Obj_VIP"),
        ("slowly/ADV", "Desc_VIP"),
        ("walks/VERB", "VERB"),
        ("person/NOUN", "NOUN"),
        ("and/CCONJ", "OTHER"),
        ("to/PART", "OTHER"),
    ],
)
def test_special_words_override_the_part_of_speech(token, expected):
    _, tags, _ = text_motion_evaluator.encode_tokens([token])
    np.testing.assert_array_equal(
        tags[1], np.eye(15)[text_motion_evaluator.TAGS.index(expected)]
    )
