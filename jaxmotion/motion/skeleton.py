"""The skeleton, motions of it, and forward kinematics.

A pose is a root position in the world and one parent-local rotation a joint. With
parent p of joint j (column vectors):

    R_g[0] = R[0]           p[0] = root position
    R_g[j] = R_g[p] R[j]    p[j] = p[p] + R_g[p] offset[j]

Units: meters, seconds; world axes y up, right-handed.
"""

import dataclasses
import functools
import operator
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxmotion.motion import rotation

# Beyond it float32 resolves 6 cm at best: no position of a character.
MAX_METERS = 1e6


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True, kw_only=True, eq=False)
class Skeleton:
    """Bones of one character.

    Attributes:
      offsets: Joint position in its parent's frame, meters. The root's is unused.
      parents: Parent of each joint; -1 for the root, else smaller than the joint.
      feet: Joints whose contact with the ground counts (toes, left before right).
    """

    offsets: Float[Array, "joints 3"]
    parents: tuple[int, ...] = jax.tree.static()
    names: tuple[str, ...] = jax.tree.static()
    feet: tuple[int, ...] = jax.tree.static(default=())

    @property
    def num_joints(self) -> int:
        """Number of joints."""
        return len(self.parents)

    def index(self, name: str) -> int:
        """Index of the joint of that name; a `ValueError` names those there are."""
        if name not in self.names:
            raise ValueError(
                f"unknown joint {name!r}: the skeleton has {', '.join(self.names)}"
            )
        return self.names.index(name)


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True, kw_only=True, eq=False)
class Motion:
    """Frames of one character (or, with leading axes, of many).

    Attributes:
      root_position: World position of the root joint, meters, y up.
      joint_rotation: Parent-local rotations as two columns; the root's is global.
    """

    root_position: Float[Array, "*batch frames 3"]
    joint_rotation: Float[Array, "*batch frames joints 6"]
    fps: float = jax.tree.static(default=30.0)

    # Indexed, never looped over: `jnp.stack(motion)` should raise.
    __iter__ = None

    def __getitem__(self, index: int | slice | Array | tuple) -> "Motion":
        """The motion at an index of the leading axes, such as `motions[0]`."""
        return jax.tree.map(lambda x: x[index], self)


def check_parents(parents: tuple[int, ...]) -> None:
    """Raises `ValueError` unless parents come before joints and joint 0 is the root."""
    for joint, parent in enumerate(parents):
        expected = parent == -1 if joint == 0 else 0 <= parent < joint
        if not expected:
            rule = "-1 (joint 0 is the root)" if joint == 0 else f"in 0..{joint - 1}"
            raise ValueError(f"parent of joint {joint} is {parent}, expected {rule}")


def check_skeleton(*, offsets: Any, parents: Any, names: Any, feet: Any) -> None:
    """Raises unless values, which may come from a file, are fields of a `Skeleton`.

    A `ValueError` names the field, what was expected and what was found.
    """
    for field, values in (("parents", parents), ("feet", feet)):
        for value in values:
            if type(value) is not int:
                raise ValueError(f"{field} should be whole numbers, found {value!r}")
    if not parents:
        raise ValueError("parents: expected at least one joint, found none")
    check_parents(tuple(parents))
    count = len(parents)
    try:
        found = np.asarray(offsets, np.float64)
    except (TypeError, ValueError, OverflowError):
        raise ValueError(f"offsets should be {count} rows of 3 numbers") from None
    if found.shape != (count, 3):
        raise ValueError(f"offsets have shape {found.shape}, expected {(count, 3)}")
    if not (np.abs(found) <= MAX_METERS).all():
        joint = int(np.argwhere(~(np.abs(found) <= MAX_METERS))[0, 0])
        raise ValueError(
            f"offset of joint {joint} is {found[joint].tolist()}, expected numbers "
            f"within {MAX_METERS:g} m"
        )
    if len(names) != count:
        raise ValueError(f"{len(names)} names for {count} joints")
    for joint, name in enumerate(names):
        if not isinstance(name, str) or not name:
            raise ValueError(f"name of joint {joint} should be text, found {name!r}")
        if name in names[:joint]:
            raise ValueError(f"two joints have the name {name!r}")
    for foot in feet:
        if not 0 <= foot < count or list(feet).count(foot) > 1:
            raise ValueError(
                f"feet {list(feet)}: expected different joints in 0..{count - 1}"
            )


def _times(a: Array, b: Array) -> Array:
    """Product of matrices [rows, columns, batch]."""
    return functools.reduce(
        operator.add, (a[:, i, None] * b[None, i] for i in range(3))
    )


def _transposed(a: Array) -> Array:
    return jnp.swapaxes(a, 0, 1)


