"""Files as published, written by PyTorch's layers or by hand, and bad ones."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from safetensors import numpy as safetensors

from jaxmotion.evaluators import published
from jaxmotion.evaluators import text_motion as text_motion_evaluator
from jaxmotion.evaluators.network import StyleClassifier

torch = pytest.importorskip("torch")
from tests.reference import matching_torch  # noqa: E402
from tests.reference import published_torch as peers  # noqa: E402

pytestmark = pytest.mark.slow

CONFIG = text_motion_evaluator.MatcherConfig(
    num_features=7, movement_width=8, motion_width=6, text_width=5, embedding=4
)


@pytest.fixture(scope="module")
def evaluator():
    return matching_torch.Evaluator(CONFIG)


@pytest.fixture
def state(evaluator):
    """As released: with the optimizers' states and counters beside the weights."""
    optimizer = torch.optim.Adam(evaluator.text.parameters(), lr=1e-4)
    for array in evaluator.text.parameters():
        array.grad = torch.zeros_like(array)
    optimizer.step()  # of no gradient: it only makes the state
    return {
        **evaluator.state_dicts(),
        "opt_text_encoder": optimizer.state_dict(),
        "epoch": 3,
        "iter": 5,
    }


def save(state, folder):
    path = folder / "finest.tar"
    torch.save(state, path)
    return path


def flat(state):
    return {
        f"{module}.{name}": x.detach().numpy()
        for module in ("movement_encoder", "motion_encoder", "text_encoder")
        for name, x in state[module].items()
    }


def test_embeddings_are_pytorchs(evaluator, state, tmp_path):
    params = published.load_matcher(save(state, tmp_path), config=CONFIG)
    generator = np.random.default_rng(0)
    frames, words = np.array([24, 8, 16]), np.array([2, 22, 9])
    x = generator.normal(size=(3, 24, 7)).astype(np.float32)
    x[np.arange(24)[None] >= frames[:, None]] = 0.0
    vectors = generator.normal(size=(3, 22, 300)).astype(np.float32)
    tags = np.eye(15, dtype=np.float32)[generator.integers(0, 15, (3, 22))]
    motion = text_motion_evaluator.embed_motion(
        params, jnp.asarray(x), jnp.asarray(frames, jnp.int32), config=CONFIG
    )
    np.testing.assert_allclose(motion, evaluator.embed_motion(x, frames), atol=1e-5)
    text = text_motion_evaluator.embed_text(
        params,
        jnp.asarray(vectors),
        jnp.asarray(tags),
        jnp.asarray(words, jnp.int32),
        config=CONFIG,
    )
    want = evaluator.embed_text(vectors, tags, words)
    assert want.std() > 0.1
    np.testing.assert_allclose(text, want, atol=1e-5)


def test_parameters_are_those_of_the_network(state, tmp_path):
    params = published.load_matcher(save(state, tmp_path), config=CONFIG)
    ours = jax.eval_shape(
        lambda k: text_motion_evaluator.init_matcher(k, CONFIG), jax.random.key(0)
    )
    shapes = lambda tree: jax.tree.map(lambda x: (x.shape, x.dtype), tree)  # noqa: E731
    assert shapes(params) == shapes(ours)


def test_safetensors_hold_the_same(state, tmp_path):
    path = tmp_path / "evaluator.safetensors"
    safetensors.save_file(flat(state), path)
    jax.tree.map(
        np.testing.assert_array_equal,
        published.load_matcher(path, config=CONFIG),
        published.load_matcher(save(state, tmp_path), config=CONFIG),
    )


def test_weights_of_another_size_are_named(state, tmp_path):
    with pytest.raises(ValueError, match=r"main\.0\.weight \(8, 7, 4\) instead of"):
        published.load_matcher(save(state, tmp_path))


def test_foreign_files_are_refused(state, tmp_path):
    with pytest.raises(FileNotFoundError, match="no weights file"):
        published.load_matcher(tmp_path / "none.tar")
    del state["text_encoder"]
    with pytest.raises(ValueError, match="text_encoder, found.*'motion_encoder'"):
        published.load_matcher(save(state, tmp_path), config=CONFIG)
    with pytest.raises(ValueError, match="found list"):
        published.load_matcher(save([1], tmp_path), config=CONFIG)


def style_classifier(path, **changes):
    peer = peers.randomize(peers.StyleClassifier(classes=5), 6)
    with torch.inference_mode():  # one step of training, for statistics that fit
        for module in peer.modules():
            if isinstance(module, torch.nn.BatchNorm1d):
                module.reset_running_stats()
                module.momentum = None
        normal = torch.Generator().manual_seed(1)
        peer.train()(torch.randn((64, 45, 60), generator=normal))
        peer.eval()
    names = ["Angry", "Old", "Proud", "Stiff", "Zombie"]
    content = {"state_dict": peer.state_dict(), "in_feat": 45, "class_names": names}
    torch.save(content | changes, path)
    return peer


def test_the_style_classifier_is_pytorchs(tmp_path):
    path = tmp_path / "100style_position_classifier.pth"
    peer = style_classifier(path)
    params, names = published.load_style_classifier(path)
    assert names == ("Angry", "Old", "Proud", "Stiff", "Zombie")
    x = np.random.default_rng(0).normal(size=(3, 60, 45)).astype(np.float32)
    ours = StyleClassifier(5).apply({"params": params}, jnp.asarray(x))
    with torch.inference_mode():
        theirs = peer.double()(torch.from_numpy(x.swapaxes(1, 2)).double())
    for found, wanted in zip(ours, theirs, strict=True):
        assert wanted.std() > 0.1
        np.testing.assert_allclose(found, wanted.numpy(), atol=1e-5)
    like = jax.eval_shape(StyleClassifier(5).init, jax.random.key(0), jnp.asarray(x))
    shapes = lambda tree: jax.tree.map(lambda x: (x.shape, x.dtype), tree)  # noqa: E731
    assert shapes(params) == shapes(like["params"])


def test_evaluators_that_do_not_fit_are_named(tmp_path):
    path = tmp_path / "weights.pth"
    style_classifier(path, class_names=["Old"])
    with pytest.raises(ValueError, match="'class_names' should list .* 5 styles"):
        published.load_style_classifier(path)
    state = peers.StyleClassifier(classes=5).state_dict()
    del state["bn3.running_var"]
    style_classifier(path, state_dict=state)
    with pytest.raises(ValueError, match="style classifier; missing: bn3.running_var$"):
        published.load_style_classifier(path)
