import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from jaxmotion.motion import features, pose
from jaxmotion.motion.skeleton import (
    Motion,
    Skeleton,
    global_transforms,
)
from tests import person, tiny
from tests.person import float32
from tests.reference import pose as reference

FRAMES = 31

pose_vectors = jax.jit(pose.pose_vectors)


@pytest.fixture
def skeleton():
    return person.skeleton()


def described(vectors, num_joints=6):
    """Parts of pose vectors by name."""
    layout = pose.pose_layout(num_joints)
    return {k: np.asarray(v) for k, v in features.unpack(layout, vectors).items()}


def parts_of_walk(skeleton, velocity, turn_rate=0.0, heading=0.7):
    """Parts for a stiff person that goes and turns with its bone."""
    time = np.arange(FRAMES) / 60.0
    yaw = heading + turn_rate * time
    root = np.multiply.outer(time, velocity) + np.array([0.2, 0.9, -0.3])
    motion = person.motion(root, person.upright(root, yaw))
    bone = person.path(root[:, [0, 2]], yaw)
    return described(pose_vectors(skeleton, motion, bone))


# --- the vector ------------------------------------------------------------------


def test_22_joints_have_338_features_in_the_documented_order():
    layout = pose.pose_layout(22)
    assert layout.size == 338
    assert layout.fields == (
        ("position", 0, 66),
        ("rotation", 66, 198),
        ("velocity", 198, 264),
        ("angular_velocity", 264, 330),
        ("root_velocity", 330, 333),
        ("root_angular_velocity", 333, 336),
        ("contact", 336, 338),
    )


@pytest.mark.slow
@pytest.mark.parametrize("fps", [30.0, 60.0])
def test_22_joints_agree_with_products_of_matrices(fps):
    generator = np.random.default_rng(3)
    parents = (-1, *(int(generator.integers(j)) for j in range(1, 22)))
    offsets = generator.normal(scale=0.2, size=(22, 3))
    body = Skeleton(
        offsets=float32(offsets),
        parents=parents,
        names=tuple(f"joint{j}" for j in range(22)),
        feet=(4, 9),
    )
    root, matrices = person.wander(FRAMES, fps, 22)
    position, yaw = person.wandering_bone(FRAMES, fps)
    bone = person.path(position, yaw)
    found = pose_vectors(body, person.motion(root, matrices, fps), bone)
    facing = person.directions(yaw)
    expected = reference.pose_parts(
        offsets, parents, (4, 9), root, matrices, position, facing, fps
    )
    assert found.shape == (FRAMES, 338)
    parts = described(found, 22)
    assert list(parts) == list(expected)
    for name in list(expected)[:-1]:
        np.testing.assert_allclose(parts[name], expected[name], atol=3e-4, err_msg=name)
    joined = np.concatenate([expected[name] for name in parts], axis=-1)
    np.testing.assert_allclose(found[:, :336], joined[:, :336], atol=3e-4)


def test_bones_of_the_skeleton_are_exactly_constant_channels(skeleton):
    root, matrices = person.wander(FRAMES)
    vectors = pose_vectors(
        skeleton,
        person.motion(root, matrices),
        person.path(*person.wandering_bone(FRAMES)),
    )
    parts = described(vectors)
    position = parts["position"].reshape(FRAMES, 6, 3)
    np.testing.assert_array_equal(
        position[:, 1:], np.tile(skeleton.offsets[1:], (FRAMES, 1, 1))
    )
    np.testing.assert_array_equal(parts["velocity"][:, 3:], 0.0)
    assert np.all(np.ptp(parts["velocity"][:, :3], axis=0) > 0.1)


