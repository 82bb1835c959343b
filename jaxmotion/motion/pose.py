"""Poses as vectors: what a character is and does in one frame, seen from itself.

A *simulation bone* on the ground carries the character: a smooth path with a facing
(`data.simulation` makes it). With J joints a pose vector has, in this order,

    position              [J, 3]  local translations, meters
    rotation              [J, 6]  local rotations, two columns each
    velocity              [J, 3]  of the local translations, meters per second
    angular_velocity      [J, 3]  of the local rotations, radians per second
    root_velocity         [3]     of the bone, in its own axes, meters per second
    root_angular_velocity [3]     of the bone, in its own axes, radians per second
    contact               [2]     whether the left and the right toe stand, 0 or 1

that is 15 J + 8 numbers: 338 for LaFAN1's 22 joints. Joint 0 is local to the bone, the
others to their parents, whose translations are the bones of the skeleton and constant.

Source: Li et al. 2024 (AAMDM), section 3.6; the breakdown is that of orangeduck's
Learned Motion Matching, which it follows. Differs: a rotation's two columns lie after
each other here, interleaved there.
"""

import functools
import operator

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxmotion.motion import ground, rotation, rotation_vector
from jaxmotion.motion.features import FeatureLayout, feature_layout, pack, unpack
from jaxmotion.motion.skeleton import Motion, Skeleton, joint_positions
from jaxmotion.motion.trajectory import PlanarFrame, Trajectory

CONTACT_SPEED = 0.15  # meters per second
_CONTACT_FILTER = 6  # frames of the median at 60 frames per second


def pose_layout(num_joints: int) -> FeatureLayout:
    """Fields of a pose vector, 15 J + 8 features."""
    return feature_layout(
        position=3 * num_joints,
        rotation=6 * num_joints,
        velocity=3 * num_joints,
        angular_velocity=3 * num_joints,
        root_velocity=3,
        root_angular_velocity=3,
        contact=2,
    )


def _central(step: Float[Array, "steps *shape"]) -> Float[Array, "steps+1 *shape"]:
    """Central differences from steps between neighbors; ends are extrapolated."""
    middle = 0.5 * (step[1:] + step[:-1])
    if middle.shape[0] < 2:  # nothing to extrapolate from
        return jnp.concatenate([step[:1], middle, step[-1:]])
    first = 2.0 * middle[:1] - middle[1:2]
    last = 2.0 * middle[-1:] - middle[-2:-1]
    return jnp.concatenate([first, middle, last])


def _angular(matrix: Array, fps: float) -> Array:
    """Angular velocity in the axes of the parent, radians per second."""
    turn = rotation.product(matrix[1:], jnp.swapaxes(matrix[:-1], -1, -2))
    return _central(rotation_vector.from_matrix(turn) * fps)


