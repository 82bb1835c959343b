"""The evaluator sees limbs and nothing else, and learns to tell styles."""

import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxmotion.data import procedural
from jaxmotion.evaluators import style as style_evaluator
from jaxmotion.motion import features, trajectory
from jaxmotion.motion.skeleton import Motion, Skeleton
from tests import tiny

CONFIG = style_evaluator.Config(num_classes=2, num_joints=5, frames=12)


@pytest.mark.slow
def test_the_input_against_a_loop(skeleton):
    motion = tiny.walk(20, turn=1.0, start=0.5)
    found = style_evaluator.window_input(skeleton, motion)
    positions = np.asarray(tiny.positions(skeleton, motion), np.float64)
    for frame in range(20):
        root = positions[frame, 0]
        across = positions[frame, 1] - positions[frame, 3]
        ahead = np.cross(across, [0, 1, 0])
        ahead /= np.linalg.norm(ahead)
        left = np.cross([0, 1, 0], ahead)
        expected = [
            [(p - root) @ left, (p - root)[1], (p - root) @ ahead]
            for p in positions[frame]
        ]
        expected[0] = [0, root[1], 0]
        np.testing.assert_allclose(
            np.asarray(found[frame]).reshape(5, 3), expected, atol=1e-5
        )


def test_neither_place_nor_facing_is_seen(skeleton):
    motion = tiny.walk(20, turn=1.0)
    frame = trajectory.PlanarFrame(
        origin=jnp.array([3.0, -5.0]), facing=jnp.array([0.6, -0.8])
    )
    np.testing.assert_allclose(
        style_evaluator.window_input(skeleton, features.from_frame(motion, frame)),
        style_evaluator.window_input(skeleton, motion),
        atol=1e-5,
    )


def test_the_loss_is_the_cross_entropy():
    params = tiny.random_params(style_evaluator.init, CONFIG)
    x = jax.random.normal(jax.random.key(0), (6, 12, 15))
    labels = jnp.array([0, 1, 1, 0, 1, 0])
    loss, info = jax.jit(
        lambda params, key: style_evaluator.loss(
            params, key, (x, labels), config=CONFIG
        )
    )(params, jax.random.key(1))
    net = style_evaluator.WindowClassifier(2)
    _, logits = jax.jit(functools.partial(net.apply, train=True))(
        {"params": params}, x, rngs={"dropout": jax.random.key(1)}
    )
    logits = np.asarray(logits, np.float64)
    chance = np.exp(logits) / np.exp(logits).sum(axis=-1, keepdims=True)
    expected = -np.mean(np.log(chance[np.arange(6), labels]))
    np.testing.assert_allclose(loss, expected, rtol=1e-4)
    np.testing.assert_allclose(
        info["accuracy"], np.mean(logits.argmax(-1) == labels), rtol=1e-6
    )


@pytest.fixture(scope="module")
def windows_of_styles(skeleton):
    """Windows of slow and fast walkers; every second is held out."""
    x, labels = [], []
    for label, speed in enumerate((0.7, 1.4)):
        for start in range(8):
            motion = tiny.walk(60, speed=speed, start=float(start))
            rows = style_evaluator.window_input(skeleton, motion)
            x += [rows[i : i + 12] for i in range(start, 48, 6)]
            labels += [label] * len(range(start, 48, 6))
    return jnp.stack(x), jnp.asarray(labels, jnp.int32)


@pytest.mark.slow
def test_it_learns_to_tell_two_styles(windows_of_styles):
    x, labels = windows_of_styles
    params, info = style_evaluator.train(
        jax.random.key(0), x[::2], labels[::2], config=CONFIG, num_steps=50, batch=16
    )
    assert info["loss"].shape == (50,)
    assert info["loss"][-10:].mean() < info["loss"][:3].mean()
    found, logits = style_evaluator.classify(params, x[1::2], config=CONFIG)
    assert found.shape == (x[1::2].shape[0], 512)
    assert np.mean(logits.argmax(-1) == labels[1::2]) > 0.7


