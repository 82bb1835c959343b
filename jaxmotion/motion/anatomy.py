"""Trunk, limbs and sides of a skeleton, and the T-pose of it.

What a joint is follows from the tree and the bones' lengths, and where there are names,
from them: a limb is a chain of at least three joints that leaves the trunk, its longest
two bones in a row are thigh and shank, or upper arm and forearm. So skeletons of any
convention are told apart, also those whose zero pose is no pose of a person (LaFAN1's
bones all lie along x).
"""

import dataclasses
import re

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxmotion.motion.skeleton import Motion, Skeleton

LEFT, RIGHT, MIDDLE = "left", "right", "middle"
_SIDES = (
    re.compile(r"(left|right)", re.IGNORECASE),
    re.compile(r"(?:^|(?<=[_\-.: ]))([lr])(?=$|[_\-.: ])", re.IGNORECASE),
    re.compile(r"^([lrLR])(?=[A-Z])"),
    re.compile(r"(?<=[a-z\d])([LR])$"),
)
_TIP = re.compile(r"end|top|site|nub|tip")
# How far the sole's bone falls, per length, where the zero pose does not tell.
SOLE = 0.45


@dataclasses.dataclass(frozen=True, kw_only=True)
class Limb:
    """Joints of an arm or a leg.

    Attributes:
      before: What leads to it from the trunk, such as a clavicle.
      upper: Shoulder or hip.
      middle: Elbow or knee.
      end: Wrist or ankle.
      after: The longest chain behind it: ball of the foot, or a finger.
      side: LEFT, RIGHT, or MIDDLE where neither names nor the zero pose tell.
    """

    before: tuple[int, ...]
    upper: int
    middle: int
    end: int
    after: tuple[int, ...]
    side: str = MIDDLE

    @property
    def first(self) -> int:
        """The joint that leaves the trunk."""
        return (*self.before, self.upper)[0]


@dataclasses.dataclass(frozen=True, kw_only=True)
class Anatomy:
    """What the joints are.

    Attributes:
      trunk: From the root to the head; the root alone where no head is found.
      has_head: Whether the trunk ends at a head; at a neck otherwise.
      arms, legs: Limbs; both empty for a skeleton that is no person's.
      sides: LEFT, RIGHT or MIDDLE, one a joint.
      upright: Whether the zero pose stands, with y up.
    """

    trunk: tuple[int, ...]
    has_head: bool
    arms: tuple[Limb, ...]
    legs: tuple[Limb, ...]
    sides: tuple[str, ...]
    upright: bool


def side_of(name: str) -> str:
    """LEFT, RIGHT or MIDDLE, as a joint's name says."""
    found = next(filter(None, (pattern.search(name) for pattern in _SIDES)), None)
    if found is None:
        return MIDDLE
    return LEFT if found.group(1).lower().startswith("l") else RIGHT


def side_patterns() -> list[tuple[str, str]]:
    """What `side_of` looks for, in its order: patterns, and "i" where case is none."""
    return [(x.pattern, "i" if x.flags & re.IGNORECASE else "") for x in _SIDES]


def chain(parents: tuple[int, ...], joint: int) -> list[int]:
    """Joints from the root to one."""
    found = []
    while joint >= 0:
        found.append(joint)
        joint = parents[joint]
    return found[::-1]


def zero_pose(skeleton: Skeleton) -> np.ndarray:
    """Joints [J, 3] where no joint is turned, from the root, meters."""
    places = np.array(skeleton.offsets, float)
    places[0] = 0.0
    for joint, parent in enumerate(skeleton.parents):
        if parent >= 0:
            places[joint] += places[parent]
    return places


def find_head(
    parents: tuple[int, ...],
    names: tuple[str, ...],
    sides: tuple[str, ...],
    height: np.ndarray,
) -> tuple[int | None, bool]:
    """The joint at the trunk's upper end (None for none), and whether it is a head.

    Without such a name it is the highest leaf in the middle.
    """
    for word in ("head", "neck"):
        found = [j for j, name in enumerate(names) if word in name.lower()]
        found = [j for j in found if not _TIP.search(names[j].lower())]
        if found:
            # A neck may have several joints.
            return (found[0], True) if word == "head" else (found[-1], False)
    free = [
        j for j in range(1, len(parents)) if j not in parents and sides[j] == MIDDLE
    ]
    top = max(free, key=lambda j: height[j], default=None)
    return (top, True) if top is not None and height[top] > height[0] else (None, False)


