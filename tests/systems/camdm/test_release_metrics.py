"""What CAMDM's scripts print, against a transcription in float64 and planted cases."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.ndimage import gaussian_filter1d
from scipy.spatial.transform import Rotation

from jaxmotion.data import procedural
from jaxmotion.motion.skeleton import Motion
from jaxmotion.motion.trajectory import Command
from jaxmotion.systems.camdm import release as camdm_release
from tests.reference import metrics as oracle
from tests.reference import motion as kinematics

BONES = procedural.walker_skeleton()
# The walker's names, and those of 100STYLE with collars, and both kinds of toes.
STYLE100 = tuple(
    name.replace("Shoulder", "Collar")
    .replace("UpLeg", "Hip")
    .replace("LeftHand", "LeftToe")
    .replace("RightHand", "RightToe")
    for name in BONES.names
)


def six(rotations):
    matrix = rotations.as_matrix()
    return np.concatenate([matrix[..., 0], matrix[..., 1]], axis=-1)


def clip(seed, frames=70, speed=1.2):
    """Random poses that change smoothly, on a walk that wanders to all sides."""
    rng = np.random.default_rng(seed)
    angles = gaussian_filter1d(rng.normal(size=(frames, 22, 3)), 4, axis=0)
    yaw = np.cumsum(gaussian_filter1d(rng.normal(size=frames), 6)) + rng.uniform(-3, 3)
    turn = [Rotation.from_rotvec(angles[f]) for f in range(frames)]
    rotations = np.stack([six(r) for r in turn])
    for f in range(frames):
        rotations[f, 0] = six(Rotation.from_euler("y", yaw[f]) * turn[f][0])
    step = speed / 30 * np.stack([np.sin(yaw), np.cos(yaw)], -1)
    path = np.cumsum(step, axis=0)
    height = 0.9 + 0.02 * np.sin(np.arange(frames))
    return Motion(
        root_position=jnp.asarray(
            np.stack([path[:, 0], height, path[:, 1]], -1), jnp.float32
        ),
        joint_rotation=jnp.asarray(rotations, jnp.float32),
        fps=30.0,
    )


def commands(seed, frames=70):
    """Eight directions, standing still among them, and slow turns of the facing."""
    rng = np.random.default_rng(seed)
    move = np.repeat(rng.integers(-1, 2, (frames // 10 + 1, 2)), 10, axis=0)[:frames]
    look = np.linspace(0, 7, frames) + rng.uniform(-3, 3)
    return Command(
        velocity=jnp.asarray(1.2 * move, jnp.float32),
        facing=jnp.asarray(np.stack([np.sin(look), np.cos(look)], -1), jnp.float32),
        label=jnp.zeros(frames, jnp.int32),
    )


def released(skeleton, motion, command):
    """The oracle on the very same arrays, through kinematics of its own."""
    rotations = np.float64(motion.joint_rotation)
    joints = [
        kinematics.world_transforms(
            np.float64(skeleton.offsets),
            skeleton.parents,
            root,
            [kinematics.gram_schmidt(r) for r in rotations[f]],
        )[:, :3, 3]
        for f, root in enumerate(np.float64(motion.root_position))
    ]
    names = [name.split(":")[-1] for name in skeleton.names]
    told = (np.asarray(command.velocity), np.asarray(command.facing))
    return oracle.camdm_release(names, np.stack(joints), *told)


@jax.jit
def measured(skeleton, motion, frames, command):
    return camdm_release.clip_metrics(skeleton, motion, frames, command)


def degrees(found):
    angles = ("trajectory", "orientation")
    return {k: float(np.degrees(v) if k in angles else v) for k, v in found.items()}


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("names", [BONES.names, STYLE100], ids=["mixamo", "100style"])
def test_all_columns_are_those_of_the_scripts(names, seed):
    skeleton = dataclasses.replace(BONES, names=names)
    motion, command = clip(seed), commands(seed)
    found = degrees(measured(skeleton, motion, jnp.array(70), command))
    wanted = released(skeleton, motion, command)
    assert set(found) == set(wanted)
    for name, value in wanted.items():
        assert found[name] == pytest.approx(value, rel=1e-5, abs=1e-5), name


def test_frames_that_pad_a_clip_and_a_rigs_prefix_change_nothing():
    motion, command = clip(7, frames=50), commands(7, frames=50)
    wanted = released(BONES, motion, command)
    # What is after the end is another clip, whose toes are lower.
    rest = clip(8, frames=20)
    low = rest.root_position - jnp.array([[0.0, 0.5, 0.0]])
    rest = dataclasses.replace(rest, root_position=low)
    longer = jax.tree.map(lambda *x: jnp.concatenate(x), motion, rest)
    told = jax.tree.map(lambda *x: jnp.concatenate(x), command, commands(8, frames=20))
    names = tuple(f"mixamorig:{name}" for name in BONES.names)
    skeleton = dataclasses.replace(BONES, names=names)
    found = degrees(measured(skeleton, longer, jnp.array(50), told))
    for name, value in wanted.items():
        assert found[name] == pytest.approx(value, rel=1e-5, abs=1e-5), name


def straight(toward, noise=0.0524, frames=300):
    """A walk along x, +1 or -1, whose steps turn by 3 degrees at random."""
    rng = np.random.default_rng(0)
    turn = noise * rng.normal(size=frames)
    step = 0.04 * np.stack([toward * np.cos(turn), np.sin(turn)], -1)
    told = np.tile([toward, 0.0], (frames, 1))
    return told.astype(np.float32), np.cumsum(step, axis=0).astype(np.float32)


def test_directions_are_cut_at_plus_x():
    """The scripts mirror x: a walk toward -x is good, one toward +x half a turn off.

    As measured with the released scripts: 0.1 and 185.9 degrees.
    """
    found = {}
    for toward in (-1.0, 1.0):
        told, path = straight(toward)
        error = camdm_release.trajectory_error(jnp.asarray(told), jnp.asarray(path))
        found[toward] = float(np.degrees(error))
        mirrored = np.diff(np.float64(path), axis=0) * [-1.0, 1.0]
        angle = np.degrees(np.arctan2(mirrored[:, 1], mirrored[:, 0]))
        wanted = abs(np.mean(np.degrees(np.arctan2(0.0, -toward)) - angle))
        assert found[toward] == pytest.approx(wanted, rel=1e-5, abs=1e-5)
    assert found[-1.0] < 0.5
    assert found[1.0] == pytest.approx(180.0, abs=20.0)


def test_facings_are_cut_at_minus_x_and_sides_cancel():
    def error(a, b):
        vectors = (np.stack([np.cos(p), np.sin(p)], -1) for p in (a, b))
        told, faced = (jnp.asarray(v, jnp.float32) for v in vectors)
        return float(camdm_release.orientation_error(told, faced))

    over = np.full(4, np.pi - 0.1)
    assert error(over, -over) == pytest.approx(2 * np.pi - 0.2, rel=1e-5)
    assert error(over - np.pi, np.pi - over) == pytest.approx(0.2, rel=1e-5)
    sides = 0.5 * (-1.0) ** np.arange(10)
    assert error(np.zeros(10), sides) == pytest.approx(0.0, abs=1e-6)


def test_who_stands_where_told_has_no_error():
    """Standing has the polar angle 0, as what nobody asks for has."""
    still = jnp.full((20, 2), -0.7)
    for zero in (0.0, -0.0):
        found = camdm_release.trajectory_error(jnp.full((20, 2), zero), still)
        assert float(found) == 0.0


def test_a_lifted_clip_slides_as_before():
    """The ground is the clip's lowest toe, so that who floats looks as if it stood."""
    motion, command = clip(3), commands(3)
    up = motion.root_position + jnp.array([[0.0, 0.03, 0.0]])
    lifted = dataclasses.replace(motion, root_position=up)
    slide = [
        float(measured(BONES, x, jnp.array(70), command)["slide"])
        for x in (motion, lifted)
    ]
    assert slide[0] > 0.01
    assert slide[1] == pytest.approx(slide[0], rel=1e-5)
    wanted = released(BONES, lifted, command)["slide"]
    assert slide[1] == pytest.approx(wanted, rel=1e-5)