def skeleton_with(names, rng):
    """A chain from the root to each joint."""
    return Skeleton(
        offsets=jnp.asarray(rng.normal(size=(len(names), 3)), jnp.float32),
        parents=(-1, *(0,) * (len(names) - 1)),
        names=tuple(names),
        feet=(1, 2),
    )


MIXAMO = (
    "Hips Spine Neck Head LeftShoulder LeftArm LeftForeArm LeftHand RightShoulder "
    "RightArm RightForeArm RightUpLeg RightLeg RightFoot LeftUpLeg LeftLeg LeftFoot"
)
STYLE = (
    "Hips Chest LeftCollar LeftShoulder LeftElbow RightCollar RightShoulder RightElbow "
    "Neck Head RightHip RightKnee RightAnkle LeftHip LeftKnee LeftAnkle"
)
ORDER = {
    MIXAMO: "Hips Neck Head RightShoulder RightArm RightForeArm LeftShoulder LeftArm "
    "LeftForeArm RightUpLeg RightLeg RightFoot LeftUpLeg LeftLeg LeftFoot",
    STYLE: "Hips Neck Head RightCollar RightShoulder RightElbow LeftCollar "
    "LeftShoulder LeftElbow RightHip RightKnee RightAnkle LeftHip LeftKnee LeftAnkle",
}
ACROSS = {
    MIXAMO: ("LeftShoulder", "RightShoulder", "LeftUpLeg", "RightUpLeg"),
    STYLE: ("LeftCollar", "RightCollar", "LeftHip", "RightHip"),
}


@pytest.mark.slow
@pytest.mark.parametrize("names", [MIXAMO, STYLE])
def test_the_released_input_is_that_of_the_released_scripts(names):
    """Float64: across = shoulders + hips, each of length 1; facing +x; no root."""
    rng = np.random.default_rng(0)
    joints = names.split()
    skeleton = skeleton_with([f"rig:{name}" for name in joints], rng)
    motion = Motion(
        root_position=jnp.asarray(rng.normal(size=(6, 3)), jnp.float32),
        joint_rotation=jnp.asarray(rng.normal(size=(6, len(joints), 6)), jnp.float32),
        fps=30.0,
    )
    positions = np.asarray(tiny.positions(skeleton, motion), np.float64)
    at = lambda name: positions[:, joints.index(name)]  # noqa: E731
    left_top, right_top, left_hip, right_hip = map(at, ACROSS[names])
    across = np.zeros((6, 3))
    for left, right in ((left_top, right_top), (left_hip, right_hip)):
        across += (left - right) / np.linalg.norm(left - right, axis=-1)[:, None]
    forward = np.cross(across, [0.0, 1.0, 0.0])
    angle = np.arctan2(forward[:, 2], forward[:, 0])
    local = np.stack([at(x) - at("Hips") for x in ORDER[names].split()], axis=1)
    c, s = np.cos(angle)[:, None], np.sin(angle)[:, None]
    x, y, z = np.moveaxis(local, -1, 0)
    wanted = np.stack([c * x + s * z, y, c * z - s * x], axis=-1).reshape(6, 45)
    found = style_evaluator.released_input(skeleton, motion)
    np.testing.assert_allclose(found, wanted, atol=1e-5)


def test_the_released_input_names_the_joints_that_it_needs():
    skeleton = skeleton_with(
        ["Hips", "LeftUpLeg", "RightUpLeg"], np.random.default_rng(0)
    )
    with pytest.raises(ValueError, match="needs the joints hips, neck, .* has Hips, "):
        style_evaluator.released_joints(skeleton)


def test_windows_of_another_rate_are_not_learned_from():
    """Of 60 frames, which at 60 per second are half as long."""
    clips = dataclasses.replace(procedural.make_clips(minutes=0.2), fps=60.0)
    with pytest.raises(ValueError, match="60 frames per second, expected 30"):
        style_evaluator.fit(jax.random.key(0), clips, field="style")
