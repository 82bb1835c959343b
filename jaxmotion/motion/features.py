"""Motion as flat features, their normalization, and changes of ground frame.

A network sees a frame as one vector, whose slices a `FeatureLayout` names. CAMDM's is
the 6D rotation of each joint followed by a pseudo-joint (x, y, z, 0, 0, 0) with the
root's position: (J + 1) * 6 numbers.
"""

import dataclasses
import functools
from collections.abc import Mapping
from typing import Literal

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxmotion.motion import ground, rotation
from jaxmotion.motion.skeleton import Motion, Skeleton
from jaxmotion.motion.trajectory import PlanarFrame, root_trajectory


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True, kw_only=True)
class FeatureLayout:
    """Names of the slices of a feature vector; hashable, and static under jit.

    Fields are (name, start, stop) of each slice, in order and without gaps.
    """

    fields: tuple[tuple[str, int, int], ...] = jax.tree.static()

    def __post_init__(self) -> None:
        expected, names = 0, set()
        for name, start, stop in self.fields:
            if name in names:
                raise ValueError(f"field {name!r} occurs twice")
            if start != expected or stop <= start:
                raise ValueError(
                    f"field {name!r} is {start}..{stop}, expected to start at "
                    f"{expected} and to hold at least one number"
                )
            names.add(name)
            expected = stop

    @property
    def size(self) -> int:
        """Length of the feature vector."""
        return self.fields[-1][2] if self.fields else 0


def feature_layout(**sizes: int) -> FeatureLayout:
    """Layout of fields that follow each other, with so many numbers (positive) each."""
    fields, start = [], 0
    for name, size in sizes.items():
        fields.append((name, start, start + size))
        start += size
    return FeatureLayout(fields=tuple(fields))


@functools.partial(jax.jit, static_argnames=("layout",))
def pack(
    layout: FeatureLayout, parts: Mapping[str, Float[Array, "*batch _"]]
) -> Float[Array, "*batch features"]:
    """Joins named parts, one of each field's size (else `ValueError`), into vectors."""
    names = [name for name, _, _ in layout.fields]
    if set(parts) != set(names):
        raise ValueError(f"parts are {sorted(parts)}, expected {sorted(names)}")
    for name, start, stop in layout.fields:
        if parts[name].shape[-1] != stop - start:
            raise ValueError(
                f"field {name!r} has {parts[name].shape[-1]} numbers, "
                f"expected {stop - start}"
            )
    return jnp.concatenate([parts[name] for name in names], axis=-1)


def unpack(
    layout: FeatureLayout, features: Float[Array, "*batch features"]
) -> dict[str, Float[Array, "*batch _"]]:
    """Inverse of `pack`; `ValueError` if the vectors are not of the layout's size."""
    if features.shape[-1] != layout.size:
        raise ValueError(
            f"features have {features.shape[-1]} numbers, expected {layout.size}"
        )
    return {name: features[..., start:stop] for name, start, stop in layout.fields}


RotationLayout = Literal["rows", "columns"]


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True, kw_only=True, eq=False)
class Normalizer:
    """An affine map to zero mean and unit deviation; `std` is at least the floor."""

    mean: Float[Array, " features"]
    std: Float[Array, " features"]


@jax.jit
def fit_normalizer(
    features: Float[Array, "*batch features"], *, floor: float | Array = 1e-4
) -> Normalizer:
    """Mean and standard deviation of each feature over all other axes.

    The least deviation `floor`, in the features' units, keeps constant channels finite
    (they map to zero).
    """
    rows = features.reshape(-1, features.shape[-1])
    mean = jnp.mean(rows, axis=0)
    # Two passes: the mean of squares would lose a small deviation on a large mean.
    variance = jnp.mean((rows - mean[None]) ** 2, axis=0)
    return Normalizer(mean=mean, std=jnp.maximum(jnp.sqrt(variance), floor))


def _like(vector: Array, x: Array) -> Array:
    return vector.reshape((1,) * (x.ndim - 1) + (-1,))


@jax.jit
def normalize(
    normalizer: Normalizer, x: Float[Array, "*batch features"]
) -> Float[Array, "*batch features"]:
    """Maps features from their own units to zero mean and unit deviation."""
    return (x - _like(normalizer.mean, x)) / _like(normalizer.std, x)


@jax.jit
def denormalize(
    normalizer: Normalizer, x: Float[Array, "*batch features"]
) -> Float[Array, "*batch features"]:
    """Inverse of `normalize`."""
    return x * _like(normalizer.std, x) + _like(normalizer.mean, x)


