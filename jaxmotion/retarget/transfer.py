"""Motion of one person's skeleton on another's, of other bones, axes and joints.

Both stand in the T-pose that `motion.anatomy` finds, whatever their rest poses are.
With D_j = R_j B_j^T a joint's turn from its T-pose B_j in the world:

1. Every joint of the target takes the turn of the source's joint of its role; spines
   and necks of other numbers of joints take the mean over what they overlap, and the
   spine swings until the chest is in the source's direction from the hips; what has no
   role (fingers, a face, a skirt) stays as it is at its parent.
2. The middle of the hips goes where the source's goes, scaled by the legs' lengths,
   from the height of the ankles over the ground.
3. The ball of each foot goes where the source's goes, scaled alike, so what is planted
   stays planted, and never below the ground. Thigh and shank follow in closed form,
   the knee on the side where the source's is; where a leg is too short, the hips sink.
   Each hand goes where the source's is from its shoulder, in lengths of the arm.
4. Twist bones take their part of the turn about the bone.

Everything is closed form: no step of Newton's method is needed, since a goal of a limb
of two bones within reach is met exactly.
"""

import dataclasses
import functools
import math
import operator
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jaxtyping import Array, Float

from jaxmotion.motion import anatomy, rotation
from jaxmotion.motion.anatomy import LEFT, RIGHT, Anatomy, Limb
from jaxmotion.motion.skeleton import Motion, Skeleton
from jaxmotion.retarget import roles as names

# An adult's ankle over the sole and thigh with shank, meters; how far behind the ankle
# the heel is.
_ANKLE, _LEG, _HEEL = 0.098, 0.87, 0.045
# Reach of a limb that is still bent a little, and the pull of knees ahead and elbows
# back where a limb is straight, in lengths of it.
_REACH, _PULL = 0.9999, 0.005


@dataclasses.dataclass(frozen=True, kw_only=True, eq=False)
class Rest:
    """A skeleton in its T-pose, and what its joints are; equal if all values are.

    Attributes:
      places: [J, 3] the root at the origin.
      turns: [J, 3, 3] world.
      sole: Height of the ground there.
    """

    skeleton: Skeleton
    roles: dict[str, str]
    anatomy: Anatomy
    places: np.ndarray
    turns: np.ndarray
    sole: float

    @functools.cached_property
    def _value(self) -> tuple[Any, ...]:
        bones = self.skeleton
        arrays = (bones.offsets, self.places, self.turns)
        return (
            (bones.names, bones.parents, self.anatomy, self.sole),
            tuple(sorted(self.roles.items())),
            tuple(np.asarray(x).tobytes() for x in arrays),
        )

    def __eq__(self, other: object) -> bool:
        return isinstance(other, Rest) and self._value == other._value

    def __hash__(self) -> int:
        return hash(self._value)

    def joint(self, role: str) -> int | None:
        """Index of a role's joint; None where it has none."""
        name = self.roles.get(role)
        return None if name is None else self.skeleton.names.index(name)

    @property
    def leg(self) -> float:
        """Mean length of thigh and shank."""
        return float(np.mean([sum(self.lengths(leg)) for leg in self.anatomy.legs]))

    def lengths(self, limb: Limb) -> tuple[float, float]:
        """Of a limb's two bones."""
        a, b, c = self.places[[limb.upper, limb.middle, limb.end]]
        return float(np.linalg.norm(b - a)), float(np.linalg.norm(c - b))