def find_limbs(
    parents: tuple[int, ...],
    lengths: np.ndarray,
    trunk: list[int],
    named: tuple[str, ...],
) -> tuple[list[Limb], list[Limb]]:
    """Arms and legs, not sided: legs are what leaves the trunk at its lowest joint.

    Both of a pair may leave it at one joint, if their names tell them apart.
    """
    parts: dict[tuple[int, str], list[int]] = {}
    for leaf in (j for j in range(len(parents)) if j not in parents):
        part = [j for j in chain(parents, leaf) if j not in trunk]
        if part:
            best = parts.get((part[0], named[leaf]), [])
            if lengths[part].sum() > lengths[best].sum():
                parts[part[0], named[leaf]] = part
    found = [p for p in parts.values() if len(p) > 2 and parents[p[0]] != trunk[-1]]
    lowest = min((trunk.index(parents[part[0]]) for part in found), default=0)
    arms, legs = [], []
    for part in found:
        i = 1 + int(np.argmax(lengths[part[1:-1]] + lengths[part[2:]]))
        limb = Limb(
            before=tuple(part[: i - 1]),
            upper=part[i - 1],
            middle=part[i],
            end=part[i + 1],
            after=tuple(part[i + 2 :]),
        )
        low = trunk.index(parents[part[0]]) == lowest
        (legs if low else arms).append(limb)
    return arms, legs


def find_anatomy(skeleton: Skeleton, sides: tuple[str, ...] | None = None) -> Anatomy:
    """What the joints of a skeleton are.

    Sides are LEFT, RIGHT or MIDDLE, one a joint; None for what the names say, and where
    they say nothing, the zero pose.
    """
    parents = skeleton.parents
    if sides is not None and (
        len(sides) != len(parents) or set(sides) - {LEFT, RIGHT, MIDDLE}
    ):
        raise ValueError(
            f"sides are {sides}, expected {len(parents)} of {LEFT}, {RIGHT}, {MIDDLE}"
        )
    named = tuple(map(side_of, skeleton.names)) if sides is None else tuple(sides)
    places = zero_pose(skeleton)
    lengths = np.linalg.norm(np.asarray(skeleton.offsets, float), axis=-1)
    lengths[0] = 0.0
    head, has_head = find_head(parents, skeleton.names, named, places[:, 1])
    trunk = chain(parents, 0 if head is None else head)
    arms, legs = (
        ([], []) if head is None else find_limbs(parents, lengths, trunk, named)
    )
    if not (arms and legs):
        return Anatomy(
            trunk=tuple(trunk),
            has_head=has_head,
            arms=(),
            legs=(),
            sides=named,
            upright=True,
        )
    rise = places[trunk[-1]] - np.mean([places[leg.end] for leg in legs], axis=0)
    upright = rise[1] > 0.8 * np.linalg.norm(rise)
    if set(named) == {MIDDLE} and upright and sides is None:
        named = _guess_sides(parents, places, arms, legs)
    made = [
        _one_per_side(
            [dataclasses.replace(limb, side=named[limb.middle]) for limb in limbs],
            lengths,
        )
        for limbs in (arms, legs)
    ]
    return Anatomy(
        trunk=tuple(trunk),
        has_head=has_head,
        arms=made[0],
        legs=made[1],
        sides=named,
        upright=bool(upright),
    )


def _one_per_side(limbs: list[Limb], lengths: np.ndarray) -> tuple[Limb, ...]:
    """The longest limb of each side: a hood or a ribbon is none."""
    if {LEFT, RIGHT} - {limb.side for limb in limbs}:
        return tuple(limbs)
    long = lambda limb: lengths[limb.middle] + lengths[limb.end]  # noqa: E731
    best = [
        max((limb for limb in limbs if limb.side == side), key=long)
        for side in (LEFT, RIGHT)
    ]
    return tuple(limb for limb in limbs if limb in best)


def _guess_sides(
    parents: tuple[int, ...], places: np.ndarray, arms: list[Limb], legs: list[Limb]
) -> tuple[str, ...]:
    """Sides of a zero pose that stands: toes point ahead."""
    toes = [places[leg.after[0]] - places[leg.end] for leg in legs if leg.after]
    ahead = np.sum(toes, axis=0) if toes else np.zeros(3)
    left = np.array([ahead[2], 0.0, -ahead[0]])
    found = [MIDDLE] * len(parents)
    for limb in (*arms, *legs):
        away = float(left @ (places[limb.upper] - places[parents[limb.first]]))
        if abs(away) > 1e-9:
            for joint in range(len(parents)):
                if limb.first in chain(parents, joint):
                    found[joint] = LEFT if away > 0 else RIGHT
    return tuple(found)


