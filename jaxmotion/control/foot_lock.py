"""Feet that stand where they were put down.

A network's frames slide: while a foot carries the body its toe drifts by some
centimeters per second. The lock holds the toe at the point where the contact began and
bends the leg to reach it.

1. **Contact.** A toe is in contact from the frame in which it is slow and low until it
   is fast or high; the thresholds of the end lie above those of the beginning, so that
   a contact does not flicker.
2. **Lock.** A contact that begins locks the toe at the point of the ground where it is
   displayed. The lock ends with the contact, or when the animated toe is farther than
   `radius` from the point, or when locks would cross the legs of who turns on the spot;
   during one contact it begins again where the toe has caught up. Into and out of the
   lock, the offset between what was displayed and what is wanted now decays as a
   critically damped spring: no jump. Only the two horizontal coordinates are locked:
   the height stays the model's, since a toe that is held down while it lifts would be
   dragged over the ground.
3. **Body.** While all feet are locked the body follows them: a character that is told
   to stand and whose plans creep away stays over its feet. The body moves back to its
   plan when a foot lifts; it strays from it by `body_reach` at most.
4. **Leg.** The ankle moves by as much as the toe has to, by two-bone inverse
   kinematics: the interior angles follow from the law of cosines,

       cos(hip)  = (a^2 + d^2 - b^2) / (2 a d)                                     (1)
       cos(knee) = (a^2 + b^2 - d^2) / (2 a b)                                     (2)

   with the lengths a and b of thigh and shank and the distance d from hip to ankle,
   both before and after; the knee turns by the difference about the axis it is bent
   about already, so it never flips. As d approaches a + b, it does so exponentially
   (`softness`): a leg that is pulled too far does not snap straight. The foot keeps its
   orientation, but for what the leg cannot reach and a heel that would sink.
5. **Swing.** A toe that moves is off the ground, be it animated so or on its way out of
   a lock: at the speed v its least height over where it rests is

       clearance (1 - exp(-max(v - clear_from, 0) / clear_over))                  (3)

   Networks that turn a body at once drag the toes. Of a person's that move at more than
   .2 m/s seven in eight are higher (O3DE's takes; ours).

A frame that needs no correction comes back as it was. A controller that can be told
what was displayed (`Controller.shown`) plans on from there: the next plan begins with
the feet where they stand, and no offset outlives a plan.

Source: the offset spring and the order of lock and release after D. Holden's notes on
motion matching; two-bone inverse kinematics is textbook geometry.
"""

import dataclasses
import functools
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from jaxmotion.control import sampling
from jaxmotion.control.rollout import Controller
from jaxmotion.control.steering import Character, Method, Tuning
from jaxmotion.motion.rotation import length, product, rot6d_from_matrix, safe_normalize
from jaxmotion.motion.rotation_vector import to_matrix
from jaxmotion.motion.skeleton import Motion, Skeleton, global_transforms
from jaxmotion.motion.spring import spring
from jaxmotion.typing import Key

_UP = (0.0, 1.0, 0.0)