def test_a_root_that_stands_still_divides_by_a_centimeter():
    motion = clip(4)
    still = jnp.broadcast_to(motion.root_position[:1], motion.root_position.shape)
    motion = dataclasses.replace(motion, root_position=still)
    command = commands(4)
    found = degrees(measured(BONES, motion, jnp.array(70), command))
    wanted = released(BONES, motion, command)
    for name in ("slide", "coherence"):
        assert found[name] == pytest.approx(wanted[name], rel=1e-5), name


@pytest.mark.slow
def test_what_nobody_steers_has_no_errors_of_angle():
    found = camdm_release.clip_metrics(BONES, clip(5))
    assert set(found) == {"slide", "coherence"}
    skeleton = dataclasses.replace(
        BONES, names=tuple(name.replace("Shoulder", "Clavicle") for name in BONES.names)
    )
    found = camdm_release.clip_metrics(skeleton, clip(5), None, commands(5))
    assert set(found) == {"slide", "coherence", "trajectory"}


@pytest.mark.parametrize("features", [6, 96])
def test_distances_are_each_clips_own_by_features(features):
    """Clips of 0, 1 and more windows, fewer and more than there are features."""
    rng = np.random.default_rng(0)
    clips = np.repeat(np.arange(5), [12, 0, 1, 30, 9])
    found = rng.normal(size=(clips.size, features)).astype(np.float32)
    found += 0.3 * clips[:, None]
    styles = np.repeat([0, 1], [40, 25])
    mix = rng.normal(size=(features, features)) / np.sqrt(features)
    data = (rng.normal(size=(65, features)) @ mix).astype(np.float32)
    shuffled = rng.permutation(clips.size)
    label = np.array([0, 0, 1, 1, 0])
    got = camdm_release.frechet_distances(
        camdm_release.in_groups(found[shuffled], clips[shuffled], 5),
        camdm_release.in_groups(data, styles, 2),
        jnp.asarray(label),
    )
    assert np.isnan(got[1]) and np.isnan(got[2])
    for i in (0, 3, 4):
        own, reference = found[clips == i], data[styles == label[i]]
        wanted = oracle.frechet_of_rows(own, reference) / features
        np.testing.assert_allclose(got[i], wanted, rtol=1e-5)
        if len(own) > features:
            wanted = oracle.frechet(np.float64(own), np.float64(reference)) / features
            np.testing.assert_allclose(got[i], wanted, rtol=1e-5)