def unit(vector: np.ndarray) -> np.ndarray:
    """The direction of a vector; 0 of 0."""
    return vector / max(float(np.linalg.norm(vector)), 1e-9)


def _swing(start: np.ndarray, end: np.ndarray, half_turn: np.ndarray) -> np.ndarray:
    """The smallest rotation between directions; about `half_turn` if they oppose."""
    a, b = unit(start), unit(end)
    if a @ b < -0.9:
        first = 2 * np.outer(half_turn, half_turn) - np.eye(3)
        return _swing(first @ a, b, half_turn) @ first
    v = np.cross(a, b)
    cross = np.array([[0, -v[2], v[1]], [v[2], 0, -v[0]], [-v[1], v[0], 0]])
    return np.eye(3) + cross + cross @ cross / (1 + a @ b)


def t_pose(
    skeleton: Skeleton,
    sides: tuple[str, ...] | None = None,
    motion: np.ndarray | None = None,
    *,
    found: Anatomy | None = None,
) -> tuple[np.ndarray, np.ndarray]:
    """Positions and world rotations in the T-pose: arms level to the sides, facing +z.

    Positions [J, 3] are in meters, the root at the origin; rotations are [J, 3, 3]. The
    trunk, the feet's slope and what has no part in the pose stay as in the zero pose; a
    skeleton that is no person's stays so whole.

    Args:
      sides: See `find_anatomy`.
      motion: World rotations [F, J, 3, 3]. Where the zero pose does not stand, or a
        motion's limbs are turned about themselves against it, nothing else tells how:
        elbows bend ahead, knees back, and feet are level on average.
      found: What the joints are, where it is known; `sides` then say nothing.
    """
    offsets = np.asarray(skeleton.offsets, float)
    parents = skeleton.parents
    found = find_anatomy(skeleton, sides) if found is None else found
    wanted: dict[int, tuple[int, np.ndarray]] = {}
    turn = chest = np.eye(3)
    if found.legs:
        places = zero_pose(skeleton)
        turn = _root_turn(found, places)
        chest = _chest_turn(skeleton, found, turn, places) @ turn
        for leg in found.legs:
            wanted[leg.upper] = (leg.middle, np.array([0.0, -1.0, 0.0]))
            wanted[leg.middle] = (leg.end, np.array([0.0, -1.0, 0.0]))
            if leg.after:
                sole = places[leg.after[0]] - places[leg.end]
                fall = -sole[1] / max(np.linalg.norm(sole), 1e-9)
                if not (found.upright and 0.0 <= fall < 0.8):
                    fall = SOLE
                ahead = np.array([0.0, -fall, np.sqrt(1 - fall**2)])
                wanted[leg.end] = (leg.after[0], ahead)
        for number, arm in enumerate(found.arms):
            left = arm.side == LEFT or (arm.side == MIDDLE and number == 0)
            out = np.array([1.0 if left else -1.0, 0.0, 0.0])
            joints = [*arm.before[-1:], arm.upper, arm.middle, arm.end, *arm.after[:1]]
            for joint, child in zip(joints, joints[1:], strict=False):
                bone = chest @ (places[child] - places[joint])
                # A clavicle keeps its slope.
                if joint not in arm.before or unit(bone) @ out < 0.6:
                    wanted[joint] = (child, out)
    above = _above_pelvis(skeleton, found)
    turns = np.zeros((len(parents), 3, 3))
    for joint, parent in enumerate(parents):
        turns[joint] = turn if parent < 0 else turns[parent]
        if joint == above:
            turns[joint] = chest
        if joint in wanted:
            child, direction = wanted[joint]
            bone = turns[joint] @ offsets[child]
            axis = np.array([0.0, 0.0, 1.0])
            turns[joint] = _swing(bone, direction, axis) @ turns[joint]
    if motion is not None:
        below = lambda top: [  # noqa: E731
            j for j in range(len(parents)) if top in chain(parents, j)
        ]
        turned = []
        for limb in (*found.arms, *found.legs):
            bone = wanted[limb.upper][1]
            bend = np.array([0.0, 0.0, 1.0 if limb in found.arms else -1.0])
            twist = _hinge_turn(limb, bone, bend, turns, motion)
            # A zero pose that stands is believed, unless limbs would bend backward.
            if not found.upright or np.trace(twist) < 1.0:
                turns[below(limb.upper)] = twist @ turns[below(limb.upper)]
                turned.append(limb)
        for leg in found.legs:
            if leg.after and leg in turned:
                foot = below(leg.end)
                turns[foot] = (
                    _foot_turn(leg, wanted, turns, motion, offsets) @ turns[foot]
                )
    points = np.zeros((len(parents), 3))
    for joint, parent in enumerate(parents):
        if parent >= 0:
            points[joint] = points[parent] + turns[parent] @ offsets[joint]
    return points, turns