@dataclasses.dataclass(frozen=True, kw_only=True)
class FootLock:
    """Settings of the lock.

    Attributes:
      toe_height: Height at which a standing toe rests, below which no displayed one
        goes, meters; other skeletons than the shipped models' have their own.
      ankle_height: Height below which no displayed ankle goes, meters.
      begin_speed: A contact begins below this speed, meters per second,
      begin_height: and below this height of the toe over its rest, meters.
      end_speed: It ends above this speed,
      end_height: or above this height.
      clearance: Least height above `toe_height` of a toe that moves fast, meters.
      clear_from: A toe that is slower may stay as low as it is, meters per second.
      clear_over: Speed beyond that at which its least height is all but 1/e of the
        clearance, meters per second.
      radius: Distance of the animated toe from the locked point that ends a lock,
        meters.
      crossing: Distance aside of the first toe from the second one, from hip to hip,
        below which a lock that brings it there ends, meters.
      caught_up: Distance from the animated toe within which a toe that lost its lock
        during a contact is locked anew, meters.
      half_life: Half-life of the offset into and out of a lock, seconds.
      body_half_life: Half-life in which the body moves over its locked feet, and back
        to where the model has it when a foot is free, seconds.
      body_reach: Most that it is moved, meters; 0 for a body that stays the model's.
      softness: Distance from full stretch at which a leg begins to resist, meters.
    """

    toe_height: float = 0.02
    ankle_height: float = 0.04
    begin_speed: float = 0.5
    begin_height: float = 0.03
    end_speed: float = 0.6
    end_height: float = 0.08
    clearance: float = 0.035
    clear_from: float = 0.15
    clear_over: float = 1.0
    radius: float = 0.2
    crossing: float = 0.03
    caught_up: float = 0.01
    half_life: float = 0.05
    body_half_life: float = 0.2
    body_reach: float = 0.1
    softness: float = 0.015


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True, kw_only=True, eq=False)
class LockState:
    """Both feet of a character between two frames; world, meters and seconds.

    Attributes:
      animated: Toes of the last frame as the model had them, moved with the body.
      shown: The same as they were displayed.
      contact: Whether each toe is in contact.
      locked: Whether each toe is locked.
      point: Where it is locked, if so.
      offset: Offset of what is displayed from what is wanted.
      offset_velocity: The rate of that.
      body: How far the body (x, z) is displayed from where the model has it.
      body_velocity: The rate of that.
      started: Whether there was a frame before.
    """

    animated: Float[Array, "*batch feet 3"]
    shown: Float[Array, "*batch feet 3"]
    contact: Bool[Array, "*batch feet"]
    locked: Bool[Array, "*batch feet"]
    point: Float[Array, "*batch feet 3"]
    offset: Float[Array, "*batch feet 3"]
    offset_velocity: Float[Array, "*batch feet 3"]
    body: Float[Array, "*batch 2"]
    body_velocity: Float[Array, "*batch 2"]
    started: Bool[Array, "*batch"]


def legs(skeleton: Skeleton) -> tuple[tuple[int, int, int, int], ...]:
    """Hip, knee, ankle and toe of each foot; `ValueError` if one has no leg."""
    if not skeleton.feet:
        raise ValueError("the skeleton names no feet: there is nothing to lock")
    found = []
    for toe in skeleton.feet:
        chain = [toe]
        while len(chain) < 4 and skeleton.parents[chain[0]] > 0:
            chain.insert(0, skeleton.parents[chain[0]])
        if len(chain) < 4:
            raise ValueError(
                f"foot {skeleton.names[toe]!r} has {len(chain) - 1} joints between it "
                "and the root, expected hip, knee and ankle"
            )
        found.append(tuple(chain))
    return tuple(found)


def init_lock(skeleton: Skeleton) -> LockState:
    """State before the first frame; nothing is locked."""
    count = len(legs(skeleton))
    zeros, none = jnp.zeros((count, 3)), jnp.zeros(count, bool)
    return LockState(
        animated=zeros,
        shown=zeros,
        contact=none,
        locked=none,
        point=zeros,
        offset=zeros,
        offset_velocity=zeros,
        body=jnp.zeros(2),
        body_velocity=jnp.zeros(2),
        started=jnp.zeros((), bool),
    )


def contacts(
    was: Bool[Array, " feet"],
    speed: Float[Array, " feet"],
    height: Float[Array, " feet"],
    *,
    lock: FootLock,
) -> Bool[Array, " feet"]:
    """Which toes are in contact now, given which were: thresholds with hysteresis."""
    up = height - lock.toe_height
    begins = (speed < lock.begin_speed) & (up < lock.begin_height)
    goes_on = (speed < lock.end_speed) & (up < lock.end_height)
    # No `jnp.where`: onnxruntime has none of booleans.
    return (was & goes_on) | (~was & begins)


