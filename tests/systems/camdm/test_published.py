"""CAMDM's released weights: files as published, and the network that made them."""

import io
import json
import types

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxmotion.motion.skeleton import Skeleton
from jaxmotion.systems.camdm import model as camdm_model
from jaxmotion.systems.camdm import published as camdm_published

torch = pytest.importorskip("torch")
from tests.reference import published_torch as peers  # noqa: E402

pytestmark = pytest.mark.slow

STYLES = ("Angry", "Old", "Zombie")


def skeleton(joints=4):
    names = ("Hips", "LeftUpLeg", "LeftFoot", "RightUpLeg", "RightFoot")[:joints]
    return Skeleton(
        offsets=jnp.zeros((joints, 3)),
        parents=(-1, 0, 1, 0, 3)[:joints],
        names=tuple(f"mixamorig:{name}" for name in names),
        feet=(2, 3),
    )


@pytest.fixture(scope="module")
def peer():
    made = peers.randomize(peers.Camdm(4, len(STYLES)), 3)
    first, second = made.seqEncoder.layers
    with torch.no_grad():  # of equal arrays an exporter keeps one
        second.linear1.bias.copy_(first.linear1.bias)
        second.linear2.weight.copy_(first.linear2.weight)
    return made


def settings(past=5, future=7, steps=4, heads=4):
    space = types.SimpleNamespace
    arch = space(past_frame=past, future_frame=future, num_heads=heads)
    return space(
        arch=arch, diff=space(diffusion_steps=steps), device=torch.device("cpu")
    )


def checkpoint(peer):
    """As training saves it: with an optimizer, a configuration and a loss."""
    optimizer = torch.optim.AdamW(peer.parameters())
    return {
        "epoch": 40,
        "state_dict": peer.state_dict(),
        "opt_state_dict": optimizer.state_dict(),
        "config": settings(),
        "loss": np.mean([0.5, 0.25]),
    }


@pytest.fixture
def path(peer, tmp_path):
    torch.save(checkpoint(peer), tmp_path / "best.pt")
    return tmp_path / "best.pt"


def load(path, joints=4):
    return camdm_published.load(path, skeleton=skeleton(joints), labels=STYLES)


def inputs(seed=0, batch=3):
    generator = np.random.default_rng(seed)
    shapes = dict(x=(5, 6, 7), past=(5, 6, 5), pose=(6, 7), trans=(2, 7))
    found = {
        name: generator.normal(size=(batch, *shape)).astype(np.float32)
        for name, shape in shapes.items()
    }
    return found | {"steps": np.array([0, 2, 3]), "style": np.array([2, 0, 1])}


def torch_forward(peer, given):
    order = ("x", "steps", "past", "pose", "trans", "style")
    with torch.inference_mode():
        return peer(*(torch.from_numpy(given[name]) for name in order)).numpy()


def our_forward(model, params, given):
    flat = lambda x: jnp.asarray(x.transpose(0, 3, 1, 2).reshape(3, -1, 30))  # noqa: E731
    rows = lambda x: jnp.asarray(x.transpose(0, 2, 1))  # noqa: E731
    out = camdm_model.network(model.config).apply(
        {"params": params},
        flat(given["x"]),
        jnp.asarray(given["steps"] + 1, jnp.int32),
        flat(given["past"]),
        rows(given["trans"]),
        rows(given["pose"]),
        jnp.asarray(given["style"], jnp.int32),
        jnp.ones(3, bool),
    )
    return np.asarray(out).reshape(3, 7, 5, 6).transpose(0, 2, 3, 1)


def check(peer, model, params):
    theirs = torch_forward(peer, inputs())
    assert theirs.std() > 0.1
    np.testing.assert_allclose(our_forward(model, params, inputs()), theirs, atol=1e-5)


@pytest.mark.parametrize("old_format", [False, True])
def test_a_checkpoint_predicts_what_pytorch_does(peer, tmp_path, old_format):
    path = tmp_path / "best.pt"
    torch.save(checkpoint(peer), path, _use_new_zipfile_serialization=not old_format)
    model, params = load(path)
    config = model.config
    assert (config.past, config.future, config.num_steps) == (5, 7, 4)
    assert (config.width, config.depth, config.hidden, config.heads) == (16, 2, 24, 4)
    assert model.labels == STYLES
    like = jax.eval_shape(lambda: camdm_model.init(jax.random.key(0), config))
    shapes = lambda tree: jax.tree.map(lambda x: (x.shape, x.dtype), tree)  # noqa: E731
    assert shapes(params) == shapes(like)
    check(peer, model, params)