def _hinge_turn(
    limb: Limb,
    bone: np.ndarray,
    bend: np.ndarray,
    turns: np.ndarray,
    motion: np.ndarray,
) -> np.ndarray:
    """Turns a limb about itself so that its middle joint bends toward a direction."""
    upper, lower = (motion[:, j] @ turns[j].T for j in (limb.upper, limb.middle))
    bent = np.swapaxes(upper, -1, -2) @ lower
    skew = bent - np.swapaxes(bent, -1, -2)
    hinge = 0.5 * np.stack([skew[:, 2, 1], skew[:, 0, 2], skew[:, 1, 0]], -1).mean(0)
    hinge = hinge - bone * (hinge @ bone)
    if np.linalg.norm(hinge) < 0.05:  # hardly bent: nothing to go by
        return np.eye(3)
    return _swing(hinge, np.cross(bone, bend), bone)


def _foot_turn(
    leg: Limb, wanted: dict, turns: np.ndarray, motion: np.ndarray, offsets: np.ndarray
) -> np.ndarray:
    """Turns a foot ahead again, and about itself so that it is level on average."""
    toe, ahead = wanted[leg.end]
    up = np.array([0.0, 1.0, 0.0])
    first = _swing(turns[leg.end] @ offsets[toe], ahead, up)
    above = first @ turns[leg.end] @ motion[:, leg.end, 1].mean(axis=0)
    across = lambda v: v - ahead * (v @ ahead)  # noqa: E731
    if np.linalg.norm(across(above)) < 0.2:  # it points down all the time
        return first
    return _swing(across(above), across(up), ahead) @ first


def kinematics(skeleton: Skeleton, motion: Motion) -> tuple[np.ndarray, np.ndarray]:
    """`skeleton.global_transforms` in NumPy: pictures and files compile nothing.

    Positions [*batch, frames, J, 3] are in meters; rotations [*batch, frames, J, 3, 3].
    """
    turns = np.asarray(motion.joint_rotation, float)
    offsets = np.asarray(skeleton.offsets, float)
    x = turns[..., :3] / np.linalg.norm(turns[..., :3], axis=-1, keepdims=True)
    y = turns[..., 3:] - np.sum(x * turns[..., 3:], axis=-1, keepdims=True) * x
    y = y / np.linalg.norm(y, axis=-1, keepdims=True)
    rotations = np.stack([x, y, np.cross(x, y)], axis=-1)
    positions = np.array(rotations[..., 0])
    positions[..., 0, :] = motion.root_position
    for joint, parent in enumerate(skeleton.parents[1:], 1):
        above = rotations[..., parent, :, :]
        positions[..., joint, :] = positions[..., parent, :] + above @ offsets[joint]
        rotations[..., joint, :, :] = above @ rotations[..., joint, :, :]
    return positions, rotations


def local_columns(
    parents: tuple[int, ...], rotations: np.ndarray
) -> Float[Array, "frames joints 6"]:
    """Rotations as a `Motion` has them, of world ones [F, J, 3, 3]."""
    above = [max(parent, 0) for parent in parents]
    local = np.swapaxes(rotations[:, above], -1, -2) @ rotations
    local[:, 0] = rotations[:, 0]
    columns = np.concatenate([local[..., 0], local[..., 1]], axis=-1)
    return jnp.asarray(columns, jnp.float32)