def _contacts(skeleton: Skeleton, motion: Motion) -> Array:
    """Standing toes: slow ones, and the median of that over a tenth of a second."""
    feet = joint_positions(skeleton, motion)[:, jnp.array(skeleton.feet)]
    velocity = _central(jnp.diff(feet, axis=0) * motion.fps)
    stands = jnp.linalg.norm(velocity, axis=-1) < CONTACT_SPEED
    size = max(round(_CONTACT_FILTER * motion.fps / 60.0), 1)
    padded = jnp.pad(
        stands.astype(jnp.int32),
        ((size // 2, size - 1 - size // 2), (0, 0)),
        mode="edge",
    )
    # The upper median of an even number: half of them standing is enough.
    parts = [padded[i : i + len(stands)] for i in range(size)]
    return (2 * functools.reduce(operator.add, parts) >= size).astype(jnp.float32)


def _local(skeleton: Skeleton, motion: Motion, bone: Trajectory) -> tuple[Array, Array]:
    """Local translations [F, J, 3] and rotations [F, J, 3, 3]."""
    root = motion.root_position
    planar = ground.into_frame(root[:, ::2] - bone.position, bone.facing)
    hips = jnp.stack([planar[:, 0], root[:, 1], planar[:, 1]], axis=-1)
    bones = jnp.broadcast_to(skeleton.offsets, (len(root), *skeleton.offsets.shape))
    matrix = rotation.matrix_from_rot6d(motion.joint_rotation)
    facing = rotation.matrix_from_facing(bone.facing)
    turned = rotation.product(jnp.swapaxes(facing, -1, -2), matrix[:, 0])
    return bones.at[:, 0].set(hips), matrix.at[:, 0].set(turned)


@jax.jit
def pose_vectors(
    skeleton: Skeleton, motion: Motion, bone: Trajectory
) -> Float[Array, "frames features"]:
    """Pose vector, 15 J + 8 features, of every frame of a clip (world).

    Velocities are central differences, extrapolated at the clip's ends (of three
    frames, the first and the last step). Of the skeleton's two feet the left one is
    first.

    `ValueError` for fewer than three frames, or other than two feet.
    Source: Li et al. 2024 (AAMDM), section 3.6; Holden et al. 2020, released code.
    """
    frames, fps = motion.root_position.shape[0], motion.fps
    if frames < 3:
        raise ValueError(f"{frames} frames, expected at least 3 to have velocities")
    if len(skeleton.feet) != 2:
        raise ValueError(
            f"the skeleton has {len(skeleton.feet)} feet, expected the left and the "
            "right toe"
        )
    position, matrix = _local(skeleton, motion, bone)
    moved = _central(jnp.diff(bone.position, axis=0) * fps)
    planar = ground.into_frame(moved, bone.facing)
    turned = ground.angle_from_to(bone.facing[:-1], bone.facing[1:]) * fps
    zero = jnp.zeros(frames)
    flat = lambda x: x.reshape(frames, -1)  # noqa: E731
    parts = {
        "position": flat(position),
        "rotation": flat(rotation.rot6d_from_matrix(matrix)),
        "velocity": flat(_central(jnp.diff(position, axis=0) * fps)),
        "angular_velocity": flat(_angular(matrix, fps)),
        "root_velocity": jnp.stack([planar[:, 0], zero, planar[:, 1]], axis=-1),
        "root_angular_velocity": jnp.stack([zero, _central(turned), zero], axis=-1),
        "contact": _contacts(skeleton, motion),
    }
    return pack(pose_layout(skeleton.num_joints), parts)


def character_transforms(
    parents: tuple[int, ...],
    position: Float[Array, "*batch joints 3"],
    rot6d: Float[Array, "*batch joints 6"],
) -> tuple[Float[Array, "*batch joints 3"], Float[Array, "*batch joints 3 3"]]:
    """Joints in the axes of the simulation bone: forward kinematics of a pose vector.

    Unlike `skeleton.forward_kinematics` it takes the translations from the pose, so a
    network that predicts them is told how they move the joints after them.

    Translations are in meters; rotations, two columns each, are made orthonormal. Given
    are positions, meters, and rotation matrices.

    Source: F of Li et al. 2024 (AAMDM), eq. 1.
    """
    local = rotation.matrix_from_rot6d(rot6d)
    positions, turns = [position[..., 0, :]], [local[..., 0, :, :]]
    for joint, parent in enumerate(parents[1:], start=1):
        arm = rotation.product(turns[parent], position[..., joint, :, None])
        positions.append(positions[parent] + arm[..., 0])
        turns.append(rotation.product(turns[parent], local[..., joint, :, :]))
    return jnp.stack(positions, axis=-2), jnp.stack(turns, axis=-3)


def advance_frame(
    frame: PlanarFrame,
    velocity: Float[Array, "*batch 3"],
    angular_velocity: Float[Array, "*batch 3"],
    *,
    fps: float,
) -> PlanarFrame:
    """Moves the simulation bone (world) on by one frame.

    Both velocities are in its own axes, m/s and rad/s: of the one the horizontal part
    counts, of the other the vertical one.

    Source: Holden et al. 2020, released code: p += R v dt, R = exp(w dt) R.
    """
    step = ground.out_of_frame(velocity[..., ::2], frame.facing) / fps
    facing = ground.turn(frame.facing, angular_velocity[..., 1] / fps)
    return PlanarFrame(origin=frame.origin + step, facing=ground.unit(facing))


def point_velocities(
    poses: Float[Array, "*batch frames features"],
    points: Float[Array, "*batch frames points 3"],
    *,
    num_joints: int,
    fps: float,
) -> Float[Array, "*batch frames-1 points 3"]:
    """How fast points that poses carry move over the ground; planted feet do not.

    From each frame to the next, meters per second, in the axes of the former's bone,
    whose own movement counts, as `integrate_root` has it. The points are in the axes of
    each frame's simulation bone, meters, such as joints of `character_transforms`.
    """
    parts = unpack(pose_layout(num_joints), poses[..., 1:, :])
    moves = parts["root_velocity"], parts["root_angular_velocity"]
    here = jnp.zeros((*moves[0].shape[:-1], 2))
    still = PlanarFrame(origin=here, facing=here.at[..., 1].set(1.0))
    bone = advance_frame(still, *moves, fps=fps)
    after = points[..., 1:, :, :]
    facing = jnp.broadcast_to(bone.facing[..., None, :], after[..., ::2].shape)
    planar = bone.origin[..., None, :] + ground.out_of_frame(after[..., ::2], facing)
    where = jnp.stack([planar[..., 0], after[..., 1], planar[..., 1]], axis=-1)
    return (where - points[..., :-1, :, :]) * fps


@functools.partial(jax.jit, static_argnames=("num_joints",))
def place(
    poses: Float[Array, "*batch features"], frame: PlanarFrame, *, num_joints: int
) -> tuple[Float[Array, "*batch 3"], Float[Array, "*batch joints 6"]]:
    """Root positions, meters, and parent-local 6D columns of poses in the world.

    The fields of a `Motion`. Translations of other joints than the first are not used:
    a `Motion` has the bones of its skeleton.

    Source: Li et al. 2024 (AAMDM), section 3.6.
    """
    parts = unpack(pose_layout(num_joints), poses)
    hips = parts["position"][..., :3]
    planar = frame.origin + ground.out_of_frame(hips[..., ::2], frame.facing)
    root = jnp.stack([planar[..., 0], hips[..., 1], planar[..., 1]], axis=-1)
    rot6d = parts["rotation"].reshape(*poses.shape[:-1], num_joints, 6)
    matrix = rotation.matrix_from_rot6d(rot6d)
    facing = rotation.matrix_from_facing(frame.facing)
    turned = rotation.product(facing, matrix[..., 0, :, :])
    matrix = matrix.at[..., 0, :, :].set(turned)
    return root, rotation.rot6d_from_matrix(matrix)


def integrate_root(
    poses: Float[Array, "frames features"],
    frame: PlanarFrame,
    *,
    num_joints: int,
    fps: float,
) -> PlanarFrame:
    """Path (world) of the simulation bone that pose vectors mean, from its first frame.

    A pose's velocity is what leads to it: that of the first pose has no effect.

    Source: Holden et al. 2020, released code.
    """

    def step(frame: PlanarFrame, parts: tuple[Array, Array]) -> tuple:
        following = advance_frame(frame, *parts, fps=fps)
        return following, following

    parts = unpack(pose_layout(num_joints), poses[1:])
    moves = (parts["root_velocity"], parts["root_angular_velocity"])
    _, rest = jax.lax.scan(step, frame, moves)
    return jax.tree.map(lambda a, b: jnp.concatenate([a[None], b]), frame, rest)