def least_heights(
    speed: Float[Array, "*frames feet"], *, lock: FootLock
) -> Float[Array, "*frames feet"]:
    """Heights below which toes are not displayed: part 5 of the module's text."""
    over = jnp.maximum(speed - lock.clear_from, 0.0) / lock.clear_over
    return lock.toe_height - lock.clearance * jnp.expm1(-over)


def _would_cross(
    toes: Array, wanted: Array, side: Float[Array, "3"], *, lock: FootLock
) -> Bool[Array, ""]:
    """Whether locks, but not the model, bring the first toe across the second one."""
    gap, own = (jnp.sum((x[0] - x[1]) * side) for x in (wanted, toes))
    return (gap < lock.crossing) & (own - gap > 0.05)


def step_lock(
    state: LockState,
    toes: Float[Array, "feet 3"],
    *,
    fps: float,
    lock: FootLock,
    side: Float[Array, "3"] | None = None,
) -> LockState:
    """Where the toes are to be displayed: parts 1, 2 and 5 of the module's text.

    From the state after the last frame and the animated toes of this one (world) comes
    the state of this frame; its `shown` is where the toes belong. `side` is the
    horizontal direction from the second foot's hip to the first one's, if there are
    two; without it locks may cross the legs.
    """
    dt = 1.0 / fps
    velocity = jnp.where(state.started, (toes - state.animated) * fps, 0.0)
    speed = jnp.sqrt(jnp.sum(velocity**2, axis=-1) + 1e-12)
    contact = contacts(state.contact, speed, toes[:, 1], lock=lock)
    contact = contact & state.started

    # What was displayed: the wanted place of the last frame and the offset from it.
    target = jnp.where(state.locked[:, None], state.point, toes)
    still = spring(
        state.offset,
        state.offset_velocity,
        jnp.zeros_like(state.offset),
        half_life=lock.half_life,
        dt=dt,
    )
    offset, offset_velocity = still
    here = target + offset
    moving = jnp.where(state.locked[:, None], 0.0, velocity)

    level = jnp.array([[1.0, 0.0, 1.0]])
    # A foot that was pulled off its point stands again once it has caught up.
    left = jnp.sqrt(jnp.sum(offset**2 * level, axis=-1) + 1e-12)
    again = ~state.locked & (left < lock.caught_up) & (speed < lock.begin_speed)
    begins = contact & (~state.contact | again)
    point = jnp.where(begins[:, None], here, state.point)
    away = jnp.sqrt(jnp.sum((point - toes) ** 2 * level, axis=-1) + 1e-12)
    locked = (state.locked | begins) & contact & (away < lock.radius)
    if side is not None:
        kept = jnp.where(locked[:, None], point, toes)
        crosses = _would_cross(toes, kept, side, lock=lock)
        away = jnp.where(locked, away, -1.0)
        # The one that is farther from where the model has it.
        goes = (away >= jnp.max(away)) & crosses
        locked = locked & ~goes
    wanted = jnp.where(locked[:, None], point, toes)
    wanted_velocity = jnp.where(locked[:, None], 0.0, velocity)

    # A change of what is wanted goes into the offset, so that nothing jumps.
    changed = (locked != state.locked)[:, None] | begins[:, None]
    offset = jnp.where(changed, here - wanted, offset)
    offset_velocity = jnp.where(
        changed, moving + offset_velocity - wanted_velocity, offset_velocity
    )
    shown = jnp.where(level > 0, wanted + offset, toes)
    swings = jnp.where(contact, 0.0, speed)
    moved = jnp.sqrt(jnp.sum((shown - state.shown) ** 2 * level, axis=-1) + 1e-12)
    steps = jnp.where(state.started & ~locked, moved * fps, 0.0)
    least = least_heights(jnp.maximum(swings, steps), lock=lock)
    return dataclasses.replace(
        state,
        animated=toes,
        shown=shown.at[:, 1].max(least),
        contact=contact,
        locked=locked,
        point=point,
        offset=offset,
        offset_velocity=offset_velocity,
        started=jnp.ones((), bool),
    )


