"""From our skeletons to the 22 joints of HumanML3D, and from 22 joints to a motion.

The joints are the first 22 of SMPL. Other rigs have other spines, so a joint here is a
mean of theirs: positions of the 22 joints are a matrix times those of the rig.

The way back, for an export, is a fit: a skeleton whose bones have the mean lengths of
the clip, and rotations that aim them, each from where its joint has come to, so that
stretched bones do not add up along a limb. Positions do not tell how a bone turns about
itself: a joint with one child takes the smallest swing from its parent's frame;
pelvis and upper spine, with three children each, take the least-squares rotation of
their fan, whose shape is its mean over the clip.
"""

import functools

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxmotion.motion import rotation
from jaxmotion.motion.facing import plain_names
from jaxmotion.motion.humanml import minimal_swing
from jaxmotion.motion.humanml_layout import HUMANML3D
from jaxmotion.motion.rotation import product
from jaxmotion.motion.skeleton import Motion, Skeleton

SMPL_JOINTS = (
    *("pelvis", "left_hip", "right_hip", "spine1", "left_knee", "right_knee"),
    *("spine2", "left_ankle", "right_ankle", "spine3", "left_foot", "right_foot"),
    *("neck", "left_collar", "right_collar", "head", "left_shoulder"),
    *("right_shoulder", "left_elbow", "right_elbow", "left_wrist", "right_wrist"),
)
_TRUNK = ("pelvis", "spine1", "spine2", "spine3", "neck", "head")
_LIMBS = ("hip", "knee", "ankle", "foot", "collar", "shoulder", "elbow", "wrist")
_FEET = (10, 11)

# Rest directions of the bones: a T-pose. Those of the features would do, but have the
# head in front of the neck and a shoulder under its collar; arms along the sides also
# make the swing of a raised arm a half turn, whose axis is undefined.
_REST = np.array(HUMANML3D.raw_offsets, np.float32)
_REST[SMPL_JOINTS.index("head")] = (0.0, 1.0, 0.0)
for _joint in ("shoulder", "elbow", "wrist"):
    _REST[SMPL_JOINTS.index(f"left_{_joint}")] = (1.0, 0.0, 0.0)
    _REST[SMPL_JOINTS.index(f"right_{_joint}")] = (-1.0, 0.0, 0.0)


def _rig(
    trunk: tuple[tuple[str, ...], ...], limbs: tuple[str, ...], left: str, right: str
) -> dict[str, tuple[str, ...]]:
    """For each of the 22 joints the plain names of the rig's joints it is the mean of.

    `left` and `right` are patterns that make the name of a limb's joint on that side.
    """
    rig: dict[str, tuple[str, ...]] = dict(zip(_TRUNK, trunk, strict=True))
    for side, pattern in (("left", left), ("right", right)):
        for limb, name in zip(_LIMBS, limbs, strict=True):
            rig[f"{side}_{limb}"] = (pattern.format(name),)
    return rig


def _leg_and_arm_rig(toe: str) -> dict[str, tuple[str, ...]]:
    """Rig of Mixamo and LaFAN1, which name the toes differently."""
    trunk = ("hips", "spine", "spine1", "spine2", "neck", "head")
    legs = ("upleg", "leg", "foot", toe)
    limbs = (*legs, "shoulder", "arm", "forearm", "hand")
    return _rig(tuple((name,) for name in trunk), limbs, "left{}", "right{}")


_RIGS = (
    _rig(tuple((name,) for name in _TRUNK), _LIMBS, "left{}", "right{}"),  # SMPL
    _leg_and_arm_rig("toe"),  # LaFAN1
    _leg_and_arm_rig("toebase"),  # Mixamo
    # Bandai Namco Research: two spine joints, at the height of SMPL's upper two.
    _rig(
        (("hips",), ("hips", "spine"), ("spine",), ("chest",), ("neck",), ("head",)),
        (
            *("upperleg", "lowerleg", "foot", "toes"),
            *("shoulder", "upperarm", "lowerarm", "hand"),
        ),
        "{}l",
        "{}r",
    ),
)


