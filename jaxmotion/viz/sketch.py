"""A body around a skeleton: limbs as tapered capsules, a head, hands and feet.

Joints are points without thickness, and most skeletons end at the skull's base, at the
wrists and at the balls of the feet. What is missing is added from the joints' positions
alone, in proportions of an adult, scaled to the legs. A head's turn about itself is not
in the positions: it looks where the chest does.
"""

import dataclasses

import numpy as np

from jaxmotion.motion import anatomy
from jaxmotion.motion.anatomy import Limb
from jaxmotion.viz.figure import LEFT, MIDDLE, RIGHT

LEFT_DARK, RIGHT_DARK, SKIN = "#174f8c", "#942020", "#c9a084"

# Thigh and shank of the adult whose measures stand below, meters.
_LEG = 0.87


@dataclasses.dataclass(frozen=True, kw_only=True)
class Body:
    """Capsules between points.

    Attributes:
      points: [F, P, 3] world, meters: the joints, then what is added.
      ends: [S, 2] the points that each capsule joins; twice the same for a ball.
      radii: [S, 2] at both ends, meters.
      colors: S.
    """

    points: np.ndarray
    ends: np.ndarray
    radii: np.ndarray
    colors: tuple[str, ...]


def bone_colors(names: tuple[str, ...] | None, number: int) -> list[str]:
    """Blue for the left side, red for the right, gray for the rest and without names.

    Returns:
      One color a joint, for the bone that ends at it.
    """
    colors = {anatomy.LEFT: LEFT, anatomy.RIGHT: RIGHT, anatomy.MIDDLE: MIDDLE}
    if names is None:
        return [MIDDLE] * number
    return [colors[anatomy.side_of(name)] for name in names]


def _unit(vectors: np.ndarray) -> np.ndarray:
    length = np.linalg.norm(vectors, axis=-1, keepdims=True)
    return vectors / np.maximum(length, 1e-9)


class _Builder:
    """Collects points and capsules; `s` are meters of this body in one of the adult."""

    def __init__(self, positions: np.ndarray, scale: float):
        self.points = list(np.moveaxis(positions, 1, 0))
        self.shapes: list[tuple[int, int, float, float, str]] = []
        self.s = scale

    def point(self, place: np.ndarray) -> int:
        self.points.append(place)
        return len(self.points) - 1

    def capsule(self, a: int, b: int, ra: float, rb: float, color: str) -> None:
        self.shapes.append((a, b, ra * self.s, rb * self.s, color))

    def between(self, a: int, b: int, part: float) -> int:
        return self.point((1 - part) * self.points[a] + part * self.points[b])

    def body(self) -> Body:
        return Body(
            points=np.stack(self.points, axis=1),
            ends=np.array([shape[:2] for shape in self.shapes], int).reshape(-1, 2),
            radii=np.array([shape[2:4] for shape in self.shapes]).reshape(-1, 2),
            colors=tuple(shape[4] for shape in self.shapes),
        )


def build(
    positions: np.ndarray, parents: tuple[int, ...], names: tuple[str, ...] | None
) -> Body:
    """The body of a motion.

    Args:
      positions: [F, J, 3] world positions of the joints, meters, y up.
      names: To find the head and tell left from right; None for guesses from the
        tree, and gray.
    """
    up_tree = np.array([max(p, 0) for p in parents])
    skeleton = np.linalg.norm(positions - positions[:, up_tree], axis=-1)
    lengths = np.median(skeleton, axis=0)
    sides = tuple(map(anatomy.side_of, names or [""] * len(parents)))
    height = positions[:, :, 1].mean(axis=0)
    head, has_head = anatomy.find_head(parents, names or (), sides, height)
    trunk = anatomy.chain(parents, 0 if head is None else head)
    arms, legs = (
        ([], []) if head is None else anatomy.find_limbs(parents, lengths, trunk)
    )
    if legs:
        scale = np.mean([lengths[leg.middle] + lengths[leg.end] for leg in legs]) / _LEG
    else:
        chains = [lengths[anatomy.chain(parents, j)].sum() for j in range(len(parents))]
        scale = max(max(chains) / 1.2, 1e-3)
    made = _Builder(positions, float(scale))
    colors = bone_colors(names, len(parents))
    done = set(trunk) if arms and legs else set()
    front = _forward(positions, arms, legs)
    if arms and legs:
        _add_trunk(made, parents, trunk, arms, legs)
    for leg in legs:
        _add_leg(made, leg, colors[leg.middle], front)
        done |= {leg.upper, leg.middle, leg.end, *leg.before, *leg.after[:1]}
    for arm in arms:
        _add_arm(made, parents, arm, colors[arm.middle])
        done |= {arm.upper, arm.middle, arm.end, *arm.before}
    ends = {arm.end for arm in arms}
    for joint in range(1, len(parents)):
        if joint in done:
            continue
        finger = ends & set(anatomy.chain(parents, parents[joint]))
        radius = 0.011 if finger else min(0.04, 0.2 * lengths[joint] / scale + 0.01)
        color = SKIN if finger else colors[joint]
        made.capsule(parents[joint], joint, radius, radius, color)
    if head is not None:
        _add_head(made, parents, trunk, not has_head, arms, front)
    if not made.shapes:
        made.capsule(0, 0, 0.05, 0.05, MIDDLE)
    return made.body()


