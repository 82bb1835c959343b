"""Steering many characters at once, whatever system moves them.

A system hands over a `Character`: how it starts, and a hashable method that makes a
`rollout.Controller` of parameters. `steered_rollouts` is one compiled program per
method and shape over all calls: parameters, states, commands and keys are arguments.

Who steers by hand holds keys or points at the ground: `wanted` says what that asks for.
"""

import dataclasses
import functools
import math
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.core import Tracer
from jax.sharding import Mesh
from jaxtyping import Array, Int

from jaxmotion.control import courses, rollout
from jaxmotion.control.frame import Frame
from jaxmotion.motion.skeleton import Skeleton, joint_positions
from jaxmotion.motion.trajectory import Command
from jaxmotion.typing import Exported, Key, Params

# Makes the controller of a character from arrays. Hashable, and equal to another of
# equal settings: it is a static argument of the compiled program.
Method = Callable[[Params], rollout.Controller]

MOVES = ("forward", "back", "left", "right", "run", "turn_left", "turn_right")
# Shift multiplies the speed; Q and E turn who stands by so much, radians per second.
RUN, TURN = 2.0, math.radians(150.0)
# Who runs at a target slows down to cover what is left in so many seconds, and stops
# within so many meters; he starts again beyond the second distance.
ARRIVE, NEAR, FAR = 0.7, 0.2, 0.45
# What is told stays as it is until what is wanted differs by more, radians and m/s.
HEADING_STEP, SPEED_STEP = math.radians(8.0), 0.15
# Seconds of a path that who goes along it looks ahead.
AHEAD = 0.35
# Seconds after which what somebody is asked for shows: he decides for where he will be.
LAG = 0.25
# A stick that is pushed less far is in its middle.
STICK = 0.12


@dataclasses.dataclass(frozen=True, kw_only=True, eq=False)
class Tuning:
    """What can be changed about a character while it is steered.

    Attributes:
      method: `(num_steps, scale) -> method`, and `locks=` where `lockable`: whether
        planted feet are locked. Scale and locks may be traced: others compile nothing.
      num_steps: Numbers of diffusion steps that a plan may take, increasing.
      own_steps: The one of them that the character itself takes.
      scale: Scale of the system's guidance that the character has.
      scales: The least and the largest that make sense.
      patience: Ticks that a plan may come late, for it is longer than what is played
        of it; 0 where every tick needs its own.
      lockable: Whether the foot lock can be switched on and off.
    """

    method: Callable[..., Method]
    num_steps: tuple[int, ...]
    own_steps: int
    scale: float
    scales: tuple[float, float]
    patience: int
    lockable: bool = False


@dataclasses.dataclass(frozen=True, kw_only=True, eq=False)
class Character:
    """What a system hands over to be steered.

    Attributes:
      labels: Names of the styles or skills; none where commands have no label.
      source: The data that it was trained on, and their license.
      license: License of the weights; None where nobody gave one.
      params: All arrays that `method` needs, not only a network's.
      method: Makes the controller.
      tuning: What can be changed while it is steered; None for nothing.
      starts: `(labels, seed) -> states`, batch axis first, of characters at the origin
        that face +z; raises `ValueError` where it cannot.
      clip_starts: `(clips, labels, seed) -> states` in poses of recorded clips; None
        where a system has no such start.
      exports: `(controller) -> functions by name` that can leave Python, and together
        are a tick; all on "state" and "command".
      toe_height: Where toes rest, meters; None where nobody measured it.
      ahead: Seconds of a path that he looks ahead. Who answers a command late weaves
        about a path unless he looks farther, and who looks far cuts its corners.
      coast: Seconds for which he goes on as he was when he is told to slow down: a
        place is approached from where he will be by then.
    """

    skeleton: Skeleton = dataclasses.field(repr=False)
    labels: tuple[str, ...]
    fps: float
    source: str
    license: str | None = None
    params: Params = dataclasses.field(repr=False)
    method: Method = dataclasses.field(repr=False)
    starts: Callable[[np.ndarray, int], Any] = dataclasses.field(repr=False)
    clip_starts: Callable[[Any, np.ndarray, int], Any] | None = dataclasses.field(
        default=None, repr=False
    )
    exports: Callable[[rollout.Controller], dict[str, Exported]] = dataclasses.field(
        default=rollout.exports, repr=False
    )
    tuning: Tuning | None = dataclasses.field(default=None, repr=False)
    toe_height: float | None = None
    ahead: float = AHEAD
    coast: float = LAG

    @functools.cached_property
    def state_form(self) -> Any:
        """What its states consist of; None for a model that starts from clips only."""
        form = []

        def leaves() -> None:
            form.append(_form(self.start(1)))

        try:
            try:
                jax.eval_shape(leaves)  # compiles nothing
            except jax.errors.JAXTypeError:  # starts that compute with NumPy
                leaves()
        except ValueError:
            return None
        return form[0]

    def label(self, name: str) -> int:
        """Index of a label; raises `ValueError` that names those there are."""
        return int(label_indices(self.labels, name)[0])

    def start(
        self,
        number: int | None = None,
        *,
        labels: Any = None,
        clips: Any = None,
        seed: int = 0,
    ) -> Any:
        """States of characters at the origin that face +z, batch axis first.

        `number` None: one for each label that is given, or one. Labels are a name or an
        index for all characters, or a sequence with one for each; None for the first.
        `ValueError` if a label is unknown, the numbers do not agree, or the system
        cannot start so.
        """
        found = label_indices(self.labels, labels, number)
        if clips is None:
            return _as_precise(self.starts(found, seed))
        if self.clip_starts is None:
            raise ValueError("this model does not start from clips: leave them out")
        return _as_precise(self.clip_starts(clips, found, seed))


