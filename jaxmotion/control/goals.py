"""Goals on the ground: paths, places with times, persons to follow, without collisions.

Each goal is a function of one walker, made of arrays, that says which velocity to ask
for now; `vmap` makes many. `goal_rollouts` closes the loop: what characters are asked
for in a tick depends on where they have come, in one compiled program.

* A path is pursued: the walker heads for the point of it that lies a little ahead of
  the nearest one, at the speed that the path has there (pure pursuit).
* A place is reached at a time: the speed is that with which the time suffices if the
  last meters slow down exponentially, to a slow step; who would have to creep waits
  first, and who stopped too far from it turns and goes on.
* Who is followed is followed at a distance, with his velocity.
* Walkers who would collide choose another velocity, each half of the way round the
  other: of sampled ones the cheapest by its difference from the wanted one and by how
  soon it would collide.

Source: Coulter 1992, "Implementation of the Pure Pursuit Path Tracking Algorithm"; van
den Berg, Lin and Manocha 2008, "Reciprocal Velocity Obstacles for Real-Time Multi-Agent
Navigation". Speeds and distances are ours.
"""

import dataclasses
import functools
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jaxtyping import Array, Float, Int

from jaxmotion.control import rollout, steering
from jaxmotion.control.frame import Frame
from jaxmotion.control.steering import (
    AHEAD,
    ARRIVE,
    HEADING_STEP,
    LAG,
    SPEED_STEP,
    Character,
)
from jaxmotion.motion import ground
from jaxmotion.motion.rotation import length
from jaxmotion.motion.spring import Scalar
from jaxmotion.motion.trajectory import Command
from jaxmotion.typing import Key, Params

# A path is looked at so many meters ahead at least; the nearest point of it is sought
# within so many meters of the last one. Points a meter farther along it count as so
# much farther away: where it goes back the way it came, the way there comes first.
NEAREST, REACH, LATER = 0.25, 1.0, 0.01
# Nobody is asked to go slower or faster, m/s, but to stop, nor to slow down below the
# last: standing, `locomotion_fast` does not begin at .2 to .45 m/s.
SLOWEST, FASTEST, CREEP = 0.6, 3.5, 0.45
# Nor is who moves asked to come nearer than this to a place, meters, nor who stands
# within twice as much; within the last, to start anew: steps so short end beyond it.
THERE, BESIDE = 0.05, 0.2
# Radius of a walker, meters; collisions within so many seconds count; what a collision
# in one second is worth in m/s. Another direction shows after so many seconds (of
# `locomotion`): counting on half of them, walkers in a crowd run into each other.
RADIUS, HORIZON, FEAR, TURNING = 0.35, 3.0, 2.0, 0.5
_ANGLES, _PARTS = 16, (0.35, 0.7, 1.0)


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True, kw_only=True, eq=False)
class Walker:
    """Where somebody is and how he moves on the ground (x, z), meters and seconds."""

    position: Float[Array, "*batch 2"]
    velocity: Float[Array, "*batch 2"]
    facing: Float[Array, "*batch 2"]


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True, kw_only=True, eq=False)
class Path:
    """Points to walk along, and where it ends to stand.

    Attributes:
      points: (x, z), meters; two at least, no two in a row the same.
      speed: At each point, m/s; linear between them.
    """

    points: Float[Array, "*batch points 2"]
    speed: Float[Array, "*batch points"]


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True, kw_only=True, eq=False)
class Place:
    """Where to stand from when on.

    Attributes:
      position: (x, z), meters.
      facing: Unit; taken up at the place.
      seconds: When to arrive, from the beginning.
    """

    position: Float[Array, "*batch 2"]
    facing: Float[Array, "*batch 2"]
    seconds: Float[Array, "*batch"]


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True, kw_only=True, eq=False)
class Follow:
    """Whom to follow.

    Attributes:
      leader: Index of another walker; his own: he is led by commands.
      distance: Meters; one for all, or one for each.
    """

    leader: Int[Array, "*batch"]
    distance: Float[Array, "*#batch"]


Goal = Path | Place | Follow


