"""Features of HumanML3D and KIT-ML from joint positions, and back.

A clip of F frames of J joints gives F - 1 vectors. With q[t] the rotation about +y that
turns the facing of frame t onto +z, p[t] the joints and r[t] the root, one vector has

    root_yaw_velocity  1          half the angle of q[t+1] q[t]^-1, radians a frame
    root_velocity      2          q[t+1] (r[t+1] - r[t]), x and z, a frame
    root_height        1
    joint_position     3 (J - 1)  q[t] p[t], root at x = z = 0; all joints but the root
    joint_rotation     6 (J - 1)  two columns each, from the chains (below)
    joint_velocity     3 J        q[t] (p[t+1] - p[t]), a frame
    contact            4          whether ankle and foot stand, left then right, 0 or 1

that is 12 J - 1 numbers: 263 for the 22 joints of HumanML3D, 251 for the 21 of KIT-ML.

`canonical_joints` comes first: lowest joint of the clip on the floor, root of frame 0
above the origin, frame 0 faces +z. A pose faces up x across, with across from left to
right. The facing of the later frames is smoothed along time, that of frame 0 is +z by
definition, so the first step of the yaw also holds what the smoothing did to frame 0.

Rotations: W[j] is the smallest rotation from the rest direction of joint j's own bone
(from its parent to it) to where it points in the canonical world. A chain starts with
the root's q and then has the W of its joints; a joint's rotation is the inverse of its
predecessor in the chain times its W. As published, the chains of the arms start with q
too, and q is the *inverse* of the body's yaw: the rotation of a chain's first joint
depends on the heading.

Source: Guo et al. 2022 (HumanML3D), released code. Differs in two places, known
mistakes that stayed because data were published with them (issues 107 and 156 of the
repository): there the facing over the clip has left and right hip swapped
(`hip_weight=-1` does that), and the yaw velocity changes its sign in the frame in which
the facing passes -z, so that the way back takes a wrong turn there. The bodies' sizes
are not made equal here.
"""

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxmotion.motion import ground, rotation
from jaxmotion.motion.features import pack, unpack
from jaxmotion.motion.humanml_layout import Layout

FACING_SIGMA = 20.0  # frames; of the filter on the facing


@jax.jit
def minimal_swing(
    start: Float[Array, "*#batch 3"], end: Float[Array, "*batch 3"]
) -> Float[Array, "*batch 3 3"]:
    """Smallest rotation that turns one unit vector onto another.

    Opposite ones turn about some axis at right angles.
    """
    axis = jnp.eye(3, dtype=start.dtype)[jnp.argmin(jnp.abs(start), axis=-1)]
    start, half_turn = jnp.broadcast_arrays(start, jnp.cross(start, axis), end)[:2]
    # The quaternion (1 + s.e, s x e) by the sum of both, which keeps its digits where
    # they are nearly opposite.
    both = start + end
    square = jnp.sum(both * both, axis=-1, keepdims=True)
    w = 0.5 * square
    swing = jnp.concatenate([w, jnp.cross(start, both)], axis=-1)
    half_turn = jnp.concatenate([jnp.zeros_like(w), half_turn], axis=-1)
    return rotation.matrix_from_quaternion(jnp.where(square < 1e-10, half_turn, swing))


def _turned(turn, vector: Array, facing: Array) -> Array:
    """Vectors [..., 3] with `turn` on the ground and their own heights."""
    facing = jnp.broadcast_to(facing, (*vector.shape[:-1], 2))
    planar = turn(vector[..., ::2], facing)
    return jnp.stack([planar[..., 0], vector[..., 1], planar[..., 1]], axis=-1)


def _forward(joints: Array, layout: Layout, hip_weight: float) -> Array:
    """Ground part (x, z) of up x across, with across a unit vector in space."""
    (right_hip, left_hip), (right, left) = layout.hips, layout.shoulders
    hips = joints[..., right_hip, :] - joints[..., left_hip, :]
    shoulders = joints[..., right, :] - joints[..., left, :]
    across = rotation.safe_normalize(
        hip_weight * hips + shoulders, jnp.array([-1.0, 0.0, 0.0], joints.dtype)
    )
    return jnp.stack([across[..., 2], -across[..., 0]], axis=-1)


def _smooth(signal: Array) -> Array:
    """Gaussian filter along the frames of [..., F, 2]; the ends are held."""
    radius = int(4.0 * FACING_SIGMA + 0.5)
    weight = np.exp(-0.5 * (np.arange(-radius, radius + 1) / FACING_SIGMA) ** 2)
    weight = jnp.asarray(weight / weight.sum(), signal.dtype)
    rows = jnp.swapaxes(signal, -1, -2)
    flat = rows.reshape(-1, rows.shape[-1])
    padded = jnp.pad(flat, ((0, 0), (radius, radius)), mode="edge")
    filtered = jax.vmap(
        lambda row: jnp.convolve(row, weight, mode="valid", precision="highest")
    )(padded)
    return jnp.swapaxes(filtered.reshape(rows.shape), -1, -2)


@jax.jit
def canonical_joints(
    joints: Float[Array, "*batch frames joints 3"], layout: Layout
) -> Float[Array, "*batch frames joints 3"]:
    """Moves clips to the origin, onto the floor, and turns frame 0 to +z.

    World positions, y up; a second call changes nothing.

    Source: Guo et al. 2022 (HumanML3D), released code.
    """
    if joints.shape[-2] != layout.num_joints:
        raise ValueError(
            f"positions of {joints.shape[-2]} joints, expected {layout.num_joints}"
        )
    floor = jnp.min(joints[..., 1], axis=(-2, -1))
    root = joints[..., 0, 0, :]
    origin = jnp.stack([root[..., 0], floor, root[..., 2]], axis=-1)
    facing = ground.unit(_forward(joints[..., 0, :, :], layout, 1.0))
    moved = joints - origin[..., None, None, :]
    return _turned(ground.into_frame, moved, facing[..., None, None, :])


