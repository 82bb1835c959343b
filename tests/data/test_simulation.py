import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.interpolate import CubicSpline
from scipy.spatial.transform import Rotation

from jaxmotion.data import simulation
from jaxmotion.motion.skeleton import forward_kinematics
from tests import person
from tests.data import samples
from tests.reference import pose as reference


def matrices_of(motion):
    x, y = np.moveaxis(
        np.asarray(motion.joint_rotation, np.float64).reshape(
            *motion.joint_rotation.shape[:-1], 2, 3
        ),
        -2,
        0,
    )
    return np.stack([x, y, np.cross(x, y)], axis=-1)


def spin(count, fps, rate, axis):
    """All joints turn about one axis, joint j beginning j radians ahead."""
    angle = rate * np.arange(count)[:, None] / fps + np.arange(6)
    vectors = np.multiply.outer(angle, np.asarray(axis) / np.linalg.norm(axis))
    matrices = Rotation.from_rotvec(vectors.reshape(-1, 3)).as_matrix()
    return np.zeros((count, 3)), matrices.reshape(count, 6, 3, 3)


# --- upsampling ------------------------------------------------------------------


def test_same_rate_is_the_same_motion():
    motion = samples.motion(5, 0)
    assert simulation.upsample(motion, 30.0) is motion


@pytest.mark.parametrize("factor", [2, 3, 16])
def test_multiples_of_the_rate_pass_through_the_frames(factor):
    motion = person.motion(*person.wander(20, 30.0), 30.0)
    found = simulation.upsample(motion, 30.0 * factor)
    assert found.fps == 30.0 * factor
    assert found.root_position.shape == (19 * factor + 1, 3)
    assert found.joint_rotation.shape == (19 * factor + 1, 6, 6)
    np.testing.assert_allclose(
        found.root_position[::factor], motion.root_position, atol=2e-6
    )
    np.testing.assert_allclose(
        found.joint_rotation[::factor], motion.joint_rotation, atol=2e-6
    )


@pytest.mark.parametrize(("fps", "count"), [(50.0, 32), (48.0, 31), (31.0, 20)])
def test_last_frame_is_not_behind_the_end(fps, count):
    motion = person.motion(*person.wander(20, 30.0), 30.0)
    found = simulation.upsample(motion, fps)
    assert len(found.root_position) == count
    assert (count - 1) / fps <= 19 / 30 + 1e-9 < count / fps


@pytest.mark.parametrize("fps", [60.0, 50.0])
def test_positions_are_the_cubic_spline_of_scipy(fps):
    # Rough data; what splines do at their ends has faded after ten frames.
    motion = samples.motion(40, 1)
    found = simulation.upsample(motion, fps)
    time = np.arange(len(found.root_position)) / fps
    spline = CubicSpline(np.arange(40) / 30.0, np.asarray(motion.root_position))
    inside = (time > 10 / 30) & (time < 29 / 30)
    assert inside.sum() > 20
    np.testing.assert_allclose(
        found.root_position[inside], spline(time[inside]), atol=2e-5
    )


@pytest.mark.parametrize("fps", [60.0, 50.0])
def test_smooth_motion_is_reproduced(fps):
    # Linear interpolation is wrong by 3e-3.
    motion = person.motion(*person.wander(46, 30.0), 30.0)
    found = simulation.upsample(motion, fps)
    count = len(found.root_position)
    expected = person.motion(*person.wander(count, fps), fps)
    np.testing.assert_allclose(found.root_position, expected.root_position, atol=2e-4)
    np.testing.assert_allclose(found.joint_rotation, expected.joint_rotation, atol=1e-3)
    inside = slice(6, -6)
    np.testing.assert_allclose(
        found.joint_rotation[inside], expected.joint_rotation[inside], atol=2e-4
    )


@pytest.mark.parametrize("axis", [[0, 1, 0], [1, -2, 0.5]])
def test_turns_through_half_a_turn_have_no_jumps(axis):
    # Quaternions change their sign on the way, wherever they are chosen to.
    motion = person.motion(*spin(61, 30.0, 5.0, axis), 30.0)
    found = simulation.upsample(motion, 60.0)
    expected = person.motion(*spin(121, 60.0, 5.0, axis), 60.0)
    np.testing.assert_allclose(found.joint_rotation, expected.joint_rotation, atol=1e-4)


