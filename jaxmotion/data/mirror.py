"""Left-right mirroring of motions.

The mirror image in the world plane x = 0 sends a point p to M p with M = diag(-1, 1, 1)
and swaps left and right joints: joint j takes the place of its partner s(j). A mirrored
rotation is no rotation, so each joint also needs a reflection L_j of its own axes:

    R'_j = M R_s(j) L_j                                    (global rotations)

The bone to a child c then points where it should, R'_j o_c = M R_s(j) o_s(c), if
L_j o_c = o_s(c). With joint axes along or across the bones, L_j is diagonal with
entries of +1 and -1 and determinant -1, and may differ from joint to joint (rigs often
turn the axes of the right limbs round). With p the parent of j, the local rotations are

    R'_j = L_p R_s(j) L_j,     at the root     R'_0 = M R_0 L_0,

which flips signs of the two columns of the 6D rotation and does nothing else.

Where all bones below a joint lie on one axis, two reflections fit and differ by a half
turn about the bone, which moves no joint but twists the limb. Then a reference motion
decides: the mirrored rotations should look like the partner's own.

Source: the mirroring of CAMDM's released code (quaternion y and z negated) is the case
L_j = M for all joints.
"""

import dataclasses
import itertools
import re

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float

from jaxmotion.data import selection
from jaxmotion.data.clips import Clips, take_clips
from jaxmotion.motion.skeleton import Motion, Skeleton

_WORLD = np.array([-1.0, 1.0, 1.0])
# diag(+-1) with determinant -1.
_REFLECTIONS = np.array(
    [s for s in itertools.product((1.0, -1.0), repeat=3) if np.prod(s) < 0]
)
_SIDES = {"left": "right", "l": "r"}
_SIDES |= {right: left for left, right in _SIDES.items()}
# Where a name says its side, surest first. A word that only ends so, as "upright" and
# "cleft" do, says none; "handleft" does.
_WORDS = ("up", "out", "down", *(x + y for x in (r"\b", "_") for y in "abcfw"))
_SIDE_PATTERNS = (
    re.compile(
        r"(?<![a-z])(?:left|right)|(?-i:(?<=[a-z])(?:Left|Right))|"
        rf"{''.join(f'(?<!{x})' for x in _WORDS)}(?:left|right)(?![a-z])",
        re.IGNORECASE,
    ),
    re.compile(r"(?:^|(?<=[_\-.: ]))[lr](?=$|[_\-.: ])", re.IGNORECASE),
    re.compile(r"^(?:[lr](?=[A-Z])|[LR](?=[A-Z][a-z]))"),
    re.compile(r"(?<=[a-z])[LR]$"),
)


@dataclasses.dataclass(frozen=True, kw_only=True)
class MirrorPlan:
    """How to mirror motions of one skeleton.

    Attributes:
      partner: For each joint the joint on the other side; itself in the middle.
      signs: For each joint the diagonal of the reflection of its axes.
    """

    partner: tuple[int, ...]
    signs: tuple[tuple[float, float, float], ...]


def _other_side(found: str) -> str:
    """The other side, in the same case."""
    other = _SIDES[found.lower()]
    if found.isupper():
        return other.upper()
    return other.capitalize() if found[0].isupper() else other


def swap_sides(name: str) -> str:
    """A name with left and right swapped; unchanged if it names no side.

    "LeftArm", "Hand_R", "lHip" and "walk-turn-left" become "RightArm", "Hand_L", "rHip"
    and "walk-turn-right".
    """
    for pattern in _SIDE_PATTERNS:
        if pattern.search(name):
            return pattern.sub(lambda match: _other_side(match.group()), name)
    return name


def _partners(
    skeleton: Skeleton, pairs: tuple[tuple[str, str], ...] | None
) -> list[int]:
    """Partner of each joint, from names or from given pairs."""
    names, partner = skeleton.names, list(range(skeleton.num_joints))
    if pairs is not None:
        for left, right in pairs:
            i, j = skeleton.index(left), skeleton.index(right)
            partner[i], partner[j] = j, i
    else:
        for joint, name in enumerate(names):
            other = swap_sides(name)
            # LHAND, too; but a label RUN is none of LUN's.
            if other == name and name[:1] in ("L", "R"):
                other = "RL"["LR".index(name[0])] + name[1:]
            if other in names:
                partner[joint] = names.index(other)
            elif _SIDE_PATTERNS[0].search(name):
                raise ValueError(
                    f"joint {name!r} has no partner {other!r}; give the pairs"
                )
    for joint, parent in enumerate(skeleton.parents):
        other = skeleton.parents[partner[joint]]
        if partner[partner[joint]] != joint or (
            parent >= 0 and partner[parent] != other
        ):
            raise ValueError(
                f"joints {names[joint]!r} and {names[partner[joint]]!r} are no pair: "
                "their parents are not partners"
            )
    return partner


def _fitting(
    skeleton: Skeleton, joint: int, partner: list[int], tolerance: float
) -> list[Float[np.ndarray, " 3"]]:
    """Reflections of the joint's axes that send its bones onto its partner's."""
    offsets = np.asarray(skeleton.offsets, np.float64)
    children = [c for c, parent in enumerate(skeleton.parents) if parent == joint]
    if not children:
        return list(_REFLECTIONS)
    mirrored = _REFLECTIONS[:, None, :] * offsets[children]
    target = offsets[[partner[child] for child in children]]
    errors = np.abs(mirrored - target).max(axis=(1, 2))
    if errors.min() > tolerance:
        raise ValueError(
            f"the skeleton is not symmetric at joint {skeleton.names[joint]!r}: no "
            f"reflection of its axes sends its bones onto those of "
            f"{skeleton.names[partner[joint]]!r} within {tolerance:g} m (best "
            f"{errors.min():.4g} m)"
        )
    # One that fits clearly better than another wins; the rest is a tie.
    return list(_REFLECTIONS[errors <= errors.min() + 0.1 * tolerance])