def rest(
    skeleton: Skeleton,
    *,
    given: Mapping[str, str] | str | Path | None = None,
    rotations: Float[np.ndarray, "frames joints 3 3"] | None = None,
    sole: float | None = None,
) -> Rest:
    """A skeleton in its T-pose.

    Args:
      given: Roles that are known; see `roles.find_roles`.
      rotations: World rotations of a motion, for skeletons whose zero pose does not
        stand; see `anatomy.t_pose`.
      sole: How far below the ankle joints the ground is when a foot is flat; None for
        an adult's.

    Where the skeleton names no feet they are its toes, or else its ankles.

    `ValueError` as `roles.find_roles`, or if a bone of a limb has no length.
    """
    roles = names.find_roles(skeleton, given)
    found = names.anatomy_of(skeleton, roles)
    places, turns = anatomy.t_pose(skeleton, None, rotations, found=found)
    for limb in (*found.arms, *found.legs):
        for a, b in ((limb.upper, limb.middle), (limb.middle, limb.end)):
            if np.linalg.norm(places[a] - places[b]) < 1e-6:
                raise ValueError(
                    f"the bone from {skeleton.names[a]!r} to {skeleton.names[b]!r} has "
                    "no length"
                )
    if not skeleton.feet:
        feet = [(*leg.after[:1], leg.end)[0] for leg in found.legs]
        skeleton = dataclasses.replace(skeleton, feet=tuple(feet))
    made = Rest(
        skeleton=skeleton,
        roles=roles,
        anatomy=found,
        places=places,
        turns=turns,
        sole=0.0,
    )
    ankle = float(np.mean([places[leg.end, 1] for leg in found.legs]))
    if sole is None:
        s = made.leg / _LEG
        toes = [places[leg.after[0], 1] for leg in found.legs if leg.after]
        drop = max(ankle - float(np.mean(toes)), 0.0) if toes else 0.0
        sole = drop + float(np.clip(_ANKLE * s - drop, 0.018 * s, 0.042 * s))
    return dataclasses.replace(made, sole=ankle - sole)


def _segments(rest: Rest, joints: list[int], end: np.ndarray) -> np.ndarray:
    """Parts of a chain's length at which each joint's bone begins, and the end."""
    points = np.concatenate([rest.places[joints], end[None]])
    steps = np.linalg.norm(np.diff(points, axis=0), axis=1)
    at = np.concatenate([[0.0], np.cumsum(steps)])
    return at / max(at[-1], 1e-9)


def _overlaps(target: np.ndarray, source: np.ndarray) -> np.ndarray:
    """How much of each target's bone lies along each of the source's; rows sum to 1."""
    low = np.maximum(target[:-1, None], source[None, :-1])
    high = np.minimum(target[1:, None], source[None, 1:])
    found = np.maximum(high - low, 0.0)
    for i, row in enumerate(found):
        if row.sum() < 1e-9:
            row[np.abs(source[:-1] - target[i]).argmin()] = 1.0
    return found / found.sum(axis=1, keepdims=True)


def _trunk(rest: Rest) -> tuple[list[int], list[int], np.ndarray, np.ndarray]:
    """Joints from hips to chest, and of the neck, and where the two end."""
    trunk = list(rest.anatomy.trunk)
    hips, chest = rest.joint("hips"), rest.joint("chest")
    assert hips is not None and chest is not None  # of every person
    spine = trunk[trunk.index(hips) : trunk.index(chest) + 1]
    above = trunk[trunk.index(chest) + 1 :]
    head = rest.joint("head")
    neck = [j for j in above if j != head]
    level = np.mean([rest.places[arm.upper] for arm in rest.anatomy.arms], axis=0)
    top = rest.places[above[0]] if above else level
    end = rest.places[head] if head is not None else top + [0.0, 1.0, 0.0]
    return spine, neck, top, end