def _along(path: Path, way: Array) -> tuple[Array, Array, Array]:
    """Point and speed of a path after a way along it, meters, and its whole length."""
    steps = length(jnp.diff(path.points, axis=0))
    marks = jnp.concatenate([jnp.zeros(1), jnp.cumsum(steps)])
    point = jnp.stack(
        [jnp.interp(way, marks, path.points[:, i]) for i in (0, 1)], axis=-1
    )
    return point, jnp.interp(way, marks, path.speed), marks[-1]


def pursue(
    path: Path, walker: Walker, way: Float[Array, ""], *, ahead: Scalar = AHEAD
) -> tuple[Float[Array, "2"], Float[Array, ""]]:
    """Velocity along a path, and how far along it the walker now is.

    He has come `way` meters and never goes back, so that a path may cross itself. He
    looks so many seconds ahead.
    """
    here = walker.position + LAG * walker.velocity
    ways = way + jnp.linspace(0.0, REACH, 41)
    points, _, whole = _along(path, ways)
    near = jnp.argmin(length(points - here[None]) + LATER * (ways - way))
    way = jnp.minimum(ways[near], whole)
    _, speed, _ = _along(path, way)
    goal, _, _ = _along(path, way + jnp.maximum(ahead * speed, NEAREST))
    # Slower to the end.
    left = whole - way + length(path.points[-1] - here) * (way >= whole)
    speed = jnp.minimum(speed, left / ARRIVE)
    speed = jnp.where(left < THERE, 0.0, speed)
    heading = ground.unit(goal - here, walker.facing)
    return speed * heading, way


def _seconds_to(distance: Array, speed: Array) -> Array:
    """How long it takes at a speed that falls with the distance in the end."""
    slow = jnp.minimum(distance, speed * ARRIVE)
    last = jnp.minimum(slow, CREEP * ARRIVE)
    end = ARRIVE * jnp.log(jnp.maximum(slow / (CREEP * ARRIVE), 1.0))
    return (distance - slow) / speed + end + last / CREEP


def arrive(
    place: Place, walker: Walker, seconds: Float[Array, ""], *, coast: Scalar = LAG
) -> tuple[Float[Array, "2"], Float[Array, "2"]]:
    """Velocity and facing of who is to be at a place at a time; it is `seconds` now.

    He slows down to a slow step, and takes up the facing. Who stands within 10 cm
    stays there; within 20 cm he is asked to go as slowly as he is near, and farther off
    he starts anew, facing where he goes.

    Told to slow down, he goes on as he was for `coast` seconds.
    """
    gap = place.position - walker.position - coast * walker.velocity
    distance, left = length(gap), place.seconds - seconds
    slow, fast = jnp.float32(SLOWEST), jnp.float32(FASTEST)

    def halve(ends: tuple[Array, Array], _: None) -> tuple[tuple[Array, Array], None]:
        middle = 0.5 * (ends[0] + ends[1])
        late = _seconds_to(distance, middle) > left
        return (
            jnp.where(late, middle, ends[0]),
            jnp.where(late, ends[1], middle),
        ), None

    (_, speed), _ = jax.lax.scan(halve, (slow, fast), None, length=16)
    moving = length(walker.velocity) > 0.5 * SLOWEST
    waits = ~moving & (_seconds_to(distance, slow) < left)
    there = distance < jnp.where(moving, THERE, 2 * THERE)
    least = jnp.where(moving, CREEP, SLOWEST * (distance > BESIDE))
    speed = jnp.maximum(jnp.minimum(speed, distance / ARRIVE), least)
    speed = speed * ~(waits | there)
    heading = ground.unit(gap, walker.facing)
    near = distance < jnp.where(moving, 0.5 * ARRIVE, BESIDE)
    facing = jnp.where(near, place.facing, jnp.where(waits, walker.facing, heading))
    return speed * heading, facing


def follow(
    leader: Walker, walker: Walker, distance: Float[Array, ""]
) -> Float[Array, "2"]:
    """Velocity of who keeps his distance behind another."""
    gap = leader.position - walker.position
    back = ground.unit(leader.velocity, ground.unit(gap))
    wish = leader.velocity + (gap - distance * back) / ARRIVE
    # Who is near enough to one who stands stands, too.
    rest = length(leader.velocity) < 0.5 * SLOWEST
    slack = length(gap) - distance
    wish = jnp.where(rest, ground.unit(gap) * slack / ARRIVE, wish)
    speed = jnp.minimum(length(wish), FASTEST)
    speed = jnp.where(rest & (slack < 2 * THERE), 0.0, speed)
    return speed * ground.unit(wish, walker.facing)