def _forward(
    positions: np.ndarray, arms: list[Limb], legs: list[Limb]
) -> np.ndarray | None:
    """Where the chest faces [F, 3], level; None if the tree does not tell."""
    pair = arms if len(arms) == 2 else legs
    feet = [leg for leg in legs if leg.after]
    if len(pair) != 2 or not feet:
        return None
    across = positions[:, pair[0].upper] - positions[:, pair[1].upper]
    forward = _unit(np.stack([-across[:, 2], 0 * across[:, 1], across[:, 0]], -1))
    # Joints are listed left first or right first: toes point ahead in both.
    toes = sum(positions[:, leg.after[0]] - positions[:, leg.end] for leg in feet)
    return forward * (np.sign(np.mean(np.sum(forward * toes, -1))) or 1.0)


def _add_trunk(
    made: _Builder,
    parents: tuple[int, ...],
    trunk: list[int],
    arms: list[Limb],
    legs: list[Limb],
) -> None:
    """Belly, chest, pelvis, flanks and shoulders."""
    first = min(
        trunk.index(parents[arm.before[0] if arm.before else arm.upper]) for arm in arms
    )
    for a, b in zip(trunk[:first], trunk[1 : first + 1], strict=True):
        made.capsule(a, b, 0.105, 0.105, MIDDLE)
    chest = trunk[first]
    nape = trunk[min(first + 1, len(trunk) - 1)]
    made.capsule(chest, nape, 0.1, 0.055, MIDDLE)
    for leg in legs:
        hip = made.between(leg.upper, trunk[0], 0.15)
        made.capsule(trunk[0], hip, 0.1, 0.088, MIDDLE)
    for arm in arms:
        shoulder = made.between(arm.upper, chest, 0.3)
        made.capsule(chest, shoulder, 0.1, 0.066, MIDDLE)
        made.capsule(nape, shoulder, 0.05, 0.06, MIDDLE)
        side = made.points[arm.upper] - made.points[chest]
        hip = max(
            legs,
            key=lambda leg, side=side: np.mean(
                np.sum(side * (made.points[leg.upper] - made.points[trunk[0]]), -1)
            ),
        ).upper
        low = made.between(hip, trunk[0], 0.25)
        ribs = made.between(shoulder, low, 0.35)
        made.capsule(shoulder, ribs, 0.066, 0.085, MIDDLE)
        made.capsule(ribs, low, 0.085, 0.085, MIDDLE)