def _sources(source: Rest, target: Rest) -> tuple[np.ndarray, list[int]]:
    """Whose turn each joint of the target takes [Jt, Js], and the leader of each.

    The leader is the joint of the target that it follows: itself where it has a role,
    else its parent's; -1 above the hips, where nothing turns.
    """
    parents = target.skeleton.parents
    rows = np.zeros((len(parents), source.skeleton.num_joints))
    leader = [-1] * len(parents)
    known: dict[int, np.ndarray] = {}
    eye = np.eye(rows.shape[1])
    spine_t, neck_t, top_t, end_t = _trunk(target)
    spine_s, neck_s, top_s, end_s = _trunk(source)
    parts = _overlaps(
        _segments(target, spine_t, top_t), _segments(source, spine_s, top_s)
    )
    for joint, row in zip(spine_t, parts, strict=True):
        known[joint] = row @ eye[spine_s]
    known[spine_t[-1]] = eye[spine_s[-1]]
    known[spine_t[0]] = eye[spine_s[0]]
    if neck_t:
        joints = neck_s or [spine_s[-1]]
        parts = _overlaps(
            _segments(target, neck_t, end_t), _segments(source, joints, end_s)
        )
        for joint, row in zip(neck_t, parts, strict=True):
            known[joint] = row @ eye[joints]
    for role in names.ROLES:
        mine, yours = target.joint(role), source.joint(role)
        if mine is None or role in ("hips", "chest", "neck"):
            continue
        if yours is None and role == "head":
            yours = source.anatomy.trunk[-1]
        if yours is not None:
            known[mine] = eye[yours]
    hips = target.joint("hips")
    for joint, parent in enumerate(parents):
        if joint in known:
            rows[joint], leader[joint] = known[joint], joint
        elif parent >= 0 and hips in anatomy.chain(parents, joint):
            rows[joint], leader[joint] = rows[parent], leader[parent]
    return rows, leader


# Computed here, once: the compiler would do it again in each place that needs it.
_settled = jax.lax.optimization_barrier


# Vectors are [n, 3, batch] and matrices [n, rows, columns, batch], and products are
# written out: they compile into few loops, which run over the batch.
def _times(a: Array, b: Array) -> Array:
    parts = [a[:, :, k, None] * b[:, None, k] for k in range(3)]
    return functools.reduce(operator.add, parts)


def _turned(a: Array, v: Array) -> Array:
    parts = [a[:, :, k] * v[:, k, None] for k in range(3)]
    return functools.reduce(operator.add, parts)


def _dot(a: Array, b: Array) -> Array:
    parts = [a[:, k, None] * b[:, k, None] for k in range(3)]
    return functools.reduce(operator.add, parts)


def _unit(v: Array) -> Array:
    return v / jnp.maximum(jnp.sqrt(_dot(v, v)), 1e-9)


def _swung(turns: Array, start: Array, end: Array) -> Array:
    """Turns after the smallest rotation between unit vectors that are not opposed.

    That is two half turns, about the first and about the middle of both.
    """
    middle = _unit(start + end)
    for axis in (start, middle):
        along = sum(axis[:, k, None, None] * turns[:, k, None] for k in range(3))
        turns = 2.0 * axis[:, :, None] * along - turns
    return turns


def _smallest(start: np.ndarray, end: np.ndarray) -> np.ndarray:
    """That rotation itself, [3, 3]."""
    middle = anatomy.unit(start + end)
    first, second = (2.0 * np.outer(x, x) - np.eye(3) for x in (start, middle))
    return second @ first


def _constant(vectors: Any) -> Array:
    """[n, 3] or [n, 3, 3] for the same in all of a batch."""
    return jnp.asarray(np.asarray(vectors, np.float32)[..., None])


def _world(
    skeleton: Skeleton, root_position: Array, joint_rotation: Array
) -> tuple[Array, Array]:
    """`global_transforms`, by generations of joints: few steps for few characters."""
    parents, offsets = skeleton.parents, np.asarray(skeleton.offsets)
    local = rotation.columns_from_rot6d(
        jnp.moveaxis(joint_rotation, 0, -1).swapaxes(0, 1)
    )
    local = jnp.moveaxis(local, 2, 0)
    depth = np.array([len(anatomy.chain(parents, j)) for j in range(len(parents))])
    places, turns, before = [root_position.T[None]], [local[:1]], np.array([0])
    order = [0]
    for number in range(2, depth.max() + 1):
        joints = np.flatnonzero(depth == number)
        up = np.searchsorted(before, [parents[j] for j in joints])
        parent = turns[-1][up]
        place = places[-1][up] + _turned(parent, _constant(offsets[joints]))
        place, turn = _settled((place, _times(parent, local[joints])))
        places.append(place)
        turns.append(turn)
        before = joints
        order += joints.tolist()
    back = np.argsort(order)
    return jnp.concatenate(places)[back], jnp.concatenate(turns)[back]