def test_new_frames_are_rotations():
    found = simulation.upsample(samples.motion(12, 3), 60.0)
    x, y = np.split(np.asarray(found.joint_rotation), 2, axis=-1)
    np.testing.assert_allclose(np.linalg.norm(x, axis=-1), 1.0, atol=2e-6)
    np.testing.assert_allclose(np.linalg.norm(y, axis=-1), 1.0, atol=2e-6)
    np.testing.assert_allclose(np.sum(x * y, axis=-1), 0.0, atol=2e-6)


def test_two_frames_are_joined_by_a_line():
    motion = person.motion(*spin(2, 30.0, 6.0, [0, 1, 0]), 30.0)
    found = simulation.upsample(motion, 60.0)
    expected = person.motion(*spin(3, 60.0, 6.0, [0, 1, 0]), 60.0)
    np.testing.assert_allclose(found.joint_rotation, expected.joint_rotation, atol=1e-5)


def test_rates_and_clips_that_make_no_sense_are_refused():
    motion = samples.motion(8, 2)
    for fps in (29.0, 0.0, -60.0, 30.0 * 16.1, float("nan"), float("inf")):
        with pytest.raises(ValueError, match=r"fps|rate"):
            simulation.upsample(motion, fps)
    with pytest.raises(ValueError, match="frame"):
        simulation.upsample(samples.motion(1, 2), 60.0)


# --- the simulation bone ---------------------------------------------------------


def walk(position, yaw, fps=60.0):
    """A stiff person whose hips follow a path [F, 2]."""
    root = np.insert(np.asarray(position), 1, 0.9, axis=-1)
    return person.motion(root, person.upright(root, np.asarray(yaw)), fps)


def chest_of(motion):
    positions = forward_kinematics(
        person.skeleton(), motion.root_position, motion.joint_rotation
    )
    return np.asarray(positions, np.float64)[:, 5]


@pytest.mark.parametrize("fps", [30.0, 60.0])
def test_straight_walk_is_its_own_bone(fps):
    time = np.arange(2 * int(fps)) / fps
    yaw = np.full(len(time), -2.2)
    motion = walk(np.multiply.outer(time, [0.9, -0.5]) + 3.0, yaw, fps)
    bone = simulation.simulation_bone(person.skeleton(), motion)
    np.testing.assert_allclose(bone.position, chest_of(motion)[:, [0, 2]], atol=1e-5)
    np.testing.assert_allclose(bone.facing, person.directions(yaw), atol=1e-5)


def test_bone_runs_under_the_chest_and_not_under_the_hips():
    matrices = person.upright(np.zeros((80, 3)), np.zeros(80))
    matrices[:, 0] = Rotation.from_rotvec([0.6, 0, 0]).as_matrix()
    motion = person.motion(np.tile([0, 0.9, 0], (80, 1)), matrices)
    bone = simulation.simulation_bone(person.skeleton(), motion)
    ahead = (matrices[0, 0] @ person.OFFSETS[5])[[0, 2]]
    assert ahead[1] > 0.2
    np.testing.assert_allclose(bone.position, np.tile(ahead, (80, 1)), atol=1e-5)
    np.testing.assert_allclose(bone.facing, np.tile([0.0, 1.0], (80, 1)), atol=1e-5)


def test_bone_faces_as_the_hips_and_not_as_it_goes():
    time = np.arange(80) / 60.0
    backward = walk(np.multiply.outer(time, [0.0, -1.0]), 0 * time)
    bone = simulation.simulation_bone(person.skeleton(), backward)
    np.testing.assert_allclose(bone.facing, np.tile([0.0, 1.0], (80, 1)), atol=1e-5)


def test_cubic_paths_are_kept_to_their_ends():
    time = np.arange(80) / 60.0
    position = np.stack([time**3 - time, 1.0 + 2.0 * time**2], axis=-1)
    motion = walk(position, 0 * time + 0.4)
    bone = simulation.simulation_bone(person.skeleton(), motion)
    np.testing.assert_allclose(bone.position, chest_of(motion)[:, [0, 2]], atol=2e-5)


def test_bone_is_the_filtered_path_of_scipy():
    generator = np.random.default_rng(0)
    position, yaw = person.wandering_bone(80)
    position = position + generator.normal(scale=0.02, size=(80, 2))
    motion = walk(position, yaw + generator.normal(scale=0.1, size=80))
    bone = simulation.simulation_bone(person.skeleton(), motion)
    across = matrices_of(motion)[:, 0] @ (person.OFFSETS[1] - person.OFFSETS[3])
    expected = reference.simulation_bone(chest_of(motion), across)
    np.testing.assert_allclose(bone.position, expected[0], atol=1e-5)
    np.testing.assert_allclose(bone.facing, expected[1], atol=1e-5)


