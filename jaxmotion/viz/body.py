"""A body around a skeleton: limbs as tapered capsules, a head, hands and feet.

Joints are points without thickness, and most skeletons end at the skull's base, at the
wrists and at the balls of the feet. What is missing is added in proportions of an
adult, scaled to the legs. A body is made once, from the skeleton in its T-pose; every
capsule then follows the joints that its two ends are fixed to. Pictures, pages, files
and the live page all draw this one description.
"""

import dataclasses

import numpy as np
from jaxtyping import Float

from jaxmotion.motion import anatomy
from jaxmotion.motion.anatomy import Anatomy, Limb, unit
from jaxmotion.motion.skeleton import Skeleton
from jaxmotion.viz.figure import LEFT, MIDDLE, RIGHT

LEFT_DARK, RIGHT_DARK, SKIN = "#174f8c", "#942020", "#c9a084"
_COLORS = {anatomy.LEFT: LEFT, anatomy.RIGHT: RIGHT, anatomy.MIDDLE: MIDDLE}
_DARK = {LEFT: LEFT_DARK, RIGHT: RIGHT_DARK, MIDDLE: MIDDLE}

# Thigh and shank of the adult whose measures stand below, meters.
_LEG = 0.87
_UP, _AHEAD = np.array([0.0, 1.0, 0.0]), np.array([0.0, 0.0, 1.0])


@dataclasses.dataclass(frozen=True, kw_only=True)
class Body:
    """Capsules whose ends are fixed to joints.

    Attributes:
      joints: [S, 2] joint that each end follows, mostly the same for both.
      places: [S, 2, 3] ends in those joints' frames, meters; twice the same for a ball.
      radii: [S, 2] at both ends, meters.
      colors: S, such as "#2878c8".
    """

    joints: np.ndarray
    places: np.ndarray
    radii: np.ndarray
    colors: tuple[str, ...]

    def ends(
        self,
        positions: Float[np.ndarray, "*batch joints 3"],
        rotations: Float[np.ndarray, "*batch joints 3 3"],
    ) -> Float[np.ndarray, "*batch capsules 2 3"]:
        """Where the capsules end in the world, meters.

        Args:
          positions: Of the joints, world, meters; see `skeleton.global_transforms`.
          rotations: Of the joints, world.
        """
        turned = rotations[..., self.joints, :, :] @ self.places[..., None]
        return positions[..., self.joints, :] + turned[..., 0]


def capsule_mesh(
    ends: np.ndarray, radii: np.ndarray, *, around: int = 12, rings: int = 4
) -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """A tapered capsule as triangles.

    Args:
      ends: [2, 3] centers of its two balls, meters.
      radii: [2] meters.
      around: Vertices in a ring.
      rings: Rings of each ball's half.

    Returns:
      Vertices [V, 3] and normals [V, 3]; the end (0 or 1) that each belongs to [V];
      faces [T, 3], counterclockwise from outside.
    """
    along = ends[1] - ends[0]
    length = float(np.linalg.norm(along))
    z = along / length if length > 1e-9 else _UP
    x = np.cross(z, _UP if abs(z[1]) < 0.9 else _AHEAD)
    x = x / np.linalg.norm(x)
    y = np.cross(z, x)
    # Where the balls' common tangent cone touches them.
    lean = np.arcsin(np.clip((radii[0] - radii[1]) / max(length, 1e-9), -0.99, 0.99))
    lean = lean if length > 1e-9 else 0.0
    low = np.linspace(-np.pi / 2, lean, rings + 1)
    high = np.linspace(lean, np.pi / 2, rings + 1)
    angle = np.concatenate([low, high])[:, None]
    owner = np.repeat([0, 1], rings + 1)
    turn = np.linspace(0, 2 * np.pi, around, endpoint=False)
    flat = np.cos(turn)[:, None] * x + np.sin(turn)[:, None] * y
    normals = np.cos(angle)[..., None] * flat + np.sin(angle)[..., None] * z
    vertices = ends[owner][:, None] + radii[owner][:, None, None] * normals
    here = np.arange(len(angle) - 1)[:, None] * around + np.arange(around)
    right = np.roll(here, -1, axis=1)
    faces = np.stack(
        [here, right, right + around, here, right + around, here + around], axis=-1
    ).reshape(-1, 3)
    # The outermost rings are points: half of their triangles have no area.
    corner = vertices.reshape(-1, 3)[faces]
    sides = np.cross(corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0])
    faces = faces[np.linalg.norm(sides, axis=-1) > 1e-12]
    owner = np.repeat(owner, around)
    return vertices.reshape(-1, 3), normals.reshape(-1, 3), owner, faces


