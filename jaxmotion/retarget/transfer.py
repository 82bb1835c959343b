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
import operator
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxmotion.motion import anatomy, rotation
from jaxmotion.motion.anatomy import LEFT, RIGHT, Anatomy, Limb
from jaxmotion.motion.skeleton import Motion, Skeleton, global_transforms
from jaxmotion.retarget import roles as names

# An adult's ankle over the sole and thigh with shank, meters; how far behind the ankle
# the heel is.
_ANKLE, _LEG, _HEEL = 0.098, 0.87, 0.045
# Reach of a limb that is still bent a little, and the pull of knees ahead and elbows
# back where a limb is straight, in lengths of it.
_REACH, _PULL = 0.9999, 0.005


@dataclasses.dataclass(frozen=True, kw_only=True, eq=False)
class Rest:
    """A skeleton in its T-pose, and what its joints are.

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

    Raises:
      OSError, ValueError: see `roles.find_roles`.
      ValueError: if a bone of a limb has no length.
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


# Written out: products of 3 x 3 matrices then compile into the loops around them.
def _times(a: Array, b: Array) -> Array:
    parts = [a[..., :, k, None] * b[..., None, k, :] for k in range(3)]
    return functools.reduce(operator.add, parts)


def _turned(a: Array, v: np.ndarray | Array) -> Array:
    return functools.reduce(operator.add, (a[..., :, k] * v[k] for k in range(3)))


def _orthonormal(matrices: Array) -> Array:
    columns = jnp.concatenate([matrices[..., 0], matrices[..., 1]], axis=-1)
    return rotation.matrix_from_rot6d(columns)


def _swing(start: Array, end: Array) -> Array:
    """The smallest rotation between unit vectors that are not opposed."""
    v = jnp.cross(start, end)
    x, y, z = v[..., 0], v[..., 1], v[..., 2]
    o = jnp.zeros_like(x)
    cross = jnp.stack([o, -z, y, z, o, -x, -y, x, o], -1).reshape(*x.shape, 3, 3)
    far = 1.0 / jnp.maximum(1.0 + jnp.sum(start * end, axis=-1), 1e-4)
    return jnp.eye(3) + cross + far[..., None, None] * _times(cross, cross)


def _unit(v: Array) -> Array:
    return v / jnp.maximum(jnp.linalg.norm(v, axis=-1, keepdims=True), 1e-9)


def two_bones(
    start: Float[Array, "*batch 3"],
    goal: Float[Array, "*batch 3"],
    pole: Float[Array, "*batch 3"],
    a: float,
    b: float,
) -> Float[Array, "*batch 3"]:
    """Where the middle joint of a limb is whose end reaches for a goal.

    Args:
      start: Of the limb.
      goal: Of its end; beyond its reach, it points there.
      pole: A direction, to the side of which the middle joint is.
      a, b: Lengths of the two bones.

    Source: the law of cosines.
    """
    way = goal - start
    far = jnp.linalg.norm(way, axis=-1, keepdims=True)
    along = way / jnp.maximum(far, 1e-9)
    far = jnp.clip(far, abs(a - b) * 1.001 + 1e-9, _REACH * (a + b))
    cosine = jnp.clip((a * a + far * far - b * b) / (2 * a * far), -1.0, 1.0)
    sine = jnp.sqrt(jnp.maximum(1.0 - cosine * cosine, 0.0))
    aside = pole - along * jnp.sum(along * pole, axis=-1, keepdims=True)
    return start + a * (cosine * along + sine * _unit(aside))


@dataclasses.dataclass(frozen=True, eq=False)
class Retarget:
    """Motions of the source to motions of the target; see the module.

    A pure function, one program per shape; it may be jitted and vmapped with more.
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
        """The motion of the target.

        Args:
          motion: Of the source, with whatever axes lead.
        """
        root, turns = self.pose(motion.root_position, motion.joint_rotation)
        return Motion(root_position=root, joint_rotation=turns, fps=motion.fps)

    def pose(
        self,
        root_position: Float[Array, "*batch 3"],
        joint_rotation: Float[Array, "*batch source 6"],
    ) -> tuple[Float[Array, "*batch 3"], Float[Array, "*batch target 6"]]:
        """Root positions and local rotations of the target, as `Motion` has them."""
        return self._program(root_position, joint_rotation)

    @functools.cached_property
    def _program(self) -> Callable[[Array, Array], tuple[Array, Array]]:
        many = jax.vmap(self._one)

        # Reshapes inside: outside, each would cost as much as the rest.
        def pose(root_position: Array, joint_rotation: Array) -> tuple[Array, Array]:
            batch = root_position.shape[:-1]
            root, turns = many(
                root_position.reshape(-1, 3),
                joint_rotation.reshape(-1, *joint_rotation.shape[-2:]),
            )
            return root.reshape(*batch, 3), turns.reshape(*batch, *turns.shape[1:])

        return jax.jit(pose)

    def _one(self, root_position: Array, joint_rotation: Array) -> tuple[Array, Array]:
        """Of one character in one frame."""
        places, turns = global_transforms(
            self.source.skeleton, root_position, joint_rotation
        )
        rows, leader = self._rows
        leaders = sorted({*leader} - {-1})
        back = jnp.asarray(np.swapaxes(self.source.turns, -1, -2), turns.dtype)
        mixed = jnp.einsum(
            "ts,sij->tij",
            jnp.asarray(rows[leaders], turns.dtype),
            _times(turns, back),
            precision="highest",
        )
        mixed, places = _settled((_orthonormal(mixed), places))
        # By joint of the target: those that have a role.
        turned = {joint: mixed[i] for i, joint in enumerate(leaders)}
        turned = self._spine(places, turned)
        middle, goals = _settled(self._goals(places, turned))
        turned = self._legs(places, turned, middle, goals)
        turned = self._arms(places, turned)
        turned[-1] = jnp.eye(3, dtype=turns.dtype)  # above the hips
        twists = self._twists(turned)
        turned = [twists.get(j, turned[up]) for j, up in enumerate(leader)]
        hips = turned[self.target.joint("hips")]  # pyright: ignore
        turned = _settled(jnp.stack(turned))
        world = _times(turned, jnp.asarray(self.target.turns, turns.dtype))
        parents = np.maximum(self.target.skeleton.parents, 0)
        local = _times(jnp.swapaxes(world[parents], -1, -2), world)
        local = jnp.concatenate([world[:1], local[1:]])
        number = self.target.joint("hips")
        offset = self._hip_middle - self.target.places[number]
        root = middle - _turned(hips, offset.astype(np.float32))
        # What is above the hips does not turn.
        root = root - self.target.places[number].astype(np.float32)
        return root, rotation.rot6d_from_matrix(local)

    def _spine(self, places: Array, turned: dict[int, Array]) -> dict[int, Array]:
        """All turns after the chest was brought to where the source's is from the hips.

        Means over spines of other numbers of joints bend a little less or more.
        """
        yours, mine = _trunk(self.source)[0], _trunk(self.target)[0]
        if len(mine) < 3 or len(yours) < 2:
            return turned
        hips, at = turned[mine[0]], self.target.places[mine]
        rest = np.diff(self.source.places[[yours[0], yours[-1]]], axis=0)[0]
        own = at[-1] - at[0]
        size = np.linalg.norm(own) / max(np.linalg.norm(rest), 1e-9)
        if not 1e-6 < size < 1e6:
            return turned
        # From its direction in one T-pose to that in the other.
        between = _swing(
            jnp.asarray(anatomy.unit(rest)), jnp.asarray(anatomy.unit(own))
        )
        way = _times(hips, _times(between.astype(hips.dtype), hips.T))
        goal = size * jnp.einsum("ij,j->i", way, places[yours[-1]] - places[yours[0]])
        bones = np.diff(at, axis=0).astype(np.float32)
        goal = goal - _turned(hips, bones[0])
        now = jnp.zeros(3)
        for joint, bone in zip(mine[1:-1], bones[1:], strict=True):
            now = now + _turned(turned[joint], bone)
        swing = _swing(_unit(now), _unit(goal))
        return turned | {j: _settled(_times(swing, turned[j])) for j in mine[1:-1]}

    @functools.cached_property
    def _hip_middle(self) -> np.ndarray:
        """Between the target's hip joints in its T-pose."""
        return np.mean(
            [self.target.places[leg.upper] for leg in self.target.anatomy.legs], axis=0
        )

    def _scaled(self, points: Array, source: float, target: float) -> Array:
        """The source's points for the target; both have a height that is the same."""
        lift = jnp.array([0.0, target - self.scale * source, 0.0], points.dtype)
        return self.scale * points + lift

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
        self, places: Array, turned: dict[int, Array]
    ) -> tuple[Array, list[Array]]:
        """Where the middle of the hips and the ankles go."""
        source, target = self.source, self.target
        pairs = self._pairs("legs")
        heights = []
        for one, limbs in (
            (source, [p[0] for p in pairs]),
            (target, [p[1] for p in pairs]),
        ):
            heights.append(
                float(np.mean([one.places[leg.end, 1] for leg in limbs])) - one.sole
            )
        middle = 0.5 * sum(places[leg.upper] for leg, _ in pairs)
        middle = self._scaled(jnp.asarray(middle), *heights)
        goals, drops = [], []
        for yours, mine in pairs:
            foot = turned[mine.end]
            ankle = target.places[mine.end]
            # Heel and the sole under the ball, from the ankle.
            low = [np.array([0.0, target.sole - ankle[1], -_HEEL * target.leg / _LEG])]
            if yours.after and mine.after:
                ball = target.places[mine.after[0]] - ankle
                own = float(ankle[1] + ball[1] - target.sole)
                other = float(source.places[yours.after[0], 1] - source.sole)
                goal = self._scaled(places[yours.after[0]], other, own)
                goal = goal - _turned(foot, ball.astype(np.float32))
                low.append(ball - [0.0, own, 0.0])
            else:
                goal = self._scaled(places[yours.end], *heights)
            # Neither heel nor ball below the ground, or below the source's own.
            reach = np.array([0.0, source.sole - source.places[yours.end, 1], 0.0])
            heel = reach - [0.0, 0.0, _HEEL * source.leg / _LEG]
            floor = _turned(foot, heel.astype(np.float32))[..., 1]
            floor = jnp.minimum(self.scale * (places[yours.end, 1] + floor), 0.0)
            under = [
                floor - goal[..., 1] - _turned(foot, p.astype(np.float32))[..., 1]
                for p in low
            ]
            lift = jnp.maximum(jnp.max(jnp.stack(under), axis=0), 0.0)
            goal = goal.at[..., 1].add(lift)
            goals.append(goal)
            # Where the leg is too short for its goal, the hips sink.
            hip = self._hip(turned, middle, mine)
            long = _REACH * sum(target.lengths(mine))
            aside = jnp.sum((hip - goal)[..., [0, 2]] ** 2, axis=-1)
            most = goal[..., 1] + jnp.sqrt(jnp.maximum(long * long - aside, 0.0))
            drops.append(jnp.clip(hip[..., 1] - most, 0.0, 0.15 * long))
        middle = middle.at[..., 1].add(-jnp.maximum(*drops))
        return middle, goals

    def _hip(self, turned: dict[int, Array], middle: Array, leg: Limb) -> Array:
        """The target's hip joint."""
        hips = self.target.joint("hips")
        offset = self.target.places[leg.upper] - self._hip_middle
        turn = turned[hips]  # pyright: ignore[reportArgumentType]
        return middle + _turned(turn, offset.astype(np.float32))

    def _aimed(
        self, turned: dict[int, Array], joint: int, child: int, direction: Array
    ) -> dict[int, Array]:
        """All turns after a joint's bone was swung to a direction."""
        bone = anatomy.unit(self.target.places[child] - self.target.places[joint])
        now = _turned(turned[joint], bone.astype(np.float32))
        swing = _swing(now, _unit(direction))
        return turned | {joint: _settled(_times(swing, turned[joint]))}

    def _limb(
        self,
        turned: dict[int, Array],
        places: Array,
        yours: Limb,
        mine: Limb,
        start: Array,
        goal: Array,
        ahead: float,
    ) -> dict[int, Array]:
        """All turns after a limb of two bones has reached for a goal."""
        a, b = self.target.lengths(mine)
        upper, middle, end = (places[j] for j in (yours.upper, yours.middle, yours.end))
        way = _unit(end - upper)
        bent = middle - upper
        bent = bent - way * jnp.sum(bent * way, axis=-1, keepdims=True)
        straight = _PULL * sum(self.source.lengths(yours)) * ahead
        pole = bent + straight * turned[mine.upper][:, 2]
        joint = two_bones(start, goal, pole, a, b)
        turned = self._aimed(turned, mine.upper, mine.middle, joint - start)
        # From where the middle joint is to the goal, or to as far as it can be.
        return self._aimed(turned, mine.middle, mine.end, goal - joint)

    def _legs(
        self, places: Array, turned: dict[int, Array], middle: Array, goals: list[Array]
    ) -> dict[int, Array]:
        for (yours, mine), goal in zip(self._pairs("legs"), goals, strict=True):
            hip = self._hip(turned, middle, mine)
            turned = self._limb(turned, places, yours, mine, hip, goal, 1.0)
        return turned

    def _arms(self, places: Array, turned: dict[int, Array]) -> dict[int, Array]:
        for yours, mine in self._pairs("arms"):
            part = sum(self.target.lengths(mine)) / sum(self.source.lengths(yours))
            goal = part * (places[yours.end] - places[yours.upper])
            start = jnp.zeros_like(goal)
            turned = self._limb(turned, places, yours, mine, start, goal, -1.0)
        return turned

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

    def _twists(self, turned: dict[int, Array]) -> dict[int, Array]:
        """Turns of the twist bones."""
        found = {}
        for twist, joint, a, b, part in self._twist_bones:
            child = next(
                limb.middle if limb.upper == joint else limb.end
                for limb in (*self.target.anatomy.arms, *self.target.anatomy.legs)
                if joint in (limb.upper, limb.middle)
            )
            bone = anatomy.unit(self.target.places[child] - self.target.places[joint])
            x, y, z = bone.astype(np.float32)
            above = turned[self._rows[1][a]]  # a joint between may have no role
            between = _times(above.T, turned[b])
            skew = between - between.T
            about = skew[2, 1] * x + skew[0, 2] * y + skew[1, 0] * z
            trace = jnp.maximum(1.0 + jnp.trace(between), 1e-6)
            angle = part * 2.0 * jnp.arctan2(about, trace)
            cross = jnp.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
            turn = jnp.cos(angle) * jnp.eye(3) + jnp.sin(angle) * cross
            turn = turn + (1 - jnp.cos(angle)) * np.outer(bone, bone).astype("f4")
            found[twist] = _times(turned[joint], turn)
        return found


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


def retarget(
    source: Skeleton | Rest,
    target: Skeleton | Rest,
    *,
    roles: Mapping[str, str] | str | Path | None = None,
    motion: Motion | None = None,
) -> Retarget:
    """The function that makes motions of the target of motions of the source.

    Args:
      source: Such as `model.skeleton`.
      target: Any person's skeleton; or a `Rest`, where more is known of it.
      roles: Of the target; see `roles.find_roles`.
      motion: Any second of the source's, where its zero pose does not tell how its
        limbs are turned about themselves; see `anatomy.t_pose`.

    Raises:
      OSError, ValueError: see `rest`; says which of the two.
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