@pytest.mark.parametrize("fps", [30.0, 60.0])
def test_sway_of_steps_is_taken_out(fps):
    # Four steps per second, with hips that turn and a chest that swings.
    time = np.arange(2 * int(fps)) / fps
    sway = np.sin(8 * np.pi * time)
    position = np.stack([0.03 * sway, 1.1 * time], axis=-1)
    bone = simulation.simulation_bone(
        person.skeleton(), walk(position, 0.3 * sway, fps)
    )
    inside = slice(int(0.5 * fps) + 1, -int(0.5 * fps) - 1)
    np.testing.assert_allclose(bone.position[inside, 0], 0.0, atol=0.01)
    np.testing.assert_allclose(bone.facing[inside, 0], 0.0, atol=0.06)
    np.testing.assert_allclose(np.linalg.norm(bone.facing, axis=-1), 1.0, atol=1e-6)


def test_height_does_not_matter():
    root, matrices = person.wander(80)
    low = simulation.simulation_bone(person.skeleton(), person.motion(root, matrices))
    lifted = root + np.multiply.outer(np.arange(80), [0.0, 0.05, 0.0])
    high = simulation.simulation_bone(
        person.skeleton(), person.motion(lifted, matrices)
    )
    for a, b in zip(jax.tree.leaves(low), jax.tree.leaves(high), strict=True):
        np.testing.assert_allclose(a, b, atol=1e-6)


def test_moving_and_turning_the_world_moves_and_turns_the_bone():
    root, matrices = person.wander(80)
    before = simulation.simulation_bone(
        person.skeleton(), person.motion(root, matrices)
    )
    matrix, shift = person.about_y(-2.5), np.array([2.0, 0.0, 1.0])
    moved = matrices.copy()
    moved[:, 0] = matrix @ matrices[:, 0]
    after = simulation.simulation_bone(
        person.skeleton(), person.motion(root @ matrix.T + shift, moved)
    )
    ground = matrix[np.ix_([0, 2], [0, 2])]
    np.testing.assert_allclose(
        after.position,
        np.asarray(before.position) @ ground.T + shift[[0, 2]],
        atol=1e-5,
    )
    np.testing.assert_allclose(
        after.facing, np.asarray(before.facing) @ ground.T, atol=1e-4
    )


@pytest.mark.slow
@pytest.mark.parametrize("fps", [24.0, 30.0, 60.0])
def test_shortest_clip_is_about_a_second(fps):
    least = simulation.least_frames(fps)
    assert least % 2 == 1
    assert abs(least / fps - 61 / 60) <= 1 / fps
    motion = person.motion(*person.wander(least, fps), fps)
    bone = simulation.simulation_bone(person.skeleton(), motion)
    assert bone.position.shape == (least, 2)
    assert bool(jnp.all(jnp.isfinite(bone.position)))
    short = person.motion(*person.wander(least - 1, fps), fps)
    with pytest.raises(ValueError, match=f"{least}"):
        simulation.simulation_bone(person.skeleton(), short)


def test_windows_at_60_frames_a_second_are_the_published_ones():
    assert simulation.least_frames(60.0) == 61


@pytest.mark.parametrize(
    ("names", "joint"),
    [
        (("Spine1", "Chest", "Chest2", "Spine2"), 5),
        (("Spine1", "Chest", "Chest2", "Neck"), 4),
        (("Spine1", "Chest", "Neck", "Head"), 3),
        (("Spine", "Spine1", "Neck", "Head"), 3),
        (("mixamorig:Spine1", "mixamorig:Spine2", "Neck", "Head"), 3),
        (("Spine", "SPINE2", "chest", "Head"), 3),
    ],
)
def test_chest_is_the_first_known_name(names, joint):
    body = person.skeleton(names=("Hips", "LeftUpLeg", *names))
    assert simulation.chest_joint(body) == joint


def test_skeletons_without_chest_or_hips_are_refused():
    motion = person.motion(*person.wander(80))
    chestless = person.skeleton(names=(*person.NAMES[:5], "Belly"))
    with pytest.raises(ValueError, match="Belly"):
        simulation.chest_joint(chestless)
    with pytest.raises(ValueError, match="Belly"):
        simulation.simulation_bone(chestless, motion)
    legless = person.skeleton(names=("Hips", "A", "B", "C", "D", "Spine2"))
    with pytest.raises(ValueError, match="LeftUpLeg|leftupleg"):
        simulation.simulation_bone(legless, motion)