def _move_body(state: LockState, *, fps: float, lock: FootLock) -> LockState:
    """The body on its way to where its feet are locked: part 3 of the module's text."""
    pull = jnp.mean((state.point - state.animated)[:, ::2], axis=0)
    goal = state.body + pull
    goal = goal * jnp.minimum(1.0, lock.body_reach / length(goal))
    body, velocity = spring(
        state.body,
        state.body_velocity,
        jnp.where(jnp.all(state.locked), goal, 0.0),
        half_life=lock.body_half_life,
        dt=1.0 / fps,
    )
    return dataclasses.replace(state, body=body, body_velocity=velocity)


def _angle(cosine: Array) -> Array:
    """Inverse of the cosine with a gradient that is finite everywhere."""
    return jnp.arccos(jnp.clip(cosine, -1.0 + 1e-6, 1.0 - 1e-6))


def _turn(axis: Array, angle: Array) -> Array:
    return to_matrix(axis * angle[..., None])


def _swing(start: Array, end: Array) -> Array:
    """Least rotation from one direction to another; not for opposite ones."""
    start, end = (safe_normalize(x, jnp.array(_UP)) for x in (start, end))
    cross, cosine = jnp.cross(start, end), jnp.sum(start * end, axis=-1)
    x, y, z = cross
    zero = jnp.zeros_like(x)
    skew = jnp.array([[zero, -z, y], [z, zero, -x], [-y, x, zero]])
    return jnp.eye(3) + skew + product(skew, skew) / jnp.maximum(1.0 + cosine, 1e-3)


def solve_leg(
    positions: Float[Array, "4 3"],
    rotations: Float[Array, "4 3 3"],
    toe: Float[Array, "3"],
    *,
    bend: Float[Array, "3"],
    lock: FootLock,
) -> Float[Array, "3 3 3"]:
    """World rotations of hip, knee and ankle that bring the toe to a place.

    They stay as they are where the toe is in its place. Positions (hip, knee, ankle and
    toe, as animated) and rotations are in the world. A straight leg bends about `bend`:
    the knee moves along the cross product of it and the leg's direction.
    """
    hip, knee, ankle, animated = positions
    goal = ankle + toe - animated
    goal = goal.at[1].set(jnp.maximum(goal[1], lock.ankle_height))
    thigh, shank = length(knee - hip), length(ankle - knee)
    before, asked = length(ankle - hip), length(goal - hip)
    # The last centimeters of stretch are approached, never reached; a leg that is
    # animated straighter than that may stay so.
    start = jnp.maximum(thigh + shank - lock.softness, before)
    rest = jnp.maximum(thigh + shank - start, 1e-4)
    over = jnp.maximum(asked - start, 0.0)
    after = jnp.where(over > 0.0, start + rest * (1.0 - jnp.exp(-over / rest)), asked)
    after = jnp.maximum(after, jnp.abs(thigh - shank) + 1e-3)

    def interior(distance: Array) -> tuple[Array, Array]:
        at_hip = (thigh**2 + distance**2 - shank**2) / (2 * thigh * distance)
        at_knee = (thigh**2 + shank**2 - distance**2) / (2 * thigh * shank)
        return _angle(at_hip), _angle(at_knee)

    (hip_0, knee_0), (hip_1, knee_1) = interior(before), interior(after)
    own = jnp.cross(ankle - hip, knee - hip) / (thigh * shank)
    along = (ankle - hip) / before
    spare = bend - jnp.sum(bend * along) * along
    sine = length(own)
    axis = safe_normalize(
        jnp.where(sine > 0.02, own, own + (1.0 - sine / 0.02) * spare), bend
    )
    opened = _turn(axis, hip_1 - hip_0)
    lower = _turn(axis, hip_1 - hip_0 + knee_1 - knee_0)
    swing = _swing(ankle - hip, goal - hip)
    # The foot keeps its orientation, then looks at the toe's place.
    reached = hip + after * safe_normalize(goal - hip, jnp.array(_UP))
    look = _swing(animated - ankle, toe - reached)
    return jnp.stack(
        [
            product(product(swing, opened), rotations[0]),
            product(product(swing, lower), rotations[1]),
            product(look, rotations[2]),
        ]
    )