def _collides(gap: Array, velocity: Array, radius: Array) -> Float[Array, "..."]:
    """Seconds until a gap that changes with a velocity is as small as a radius."""
    a = jnp.sum(jnp.square(velocity), axis=-1) + 1e-9
    b = jnp.sum(gap * velocity, axis=-1)
    c = jnp.sum(jnp.square(gap), axis=-1) - radius**2
    root = b * b - a * c
    when = (-b - jnp.sqrt(jnp.maximum(root, 0.0))) / a
    hits = (root > 0.0) & (b < 0.0)
    # Who is too near already only minds what brings him nearer.
    when = jnp.where(c < 0.0, jnp.where(b < 0.0, 0.05, jnp.inf), when)
    return jnp.where(hits | (c < 0.0), jnp.maximum(when, 0.05), jnp.inf)


def avoid(
    wanted: Float[Array, "walkers 2"],
    walkers: Walker,
    circles: Float[Array, "circles 3"] | None = None,
    *,
    radius: float = RADIUS,
) -> Float[Array, "walkers 2"]:
    """Velocities, m/s, near those wanted with which nobody runs into anybody.

    Circles are center (x, z) and radius of what stands around, meters, as `radius` is.

    Source: van den Berg et al. 2008, sections IV and V.
    """
    number = len(wanted)
    turns = jnp.linspace(-jnp.pi, jnp.pi, _ANGLES, endpoint=False)
    speed = jnp.maximum(length(wanted), SLOWEST)[:, None, None]
    base = speed * ground.unit(wanted, walkers.facing)[:, None]
    shape = (number, _ANGLES)
    turned = ground.turn(
        jnp.broadcast_to(base, (*shape, 2)), jnp.broadcast_to(turns, shape)
    )
    parts = jnp.array(_PARTS).reshape(1, 1, -1, 1)
    moves = (turned[:, :, None] * parts).reshape(number, -1, 2)
    choices = jnp.concatenate(
        [jnp.stack([wanted, 0.0 * wanted], axis=1), moves], axis=1
    )

    def penalty(i: Array, choices: Array) -> Array:
        soon_at = walkers.position + TURNING * walkers.velocity
        gap = soon_at[i][None] - soon_at  # from each other one
        # Each goes half of the way round: the other is taken to do the other half.
        both = walkers.velocity[i][None] + walkers.velocity
        mean = 2.0 * choices[:, None] - both[None]
        times = _collides(gap[None], mean, jnp.float32(2 * radius))
        times = jnp.where(jnp.arange(number)[None] == i, jnp.inf, times)
        soon = jnp.min(times, axis=1)
        if circles is not None:
            away = walkers.position[i][None] - circles[:, :2]
            own = _collides(away[None], choices[:, None], circles[None, :, 2] + radius)
            soon = jnp.minimum(soon, jnp.min(own, axis=1))
        danger = jnp.where(soon < HORIZON, FEAR / soon, 0.0)
        # To the right, if both sides are as good.
        side = wanted[i, 0] * choices[:, 1] - wanted[i, 1] * choices[:, 0]
        return danger + length(choices - wanted[i][None]) - 0.02 * jnp.sign(side)

    costs = jax.vmap(penalty)(jnp.arange(number), choices)
    best = jnp.argmin(costs, axis=1)
    return jnp.take_along_axis(choices, best[:, None, None], axis=1)[:, 0]


def averaged(velocity: Any, moved: Any, fps: float) -> Any:
    """The velocity of who moved so in a tick, m/s; hips sway, so over .2 s."""
    keep = 0.5 ** (1.0 / (0.1 * fps))
    return keep * velocity + (1.0 - keep) * moved