def _add_leg(made: _Builder, leg: Limb, color: str, front: np.ndarray | None) -> None:
    dark = {LEFT: LEFT_DARK, RIGHT: RIGHT_DARK}.get(color, MIDDLE)
    made.capsule(leg.upper, leg.middle, 0.082, 0.056, color)
    calf = made.between(leg.middle, leg.end, 0.3)
    made.capsule(leg.middle, calf, 0.056, 0.054, color)
    made.capsule(calf, leg.end, 0.054, 0.038, color)
    knee, ankle = made.points[leg.middle], made.points[leg.end]
    shank = _unit(ankle - knee)
    if leg.after:
        toe = made.points[leg.after[0]]
    elif front is not None:
        toe = ankle + (0.15 * front + 0.05 * shank) * made.s
    else:
        made.capsule(leg.end, leg.end, 0.05, 0.05, dark)
        return
    # The sole: level where the foot stands, so it keeps the angle at which the bone
    # to the toes then falls.
    foot = np.median(np.linalg.norm(toe - ankle, axis=-1))
    low = np.percentile(ankle[:, 1], 10) - np.percentile(toe[:, 1], 10)
    slope = np.arcsin(np.clip(low / max(foot, 1e-9), 0.3, 0.65))
    ahead = _unit(toe - ankle)
    lift = -shank - ahead * np.sum(-shank * ahead, -1, keepdims=True)
    lift = _unit(lift)
    level = np.cos(slope) * ahead + np.sin(slope) * lift
    above = np.cos(slope) * lift - np.sin(slope) * ahead
    thick = 0.03 * made.s
    drop = max(np.sin(slope) * foot - 0.008 * made.s, 0.0)
    heel = made.point(ankle - above * drop - level * 0.035 * made.s)
    ball = leg.after[0] if leg.after else made.point(toe)
    tip = made.point(made.points[ball] + level * 0.055 * made.s - above * 0.1 * thick)
    made.capsule(leg.end, heel, 0.04, 0.036, dark)
    made.capsule(leg.end, ball, 0.042, 0.034, dark)
    made.capsule(made.between(leg.end, heel, 0.5), ball, 0.038, 0.034, dark)
    made.capsule(heel, ball, 0.036, 0.034, dark)
    made.capsule(ball, tip, 0.034, 0.026, dark)


def _add_arm(made: _Builder, parents: tuple[int, ...], arm: Limb, color: str) -> None:
    made.capsule(arm.upper, arm.upper, 0.062, 0.062, color)
    made.capsule(arm.upper, arm.middle, 0.054, 0.041, color)
    made.capsule(arm.middle, arm.end, 0.042, 0.029, color)
    along = _unit(made.points[arm.end] - made.points[arm.middle])
    knuckles = [j for j, parent in enumerate(parents) if parent == arm.end]
    if knuckles:
        place = np.mean([made.points[j] for j in knuckles], axis=0)
    else:
        place = made.points[arm.end] + along * 0.075 * made.s
    palm = made.point(place)
    made.capsule(arm.end, palm, 0.03, 0.038, SKIN)
    if all(j not in parents for j in knuckles):
        tip = made.point(place + along * 0.055 * made.s)
        made.capsule(palm, tip, 0.038, 0.024, SKIN)


def _add_head(
    made: _Builder,
    parents: tuple[int, ...],
    trunk: list[int],
    is_neck: bool,
    arms: list[Limb],
    front: np.ndarray | None,
) -> None:
    head = made.points[trunk[-1]]
    below = made.points[trunk[-2]] if len(trunk) > 1 else head - [0.0, 1.0, 0.0]
    up = _unit(head - below)
    # Who leans keeps the head level, more or less; the joints do not tell.
    up = _unit(up + np.array([0.0, 0.8, 0.0]) * np.clip(up[:, 1:2], 0.0, 1.0))
    base = head + up * (0.09 * made.s if is_neck else 0.0)
    ahead = np.zeros_like(head) if front is None else front
    ahead = _unit(ahead - up * np.sum(ahead * up, -1, keepdims=True))
    chest = {parents[arm.before[0] if arm.before else arm.upper] for arm in arms}
    above = next((i for i, joint in enumerate(trunk) if joint in chest), len(trunk) - 2)
    for a, b in zip(trunk[above + 1 :], trunk[above + 2 :], strict=False):
        made.capsule(a, b, 0.06, 0.056, SKIN)
    throat = made.point(base + (0.03 * up) * made.s)
    made.capsule(trunk[-1], throat, 0.056, 0.054, SKIN)
    chin = made.point(base + (0.012 * up + 0.03 * ahead) * made.s)
    skull = made.point(base + (0.078 * up + 0.006 * ahead) * made.s)
    made.capsule(chin, skull, 0.07, 0.094, SKIN)
    if front is not None:
        nose = made.point(base + (0.036 * up + 0.102 * ahead) * made.s)
        made.capsule(nose, nose, 0.016, 0.016, SKIN)