class _Builder:
    """Collects points and capsules; `s` are meters of this body in one of the adult."""

    def __init__(self, skeleton: Skeleton, sides: tuple[str, ...] | None):
        self.parents = skeleton.parents
        joints, self.turns = anatomy.t_pose(skeleton, sides)
        self.joints = joints
        self.points = list(joints)
        self.owners = list(range(len(joints)))
        self.shapes: list[tuple[int, int, float, float, str]] = []
        self.s = 1.0

    def point(self, place: np.ndarray, owner: int) -> int:
        self.points.append(place)
        self.owners.append(owner)
        return len(self.points) - 1

    def capsule(self, a: int, b: int, ra: float, rb: float, color: str) -> None:
        self.shapes.append((a, b, ra * self.s, rb * self.s, color))

    def between(self, a: int, b: int, part: float, owner: int) -> int:
        return self.point((1 - part) * self.points[a] + part * self.points[b], owner)

    def _followed(self, a: int, b: int) -> tuple[int, int]:
        """Joints that the ends follow: one for both where that comes to the same."""
        could = [{self.owners[p]} for p in (a, b)]
        for found, p in zip(could, (a, b), strict=True):
            if p < len(self.parents) and self.parents[p] >= 0:
                found.add(self.parents[p])
        common = could[0] & could[1]
        return (min(common),) * 2 if common else (self.owners[a], self.owners[b])

    def body(self) -> Body:
        followed = [self._followed(a, b) for a, b, *_ in self.shapes]
        places = [
            [
                self.turns[joint].T @ (self.points[p] - self.joints[joint])
                for p, joint in zip((a, b), pair, strict=True)
            ]
            for (a, b, *_), pair in zip(self.shapes, followed, strict=True)
        ]
        return Body(
            joints=np.array(followed, int),
            places=np.array(places),
            radii=np.array([shape[2:4] for shape in self.shapes]),
            colors=tuple(shape[4] for shape in self.shapes),
        )


def describe(skeleton: Skeleton, sides: tuple[str, ...] | None = None) -> Body:
    """The body of a skeleton.

    Args:
      sides: `anatomy.LEFT`, `RIGHT` or `MIDDLE` of each joint; None for what the names
        and the zero pose say. Left is blue and right is red.

    Raises:
      ValueError: if `sides` are not one a joint.
    """
    found = anatomy.find_anatomy(skeleton, sides)
    made = _Builder(skeleton, sides)
    parents = skeleton.parents
    offsets = np.asarray(skeleton.offsets, float)
    lengths = np.linalg.norm(offsets, axis=-1) * (np.arange(len(parents)) > 0)
    if found.legs:
        leg = [lengths[leg.middle] + lengths[leg.end] for leg in found.legs]
        made.s = max(float(np.mean(leg)) / _LEG, 1e-3)
    else:
        reach = lengths.copy()
        for joint, parent in enumerate(parents):
            reach[joint] += reach[parent] if parent >= 0 else 0.0
        made.s = max(float(reach.max()) / 1.2, 1e-3)
    colors = [_COLORS[side] for side in found.sides]
    done: set[int] = set()
    if found.legs:
        done |= set(found.trunk)
        _add_trunk(made, found)
    for leg in found.legs:
        _add_leg(made, leg, colors[leg.middle])
        done |= {leg.upper, leg.middle, leg.end, *leg.before, *leg.after[:1]}
    for arm in found.arms:
        _add_arm(made, arm, colors[arm.middle])
        done |= {arm.upper, arm.middle, arm.end, *arm.before}
    hands = {arm.end for arm in found.arms}
    for joint in range(1, len(parents)):
        if parents[joint] in hands:
            hands.add(joint)
        if joint in done or lengths[joint] < 1e-6:
            continue
        finger = parents[joint] in hands
        radius = 0.011 if finger else min(0.04, 0.2 * lengths[joint] / made.s + 0.01)
        color = SKIN if finger else colors[joint]
        made.capsule(parents[joint], joint, radius, radius, color)
    if len(found.trunk) > 1:
        _add_head(made, found)
    if not made.shapes:
        made.capsule(0, 0, 0.05, 0.05, MIDDLE)
    return made.body()