def _move(motion: Motion, facing: Array, before: Array, after: Array, turn) -> Motion:
    """Moves by `before`, turns all ground vectors, moves by `after`."""
    root = motion.root_position
    # The two columns of the root's rotation are vectors, and turn as vectors do.
    columns = motion.joint_rotation[..., 0, :].reshape(*root.shape[:-1], 2, 3)
    facing = facing[..., None, :]
    planar = turn(
        root[..., ::2] + before[..., None, :],
        jnp.broadcast_to(facing, (*root.shape[:-1], 2)),
    )
    planar = planar + after[..., None, :]
    turned = turn(
        columns[..., ::2],
        jnp.broadcast_to(facing[..., None, :], (*columns.shape[:-1], 2)),
    )
    columns = columns.at[..., ::2].set(turned)
    rot6d = columns.reshape(*root.shape[:-1], 6)
    return dataclasses.replace(
        motion,
        root_position=root.at[..., ::2].set(planar),
        joint_rotation=motion.joint_rotation.at[..., 0, :].set(rot6d),
    )


@jax.jit
def to_frame(motion: Motion, frame: PlanarFrame) -> Motion:
    """A world motion seen from a ground frame: origin at zero, facing along +z.

    Rigid: only the root's position and rotation change, heights stay. One frame serves
    the whole motion.
    """
    zero = jnp.zeros_like(frame.origin)
    return _move(motion, frame.facing, -frame.origin, zero, ground.into_frame)


def to_first_pose(skeleton: Skeleton, motion: Motion) -> Motion:
    """Moves motions (world) to the ground's origin facing +z; heights stay."""
    first = Motion(
        root_position=motion.root_position[..., :1, :],
        joint_rotation=motion.joint_rotation[..., :1, :, :],
        fps=motion.fps,
    )
    path = root_trajectory(skeleton, first)
    return to_frame(
        motion,
        PlanarFrame(origin=path.position[..., 0, :], facing=path.facing[..., 0, :]),
    )


@jax.jit
def from_frame(motion: Motion, frame: PlanarFrame) -> Motion:
    """Inverse of `to_frame`: the motion in the world."""
    zero = jnp.zeros_like(frame.origin)
    return _move(motion, frame.facing, zero, frame.origin, ground.out_of_frame)


def _check_layout(rotation_layout: str) -> None:
    if rotation_layout not in ("rows", "columns"):
        raise ValueError(
            f"rotation_layout is {rotation_layout!r}, expected 'rows' or 'columns'"
        )


@functools.partial(jax.jit, static_argnames=("rotation_layout",))
def motion_features(
    motion: Motion, *, rotation_layout: RotationLayout = "rows"
) -> Float[Array, "*batch frames features"]:
    """CAMDM's features: 6D of each joint, then the root as (x, y, z, 0, 0, 0).

    (J + 1) * 6 per frame; positions are in meters, and 6D is the first two "rows" of
    each matrix, as in the released code, or its first two "columns".

    Source: Chen et al. 2024 (CAMDM), sec. 3.1 and released code.
    """
    _check_layout(rotation_layout)
    rot6d, root = motion.joint_rotation, motion.root_position
    if rotation_layout == "rows":
        rot6d = rotation.rot6d_rows_to_columns(rot6d)
    pseudo = jnp.concatenate([root, jnp.zeros_like(root)], axis=-1)
    joints = jnp.concatenate([rot6d, pseudo[..., None, :]], axis=-2)
    return joints.reshape(*root.shape[:-1], -1)


@functools.partial(jax.jit, static_argnames=("fps", "rotation_layout"))
def motion_from_features(
    features: Float[Array, "*batch frames features"],
    fps: float,
    *,
    rotation_layout: RotationLayout = "rows",
) -> Motion:
    """Inverse of `motion_features`; any finite features give rotations (Gram-Schmidt).

    The last three of a frame's (J + 1) * 6 numbers are ignored; `ValueError` for other
    sizes.
    Source: Chen et al. 2024 (CAMDM), sec. 3.1 and released code.
    """
    _check_layout(rotation_layout)
    size = features.shape[-1]
    if size % 6 or size < 12:
        raise ValueError(f"{size} features, expected (joints + 1) * 6")
    joints = features.reshape(*features.shape[:-1], -1, 6)
    rot6d, root = joints[..., :-1, :], joints[..., -1, :3]
    if rotation_layout == "rows":
        rot6d = rotation.rot6d_rows_to_columns(rot6d)
    else:
        rot6d = rotation.rot6d_from_matrix(rotation.matrix_from_rot6d(rot6d))
    return Motion(root_position=root, joint_rotation=rot6d, fps=fps)