def test_moving_and_turning_the_world_changes_nothing(skeleton):
    root, matrices = person.wander(FRAMES)
    position, yaw = person.wandering_bone(FRAMES)
    before = pose_vectors(
        skeleton, person.motion(root, matrices), person.path(position, yaw)
    )
    matrix, shift = person.about_y(2.0), np.array([1.0, 0.0, -2.0])
    moved = matrices.copy()
    moved[:, 0] = matrix @ matrices[:, 0]
    ground = np.insert(position, 1, 0.0, axis=-1) @ matrix.T + shift
    after = pose_vectors(
        skeleton,
        person.motion(root @ matrix.T + shift, moved),
        person.path(ground[:, [0, 2]], yaw + 2.0),
    )
    np.testing.assert_allclose(after, before, atol=3e-4)


def test_height_of_the_root_is_above_the_ground(skeleton):
    parts = parts_of_walk(skeleton, [0.0, 0.0, 0.0])
    np.testing.assert_allclose(
        parts["position"][:, :3], np.tile([0, 0.9, 0], (FRAMES, 1)), atol=1e-6
    )


def test_constant_walk_has_exactly_its_velocity(skeleton):
    forward = 1.3 * np.array([np.sin(0.7), 0.0, np.cos(0.7)])
    left = 0.4 * np.array([np.cos(0.7), 0.0, -np.sin(0.7)])
    parts = parts_of_walk(skeleton, forward + left)
    expected = np.tile([0.4, 0.0, 1.3], (FRAMES, 1))
    np.testing.assert_allclose(parts["root_velocity"], expected, atol=5e-5)
    for name in ("velocity", "angular_velocity", "root_angular_velocity"):
        np.testing.assert_allclose(parts[name], 0.0, atol=5e-5, err_msg=name)


@pytest.mark.parametrize("rate", [1.5, -4.0])
def test_constant_turn_has_exactly_its_rate(skeleton, rate):
    # Fast enough for the yaw to pass half a turn.
    heading = np.sign(rate) * 2.8
    parts = parts_of_walk(skeleton, [0.0, 0.0, 0.0], rate, heading)
    expected = np.tile([0.0, rate, 0.0], (FRAMES, 1))
    np.testing.assert_allclose(parts["root_angular_velocity"], expected, atol=1e-4)
    for name in ("velocity", "angular_velocity", "root_velocity"):
        np.testing.assert_allclose(parts[name], 0.0, atol=1e-4, err_msg=name)


def test_circle_goes_straight_ahead_in_its_own_axes(skeleton):
    fps, rate, radius = 60.0, 2.0, 0.7
    yaw = 0.3 + rate * np.arange(FRAMES) / fps
    center = np.array([1.0, 0.9, 2.0])
    root = center + radius * np.stack([-np.cos(yaw), 0 * yaw, np.sin(yaw)], axis=-1)
    vectors = pose_vectors(
        skeleton,
        person.motion(root, person.upright(root, yaw), fps),
        person.path(root[:, [0, 2]], yaw),
    )
    parts = described(vectors)
    chord = radius * np.sin(rate / fps) * fps
    np.testing.assert_allclose(
        parts["root_velocity"][1:-1], np.tile([0, 0, chord], (FRAMES - 2, 1)), atol=1e-4
    )
    np.testing.assert_allclose(
        parts["root_angular_velocity"], np.tile([0, rate, 0], (FRAMES, 1)), atol=1e-4
    )


def test_joint_that_turns_steadily_has_its_rate_in_the_axes_of_its_parent(skeleton):
    time = np.arange(FRAMES) / 60.0
    spin, start = np.array([1.0, -2.0, 0.5]), Rotation.from_rotvec([0.4, 0.9, -1.2])
    root = np.tile([0.0, 0.9, 0.0], (FRAMES, 1))
    matrices = person.upright(root, 0.3 + time)
    turns = Rotation.from_rotvec(np.multiply.outer(time, spin)) * start
    matrices[:, 1] = turns.as_matrix()
    bone = person.path(root[:, [0, 2]], 0 * time)
    parts = described(pose_vectors(skeleton, person.motion(root, matrices), bone))
    found = parts["angular_velocity"].reshape(FRAMES, 6, 3)
    np.testing.assert_allclose(found[:, 1], np.tile(spin, (FRAMES, 1)), atol=2e-4)
    # The first joint turns against its bone, which stands.
    np.testing.assert_allclose(found[:, 0], np.tile([0, 1, 0], (FRAMES, 1)), atol=2e-4)