def place_toes(
    skeleton: Skeleton,
    positions: Float[Array, "joints 3"],
    rotations: Float[Array, "joints 3 3"],
    joint_rotation: Float[Array, "joints 6"],
    toes: Float[Array, "feet 3"],
    *,
    lock: FootLock,
) -> Float[Array, "joints 6"]:
    """Rotations of a pose whose toes are moved to other places: part 4.

    Only hips, knees and ankles differ. Places are in the world, meters; none lower than
    that of a standing toe is taken.
    """
    chains = legs(skeleton)
    # Knees bend about the line between the hips, so that the shank goes back.
    hips = [chain[0] for chain in chains]
    side = positions[hips[0]] - positions[hips[-1]] if len(hips) > 1 else None
    new = rotations
    for i, chain in enumerate(chains):
        joints = jnp.array(chain)
        bend = rotations[0][:, 0] if side is None else side
        solved = solve_leg(
            positions[joints],
            rotations[joints],
            jnp.maximum(toes[i], jnp.array([-jnp.inf, lock.toe_height, -jnp.inf])),
            bend=-safe_normalize(bend, jnp.array([1.0, 0.0, 0.0])),
            lock=lock,
        )
        new = new.at[joints[:3]].set(solved.astype(new.dtype))
    changed = sorted({joint for chain in chains for joint in chain[:3]})
    index = jnp.array(changed)
    parents = jnp.array([skeleton.parents[joint] for joint in changed])
    local = product(jnp.swapaxes(new[parents], -1, -2), new[index])
    found = rot6d_from_matrix(local).astype(joint_rotation.dtype)
    return joint_rotation.at[index].set(found)


def lock_frame(
    skeleton: Skeleton,
    state: LockState,
    root_position: Float[Array, "3"],
    joint_rotation: Float[Array, "joints 6"],
    *,
    fps: float,
    lock: FootLock,
) -> tuple[LockState, Float[Array, "3"], Float[Array, "joints 6"]]:
    """The next frame with its feet, the skeleton's toes, locked.

    Beside the state come the root's position (world, meters) and the rotations.
    """
    state = _move_body(state, fps=fps, lock=lock)
    root_position = root_position.at[::2].add(state.body)
    places, turns = global_transforms(skeleton, root_position, joint_rotation)
    toes = places[jnp.array(skeleton.feet)]
    hips = [places[chain[0]] for chain in legs(skeleton)]
    side = None
    if len(hips) == 2:
        level = (hips[0] - hips[1]) * jnp.array([1.0, 0.0, 1.0])
        side = safe_normalize(level, jnp.array([1.0, 0.0, 0.0]))
    state = step_lock(state, toes, fps=fps, lock=lock, side=side)
    shown = place_toes(skeleton, places, turns, joint_rotation, state.shown, lock=lock)
    return state, root_position, shown


def _planted(
    toes: Float[Array, "frames feet 3"], *, fps: float, lock: FootLock
) -> Bool[Array, "frames-1 feet"]:
    """Whether each toe is in contact in a frame and in the next one."""
    velocity = jnp.diff(toes, axis=0) * fps
    speed = jnp.sqrt(jnp.sum(velocity**2, axis=-1) + 1e-12)

    def step(was: Array, now: tuple[Array, Array]) -> tuple[Array, Array]:
        is_now = contacts(was, *now, lock=lock)
        return is_now, is_now

    none = jnp.zeros(toes.shape[1], bool)
    return jax.lax.scan(step, none, (speed, toes[:-1, :, 1]))[1]