def joint_mapping(skeleton: Skeleton) -> Float[Array, "22 joints"]:
    """Weights that make HumanML3D's joints from those of a skeleton.

    One row per joint of `SMPL_JOINTS`, which sums to 1. Knows the joint names of SMPL,
    LaFAN1, Mixamo and Bandai Namco Research, in any case and after a prefix like
    "mixamorig:"; joints that are not needed are left out.

    A `ValueError` names what is missing from the rig that fits best.
    """
    plain = plain_names(skeleton)

    def missing(rig: dict[str, tuple[str, ...]]) -> list[str]:
        return sorted({n for names in rig.values() for n in names} - set(plain))

    rig = min(_RIGS, key=lambda rig: len(missing(rig)))
    if missing(rig):
        raise ValueError(
            "no mapping onto the 22 joints of HumanML3D: the nearest known rig also "
            f"has {', '.join(missing(rig))}; the skeleton has "
            f"{', '.join(skeleton.names)}"
        )
    weights = np.zeros((len(SMPL_JOINTS), skeleton.num_joints), np.float32)
    for row, joint in enumerate(SMPL_JOINTS):
        for name in rig[joint]:
            weights[row, plain.index(name)] = 1.0 / len(rig[joint])
    return jnp.asarray(weights)


@jax.jit
def mapped_joints(
    mapping: Float[Array, "22 joints"], positions: Float[Array, "*batch joints 3"]
) -> Float[Array, "*batch 22 3"]:
    """World positions, meters, of HumanML3D's joints, by a `joint_mapping`."""
    # In full precision also where matrix products are rounded by default.
    return jnp.einsum("kj,...jc->...kc", mapping, positions, precision="highest")


def _children(joint: int) -> list[int]:
    """Joints whose parent is the joint."""
    return [c for c, parent in enumerate(HUMANML3D.parents) if parent == joint]


def _fan_rotation(rest: Array, seen: Array) -> Array:
    """Least-squares rotation [F, 3, 3] of vectors at rest [N, 3] onto seen [F, N, 3].

    Source: Kabsch 1976.
    """
    covariance = jnp.einsum("fni,nj->fij", seen, rest, precision="highest")
    left, _, right = jnp.linalg.svd(covariance)
    # The nearest orthogonal matrix that does not mirror.
    sign = jnp.where(jnp.linalg.det(product(left, right)) < 0, -1.0, 1.0)
    last = left[..., :, 2:] * sign[:, None, None]
    return product(jnp.concatenate([left[..., :, :2], last], axis=-1), right)


def _mean_offsets(bones: Array) -> Array:
    """Offsets [22, 3] at rest of bones [F, 22, 3] seen in a clip."""
    rest = jnp.asarray(_REST)
    for joint in range(len(SMPL_JOINTS)):
        children = jnp.array(_children(joint), jnp.int32)
        if len(children) < 2:
            continue
        seen = bones[:, children]
        turn = _fan_rotation(rest[children], seen)
        own = jnp.einsum("fij,fni->fnj", turn, seen, precision="highest")
        up = jnp.array([0.0, 1.0, 0.0])
        mean = rotation.safe_normalize(jnp.mean(own, axis=0), up)
        rest = rest.at[children].set(mean)
    length = jnp.mean(jnp.linalg.norm(bones, axis=-1), axis=0)
    return length[:, None] * rest


@functools.partial(jax.jit, static_argnames=("fps",))
def motion_from_joints(
    positions: Float[Array, "frames 22 3"], fps: float
) -> tuple[Skeleton, Motion]:
    """Skeleton and motion that follow joint positions, for example for a BVH file.

    The joints are `SMPL_JOINTS`, the positions in the world, meters, y up. The bones
    have constant lengths, so positions whose bones stretch are only approximated. In
    rest the person stands as a T and faces +z.
    """
    parents = HUMANML3D.parents
    bones = positions - positions[:, jnp.array((0, *parents[1:]))]
    offsets = _mean_offsets(bones)
    up = jnp.array([0.0, 1.0, 0.0])
    identity = jnp.broadcast_to(jnp.eye(3), (positions.shape[0], 3, 3))
    world, local, placed = [], [], []
    for joint, parent in enumerate(parents):
        above = identity if parent < 0 else world[parent]
        below = jnp.swapaxes(above, -1, -2)
        here = positions[:, 0]
        if parent >= 0:
            here = placed[parent] + product(above, offsets[joint][:, None])[..., 0]
        children = jnp.array(_children(joint), jnp.int32)
        seen = positions[:, children] - here[:, None]
        turn = identity
        if len(children) == 1:
            aim = product(below, rotation.safe_normalize(seen[:, 0], up)[..., None])
            turn = minimal_swing(jnp.asarray(_REST)[children], aim[..., 0])
        elif len(children) > 1:
            turn = product(below, _fan_rotation(offsets[children], seen))
        world.append(product(above, turn))
        local.append(turn)
        placed.append(here)
    rot6d = rotation.rot6d_from_matrix(jnp.stack(local, axis=-3))
    skeleton = Skeleton(offsets=offsets, parents=parents, names=SMPL_JOINTS, feet=_FEET)
    return skeleton, Motion(
        root_position=positions[:, 0], joint_rotation=rot6d, fps=fps
    )