def _facings(joints: Array, layout: Layout) -> Array:
    """Facing (x, z) of each frame of canonical joints."""
    smooth = ground.unit(_smooth(_forward(joints, layout, layout.hip_weight)))
    return smooth.at[..., 0, :].set(jnp.array([0.0, 1.0], joints.dtype))


def _chain_rotations(joints: Array, facing: Array, layout: Layout) -> Array:
    """Rotations [..., F, J - 1, 6] of canonical joints along the chains."""
    parents = jnp.array(layout.parents[1:])
    rest = jnp.array(layout.raw_offsets[1:], joints.dtype)
    segments = joints[..., 1:, :] - joints[..., parents, :]
    segments = rotation.safe_normalize(
        segments, jnp.array([0.0, 1.0, 0.0], joints.dtype)
    )
    world = minimal_swing(rest, segments)
    start = jnp.swapaxes(rotation.matrix_from_facing(facing), -1, -2)
    every = jnp.concatenate([start[..., None, :, :], world], axis=-3)
    # A chain's first joint follows the root, wherever the chain starts.
    first = {chain[1] for chain in layout.chains}
    before = [0 if j in first else p for j, p in enumerate(layout.parents)][1:]
    inverse = jnp.swapaxes(every[..., jnp.array(before), :, :], -1, -2)
    return rotation.rot6d_from_matrix(rotation.product(inverse, world))


@jax.jit
def features_from_joints(
    joints: Float[Array, "*batch frames joints 3"], layout: Layout
) -> Float[Array, "*batch frames-1 features"]:
    """Features of clips, not normalized, a vector per frame but for the last one.

    World positions, y up, at the frame rate of the data set; need not be canonical.

    Source: Guo et al. 2022 (HumanML3D), released code.
    """
    if joints.shape[-3] < 2:
        raise ValueError(f"{joints.shape[-3]} frames, expected at least 2")
    joints = canonical_joints(joints, layout)
    facing = _facings(joints, layout)
    step = joints[..., 1:, :, :] - joints[..., :-1, :, :]
    turn = ground.angle_from_to(facing[..., :-1, :], facing[..., 1:, :])
    root = joints[..., :1, :].at[..., 1].set(0.0)
    local = _turned(ground.into_frame, joints - root, facing[..., None, :])
    velocity = _turned(ground.into_frame, step, facing[..., :-1, None, :])
    way = jnp.sum(step[..., jnp.array(layout.feet), :] ** 2, axis=-1)
    flat = lambda x: x.reshape(*x.shape[:-2], -1)  # noqa: E731
    parts = {
        "root_yaw_velocity": -0.5 * turn[..., None],
        "root_velocity": ground.into_frame(step[..., 0, ::2], facing[..., 1:, :]),
        "root_height": joints[..., :-1, 0, 1:2],
        "joint_position": flat(local[..., :-1, 1:, :]),
        "joint_rotation": flat(
            _chain_rotations(joints, facing, layout)[..., :-1, :, :]
        ),
        "joint_velocity": flat(velocity),
        "contact": (way < layout.contact_threshold).astype(joints.dtype),
    }
    return pack(layout.channels, parts)


def _delayed(steps: Array) -> Array:
    """The steps [..., F, N] one frame later, after a first one of zero."""
    return jnp.concatenate([0.0 * steps[..., :1, :], steps[..., :-1, :]], axis=-2)


def _added(a: Array, b: Array) -> Array:
    """Half of a yaw and half of another, within a quarter turn of 0.

    A sum over minutes of turning would lose the digits that the path needs.
    """
    total = a + b
    turns = jnp.round(total / jnp.pi)
    # Pi in two parts, of which the first times a few turns is exact.
    return total - turns * 3.140625 - turns * (jnp.pi - 3.140625)


@jax.jit
def joints_from_features(
    features: Float[Array, "*batch frames features"], layout: Layout
) -> Float[Array, "*batch frames {layout.num_joints} 3"]:
    """Joint positions that features, not normalized, mean.

    The root of the first frame is above the origin and faces +z. Only the root's
    channels and `joint_position` count; the others repeat what is in them and may
    contradict it where a network has made them.

    Source: Guo et al. 2022 (HumanML3D), released code.
    """
    parts = unpack(layout.channels, features)
    half = jax.lax.associative_scan(
        _added, _delayed(parts["root_yaw_velocity"]), axis=features.ndim - 2
    )
    facing = jnp.concatenate([-jnp.sin(2.0 * half), jnp.cos(2.0 * half)], axis=-1)
    # A velocity is in the axes of the frame that it leads to.
    step = ground.out_of_frame(_delayed(parts["root_velocity"]), facing)
    x, z = jnp.moveaxis(jnp.cumsum(step, axis=-2), -1, 0)
    root = jnp.stack([x, parts["root_height"][..., 0], z], axis=-1)[..., None, :]
    local = parts["joint_position"].reshape(*features.shape[:-1], -1, 3)
    others = _turned(ground.out_of_frame, local, facing[..., None, :])
    others = others + root.at[..., 1].set(0.0)
    return jnp.concatenate([root, others], axis=-2)