def _add_trunk(made: _Builder, found: Anatomy) -> None:
    """Belly, chest, pelvis, flanks and shoulders."""
    trunk = found.trunk
    pelvis = made.parents[found.legs[0].first]
    first = min(trunk.index(made.parents[arm.first]) for arm in found.arms)
    for a, b in zip(trunk[:first], trunk[1 : first + 1], strict=True):
        if trunk.index(a) >= trunk.index(pelvis):
            made.capsule(a, b, 0.105, 0.105, MIDDLE)
    chest = trunk[first]
    nape = trunk[min(first + 1, len(trunk) - 1)]
    made.capsule(chest, nape, 0.1, 0.055, MIDDLE)
    for leg in found.legs:
        hip = made.between(leg.upper, pelvis, 0.15, pelvis)
        made.capsule(pelvis, hip, 0.1, 0.088, MIDDLE)
    for arm in found.arms:
        owner = arm.before[-1] if arm.before else chest
        shoulder = made.between(arm.upper, chest, 0.3, owner)
        made.capsule(chest, shoulder, 0.1, 0.066, MIDDLE)
        made.capsule(nape, shoulder, 0.05, 0.06, MIDDLE)
        away = made.joints[arm.upper] - made.joints[chest]
        hip = max(
            (leg.upper for leg in found.legs),
            key=lambda hip, away=away: away @ (made.joints[hip] - made.joints[pelvis]),
        )
        low = made.between(hip, pelvis, 0.25, pelvis)
        ribs = made.between(shoulder, low, 0.35, chest)
        made.capsule(ribs, shoulder, 0.085, 0.066, MIDDLE)
        made.capsule(ribs, low, 0.085, 0.085, MIDDLE)


def _add_leg(made: _Builder, leg: Limb, color: str) -> None:
    dark = _DARK[color]
    made.capsule(leg.upper, leg.middle, 0.082, 0.056, color)
    calf = made.between(leg.middle, leg.end, 0.3, leg.middle)
    made.capsule(leg.middle, calf, 0.056, 0.054, color)
    made.capsule(calf, leg.end, 0.054, 0.038, color)
    ankle = made.joints[leg.end]
    if leg.after:
        ball = leg.after[0]
    else:
        ball = made.point(ankle + (0.15 * _AHEAD - 0.05 * _UP) * made.s, leg.end)
    # The T-pose stands: the sole is level there.
    level = (made.points[ball] - ankle) * [1.0, 0.0, 1.0]
    level = unit(level) if np.linalg.norm(level) > 1e-6 else _AHEAD
    drop = max(ankle[1] - made.points[ball][1] - 0.008 * made.s, 0.0)
    heel = made.point(ankle - _UP * drop - level * 0.035 * made.s, leg.end)
    place = made.points[ball] + level * 0.055 * made.s - _UP * 0.003 * made.s
    tip = made.point(place, made.owners[ball])
    middle = made.between(leg.end, heel, 0.5, leg.end)
    made.capsule(leg.end, heel, 0.04, 0.036, dark)
    made.capsule(leg.end, ball, 0.042, 0.034, dark)
    made.capsule(middle, ball, 0.038, 0.034, dark)
    made.capsule(heel, ball, 0.036, 0.034, dark)
    made.capsule(ball, tip, 0.034, 0.026, dark)


def _add_arm(made: _Builder, arm: Limb, color: str) -> None:
    made.capsule(arm.upper, arm.upper, 0.062, 0.062, color)
    made.capsule(arm.upper, arm.middle, 0.054, 0.041, color)
    made.capsule(arm.middle, arm.end, 0.042, 0.029, color)
    along = unit(made.joints[arm.end] - made.joints[arm.middle])
    knuckles = [j for j, parent in enumerate(made.parents) if parent == arm.end]
    if knuckles:
        place = np.mean([made.joints[j] for j in knuckles], axis=0)
    else:
        place = made.joints[arm.end] + along * 0.075 * made.s
    palm = made.point(place, arm.end)
    made.capsule(arm.end, palm, 0.03, 0.038, SKIN)
    if all(j not in made.parents for j in knuckles):
        tip = made.point(place + along * 0.055 * made.s, arm.end)
        made.capsule(palm, tip, 0.038, 0.024, SKIN)


def _add_head(made: _Builder, found: Anatomy) -> None:
    trunk = found.trunk
    top = trunk[-1]
    up = unit(made.joints[top] - made.joints[trunk[-2]])
    up = unit(up + 1.5 * _UP) if up[1] > 0 else up
    base = made.joints[top] + up * (0.0 if found.has_head else 0.09 * made.s)
    carriers = [trunk.index(made.parents[arm.first]) for arm in found.arms]
    above = min(carriers, default=len(trunk) - 2)
    for a, b in zip(trunk[above + 1 :], trunk[above + 2 :], strict=False):
        made.capsule(a, b, 0.06, 0.056, SKIN)
    ahead = unit(_AHEAD - up * (_AHEAD @ up))
    throat = made.point(base + (0.03 * up) * made.s, top)
    made.capsule(top, throat, 0.056, 0.054, SKIN)
    chin = made.point(base + (0.012 * up + 0.03 * ahead) * made.s, top)
    skull = made.point(base + (0.078 * up + 0.006 * ahead) * made.s, top)
    made.capsule(chin, skull, 0.07, 0.094, SKIN)
    if found.legs:
        nose = made.point(base + (0.036 * up + 0.102 * ahead) * made.s, top)
        made.capsule(nose, nose, 0.016, 0.016, SKIN)