def check_states(character: Character, states: Any) -> None:
    """Raises `ValueError` for states of another model, where the model can start."""
    if character.state_form not in (None, _form(states)):
        raise ValueError(
            "states are of another model: expected those of this one's start()"
        )


def _form(states: Any) -> tuple[Any, list[tuple[int, ...]]]:
    """What one character's state consists of, and the shapes of its arrays."""
    leaves, structure = jax.tree.flatten(states)
    return structure, [x.shape[1:] for x in leaves]


def _as_precise(states: Any) -> Any:
    """With floats of JAX's default precision: a scan must hand on what it was given."""
    wide = jnp.result_type(float)
    return jax.tree.map(
        lambda x: x.astype(wide) if jnp.issubdtype(x.dtype, jnp.floating) else x, states
    )


def steered(model: Any, *, what: str = "this model") -> Character:
    """The model, which must be a character; raises `ValueError` for whole motions."""
    if isinstance(model, Character):
        return model
    if not hasattr(model, "skeleton"):
        raise ValueError(f"{what} is a {type(model).__name__}, expected one of `load`")
    raise ValueError(
        f"{what} makes whole motions: it is sampled, not steered or rolled out"
    )


def label_indices(
    names: tuple[str, ...], labels: Any = None, number: int | None = None
) -> np.ndarray:
    """Index of each character's label; zeros where the model has no labels.

    The labels are a name or an index for all, or a sequence with one for each; None for
    the first. As many characters as labels where no number is given. `ValueError` if a
    label is unknown or the numbers do not agree.
    """
    if number is not None and not (isinstance(number, int | np.integer) and number > 0):
        raise ValueError(f"number of characters is {number!r}, expected 1 or more")
    single = labels is None or isinstance(labels, str) or np.ndim(labels) == 0
    given: list[Any]
    given = [0 if labels is None else labels] if single else list(labels)  # pyright: ignore[reportArgumentType]
    given = [x.item() if isinstance(x, np.ndarray | Array) else x for x in given]
    if single:
        given = given * (1 if number is None else number)
    elif number is not None and len(given) != number:
        raise ValueError(f"{len(given)} labels for {number} characters")
    found = []
    for label in given:
        if isinstance(label, str):
            if label not in names:
                known = ", ".join(names) or "none"
                raise ValueError(f"unknown label {label!r}: the model has {known}")
            label = names.index(label)
        if isinstance(label, bool) or not isinstance(label, int | np.integer):
            raise ValueError(f"label is {label!r}, expected a name or an index")
        found.append(int(label))
    check_labels(np.array(found, int), names)
    return np.array(found if names else np.zeros(len(found)), np.int32)


def label_array(
    names: tuple[str, ...], labels: Any = None, number: int | None = None
) -> Int[Array, " labels"]:
    """`label_indices`; indices within a caller's `jax.jit` pass as they are."""
    if not isinstance(labels, Tracer):
        return jnp.asarray(label_indices(names, labels, number), jnp.int32)
    if labels.ndim > 1 or not jnp.issubdtype(labels.dtype, jnp.integer):
        raise ValueError(
            f"labels are {labels.dtype}{list(labels.shape)}, expected whole numbers"
        )
    if labels.ndim and number not in (None, len(labels)):
        raise ValueError(f"{len(labels)} labels for {number} characters")
    shape = labels.shape or (number or 1,)
    return jnp.broadcast_to(labels if names else 0, shape).astype(jnp.int32)