@pytest.fixture
def onnx(peer, tmp_path, monkeypatch):
    """Exported by PyTorch, with the JSON that lies beside a released file."""
    exporter = pytest.importorskip("torch.onnx._internal.torchscript_exporter")
    # It would only add operators of others, by the package onnx.
    monkeypatch.setattr(
        exporter.onnx_proto_utils, "_add_onnxscript_fn", lambda data, *_: data
    )
    given = inputs()
    order = ("x", "steps", "past", "pose", "trans", "style")
    arguments = tuple(torch.from_numpy(given[name][:1]) for name in order)
    data = io.BytesIO()
    torch.onnx.export(peer, arguments, data, dynamo=False, opset_version=15)
    path = tmp_path / "released_best.onnx"
    path.write_bytes(data.getvalue())
    stated = {"past_points": 5, "future_points": 7, "diffusion_steps": 4}
    stated["joint_names"] = list(skeleton().names)
    path.with_suffix(".config.json").write_text(json.dumps(stated))
    styles = tmp_path / "100style_conditions.json"
    styles.write_text(json.dumps({"styles": STYLES}))
    return path


@pytest.mark.filterwarnings("ignore")
def test_an_onnx_file_predicts_what_pytorch_does(peer, onnx):
    names = onnx.read_bytes()
    assert b"onnx::MatMul" in names and b"linear1.weight" not in names
    model, params = camdm_published.load(onnx, skeleton=skeleton())
    assert model.labels == STYLES and model.config.past == 5
    check(peer, model, params)


@pytest.mark.filterwarnings("ignore")
def test_what_lies_beside_an_onnx_file_must_fit(onnx):
    for change, message in (
        (
            {"joint_names": ["Hips", "LeftFoot"]},
            "joints should be Hips, LeftFoot, foun",
        ),
        ({"past_points": "5"}, "states past_points '5'"),
    ):
        path = onnx.with_suffix(".config.json")
        before = path.read_text()
        path.write_text(json.dumps(json.loads(before) | change))
        with pytest.raises(ValueError, match=message):
            camdm_published.load(onnx, skeleton=skeleton())
        path.write_text(before)
    (onnx.parent / "100style_conditions.json").write_text("[]")
    with pytest.raises(ValueError, match="100style_conditions.json: expected a JSON"):
        camdm_published.load(onnx, skeleton=skeleton())


def test_every_misfit_is_named(peer, tmp_path):
    path = tmp_path / "best.pt"
    content = checkpoint(peer)
    state = content["state_dict"] = dict(content["state_dict"])
    del state["seqEncoder.layers.1.norm2.bias"]
    state["output_process.poseFinal.weight"] = torch.zeros(30, 15)
    state["more"] = torch.zeros(2)
    torch.save(content, path)
    message = (
        r"best\.pt does not fit CAMDM's network; missing: "
        r"seqEncoder\.layers\.1\.norm2\.bias; unknown: more; of another shape: "
        r"output_process\.poseFinal\.weight \(30, 15\) instead of \(30, 16\)$"
    )
    with pytest.raises(ValueError, match=message):
        load(path)


def test_skeleton_and_styles_must_fit(path):
    with pytest.raises(ValueError, match="the model has 4 joints, the skeleton 5"):
        load(path, joints=5)
    with pytest.raises(ValueError, match="3 styles, but 1 names"):
        camdm_published.load(path, skeleton=skeleton(), labels=("Old",))
    with pytest.raises(FileNotFoundError, match="no 100style_conditions.json beside"):
        camdm_published.load(path, skeleton=skeleton())


def test_numbers_that_are_not_finite_are_refused(peer, tmp_path):
    content = checkpoint(peer)
    state = content["state_dict"] = dict(content["state_dict"])
    state["output_process.poseFinal.bias"] = torch.full((30,), float("nan"))
    torch.save(content, tmp_path / "best.pt")
    with pytest.raises(ValueError, match="not finite"):
        load(tmp_path / "best.pt")