def test_steady_acceleration_is_extrapolated_exactly_at_the_ends(skeleton):
    time = np.arange(FRAMES) / 60.0
    root = np.stack([0 * time, 0.9 + 4.0 * time**2, 0 * time], axis=-1)
    motion = person.motion(root, person.upright(root, 0 * time))
    parts = described(
        pose_vectors(skeleton, motion, person.path(root[:, [0, 2]], 0 * time))
    )
    np.testing.assert_allclose(parts["velocity"][:, 1], 8.0 * time, atol=2e-4)


def test_three_frames_are_enough_and_two_are_not(skeleton):
    root, matrices = person.wander(3)
    position, yaw = person.wandering_bone(3)
    found = pose.pose_vectors(
        skeleton, person.motion(root, matrices), person.path(position, yaw)
    )
    assert found.shape == (3, 98)
    assert np.all(np.isfinite(found))
    short = person.motion(root[:2], matrices[:2])
    with pytest.raises(ValueError, match="frames"):
        pose.pose_vectors(skeleton, short, person.path(position[:2], yaw[:2]))


@pytest.mark.parametrize("feet", [(), (2,), (2, 4, 5)])
def test_feet_that_are_not_two_are_refused(feet):
    root, matrices = person.wander(5)
    with pytest.raises(ValueError, match="feet"):
        pose.pose_vectors(
            person.skeleton(feet=feet),
            person.motion(root, matrices),
            person.path(*person.wandering_bone(5)),
        )


# --- contacts --------------------------------------------------------------------


@pytest.mark.parametrize(
    ("velocity", "stands"),
    [
        ([0.14, 0, 0], 1.0),
        ([0.16, 0, 0], 0.0),
        ([0, 0.16, 0], 0.0),
        ([0.1, 0.1, 0.1], 0.0),
    ],
)
def test_toe_stands_below_15_cm_a_second_in_space(skeleton, velocity, stands):
    parts = parts_of_walk(skeleton, velocity)
    np.testing.assert_array_equal(parts["contact"], np.full((FRAMES, 2), stands))


def contacts_of_steps(skeleton, moving):
    """Found and expected contacts when the legs turn in some steps [F-1, 2]."""
    count = len(moving) + 1
    lever = np.linalg.norm(person.OFFSETS[2])
    angles = np.zeros((count, 2))
    angles[1:] = np.cumsum(np.where(moving, 0.8 / 60 / lever, 0.0), axis=0)
    root = np.tile([0.0, 0.9, 0.0], (count, 1))
    matrices = person.upright(root, np.zeros(count))
    for side, joint in enumerate((1, 3)):
        vectors = np.multiply.outer(angles[:, side], [1.0, 0.0, 0.0])
        matrices[:, joint] = Rotation.from_rotvec(vectors).as_matrix()
    bone = np.zeros((count, 2)), np.zeros(count)
    found = pose_vectors(skeleton, person.motion(root, matrices), person.path(*bone))
    expected = reference.pose_parts(
        person.OFFSETS,
        person.PARENTS,
        person.FEET,
        root,
        matrices,
        bone[0],
        person.directions(bone[1]),
        60.0,
    )
    return described(found)["contact"], expected["contact"]


@pytest.mark.parametrize("seed", range(3))
def test_contacts_are_the_median_of_six_frames(skeleton, seed):
    generator = np.random.default_rng(seed)
    columns = []
    for side in range(2):
        runs = generator.integers(1, 8, 40)
        column = np.repeat((np.arange(40) + side) % 2 == 0, runs)[:90]
        columns.append(np.concatenate([np.full(6, side == 0), column]))
    found, expected = contacts_of_steps(skeleton, np.stack(columns, axis=-1))
    assert 10 < expected[:, 0].sum() < 80
    assert np.any(expected[:, 0] != expected[:, 1])
    np.testing.assert_array_equal(found, expected)