def check_labels(labels: np.ndarray | Array, names: tuple[str, ...]) -> None:
    """Raises unless labels are indices of names; compiled code cannot.

    All pass where a model has no labels, and within a caller's `jax.jit`, where nobody
    knows them; a `ValueError` names the range and the labels.
    """
    if isinstance(labels, Tracer):
        return
    found, last = np.asarray(labels), len(names) - 1
    if names and found.size and (found.min() < 0 or found.max() > last):
        raise ValueError(
            f"labels are in {found.min()}..{found.max()}, expected 0..{last} "
            f"({', '.join(names)})"
        )


def check_commands(commands: Command) -> None:
    """Raises `ValueError` unless they are of many characters over time, as arrays."""
    label, shape = commands.label, commands.label.shape
    if len(shape) != 2 or not jnp.issubdtype(label.dtype, jnp.integer):
        raise ValueError(
            f"commands' labels are {label.dtype}{list(shape)}, expected whole numbers "
            "[characters, ticks]"
        )
    for name in ("velocity", "facing"):
        if (found := getattr(commands, name).shape) != (*shape, 2):
            raise ValueError(
                f"commands' {name} has shape {found}, expected {(*shape, 2)}"
            )


def steered_rollouts(
    character: Character,
    key: Key,
    states: Any,
    commands: Command,
    *,
    first: int = 0,
    chunk: int | None = None,
    mesh: Mesh | None = None,
) -> Frame:
    """Frames [characters, ticks, ...] of steered characters; one compiled program.

    Args:
      commands: [characters, ticks, ...], as from `courses.course_batch`.
      chunk: Characters to run at a time, at most (the largest number that divides
        theirs); see `rollout.rollout`.
      mesh: Devices to split the characters over; see `rollout.rollout`.

    Raises:
      ValueError: if states are of another model, states and commands of different
        numbers of characters, commands of different numbers of ticks, the chunk is not
        positive, or a label is none of the model's.
    """
    check_commands(commands)
    check_labels(commands.label, character.labels)
    number = commands.label.shape[0]
    found = jax.tree.leaves(states)[0].shape[0]
    if found != number:
        raise ValueError(f"{found} states and commands for {number} characters")
    check_states(character, states)
    if chunk is not None:
        if chunk < 1:
            raise ValueError(f"chunks of {chunk} characters, expected 1 or more")
        chunk = _divisor(number, chunk)
    return _rollouts(
        character.params,
        key,
        states,
        commands,
        jnp.int32(first),
        method=character.method,
        chunk=chunk,
        mesh=mesh,
    )[1]


def _divisor(number: int, most: int) -> int:
    return max(size for size in range(1, most + 1) if number % size == 0)


def calmest(
    character: Character,
    states: Any,
    labels: np.ndarray,
    *,
    number: int,
    past: int,
    seconds: float = 12.0,
    seed: int = 0,
) -> tuple[Any, Frame]:
    """Those of many standing characters that move least in the end.

    They are to stand still for `seconds`. A shipped model starts so, with no recorded
    frame in its file. Of the `number` that are kept come the last states, and the last
    frames [number, past, ...]. Raises `ValueError` if fewer characters begin.
    """
    if not 1 <= number <= len(labels):
        raise ValueError(f"starts is {number}, expected 1 to {len(labels)}")
    commands = courses.course_batch(
        "straight",
        labels,
        np.full(len(labels), 0.0),
        seconds=seconds,
        fps=character.fps,
    )
    states, frames = _rollouts(
        character.params,
        jax.random.key(seed),
        states,
        commands,
        jnp.int32(0),
        method=character.method,
        chunk=_divisor(len(labels), 4),
        mesh=None,
    )
    frames = frames[:, -past:]
    positions = joint_positions(character.skeleton, frames.motion)
    unrest = jnp.mean(jnp.abs(jnp.diff(positions, axis=1)), axis=(1, 2, 3))
    kept = jnp.argsort(unrest)[:number]
    return jax.tree.map(lambda x: x[kept], (states, frames))


def chosen_starts(
    starts: Any, labels: np.ndarray, names: tuple[str, ...], *, seed: int
) -> Any:
    """A start of its label for each character, drawn with equal chances.

    Starts are [labels, starts, ...]; a label that is none raises `ValueError`.
    """
    check_labels(labels, names)
    labels, number = np.asarray(labels), jax.tree.leaves(starts)[0].shape[1]
    which = np.random.default_rng(seed).integers(number, size=labels.shape)
    return jax.tree.map(lambda x: x[labels, which], starts)