def _wish(
    goal: Goal,
    walkers: Walker,
    memory: Array,
    seconds: Array,
    told: Command | None,
    *,
    ahead: float,
    coast: float,
) -> tuple[Array, Array, Array]:
    """Velocity, facing and memory of each walker; leaders do as they are told."""
    if isinstance(goal, Path):
        look = functools.partial(pursue, ahead=ahead)
        velocity, memory = jax.vmap(look)(goal, walkers, memory)
    elif isinstance(goal, Place):
        now = jnp.broadcast_to(seconds, memory.shape)
        come = functools.partial(arrive, coast=coast)
        velocity, facing = jax.vmap(come)(goal, walkers, now)
        return velocity, facing, memory
    else:
        leaders = jax.tree.map(lambda x: x[goal.leader], walkers)
        velocity = jax.vmap(follow)(leaders, walkers, goal.distance)
        facing = ground.unit(velocity, walkers.facing)
        if told is not None:
            leads = (goal.leader == jnp.arange(len(goal.leader)))[:, None]
            velocity = jnp.where(leads, told.velocity, velocity)
            facing = jnp.where(leads, told.facing, facing)
        return velocity, facing, memory
    return velocity, ground.unit(velocity, walkers.facing), memory


def hold(told: Command, wanted: Command) -> Command:
    """The command that was told, unless what is wanted differs by enough.

    New commands cost new plans: directions count from `steering.HEADING_STEP` on,
    speeds from `steering.SPEED_STEP` on, and to stop at once.
    """
    old, new = length(told.velocity), length(wanted.velocity)
    stops = (new < 1e-3) != (old < 1e-3)
    turned = jnp.abs(ground.angle_from_to(told.velocity, wanted.velocity))
    faced = jnp.abs(ground.angle_from_to(told.facing, wanted.facing))
    turned = jnp.where((old > 1e-3) & (new > 1e-3), turned, 0.0)
    differs = stops | (jnp.abs(new - old) > SPEED_STEP)
    differs |= jnp.maximum(turned, faced) > HEADING_STEP
    differs |= told.label != wanted.label
    choose = lambda a, b: jnp.where(  # noqa: E731
        differs.reshape(differs.shape + (1,) * (a.ndim - differs.ndim)), b, a
    )
    return jax.tree.map(choose, told, wanted)


def goal_rollouts(
    character: Character,
    key: Key,
    states: Any,
    goal: Goal,
    *,
    seconds: float,
    places: Float[Array, "characters 2"] | None = None,
    labels: Int[Array, " characters"] | None = None,
    avoiding: bool = False,
    circles: Float[Array, "circles 3"] | None = None,
    commands: Command | None = None,
) -> Frame:
    """Frames of characters who go after goals, as one compiled program.

    Args:
      key: Consumed; character c draws from `fold_in(key, c)`.
      states: From `character.start`: at the origin, facing +z.
      goal: One kind of goal, arrays with the characters' axis first.
      places: Where each starts, (x, z) meters, instead of the origin.
      labels: Style of each; None for the first.
      circles: Center (x, z) and radius of what they keep clear of, meters.
      commands: [characters, ticks, ...], which leaders obey.

    Returns:
      Frames [characters, ticks, ...]. Root positions are in the goals' world; what a
      system has as `extra` stays relative to each one's start.

    Raises:
      ValueError: if states are of another model, goals, states, places and commands of
        different numbers of characters or seconds, somebody leads without commands or
        follows nobody, there are commands but no leaders, less than a tick is asked
        for, circles are of another shape, a number of these or of places is not finite,
        or a label is none of the model's.
    """
    number = jax.tree.leaves(states)[0].shape[0]
    places = jnp.zeros((number, 2)) if places is None else jnp.asarray(places)
    if places.ndim != 2 or places.shape[1] != 2:
        raise ValueError(f"places of shape {places.shape}, expected {(number, 2)}")
    labels = jnp.zeros(number, int) if labels is None else jnp.asarray(labels)
    for what, found in (
        ("goals", jax.tree.leaves(goal)[0].shape[0]),
        ("places", places.shape[0]),
        ("labels", labels.shape[0]),
    ):
        if found != number:
            raise ValueError(f"{found} {what} for {number} characters")
    steering.check_states(character, states)
    steering.check_labels(labels, character.labels)
    if not (np.isfinite(seconds) and seconds * character.fps >= 1):
        raise ValueError(f"seconds is {seconds}, expected a tick or more")
    ticks = round(seconds * character.fps)
    if commands is not None:
        if not isinstance(goal, Follow):
            raise ValueError(
                f"commands with a {type(goal).__name__}: only leaders of a Follow are "
                "told what to do"
            )
        steering.check_commands(commands)
        if commands.label.shape != (number, ticks):
            raise ValueError(
                f"commands of shape {commands.label.shape}, expected {(number, ticks)}"
            )
    if isinstance(goal, Follow):
        leaders = np.asarray(goal.leader)
        if leaders.size and not 0 <= leaders.min() <= leaders.max() < number:
            raise ValueError(
                f"leaders are in {leaders.min()}..{leaders.max()}, expected "
                f"0..{number - 1}"
            )
        alone = np.flatnonzero(leaders == np.arange(number)).size
        if alone and commands is None:
            raise ValueError(f"{alone} leaders without commands")
    if circles is not None and (circles.ndim != 2 or circles.shape[1] != 3):
        raise ValueError(
            f"circles of shape {circles.shape}, expected [circles, 3]: x, z and radius"
        )
    for what, values in (("places", places), ("circles", circles)):
        is_told = values is not None and not isinstance(values, Tracer)
        if is_told and not np.isfinite(np.asarray(values)).all():
            raise ValueError(
                f"{what} are not all finite: {np.asarray(values).tolist()}"
            )
    return _rollouts(
        character.params,
        key,
        states,
        goal,
        places.astype(float),
        labels.astype(jnp.int32),
        circles,
        commands,
        method=character.method,
        ticks=ticks,
        fps=character.fps,
        ahead=character.ahead,
        coast=character.coast,
        avoiding=avoiding or circles is not None,
    )


