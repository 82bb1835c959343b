"""The evaluator at its published size against PyTorch's layers, on ragged batches."""

import jax.numpy as jnp
import numpy as np
import pytest

from jaxmotion.evaluators import published
from jaxmotion.evaluators import text_motion as text_motion_evaluator

torch = pytest.importorskip("torch")
from tests.reference import matching_torch  # noqa: E402

pytestmark = pytest.mark.slow

CONFIG = text_motion_evaluator.MatcherConfig()
FRAMES = np.array([40, 196, 8, 100, 196, 60])
WORDS = np.array([22, 3, 9, 2, 14, 7])


def as_jax(*arrays):
    return [
        jnp.asarray(x, jnp.int32 if x.dtype.kind == "i" else x.dtype) for x in arrays
    ]


@pytest.fixture(scope="module")
def both(tmp_path_factory):
    """Ours with the weights of theirs, by way of a file as published."""
    theirs = matching_torch.Evaluator(CONFIG)
    path = tmp_path_factory.mktemp("weights") / "finest.tar"
    torch.save(theirs.state_dicts(), path)
    return published.load_matcher(path), theirs


def test_motions(both):
    """In a batch whose padding is zeros, as released."""
    params, theirs = both
    x = np.random.default_rng(0).normal(size=(6, 196, 259)).astype(np.float32)
    x[np.arange(196)[None] >= FRAMES[:, None]] = 0.0
    want = theirs.embed_motion(x, FRAMES)
    assert want.std(axis=0).mean() > 0.05  # motions differ
    got = text_motion_evaluator.embed_motion(params, *as_jax(x, FRAMES), config=CONFIG)
    np.testing.assert_allclose(got, want, atol=1e-5)


def test_sentences(both):
    params, theirs = both
    generator = np.random.default_rng(1)
    vectors = generator.normal(0, 0.4, (6, 22, 300)).astype(np.float32)
    tags = np.eye(15, dtype=np.float32)[generator.integers(0, 15, (6, 22))]
    want = theirs.embed_text(vectors, tags, WORDS)
    assert want.std(axis=0).mean() > 0.05
    got = text_motion_evaluator.embed_text(
        params, *as_jax(vectors, tags, WORDS), config=CONFIG
    )
    np.testing.assert_allclose(got, want, atol=1e-5)