def mirror_plan(
    skeleton: Skeleton,
    *,
    pairs: tuple[tuple[str, str], ...] | None = None,
    motion: Motion | None = None,
    tolerance: float = 0.01,
) -> MirrorPlan:
    """Works out partners and reflections of a skeleton.

    Where several reflections fit a joint, the one that makes the mirrored rotations of
    `motion` most like the motion's own is taken; without a motion, the one of the
    joint's parent if it fits, else -1 in all axes if it fits, else the first.

    Args:
      skeleton: The bones; they may be asymmetric by up to the tolerance.
      pairs: Names of left and right joints; by default from Left/Right, _L/_R, l/r.
      motion: Reference frames, as varied as possible, without batch axes.
      tolerance: Largest asymmetry of a bone's offset, meters.

    Raises:
      ValueError: if a name's partner is missing, two partners have parents that are
        none, or the bones are not symmetric; names the joint.
    """
    partner = _partners(skeleton, pairs)
    mean = None
    if motion is not None:
        rot6d = np.asarray(motion.joint_rotation, np.float64)
        mean = rot6d.mean(axis=0).reshape(-1, 2, 3)
    signs: list[np.ndarray] = []
    for joint, parent in enumerate(skeleton.parents):
        if partner[joint] < joint:
            signs.append(signs[partner[joint]])
            continue
        fitting = _fitting(skeleton, joint, partner, tolerance)
        above = _WORLD if parent < 0 else signs[parent]
        if mean is not None and parent >= 0:
            # Agreement of the mirrored mean columns with the joint's own.
            own, other = mean[joint], above * mean[partner[joint]]
            scores = [np.sum(own * other * sign[:2, None]) for sign in fitting]
            signs.append(fitting[int(np.argmax(scores))])
            continue
        is_same = [np.array_equal(sign, above) for sign in fitting]
        is_all = [np.all(sign < 0) for sign in fitting]
        choice = is_same.index(True) if any(is_same) else int(np.argmax(is_all))
        signs.append(fitting[choice])
    return MirrorPlan(
        partner=tuple(partner),
        signs=tuple((float(x), float(y), float(z)) for x, y, z in signs),
    )


def mirror(
    skeleton: Skeleton,
    motion: Motion,
    pairs: tuple[tuple[str, str], ...] | None = None,
    *,
    plan: MirrorPlan | None = None,
) -> Motion:
    """The mirror image of a motion in the world plane x = 0.

    Mirroring twice gives the motion back, to the bit.

    Args:
      motion: Frames of that skeleton, with any batch axes.
      pairs: As for `mirror_plan`; not used if a plan is given.
      plan: What `mirror_plan` returned; by default that of the skeleton alone.

    Raises:
      ValueError: as `mirror_plan`, or if the motion has another number of joints.
    """
    plan = mirror_plan(skeleton, pairs=pairs) if plan is None else plan
    if motion.joint_rotation.shape[-2] != len(plan.partner):
        raise ValueError(
            f"joint_rotation has {motion.joint_rotation.shape[-2]} joints, the plan "
            f"{len(plan.partner)}"
        )
    signs = np.array(plan.signs)
    above = np.array([_WORLD if p < 0 else signs[p] for p in skeleton.parents])
    flips = np.concatenate([above * signs[:, :1], above * signs[:, 1:2]], axis=-1)
    rot6d = motion.joint_rotation[..., np.array(plan.partner), :]
    position = motion.root_position
    return dataclasses.replace(
        motion,
        root_position=position
        * jnp.broadcast_to(jnp.asarray(_WORLD, position.dtype), position.shape),
        joint_rotation=rot6d
        * jnp.broadcast_to(jnp.asarray(flips, rot6d.dtype), rot6d.shape),
    )


def mirror_clips(clips: Clips, *, plan: MirrorPlan | None = None) -> Clips:
    """Mirror images of all clips, named "<name>_mirrored", with swapped labels.

    The image of such an image has the name without it. A swapped label that is new to
    its field is added to the field's names. The plan is by default worked out from the
    skeleton and all frames; raises what `mirror_plan` does.
    """
    motion = Motion(
        root_position=clips.root_position,
        joint_rotation=clips.joint_rotation,
        fps=clips.fps,
    )
    plan = mirror_plan(clips.skeleton, motion=motion) if plan is None else plan
    mirrored = mirror(clips.skeleton, motion, plan=plan)
    labels, label_names = {}, []
    for field, names in clips.label_names:
        swapped = [swap_sides(name) for name in names]
        known = tuple(dict.fromkeys([*names, *swapped]))
        numbers = jnp.array([known.index(name) for name in swapped], jnp.int32)
        labels[field] = numbers[clips.labels[field]]
        label_names.append((field, known))
    return dataclasses.replace(
        clips,
        root_position=mirrored.root_position,
        joint_rotation=mirrored.joint_rotation,
        labels=labels,
        label_names=tuple(label_names),
        clip_names=tuple(map(_image, clips.clip_names)),
    )


def with_mirrored(clips: Clips) -> Clips:
    """Clips and mirror images of those that have none among them, by their names."""
    lacking = [i for i, x in enumerate(clips.titles) if _image(x) not in clips.titles]
    if not lacking:
        return clips
    # Clips first, for images may add labels: left of what was only right.
    part = clips if len(lacking) == clips.num_clips else take_clips(clips, lacking)
    return selection.concatenate([clips, mirror_clips(part)])


def _image(name: str) -> str:
    """Name of a clip's mirror image."""
    plain = name.removesuffix("_mirrored")
    return f"{name}_mirrored" if plain == name else plain