@functools.partial(jax.custom_vjp, nondiff_argnums=(0,))
def _chain(
    parents: tuple[int, ...], local: Array, offsets: Array
) -> tuple[Array, Array]:
    """Positions from the root and world rotations; the batch is the last axis.

    A plain loop over static parents. Its gradient is written out below, since the
    compiler's version of it recomputes the chain for every joint.
    """
    positions, rotations = [jnp.zeros_like(local[0, :, 0])], [local[0]]
    for joint, parent in enumerate(parents[1:], start=1):
        turn = rotations[parent]
        step = sum(turn[:, i] * offsets[joint, i] for i in range(3))
        positions.append(positions[parent] + step)
        rotations.append(_times(turn, local[joint]))
    return jnp.stack(positions), jnp.stack(rotations)


def _chain_forward(
    parents: tuple[int, ...], local: Array, offsets: Array
) -> tuple[tuple[Array, Array], tuple[Array, ...]]:
    places, turns = _chain(parents, local, offsets)  # pyright: ignore[reportGeneralTypeIssues]
    return (places, turns), (local, offsets, turns)


def _chain_backward(
    parents: tuple[int, ...], kept: tuple[Array, ...], given: tuple[Array, Array]
) -> tuple[Array, Array]:
    """From the leaves to the root: what moves a joint moves all joints below it."""
    local, offsets, rotations = kept
    push, twist = list(given[0]), list(given[1])
    of_local, of_offsets = list(local), [jnp.zeros_like(offsets[0])] * len(parents)
    for joint, parent in reversed(list(enumerate(parents))[1:]):
        back = _transposed(rotations[parent])
        of_local[joint] = _times(back, twist[joint])
        of_offsets[joint] = jnp.sum(_times(back, push[joint][:, None])[:, 0], axis=-1)
        bone = push[joint][:, None] * offsets[joint].reshape(1, 3, 1)
        twist[parent] += bone + _times(twist[joint], _transposed(local[joint]))
        push[parent] += push[joint]
    of_local[0] = twist[0]
    return jnp.stack(of_local), jnp.stack(of_offsets)


_chain.defvjp(_chain_forward, _chain_backward)


@jax.jit
def global_transforms(
    skeleton: Skeleton,
    root_position: Float[Array, "*batch 3"],
    joint_rotation: Float[Array, "*batch joints 6"],
) -> tuple[Float[Array, "*batch joints 3"], Float[Array, "*batch joints 3 3"]]:
    """World positions, meters, and world rotation matrices of all joints.

    Rotations are parent-local, two columns each, one a joint (else `ValueError`).
    Differentiable in reverse mode only: its gradient is written out.
    """
    if joint_rotation.shape[-2] != skeleton.num_joints:
        raise ValueError(
            f"joint_rotation has {joint_rotation.shape[-2]} joints, "
            f"the skeleton {skeleton.num_joints}"
        )
    batch = joint_rotation.shape[:-2]
    local = rotation.columns_from_rot6d(
        jnp.moveaxis(joint_rotation.reshape(-1, skeleton.num_joints, 6), (1, 2), (1, 0))
    )
    # [joints, rows, columns, batch]
    moved, turned = _chain(  # pyright: ignore[reportGeneralTypeIssues]
        skeleton.parents, jnp.moveaxis(local, 2, 0), skeleton.offsets
    )
    back = lambda x: jnp.moveaxis(x, -1, 0).reshape(*batch, *x.shape[:-1])  # noqa: E731
    positions = back(moved)
    return positions + root_position[..., None, :], back(turned)


def forward_kinematics(
    skeleton: Skeleton,
    root_position: Float[Array, "*batch 3"],
    joint_rotation: Float[Array, "*batch joints 6"],
) -> Float[Array, "*batch joints 3"]:
    """World positions of all joints, meters, as `global_transforms` has them.

    Source: Chen et al. 2024 (CAMDM), eq. 3.
    """
    return global_transforms(skeleton, root_position, joint_rotation)[0]


def joint_positions(
    skeleton: Skeleton, motion: Motion
) -> Float[Array, "*batch frames joints 3"]:
    """World positions, meters, of all joints in all frames of a motion."""
    return forward_kinematics(skeleton, motion.root_position, motion.joint_rotation)


def from_root(
    skeleton: Skeleton, joint_rotation: Float[Array, "*batch joints 6"], joint: int
) -> Float[Array, "*batch 3"]:
    """World vector, meters, from the root to a joint: kinematics of its own chain only.

    Rotations are parent-local, two columns each; the root's is global.
    """
    chain = []
    while joint > 0:
        chain.insert(0, joint)
        joint = skeleton.parents[joint]
    turn = rotation.matrix_from_rot6d(joint_rotation[..., 0, :])
    vector = jnp.zeros_like(turn[..., 0])
    for child in chain:
        parent = skeleton.parents[child]
        if parent > 0:
            own = rotation.matrix_from_rot6d(joint_rotation[..., parent, :])
            turn = rotation.product(turn, own)
        vector = vector + rotation.product(turn, skeleton.offsets[child])
    return vector
