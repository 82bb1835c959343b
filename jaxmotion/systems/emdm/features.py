"""Motions of a skeleton as EMDM's features: rotations, and the root's way.

A frame is one 6D rotation (two rows) a joint and a pseudo-joint for the root, as in the
action-to-motion data of the released code. Ours: a motion starts at the ground's origin
facing +z; the pseudo-joint is (step in x, y, step in z, 0, 0, 0), since an error of a
step bends the path where one of a place would shake it; and features are standardized,
with one deviation for all rotations.
"""

import dataclasses

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxmotion.motion import features
from jaxmotion.motion.skeleton import Motion, Skeleton, joint_positions
from jaxmotion.systems.emdm.loss import Geometry


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True, kw_only=True, eq=False)
class Representation:
    """What turns motions of one skeleton into features and back."""

    skeleton: Skeleton
    normalizer: features.Normalizer
    fps: float = jax.tree.static()

    @property
    def num_features(self) -> int:
        """Channels of a frame."""
        return 6 * (self.skeleton.num_joints + 1)


def _raw(motion: Motion) -> Array:
    """Features before they are standardized; the first step is from the origin."""
    raw = features.motion_features(motion)
    place = raw[..., -6:-3]
    before = jnp.pad(place[..., :-1, :], [(0, 0)] * (place.ndim - 2) + [(1, 0), (0, 0)])
    root = (place - before).at[..., 1].set(place[..., 1])
    return jnp.concatenate([raw[..., :-6], root, raw[..., -3:]], axis=-1)


def fit(skeleton: Skeleton, motions: Motion, *, floor: float = 0.01) -> Representation:
    """Mean and deviation of features: of each root channel, one for all rotations.

    Motions, batch first, are from `features.to_first_pose`; the least deviation `floor`
    is in meters or entries of rotation matrices.
    """
    raw = _raw(motions)
    found = features.fit_normalizer(raw, floor=0.0)
    rotations = jnp.broadcast_to(jnp.mean(found.std[:-6]), (raw.shape[-1] - 6,))
    # The three zeros after the root's position stay zeros.
    root = jnp.concatenate([found.std[-6:-3], jnp.ones(3)])
    std = jnp.maximum(jnp.concatenate([rotations, root]), floor)
    return Representation(
        skeleton=skeleton,
        normalizer=features.Normalizer(mean=found.mean, std=std),
        fps=motions.fps,
    )


def to_features(
    motion: Motion, representation: Representation
) -> Float[Array, "*batch frames features"]:
    """Features (network's units) of motions moved by `features.to_first_pose`."""
    return features.normalize(representation.normalizer, _raw(motion))


def to_motion(
    x: Float[Array, "*batch frames features"], representation: Representation
) -> Motion:
    """Inverse of `to_features`, in meters.

    Rotations are made orthonormal, so features may come from a network.
    """
    raw = features.denormalize(representation.normalizer, x)
    step = raw[..., -6:-3]
    root = jnp.cumsum(step, axis=-2).at[..., 1].set(step[..., 1])
    raw = jnp.concatenate([raw[..., :-6], root, raw[..., -3:]], axis=-1)
    return features.motion_from_features(raw, representation.fps)


def geometry(representation: Representation, *, relative: bool) -> Geometry:
    """What the geometric losses need of a representation.

    Joint positions by forward kinematics, relative to the root as released, or else in
    the world; toes and their parents as feet; frame differences of rotations only, as
    released.
    """
    skeleton = representation.skeleton
    feet = [j for foot in skeleton.feet for j in (skeleton.parents[foot], foot)]

    def positions(x: Array) -> Array:
        motion = to_motion(x, representation)
        found = joint_positions(skeleton, motion)
        return found - found[..., :1, :] if relative else found

    return Geometry(
        positions=positions,
        feet=tuple(feet),
        channels=slice(0, representation.num_features - 6),
        fps=representation.fps,
    )