def as_t_pose(skeleton: Skeleton, motion: Motion) -> tuple[Skeleton, Motion]:
    """The positions [frames, ...] of one character, on a T-posed skeleton.

    All joints' axes are those of the world there: x left, y up, z ahead.
    """
    _, world = kinematics(skeleton, motion)
    points, turns = t_pose(skeleton, motion=world)
    columns = local_columns(skeleton.parents, world @ np.swapaxes(turns, -1, -2))
    offsets = points - points[[max(parent, 0) for parent in skeleton.parents]]
    return (
        dataclasses.replace(skeleton, offsets=jnp.asarray(offsets, jnp.float32)),
        dataclasses.replace(motion, joint_rotation=columns),
    )


def mixamo_names(skeleton: Skeleton, *, prefix: str = "mixamorig:") -> tuple[str, ...]:
    """Names of the joints as Mixamo's characters have them, which engines know.

    Joints that those have not, such as fingers, keep their names. `ValueError` if no
    trunk with arms and legs of two sides is found.
    """
    found = find_anatomy(skeleton)
    sided = {limb.side for limb in (*found.arms, *found.legs)}
    if len(found.arms) != 2 or len(found.legs) != 2 or MIDDLE in sided:
        raise ValueError(
            f"no two arms and two legs, left and right, among the joints "
            f"{', '.join(skeleton.names)}"
        )
    names: dict[int, str] = {}
    base, chest = (
        found.trunk.index(skeleton.parents[limb.first])
        for limb in (found.legs[0], found.arms[0])
    )
    names[found.trunk[base]] = "Hips"
    number = lambda i: str(i) if i else ""  # noqa: E731
    for i, joint in enumerate(found.trunk[base + 1 : chest + 1]):
        names[joint] = "Spine" + number(i)
    for i, joint in enumerate(found.trunk[chest + 1 :]):
        names[joint] = "Neck" + number(i)
    if found.has_head and found.trunk[-1] != found.trunk[chest]:
        names[found.trunk[-1]] = "Head"
    for limbs, words in (
        (found.arms, ("Shoulder", "Arm", "ForeArm", "Hand")),
        (found.legs, ("UpLeg", "Leg", "Foot")),
    ):
        for limb in limbs:
            side = limb.side.capitalize()
            clavicle = limb.before[-1:] if limbs is found.arms else ()
            joints = (*clavicle, limb.upper, limb.middle, limb.end)
            for joint, word in zip(joints, words[-len(joints) :], strict=True):
                names[joint] = side + word
            if limbs is found.legs and limb.after:
                names[limb.after[0]] = side + "ToeBase"
    return tuple(
        prefix + names[j] if j in names else name
        for j, name in enumerate(skeleton.names)
    )


def _above_pelvis(skeleton: Skeleton, found: Anatomy) -> int | None:
    """The trunk's first joint above the legs; None where there is none."""
    if not found.legs:
        return None
    pelvis = found.trunk.index(skeleton.parents[found.legs[0].first])
    return found.trunk[pelvis + 1] if pelvis + 1 < len(found.trunk) else None


def _chest_turn(
    skeleton: Skeleton, found: Anatomy, turn: np.ndarray, places: np.ndarray
) -> np.ndarray:
    """Turns the spine so that shoulders are above the hips, not across them."""
    roots = {arm.side: turn @ places[arm.first] for arm in found.arms}
    above = _above_pelvis(skeleton, found)
    chests = [chain(skeleton.parents, arm.first) for arm in found.arms]
    if set(roots) != {LEFT, RIGHT} or any(above not in chest for chest in chests):
        return np.eye(3)
    across = (roots[LEFT] - roots[RIGHT]) * [1.0, 0.0, 1.0]
    if unit(across)[0] > 0.9 or np.linalg.norm(across) < 1e-6:
        return np.eye(3)  # as a person's; a performer is never quite even
    return _swing(across, np.array([1.0, 0.0, 0.0]), np.array([0.0, 1.0, 0.0]))


def _root_turn(found: Anatomy, places: np.ndarray) -> np.ndarray:
    """Turns the zero pose so that it stands and faces +z."""
    hips = {leg.side: places[leg.upper] for leg in found.legs}
    if LEFT in hips and RIGHT in hips:
        left = hips[LEFT] - hips[RIGHT]
    elif len(found.legs) == 2:
        left = places[found.legs[0].upper] - places[found.legs[1].upper]
    else:
        return np.eye(3)
    up = places[found.trunk[-1]] - places[found.trunk[0]]
    up = np.array([0.0, 1.0, 0.0]) if found.upright else unit(up)
    left = unit(left - up * (left @ up))
    return np.stack([left, up, np.cross(left, up)])