def test_short_interruptions_of_contacts_and_of_steps_vanish(skeleton):
    # The left toe stands but for one step, the right one moves but for two.
    moving = np.zeros((96, 2), bool)
    moving[20, 0] = True
    moving[:, 1] = True
    moving[20:22, 1] = False
    found, _ = contacts_of_steps(skeleton, moving)
    np.testing.assert_array_equal(found, np.tile([1.0, 0.0], (97, 1)))


# --- kinematics ------------------------------------------------------------------


def test_character_transforms_agree_with_products_of_matrices():
    generator = np.random.default_rng(1)
    position = generator.normal(size=(2, 3, 6, 3))
    rot6d = generator.normal(size=(2, 3, 6, 6))
    places, turns = pose.character_transforms(
        person.PARENTS, float32(position), float32(rot6d)
    )
    for index in np.ndindex(2, 3):
        expected = reference.character_matrices(
            person.PARENTS, position[index], rot6d[index]
        )
        np.testing.assert_allclose(places[index], expected[:, :3, 3], atol=1e-5)
        np.testing.assert_allclose(turns[index], expected[:, :3, :3], atol=1e-5)


def test_character_transforms_of_a_clip_are_its_joints_seen_from_the_bone(skeleton):
    root, matrices = person.wander(FRAMES)
    motion = person.motion(root, matrices)
    position, yaw = person.wandering_bone(FRAMES)
    parts = described(pose_vectors(skeleton, motion, person.path(position, yaw)))
    places, turns = pose.character_transforms(
        person.PARENTS,
        float32(parts["position"]).reshape(FRAMES, 6, 3),
        float32(parts["rotation"]).reshape(FRAMES, 6, 6),
    )
    world = np.asarray(tiny.positions(skeleton, motion), np.float64)
    _, world_turns = global_transforms(
        skeleton, motion.root_position, motion.joint_rotation
    )
    for f in range(FRAMES):
        matrix = person.about_y(yaw[f])
        from_bone = world[f] - np.array([position[f, 0], 0.0, position[f, 1]])
        np.testing.assert_allclose(places[f], from_bone @ matrix, atol=1e-5)
        np.testing.assert_allclose(
            turns[f], matrix.T @ np.asarray(world_turns[f]), atol=1e-5
        )


# --- the way back ----------------------------------------------------------------


def test_placing_poses_at_their_bones_gives_the_motion(skeleton):
    root, matrices = person.wander(FRAMES)
    motion = person.motion(root, matrices)
    bone = person.wandering_bone(FRAMES)
    vectors = pose_vectors(skeleton, motion, person.path(*bone))
    found, rot6d = pose.place(vectors, person.frames(*bone), num_joints=6)
    np.testing.assert_allclose(found, motion.root_position, atol=1e-5)
    np.testing.assert_allclose(rot6d, motion.joint_rotation, atol=1e-5)


def test_place_ignores_the_bones_velocities_and_contacts_of_a_pose():
    vectors = np.random.default_rng(2).normal(size=(4, 5, 98))
    bone = person.wandering_bone(5)
    frame = jax.tree.map(
        lambda a: jnp.broadcast_to(a, (4, *a.shape)), person.frames(*bone)
    )
    before = pose.place(float32(vectors), frame, num_joints=6)
    assert before[0].shape == (4, 5, 3)
    assert before[1].shape == (4, 5, 6, 6)
    vectors[..., 3:18] += 1.0
    vectors[..., 54:] += 1.0
    after = pose.place(float32(vectors), frame, num_joints=6)
    np.testing.assert_array_equal(after[0], before[0])
    np.testing.assert_array_equal(after[1], before[1])