def toe_offsets(
    toes: Float[Array, "frames feet 3"],
    planted: Bool[Array, "frames-1 feet"],
    *,
    stand: float = 1e4,
    smooth: float = 10.0,
) -> Float[Array, "frames feet 2"]:
    """Least changes of the toes' paths (x, z), meters, after which planted toes stand.

    With toes p and offsets o it minimizes, over all frames at once,

        sum |o_f|^2  +  stand sum_planted |o_{f+1} - o_f + p_{f+1} - p_f|^2
                     +  smooth sum |o_{f+1} - 2 o_f + o_{f-1}|^2                   (4)

    by conjugate gradients: the terms are least squares, so the optimum is a linear
    system.

    Args:
      toes: World, meters.
      planted: Whether a toe should not move from a frame to the next.
    """
    path = toes[..., ::2]
    weight = stand * planted[..., None].astype(path.dtype)

    def normal(o: Array) -> Array:
        return jax.grad(lambda x: cost(x, jnp.zeros_like(path)))(o)

    def cost(o: Array, path: Array) -> Array:
        moved = jnp.diff(o + path, axis=0)
        bent = jnp.diff(o, n=2, axis=0)
        terms = (jnp.sum(o**2), jnp.sum(weight * moved**2), smooth * jnp.sum(bent**2))
        return (terms[0] + terms[1] + terms[2]) / 2

    right = -jax.grad(cost)(jnp.zeros_like(path), path)
    return jax.scipy.sparse.linalg.cg(normal, right, tol=1e-6, maxiter=2000)[0]


@functools.partial(jax.jit, static_argnames=("lock",))
def clean_motion(skeleton: Skeleton, motion: Motion, *, lock: FootLock) -> Motion:
    """A recorded or generated motion of one character whose planted feet stand.

    Unlike the lock of frame after frame it looks ahead: toes begin to move to their
    places before the contact begins, see `toe_offsets`.
    """
    transforms = jax.vmap(functools.partial(global_transforms, skeleton))
    places, turns = transforms(motion.root_position, motion.joint_rotation)
    toes = places[:, jnp.array(skeleton.feet)]
    planted = _planted(toes, fps=motion.fps, lock=lock)
    steps = jnp.diff(toes, axis=0) * motion.fps
    speed = jnp.sqrt(jnp.sum(steps**2, axis=-1) + 1e-12)
    least = least_heights(jnp.where(planted, 0.0, speed), lock=lock)
    wanted = toes.at[..., ::2].add(toe_offsets(toes, planted).astype(toes.dtype))
    wanted = wanted.at[:-1, :, 1].max(least.astype(toes.dtype))
    place = jax.vmap(functools.partial(place_toes, skeleton, lock=lock))
    rotations = place(places, turns, motion.joint_rotation, wanted)
    return dataclasses.replace(motion, joint_rotation=rotations)


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True, kw_only=True, eq=False)
class LockedState:
    """State of a controller and of its character's feet.

    Attributes:
      inner: The controller's own.
      feet: From `init_lock` at the start.
    """

    inner: Any
    feet: LockState


def _absorb(state: LockState) -> LockState:
    """The state at the start of a plan that goes on from what is displayed."""
    keep = state.locked[:, None]
    none = jnp.zeros_like(state.body)
    return dataclasses.replace(
        state,
        animated=state.shown,
        offset=jnp.where(keep, state.offset, 0.0),
        offset_velocity=jnp.where(keep, state.offset_velocity, 0.0),
        body=none,
        body_velocity=none,
    )