def two_bones(
    start: Float[Array, "limbs 3 batch"],
    goal: Float[Array, "limbs 3 batch"],
    pole: Float[Array, "limbs 3 batch"],
    a: Float[Array, "limbs 1 1"],
    b: Float[Array, "limbs 1 1"],
) -> Float[Array, "limbs 3 batch"]:
    """Where the middle joints of limbs are whose ends reach for goals.

    Goals beyond reach are pointed at; the middle joint is to the side of the pole, a
    direction; a and b are the bones' lengths.

    Source: the law of cosines.
    """
    way = goal - start
    far = jnp.sqrt(_dot(way, way))
    along = way / jnp.maximum(far, 1e-9)
    far = jnp.clip(far, jnp.abs(a - b) * 1.001 + 1e-9, _REACH * (a + b))
    cosine = jnp.clip((a * a + far * far - b * b) / (2 * a * far), -1.0, 1.0)
    sine = jnp.sqrt(jnp.maximum(1.0 - cosine * cosine, 0.0))
    aside = pole - along * _dot(along, pole)
    return start + a * (cosine * along + sine * _unit(aside))


@dataclasses.dataclass(frozen=True)
class Retarget:
    """Motions of the source to motions of the target; see the module.

    A pure function that may be jitted and vmapped with more. By itself `pose`, for
    ticks, is one program per pair of skeletons and shape; motions, whose lengths
    differ, are filled up to a power of two of frames.
    """

    source: Rest
    target: Rest

    @functools.cached_property
    def scale(self) -> float:
        """The target's legs in lengths of the source's."""
        return self.target.leg / self.source.leg

    @functools.cached_property
    def _rows(self) -> tuple[np.ndarray, list[int]]:
        return _sources(self.source, self.target)

    def _followers(self, joint: int) -> np.ndarray:
        """What turns as a joint does: itself, and what is below without a role."""
        leader = self._rows[1]
        return np.array([j for j, up in enumerate(leader) if up == joint])

    def __call__(self, motion: Motion) -> Motion:
        """The motion of the target of one of the source's, with whatever axes lead."""
        given = (motion.root_position, motion.joint_rotation)
        batch = given[0].shape[:-1]
        number = math.prod(batch)
        missing = (1 << max(number - 1, 0).bit_length()) - number
        if missing <= 0 or any(isinstance(x, Tracer) for x in given):
            root, turns = self.pose(*given)
        else:
            flat = (x.reshape(number, *x.shape[len(batch) :]) for x in given)
            filled = (
                jnp.pad(x, ((0, missing), *((0, 0),) * (x.ndim - 1)), mode="edge")
                for x in flat
            )
            root, turns = (x[:number] for x in self.pose(*filled))
            root = root.reshape(*batch, 3)
            turns = turns.reshape(*batch, *turns.shape[1:])
        return Motion(root_position=root, joint_rotation=turns, fps=motion.fps)

    def pose(
        self,
        root_position: Float[Array, "*batch 3"],
        joint_rotation: Float[Array, "*batch source 6"],
    ) -> tuple[Float[Array, "*batch 3"], Float[Array, "*batch target 6"]]:
        """Root positions and local rotations of the target, as `Motion` has them."""
        return _program(self)(root_position, joint_rotation)

    def _many(self, root_position: Array, joint_rotation: Array) -> tuple[Array, Array]:
        """Of many characters, one frame each."""
        given = _settled((root_position, joint_rotation))
        places, turns = _world(self.source.skeleton, *given)
        rows, leader = self._rows
        leaders = sorted({*leader} - {-1})
        back = _constant(np.swapaxes(self.source.turns, -1, -2))
        turned = _times(turns, back)
        parts = rows[leaders]
        # Where one joint leads, its turn; means are turned into rotations again.
        alone = parts.max(axis=1) > 1.0 - 1e-6
        if alone.all():
            turned = turned[parts.argmax(axis=1)]
        else:
            turned = jnp.tensordot(
                jnp.asarray(parts, turns.dtype), turned, 1, precision="highest"
            )
            columns = jnp.concatenate([turned[:, :, 0], turned[:, :, 1]], axis=1)
            turned = rotation.columns_from_rot6d(jnp.moveaxis(columns, 1, 0))
            turned = jnp.moveaxis(turned, 2, 0)
        turned, places = _settled((turned, places))
        # Row of each joint of the target that has a role.
        at = {joint: row for row, joint in enumerate(leaders)}
        turned = self._spine(places, turned, at)
        middle, goals = _settled(self._goals(places, turned, at))
        turned = self._limbs(places, turned, at, middle, goals)
        at[-1] = len(turned)  # above the hips
        still = jnp.broadcast_to(_constant([np.eye(3)]), (1, *turned.shape[1:]))
        turned = _settled(jnp.concatenate([turned, still]))
        turned = self._twists(turned, at)
        every = np.array([at.get(j, at[up]) for j, up in enumerate(leader)])
        world = _settled(_times(turned[every], _constant(self.target.turns)))
        parents = np.maximum(self.target.skeleton.parents, 0)
        local = _times(jnp.swapaxes(world[parents], 1, 2), world)
        local = jnp.concatenate([world[:1], local[1:]])
        number = self.target.joint("hips")
        assert number is not None  # of every person
        offset = self._hip_middle - self.target.places[number]
        hips = turned[at[number], None]
        # What is above the hips does not turn.
        root = middle - _turned(hips, _constant([offset]))
        root = root - _constant([self.target.places[number]])
        local = jnp.concatenate([local[:, :, 0], local[:, :, 1]], axis=1)
        return root[0].T, jnp.moveaxis(local, -1, 0)

    def _spine(self, places: Array, turned: Array, at: dict[int, int]) -> Array:
        """All turns after the chest was brought to where the source's is from the hips.

        Means over spines of other numbers of joints bend a little less or more.
        """
        yours, mine = _trunk(self.source)[0], _trunk(self.target)[0]
        if len(mine) < 3 or len(yours) < 2:
            return turned
        rest = np.diff(self.source.places[[yours[0], yours[-1]]], axis=0)[0]
        joints = self.target.places[mine]
        own = joints[-1] - joints[0]
        size = np.linalg.norm(own) / max(np.linalg.norm(rest), 1e-9)
        if not 1e-6 < size < 1e6:
            return turned
        hips = turned[at[mine[0]], None]
        # From its direction in one T-pose to that in the other, in axes of the hips.
        between = _smallest(anatomy.unit(rest), anatomy.unit(own))
        way = places[yours[-1], None] - places[yours[0], None]
        way = _turned(jnp.swapaxes(hips, 1, 2), way)
        way = _turned(_times(hips, _constant([between])), way)
        bones = np.diff(joints, axis=0)
        goal = size * way - _turned(hips, _constant(bones[:1]))
        middle = np.array([at[j] for j in mine[1:-1]])
        now = jnp.sum(_turned(turned[middle], _constant(bones[1:])), axis=0)[None]
        bent = _swung(turned[middle], _unit(now), _unit(goal))
        return self._replaced(turned, at, mine[1:-1], bent)

    def _replaced(
        self, turned: Array, at: dict[int, int], joints: list[int], new: Array
    ) -> Array:
        """All turns, and new ones of some joints, whose rows `at` then has."""
        at |= {joint: len(turned) + i for i, joint in enumerate(joints)}
        return _settled(jnp.concatenate([turned, new]))

    @functools.cached_property
    def _hip_middle(self) -> np.ndarray:
        """Between the target's hip joints in its T-pose."""
        return np.mean(
            [self.target.places[leg.upper] for leg in self.target.anatomy.legs], axis=0
        )

    def _pairs(self, limbs: str) -> list[tuple[Limb, Limb]]:
        """Limbs of source and target, by side."""
        both = []
        for side in (LEFT, RIGHT):
            found = [
                next(x for x in getattr(one.anatomy, limbs) if x.side == side)
                for one in (self.source, self.target)
            ]
            both.append((found[0], found[1]))
        return both

    def _goals(
        self, places: Array, turned: Array, at: dict[int, int]
    ) -> tuple[Array, Array]:
        """Where the middle of the hips [1, 3, batch] and the ankles go."""
        source, target, scale = self.source, self.target, self.scale
        pairs = self._pairs("legs")
        ankles = [
            float(np.mean([one.places[leg.end, 1] for leg in limbs])) - one.sole
            for one, limbs in zip(
                (source, target), zip(*pairs, strict=True), strict=True
            )
        ]
        # The source's point that leads each foot, from the target's ankle and as high
        # over the ground; heel and the sole under the ball, from the ankle.
        leads, points, heights, lows, reaches = [], [], [], [], []
        for yours, mine in pairs:
            ankle = target.places[mine.end]
            lows.append([[0.0, target.sole - ankle[1], -_HEEL * target.leg / _LEG]] * 2)
            if yours.after and mine.after:
                ball = target.places[mine.after[0]] - ankle
                own = float(ankle[1] + ball[1] - target.sole)
                other = float(source.places[yours.after[0], 1] - source.sole)
                leads.append(yours.after[0])
                points.append(ball)
                lows[-1][1] = ball - [0.0, own, 0.0]
            else:
                leads.append(yours.end)
                points.append(np.zeros(3))
                other, own = ankles
            heights.append([0.0, own - scale * other, 0.0])
            heel = source.sole - source.places[yours.end, 1]
            reaches.append([0.0, heel, -_HEEL * source.leg / _LEG])
        lift = _constant([[0.0, ankles[1] - scale * ankles[0], 0.0]])
        hips = [places[leg.upper, None] for leg, _ in pairs]
        middle = scale * 0.5 * (hips[0] + hips[1]) + lift
        feet = turned[np.array([at[mine.end] for _, mine in pairs])]
        goals = scale * places[np.array(leads)] + _constant(heights)
        goals = goals - _turned(feet, _constant(points))
        # Neither heel nor ball below the ground, or below the source's own.
        up = feet[:, 1]
        ends = places[np.array([yours.end for yours, _ in pairs]), 1, None]
        floor = jnp.minimum(scale * (ends + _dot(up, _constant(reaches))), 0.0)
        low = jnp.minimum(*(_dot(up, _constant(p)) for p in np.swapaxes(lows, 0, 1)))
        lift = jnp.maximum(floor - goals[:, 1, None] - low, 0.0)
        goals = goals + lift * _constant([[0.0, 1.0, 0.0]])
        # Where the leg is too short for its goal, the hips sink.
        gap = self._hips(turned, at, middle) - goals
        long = np.array([_REACH * sum(target.lengths(mine)) for _, mine in pairs])
        long = long.astype(np.float32)[:, None]
        aside = gap[:, 0] ** 2 + gap[:, 2] ** 2
        most = jnp.sqrt(jnp.maximum(long * long - aside, 0.0))
        drop = jnp.max(jnp.clip(gap[:, 1] - most, 0.0, 0.15 * long), axis=0)
        return middle - drop[None, None] * _constant([[0.0, 1.0, 0.0]]), goals

    def _hips(self, turned: Array, at: dict[int, int], middle: Array) -> Array:
        """The target's hip joints."""
        legs = [mine.upper for _, mine in self._pairs("legs")]
        offsets = self.target.places[legs] - self._hip_middle
        number = self.target.joint("hips")
        assert number is not None  # of every person
        return middle + _turned(turned[at[number], None], _constant(offsets))

    def _limbs(
        self,
        places: Array,
        turned: Array,
        at: dict[int, int],
        middle: Array,
        goals: Array,
    ) -> Array:
        """All turns after the legs have reached for goals, and the arms for theirs."""
        pairs = [*self._pairs("legs"), *self._pairs("arms")]
        yours, mine = zip(*pairs, strict=True)
        lengths = np.array([self.target.lengths(limb) for limb in mine])
        whole = np.array([sum(self.source.lengths(limb)) for limb in yours])
        upper, bend, end = (
            places[np.array([getattr(limb, name) for limb in yours])]
            for name in ("upper", "middle", "end")
        )
        hips = self._hips(turned, at, middle)
        part = _constant((lengths.sum(axis=1) / whole)[2:, None])
        start = jnp.concatenate([hips, jnp.zeros_like(hips)])
        goals = jnp.concatenate([goals, part * (end - upper)[2:]])
        rows = [
            np.array([at[getattr(limb, name)] for limb in mine])
            for name in ("upper", "middle")
        ]
        way, bent = _unit(end - upper), bend - upper
        bent = bent - way * _dot(bent, way)
        # Knees ahead and elbows back where a limb is straight.
        pull = _PULL * whole * np.array([1.0, 1.0, -1.0, -1.0])
        tops, lowers = (turned[row] for row in rows)
        pole = bent + _constant(pull[:, None]) * tops[:, :, 2]
        a, b = (_constant(x[:, None]) for x in lengths.T)
        joint = _settled(two_bones(start, goals, pole, a, b))
        # From where the middle joint is to the goal, or to as far as it can be.
        ways = (joint - start, goals - joint)
        made = []
        for turns, way, name, child in (
            (tops, ways[0], "upper", "middle"),
            (lowers, ways[1], "middle", "end"),
        ):
            bones = [
                anatomy.unit(
                    self.target.places[getattr(limb, child)]
                    - self.target.places[getattr(limb, name)]
                )
                for limb in mine
            ]
            now = _turned(turns, _constant(bones))
            made.append(_swung(turns, now, _unit(way)))
        joints = [limb.upper for limb in mine] + [limb.middle for limb in mine]
        return self._replaced(turned, at, joints, jnp.concatenate(made))

    @functools.cached_property
    def _twist_bones(self) -> list[tuple[int, int, int, int, float]]:
        """Twist joint, its limb's joint, the two whose turn counts, and its part.

        Beside a forearm or a shank it takes part of the hand's or the foot's turn, from
        0 at its beginning to 1 at its end; beside an upper arm or a thigh it gives back
        what is not its part of the limb's own turn from the trunk.
        """
        found = []
        skeleton = self.target.skeleton
        for limb in (*self.target.anatomy.arms, *self.target.anatomy.legs):
            above = skeleton.parents[limb.upper]
            for joint, a, b, start, shift in (
                (limb.middle, limb.middle, limb.end, limb.end, 0.0),
                (limb.upper, above, limb.upper, limb.middle, -1.0),
            ):
                bone = self.target.places[start] - self.target.places[joint]
                for twist in self._followers(joint):
                    away = self.target.places[twist] - self.target.places[joint]
                    part = float(away @ bone / (bone @ bone))
                    if "twist" in skeleton.names[twist].lower() and 0 <= part < 1.01:
                        found.append((int(twist), joint, a, b, min(part, 1.0) + shift))
        return found

    def _twists(self, turned: Array, at: dict[int, int]) -> Array:
        """All turns with those of the twist bones."""
        if not self._twist_bones:
            return turned
        twists, joints, above, below, parts = zip(*self._twist_bones, strict=True)
        bones = []
        for joint in joints:
            child = next(
                limb.middle if limb.upper == joint else limb.end
                for limb in (*self.target.anatomy.arms, *self.target.anatomy.legs)
                if joint in (limb.upper, limb.middle)
            )
            away = self.target.places[child] - self.target.places[joint]
            bones.append(anatomy.unit(away))
        bone = np.array(bones)
        # A joint between may have no role.
        a = turned[np.array([at[self._rows[1][j]] for j in above])]
        b = turned[np.array([at[self._rows[1][j]] for j in below])]
        between = _times(jnp.swapaxes(a, 1, 2), b)
        x, y, z = (_constant(bone[:, k]) for k in range(3))
        about = (
            (between[:, 2, 1] - between[:, 1, 2]) * x
            + (between[:, 0, 2] - between[:, 2, 0]) * y
            + (between[:, 1, 0] - between[:, 0, 1]) * z
        )
        trace = 1.0 + between[:, 0, 0] + between[:, 1, 1] + between[:, 2, 2]
        angle = 2.0 * jnp.arctan2(about, jnp.maximum(trace, 1e-6))
        angle = (_constant(parts) * angle)[:, None, None]
        cross = np.cross(np.eye(3), bone[:, None])
        outer = bone[:, :, None] * bone[:, None]
        cos, sin = jnp.cos(angle), jnp.sin(angle)
        turn = cos * _constant([np.eye(3)]) + sin * _constant(cross)
        turn = turn + (1 - cos) * _constant(outer)
        own = turned[np.array([at[joint] for joint in joints])]
        return self._replaced(turned, at, list(twists), _times(own, turn))