def test_advance_is_one_euler_step():
    generator = np.random.default_rng(4)
    position, yaw = generator.normal(size=(7, 2)), generator.uniform(-3, 3, 7)
    move, spin = generator.normal(size=(2, 7, 3)) * 4.0
    found = pose.advance_frame(
        person.frames(position, yaw), float32(move), float32(spin), fps=30.0
    )
    for i in range(7):
        origin, facing = reference.advance(
            position[i], person.directions(yaw[i]), move[i], spin[i], 30.0
        )
        np.testing.assert_allclose(found.origin[i], origin, atol=2e-6)
        np.testing.assert_allclose(found.facing[i], facing, atol=2e-6)


def test_vertical_velocity_and_tilting_do_not_move_the_bone():
    frame = person.frames([1.0, 2.0], 0.4)
    found = pose.advance_frame(
        frame, float32([0, 3.0, 0]), float32([2.0, 0, -1.0]), fps=60.0
    )
    np.testing.assert_allclose(found.origin, frame.origin, atol=1e-6)
    np.testing.assert_allclose(found.facing, frame.facing, atol=1e-6)


def motion_of(vectors, start, *, num_joints, fps):
    bone = pose.integrate_root(vectors, start, num_joints=num_joints, fps=fps)
    root, rot6d = pose.place(vectors, bone, num_joints=num_joints)
    return Motion(root_position=root, joint_rotation=rot6d, fps=fps)


def test_motion_of_poses_follows_the_integrated_bone():
    vectors = np.random.default_rng(5).normal(size=(10, 98))
    start = np.array([0.5, -1.0]), 0.8
    found = motion_of(float32(vectors), person.frames(*start), num_joints=6, fps=30.0)
    origin, facing = reference.integrate(
        start[0],
        person.directions(start[1]),
        vectors[:, 90:93],
        vectors[:, 93:96],
        30.0,
    )
    for f in range(10):
        bone = reference.bone_matrix(origin[f], facing[f])
        local = reference.character_matrices(
            (-1,), vectors[f, :3][None], vectors[f, 18:24][None]
        )
        world = bone @ local[0]
        np.testing.assert_allclose(found.root_position[f], world[:3, 3], atol=1e-5)
        six = np.concatenate([world[:3, 0], world[:3, 1]])
        np.testing.assert_allclose(found.joint_rotation[f, 0], six, atol=1e-5)


def round_trip_error(skeleton, fps):
    """Largest error of root position and rotation within half a second."""
    count = int(0.5 * fps) + 1
    motion = person.motion(*person.wander(count, fps), fps)
    position, yaw = person.wandering_bone(count, fps)
    vectors = pose_vectors(skeleton, motion, person.path(position, yaw))
    start = person.frames(position[0], yaw[0])
    found = motion_of(vectors, start, num_joints=6, fps=fps)
    np.testing.assert_allclose(
        found.joint_rotation[:, 1:], motion.joint_rotation[:, 1:], atol=1e-5
    )
    np.testing.assert_allclose(
        found.root_position[0], motion.root_position[0], atol=1e-5
    )
    return np.array(
        [
            np.abs(found.root_position - motion.root_position).max(),
            np.abs(found.joint_rotation - motion.joint_rotation).max(),
        ]
    )


def test_error_of_the_round_trip_shrinks_with_the_rate(skeleton):
    errors = np.array([round_trip_error(skeleton, fps) for fps in (30.0, 60.0)])
    assert np.all(errors[1] < 0.65 * errors[0])
    assert np.all(errors[1] < 0.02)


def test_straight_walk_survives_the_round_trip(skeleton):
    time = np.arange(FRAMES) / 60.0
    root = np.multiply.outer(time, [0.8, 0.0, -1.1]) + np.array([0.2, 0.9, -0.3])
    motion = person.motion(root, person.upright(root, 0 * time + 2.5))
    bone = root[:, [0, 2]], 0 * time + 2.5
    vectors = pose_vectors(skeleton, motion, person.path(*bone))
    start = person.frames(bone[0][0], bone[1][0])
    found = motion_of(vectors, start, num_joints=6, fps=60.0)
    np.testing.assert_allclose(found.root_position, root, atol=2e-4)
    np.testing.assert_allclose(found.joint_rotation, motion.joint_rotation, atol=1e-4)


