"""Which way a pose faces on the ground.

CAMDM takes the facing from the hips alone: with across = left hip - right hip in the
world, forward = across x up. Only the chain from the root to the hips is needed. So
are its training data made; its Unity run-time takes the forward axis of the root joint
instead, which differed from the hips by 0.5 degrees on average where the two were
compared (95th percentile 1.8, at most 7.4); its evaluation takes hips and shoulders
(`body_facing`).
"""

import functools

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxmotion.motion import ground
from jaxmotion.motion.rotation import safe_normalize
from jaxmotion.motion.skeleton import Skeleton, from_root

# Left and right hip joint in lower case, without separators and rig prefix.
_HIPS = (
    ("leftupleg", "rightupleg"),  # Mixamo, LaFAN1, CMU
    ("upperlegl", "upperlegr"),  # Bandai Namco Research
    ("lefthip", "righthip"),  # 100STYLE, SMPL
    ("lhip", "rhip"),  # BallPlay-M
)
# The same of the shoulders: the collars where there are any.
_SHOULDERS = (
    ("leftcollar", "rightcollar"),  # 100STYLE, SMPL
    ("lthorax", "rthorax"),  # BallPlay-M
    ("leftshoulder", "rightshoulder"),  # Mixamo, LaFAN1, CMU
    ("shoulderl", "shoulderr"),  # Bandai Namco Research
)


def plain_names(skeleton: Skeleton) -> list[str]:
    """Joint names in lower case, without separators: "spine2" of "mixamorig:Spine".

    The prefix of a rig goes, too.
    """
    return [name.lower().split(":")[-1].replace("_", "") for name in skeleton.names]


def hip_joints(skeleton: Skeleton) -> tuple[int, int]:
    """Indices of the left and the right hip joint, found by their names.

    Knows LeftUpLeg/RightUpLeg (Mixamo, LaFAN1), UpperLeg_L/UpperLeg_R (Bandai Namco),
    LeftHip/RightHip (100STYLE, SMPL) and L_Hip/R_Hip (BallPlay-M), in any case and
    after a prefix like "mixamorig:".

    A `ValueError` names the pairs it knows and the joints if none is found. CAMDM's
    code takes the facing from these joints, too.
    """
    plain = plain_names(skeleton)
    for left, right in _HIPS:
        if left in plain and right in plain:
            return plain.index(left), plain.index(right)
    raise ValueError(
        "no hip joints: expected LeftUpLeg/RightUpLeg, UpperLeg_L/UpperLeg_R, "
        "LeftHip/RightHip or L_Hip/R_Hip among the joint names "
        f"{', '.join(skeleton.names)}"
    )


def shoulder_joints(skeleton: Skeleton) -> tuple[int, int] | None:
    """Left and right inner shoulder joint (collar), found by name; None for none."""
    plain = plain_names(skeleton)
    for left, right in _SHOULDERS:
        if left in plain and right in plain:
            return plain.index(left), plain.index(right)
    return None


@jax.jit
def facing_from_across(across: Float[Array, "*batch 3"]) -> Float[Array, "*batch 2"]:
    """Unit facing (x, z) of a body from its right-to-left vector: across x up.

    World vectors of any length; a vertical one gives +z.

    Source: Chen et al. 2024 (CAMDM), released code.
    """
    return ground.unit(jnp.stack([-across[..., 2], across[..., 0]], axis=-1))


@functools.partial(jax.jit, static_argnames=("hips",))
def hip_facing(
    skeleton: Skeleton,
    joint_rotation: Float[Array, "*batch joints 6"],
    *,
    hips: tuple[int, int] | None = None,
) -> Float[Array, "*batch 2"]:
    """Unit facing (x, z) of poses from their hips, world.

    Rotations are parent-local, two columns each; the root's is global. +z where the
    hips lie above each other. Hips are found by name (else `ValueError`) if not given.

    Source: Chen et al. 2024 (CAMDM), released code.
    """
    left, right = hip_joints(skeleton) if hips is None else hips
    return facing_from_across(
        from_root(skeleton, joint_rotation, left)
        - from_root(skeleton, joint_rotation, right)
    )


@jax.jit
def body_facing(
    skeleton: Skeleton, positions: Float[Array, "*batch joints 3"]
) -> Float[Array, "*batch 2"]:
    """Unit facing (x, z) from hips and shoulders alike, as in CAMDM's evaluation.

    All in the world; `ValueError` if hips or shoulders are not found by name.

    Source: Chen et al. 2024 (CAMDM), released code.
    """
    shoulders = shoulder_joints(skeleton)
    if shoulders is None:
        raise ValueError(
            "no shoulder joints: expected LeftCollar, LeftShoulder, Shoulder_L or "
            f"L_Thorax among the joint names {', '.join(skeleton.names)}"
        )
    across = 0.0
    for left, right in (hip_joints(skeleton), shoulders):
        gap = positions[..., left, :] - positions[..., right, :]
        # Collar bones of CMU begin at one point.
        across += safe_normalize(gap, jnp.zeros(3, gap.dtype))
    return facing_from_across(across)