def locked(
    controller: Controller,
    skeleton: Skeleton,
    *,
    fps: float,
    lock: FootLock,
    enabled: bool | Bool[Array, ""] = True,
) -> Controller:
    """A controller that displays its frames with locked feet.

    Its state is a `LockedState`. Where `enabled`, which may be traced, is False, it
    displays frames as they come, and forgets what was locked.
    """

    def planner(plan: Any) -> Any:
        def run(key: Any, state: LockedState, command: Any) -> LockedState:
            feet = state.feet if controller.shown is None else _absorb(state.feet)
            return LockedState(inner=plan(key, state.inner, command), feet=feet)

        return run

    def advance(state: LockedState, command: Any) -> tuple[LockedState, Any]:
        inner, frame = controller.advance(state.inner, command)
        feet, root, rotations = lock_frame(
            skeleton,
            state.feet,
            frame.root_position,
            frame.joint_rotation,
            fps=fps,
            lock=lock,
        )
        if enabled is not True:
            off = (init_lock(skeleton), frame.root_position, frame.joint_rotation)
            feet, root, rotations = jax.tree.map(
                lambda x, y: jnp.where(enabled, x, y), (feet, root, rotations), off
            )
        frame = dataclasses.replace(frame, root_position=root, joint_rotation=rotations)
        if controller.shown is not None:
            inner = controller.shown(inner, frame)
        return LockedState(inner=inner, feet=feet), frame

    return dataclasses.replace(
        controller,
        plan_level=lambda state, command: controller.plan_level(state.inner, command),
        plans=tuple(planner(plan) for plan in controller.plans),
        advance=advance,
    )


@dataclasses.dataclass(frozen=True)
class _Method:
    """Makes the controller with locked feet of parameters and the skeleton."""

    method: Method
    fps: float
    lock: FootLock
    enabled: bool | Bool[Array, ""] = True

    def __call__(self, params: Any) -> Controller:
        inner, skeleton = params
        return locked(
            self.method(inner),
            skeleton,
            fps=self.fps,
            lock=self.lock,
            enabled=self.enabled,
        )


def _tuning(inner: Tuning, fps: float, lock: FootLock) -> Tuning:
    def tuned(num_steps: int, scale: Any, *, locks: Any = True) -> Method:
        return _Method(inner.method(num_steps, scale), fps, lock, locks)

    return dataclasses.replace(inner, method=tuned, lockable=True)


def lock_of(character: Character) -> FootLock:
    """Default settings, with toes that rest where the character's do."""
    if character.toe_height is None:
        return FootLock()
    return FootLock(toe_height=character.toe_height)


def lock_feet(character: Character, lock: FootLock | None = None) -> Character:
    """A character that is displayed with locked feet; its states are `LockedState`s.

    lock None: that of `lock_of`. `ValueError` unless the skeleton has feet with legs.
    """
    lock = lock_of(character) if lock is None else lock
    feet = init_lock(character.skeleton)

    def with_feet(states: Any) -> LockedState:
        number = jax.tree.leaves(states)[0].shape[0]
        every = jax.tree.map(lambda x: jnp.repeat(x[None], number, axis=0), feet)
        return LockedState(inner=states, feet=every)

    clip_starts, tuning = character.clip_starts, character.tuning
    return dataclasses.replace(
        character,
        params=(character.params, character.skeleton),
        method=_Method(character.method, character.fps, lock),
        tuning=tuning and _tuning(tuning, character.fps, lock),
        starts=lambda labels, seed: with_feet(character.starts(labels, seed)),
        clip_starts=clip_starts
        and (lambda clips, labels, seed: with_feet(clip_starts(clips, labels, seed))),
    )


@dataclasses.dataclass(frozen=True)
class _Cleaned:
    """Makes motions whose planted feet stand, of parameters and the skeleton."""

    method: sampling.Method
    lock: FootLock

    def __call__(self, params: Any) -> Callable[[Key, Array], Motion]:
        inner, skeleton = params
        make = self.method(inner)
        return lambda key, label: clean_motion(
            skeleton, make(key, label), lock=self.lock
        )


def clean_sampler(
    sampler: sampling.Sampler, lock: FootLock | None = None
) -> sampling.Sampler:
    """A sampler whose motions stand on their planted feet; see `clean_motion`.

    lock None: default settings. `ValueError` unless the skeleton has feet with legs.
    """
    legs(sampler.skeleton)
    return dataclasses.replace(
        sampler,
        params=(sampler.params, sampler.skeleton),
        method=_Cleaned(sampler.method, FootLock() if lock is None else lock),
    )