# --- points over the ground --------------------------------------------------------


def test_points_that_stand_in_the_world_do_not_move(skeleton):
    position, yaw = person.wandering_bone(FRAMES)
    root, matrices = person.wander(FRAMES)
    vectors = pose_vectors(
        skeleton, person.motion(root, matrices), person.path(position, yaw)
    )
    bone = pose.integrate_root(
        vectors, person.frames(position[0], yaw[0]), num_joints=6, fps=60.0
    )
    marks = np.random.default_rng(6).normal(size=(3, 3))
    inverse = [
        np.linalg.inv(reference.bone_matrix(o, f))
        for o, f in zip(*map(np.asarray, (bone.origin, bone.facing)), strict=True)
    ]
    points = np.array([marks @ m[:3, :3].T + m[:3, 3] for m in inverse])
    found = pose.point_velocities(vectors, float32(points), num_joints=6, fps=60.0)
    np.testing.assert_allclose(found, 0.0, atol=2e-3)


def test_points_that_go_with_the_bone_move_as_it_does():
    vectors = np.zeros((2, 4, 98))
    vectors[..., 90], vectors[..., 92] = 0.3, -0.7
    points = np.broadcast_to([0.4, 1.2, -0.1], (2, 4, 5, 3))
    found = pose.point_velocities(
        float32(vectors), float32(points), num_joints=6, fps=30.0
    )
    assert found.shape == (2, 3, 5, 3)
    np.testing.assert_allclose(
        found, np.broadcast_to([0.3, 0.0, -0.7], found.shape), atol=1e-5
    )


# --- gradients -------------------------------------------------------------------


def all_finite(tree):
    return all(bool(jnp.all(jnp.isfinite(leaf))) for leaf in jax.tree.leaves(tree))


def test_gradients_of_kinematics_are_finite_without_rotations():
    def energy(position, rot6d):
        places, turns = pose.character_transforms(person.PARENTS, position, rot6d)
        return jnp.sum(jnp.sin(places)) + jnp.sum(jnp.sin(turns))

    zeros = jnp.zeros((2, 6, 3)), jnp.zeros((2, 6, 6))
    slope = jax.jit(jax.grad(energy, argnums=(0, 1)))
    gradient = slope(*zeros)
    assert all_finite(gradient)
    assert float(jnp.abs(gradient[0]).sum()) > 0.0
    offsets = float32(np.tile(person.OFFSETS, (2, 1, 1)))
    assert all_finite(slope(offsets, zeros[1]))


def test_gradients_of_placing_are_finite_without_rotations():
    def energy(vectors, origin, facing):
        frame = person.PlanarFrame(origin=origin, facing=facing)
        found = pose.place(vectors, frame, num_joints=6)
        return sum(jnp.sum(jnp.sin(leaf)) for leaf in found)

    bone = person.frames(*person.wandering_bone(2))
    gradient = jax.jit(jax.grad(energy, argnums=(0, 1, 2)))(
        jnp.zeros((2, 98)), bone.origin, bone.facing
    )
    assert all_finite(gradient)


def test_gradients_of_the_integration_are_finite_for_a_standing_pose():
    start = person.frames([0.0, 0.0], 0.0)

    def energy(vectors):
        found = motion_of(vectors, start, num_joints=6, fps=60.0)
        return jnp.sum(found.root_position) + jnp.sum(found.joint_rotation)

    gradient = jax.jit(jax.grad(energy))(jnp.zeros((5, 98)))
    assert all_finite(gradient)
    # A pose's velocity leads up to it: the first one's has no effect.
    expected = np.array([0.0, 4.0, 3.0, 2.0, 1.0]) / 60.0
    np.testing.assert_allclose(gradient[:, 90], expected, atol=1e-5)