@functools.partial(jax.jit, static_argnames=("method", "chunk", "mesh"))
def _rollouts(
    params: Params,
    key: Key,
    states: Any,
    commands: Command,
    first: Array,
    *,
    method: Method,
    chunk: int | None,
    mesh: Mesh | None,
) -> tuple[Any, Frame]:
    more: dict[str, Any] = dict(first=first, chunk=chunk, mesh=mesh)
    return rollout.rollout(method(params), key, states, commands, **more)


@dataclasses.dataclass(frozen=True, kw_only=True)
class Inputs:
    """What one person holds down.

    Attributes:
      held: Of `MOVES`.
      azimuth: Where the camera looks, radians from +z toward +x.
      target: Point (x, z) on the ground to go to, meters; keys come first.
      path: Points to go along, whatever else is held; see `waypoints`.
      stick: A stick's (right, ahead), at most 1 long: go so, seen by the camera, and as
        fast as it is pushed; keys come first.
      face: Another one's: face so, whatever the way.
    """

    held: frozenset[str] = frozenset()
    azimuth: float = 0.0
    target: tuple[float, float] | None = None
    path: tuple[tuple[float, float], ...] = ()
    stick: tuple[float, float] | None = None
    face: tuple[float, float] | None = None


@dataclasses.dataclass(frozen=True, kw_only=True)
class Wish:
    """What is asked of a character: velocity (x, z) in m/s, and facing, unit."""

    velocity: tuple[float, float] = (0.0, 0.0)
    facing: tuple[float, float] = (0.0, 1.0)

    @property
    def speed(self) -> float:
        return math.hypot(*self.velocity)


def wanted(
    inputs: Inputs,
    last: Wish,
    *,
    position: tuple[float, float],
    speed: float,
    seconds: float,
) -> Wish:
    """What held keys and the mouse ask for.

    Directions are the camera's; who moves faces where he goes, and who stands keeps
    facing where he did. `viz/web/steer.js` is the same for pages without a server.

    Args:
      position: Of the character (x, z), meters.
      speed: Without Shift, m/s.
      seconds: Of a tick.
    """
    held = inputs.held
    ahead = ("forward" in held) - ("back" in held)
    aside = ("right" in held) - ("left" in held)
    speed = speed * (RUN if "run" in held else 1.0)
    face = _pushed(inputs.face, inputs.azimuth)
    facing = None if face is None else _toward(face[0])
    if ahead or aside:
        # To the right of who looks along +z lies -x.
        angle = inputs.azimuth - math.atan2(aside, ahead)
        return _go(angle, speed, facing)
    stick = _pushed(inputs.stick, inputs.azimuth)
    if stick is not None:
        return _go(stick[0], stick[1] * speed, facing)
    if facing is not None:
        return Wish(facing=facing)
    turn = ("turn_left" in held) - ("turn_right" in held)
    if turn:
        facing = math.atan2(*last.facing) + turn * TURN * seconds
        return Wish(facing=(math.sin(facing), math.cos(facing)))
    if inputs.target is not None:
        x, z = inputs.target[0] - position[0], inputs.target[1] - position[1]
        distance = math.hypot(x, z)
        if distance > (NEAR if last.speed else FAR):
            return _go(math.atan2(x, z), min(speed, distance / ARRIVE))
    return Wish(facing=last.facing)


def _toward(angle: float) -> tuple[float, float]:
    return math.sin(angle), math.cos(angle)


def _pushed(
    stick: tuple[float, float] | None, azimuth: float
) -> tuple[float, float] | None:
    """A stick's angle in the world and how far it is pushed; None in its middle."""
    if stick is None or (far := math.hypot(*stick)) < STICK:
        return None
    return azimuth - math.atan2(*stick), min(far, 1.0)


def _go(angle: float, speed: float, facing: tuple[float, float] | None = None) -> Wish:
    x, z = way = _toward(angle)
    return Wish(velocity=(speed * x, speed * z), facing=facing or way)


def settled(told: Wish, wish: Wish, *, steady: bool) -> Wish:
    """What to tell the character: every change of it costs a plan, so small ones wait.

    A steady wish, which was the same a tick ago, is passed on as it is.
    """
    stops = bool(told.speed) != bool(wish.speed)
    step = math.cos(HEADING_STEP)
    turned = float(np.dot(told.facing, wish.facing)) < step
    # Another way to go with the same facing, as of a second stick, counts as well.
    along = float(np.dot(told.velocity, wish.velocity))
    turned = turned or along < step * told.speed * wish.speed
    far = turned or abs(told.speed - wish.speed) > SPEED_STEP
    return wish if stops or far or steady else told