@functools.partial(
    jax.jit, static_argnames=("method", "ticks", "fps", "ahead", "coast", "avoiding")
)
def _rollouts(
    params: Params,
    key: Key,
    states: Any,
    goal: Goal,
    places: Array,
    labels: Array,
    circles: Array | None,
    commands: Command | None,
    *,
    method: steering.Method,
    ticks: int,
    fps: float,
    ahead: float,
    coast: float,
    avoiding: bool,
) -> Frame:
    controller, number = method(params), len(places)
    keys = jax.vmap(lambda c: jax.random.fold_in(key, c))(jnp.arange(number))
    forward = jnp.broadcast_to(jnp.array([0.0, 1.0]), (number, 2))
    rest = jnp.zeros((number, 2))
    walkers = Walker(position=places, velocity=rest, facing=forward)
    told = Command(velocity=rest, facing=forward, label=labels)

    def body(carry: tuple, tick: Array) -> tuple[tuple, Frame]:
        states, walkers, told, memory = carry
        led = jax.tree.map(lambda x: x[:, tick], commands)
        velocity, facing, memory = _wish(
            goal, walkers, memory, tick / fps, led, ahead=ahead, coast=coast
        )
        if avoiding:
            clear = avoid(velocity, walkers, circles)
            moved = length(clear - velocity)[:, None] > 1e-3
            facing = jnp.where(moved, ground.unit(clear, walkers.facing), facing)
            velocity = clear
        told = hold(told, Command(velocity=velocity, facing=facing, label=labels))
        now = jax.vmap(lambda k: jax.random.fold_in(k, tick))(keys)
        states, frame = rollout.batch_tick(controller, now, states, told)
        position = frame.root_position[:, ::2] + places
        moved = (position - walkers.position) * fps
        walkers = Walker(
            position=position,
            velocity=averaged(walkers.velocity, moved, fps),
            facing=told.facing,
        )
        root = frame.root_position.at[:, ::2].set(position)
        frame = dataclasses.replace(frame, root_position=root)
        return (states, walkers, told, memory), frame

    start = (states, walkers, told, jnp.zeros(number))
    _, frames = jax.lax.scan(body, start, jnp.arange(ticks))
    return jax.tree.map(lambda x: jnp.swapaxes(x, 0, 1), frames)