def page_json(source: Rest) -> dict[str, Any]:
    """What the page needs to bring a person's frames onto a rig: see `viz/web/rig.js`.

    The person itself, with lengths of limbs; the words of names; the module's numbers.
    """
    found = source.anatomy
    limbs = {
        kind: [
            {**dataclasses.asdict(limb), "lengths": source.lengths(limb)}
            for limb in getattr(found, kind)
        ]
        for kind in ("arms", "legs")
    }
    count = source.skeleton.num_joints
    person = {
        "parents": source.skeleton.parents,
        "offsets": np.asarray(source.skeleton.offsets, float).round(7).tolist(),
        "roles": {role: source.joint(role) for role in source.roles},
        "trunk": found.trunk,
        **limbs,
        "places": source.places.round(7).tolist(),
        "turns": source.turns.reshape(count, 9).round(7).tolist(),
        "sole": source.sole,
        "leg": source.leg,
    }
    numbers = {"ankle": _ANKLE, "leg": _LEG, "heel": _HEEL, "sole": anatomy.SOLE}
    numbers |= {"reach": _REACH, "pull": _PULL}
    return {"source": person, "tables": names.tables(), "numbers": numbers}


# Of values, so that a rig that is read again has a program; one is a megabyte.
@functools.lru_cache(maxsize=16)
def _program(
    function: Retarget,
) -> Callable[[Array, Array], tuple[Array, Array]]:
    # Reshapes inside: outside, each would cost as much as the rest.
    def pose(root_position: Array, joint_rotation: Array) -> tuple[Array, Array]:
        batch = root_position.shape[:-1]
        root, turns = function._many(
            root_position.reshape(-1, 3),
            joint_rotation.reshape(-1, *joint_rotation.shape[-2:]),
        )
        root = root.reshape(*batch, 3).astype(root_position.dtype)
        turns = turns.reshape(*batch, *turns.shape[1:])
        return root, turns.astype(joint_rotation.dtype)

    return jax.jit(pose)


def retarget(
    source: Skeleton | Rest,
    target: Skeleton | Rest,
    *,
    roles: Mapping[str, str] | str | Path | None = None,
    motion: Motion | None = None,
) -> Retarget:
    """The function that makes motions of the target of motions of the source.

    The target is any person's skeleton, or a `Rest` where more is known of it; roles
    are the target's, see `roles.find_roles`. Any second of the source's motion tells
    how its limbs are turned about themselves where its zero pose does not, see
    `anatomy.t_pose`. Raises as `rest`, and says which of the two.
    """
    both = []
    world = None
    if motion is not None and isinstance(source, Skeleton):
        world = anatomy.kinematics(source, motion)[1]
        world = world.reshape(-1, *world.shape[-3:])
    for what, one, given, turns in (
        ("source", source, None, world),
        ("target", target, roles, None),
    ):
        try:
            if not isinstance(one, Rest):
                one = rest(one, given=given, rotations=turns)
            both.append(one)
        except ValueError as error:
            raise ValueError(f"{what}: {error}") from None
    return Retarget(*both)
