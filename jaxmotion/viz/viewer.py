"""A person steers characters: ticks at a fixed rate, settings, recording.

A `Session` holds one group of characters, which all browsers see, and which the browser
that touched a key last steers. It ticks in a thread of its own, only while somebody
looks. One compiled program serves a model, a number of characters and a number of
diffusion steps: labels, speeds, the guidance scale and the foot lock are its arguments.
Another program is compiled in a second thread, while the old one goes on.

It knows neither a network protocol nor a file format: `viz.page` serves it.
"""

import dataclasses
import math
import threading
import time
from collections.abc import Callable, Mapping
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from jaxmotion.control import goals, rollout, waypoints
from jaxmotion.control.steering import Character, Inputs, Wish, settled, wanted
from jaxmotion.motion.skeleton import Motion, Skeleton
from jaxmotion.motion.trajectory import Command

MOST_CHARACTERS = 64
SPEEDS = (0.3, 4.0)
SPACING = 1.6
LONGEST_TAKE = 600.0
_CATCH_UP = 0.25
_KEPT_PROGRAMS = 6


@dataclasses.dataclass(frozen=True, kw_only=True)
class Settings:
    """What the panel shows.

    Attributes:
      speed: Without Shift, m/s.
      num_steps: Diffusion steps of a plan.
      scale: Guidance scale.
      foot_lock: Whether planted feet are locked, where they can be.
      characters: 1 to `MOST_CHARACTERS`.
      plan: Whether the rest of the first one's plan is shown.
      paused: Whether time stands still.
    """

    model: str
    label: int = 0
    speed: float = 1.4
    num_steps: int = 1
    scale: float = 1.0
    foot_lock: bool = True
    characters: int = 1
    plan: bool = False
    paused: bool = False


def formation(number: int) -> np.ndarray:
    """Places of characters beside the first one, (x, z) meters, in rows behind it."""
    wide = math.ceil(math.sqrt(number))
    order = sorted(range(wide), key=lambda i: abs(i - (wide - 1) // 2))
    rows, columns = np.divmod(np.arange(number), wide)
    across = np.array(order)[columns] - order[0]
    return SPACING * np.stack([across, -rows], axis=-1).astype(np.float32)


@dataclasses.dataclass(frozen=True, kw_only=True, eq=False)
class Shown:
    """One tick, for whoever draws it.

    Attributes:
      engine: Number of the program that made it; another one may have another body.
      tick: Counted from 0.
      roots: [characters, 3] world, meters.
      rotations: [characters, joints, 6] as `Motion` has them.
      ball: [characters, 3] world, meters; None in systems without.
      plan: Of the first character, if it is to be shown: the path of its root to the
        plan's end [ticks, 3], and its rotations there [joints, 6].
      told: What the first character was told.
      planned: Characters that got a new plan.
      milliseconds: That the tick took.
    """

    engine: int
    tick: int
    roots: np.ndarray
    rotations: np.ndarray
    ball: np.ndarray | None
    plan: tuple[np.ndarray, np.ndarray] | None
    told: Wish
    planned: int
    milliseconds: float


@dataclasses.dataclass(frozen=True, kw_only=True, eq=False)
class Dress:
    """Another body than a character's own.

    Attributes:
      skeleton: Its own, on which takes are recorded.
      wear: Root positions [..., 3] and rotations [..., joints, 6] of the character to
        those of the body.
      scale: Meters of the picture in one of the body's: its legs are as long as the
        character's, so that what is told and where it walks agree.
      packed: Its file; see `packed`.
    """

    skeleton: Skeleton
    wear: Callable[[Any, Any], tuple[Any, Any]]
    scale: float
    packed: bytes


class Engine:
    """The compiled tick of one model, number of characters and number of steps."""

    def __init__(
        self,
        character: Character,
        *,
        num_steps: int,
        number: int,
        show_plan: bool = False,
    ) -> None:
        """Compiles nothing yet."""
        self.character, self.num_steps, self.number = character, num_steps, number
        # Rotations [characters, joints, 6] of the first tick; None until there was one.
        self.poses: np.ndarray | None = None
        self.dress: Dress | None = None
        tuning = character.tuning
        patience = 0 if tuning is None else tuning.patience
        at_most = number if not patience else math.ceil(number / patience)

        # Parameters are an argument: the compiler's cache then keeps the program small.
        def tick(params, seed, n, crowd, told, scale, locks) -> tuple:
            method = character.method
            if tuning is not None:
                more = {"locks": locks} if tuning.lockable else {}
                method = tuning.method(num_steps, scale, **more)
            key = jax.random.fold_in(jax.random.key(seed), n)
            every = lambda x: jnp.broadcast_to(x, (number, *x.shape))  # noqa: E731
            velocity, facing, label = map(every, told)
            commands = Command(velocity=velocity, facing=facing, label=label)
            controller = method(params)
            crowd, frames = rollout.crowd_tick(
                controller, key, crowd, commands, at_most=at_most
            )
            plan = None
            if show_plan and patience:  # what would be shown without another plan
                first, command = jax.tree.map(lambda x: x[0], (crowd.states, commands))
                _, ahead = jax.lax.scan(
                    lambda state, _: controller.advance(state, command),
                    first,
                    length=patience,
                )
                plan = ahead.root_position, ahead.joint_rotation[-1]
            return (
                crowd,
                (frames.root_position, frames.joint_rotation),
                dict(
                    # A frame of who still waits for his first plan is none of a plan.
                    planned=jnp.sum(frames.planned & (crowd.waited == 0)),
                    ball=frames.extra.get("ball"),
                    plan=plan,
                ),
            )

        self._tick = jax.jit(tick)

    def start(self, label: int, seed: int) -> rollout.Crowd:
        """Characters that have not been told anything."""
        number = self.number
        labels = label if self.character.labels else None
        none = Command(
            velocity=jnp.zeros((number, 2)),
            facing=jnp.tile(jnp.array([0.0, 1.0]), (number, 1)),
            label=jnp.full(number, -1, jnp.int32),
        )
        return rollout.Crowd(
            states=self.character.start(number, labels=labels, seed=seed),
            told=none,
            waited=jnp.zeros(number, jnp.int32),
        )

    def step(
        self, crowd: rollout.Crowd, wish: Wish, settings: Settings, *, seed: int, n: int
    ) -> tuple[rollout.Crowd, Any, dict[str, Any]]:
        """The next tick; nothing comes back to the host yet."""
        told = (
            np.array(wish.velocity, np.float32),
            np.array(wish.facing, np.float32),
            np.int32(settings.label),
        )
        return self._tick(
            self.character.params,
            np.uint32(seed),
            np.uint32(n),
            crowd,
            told,
            np.float32(settings.scale),
            np.bool_(settings.foot_lock),
        )


class Session:
    """Characters that people steer. Methods may be called from any thread."""

    def __init__(
        self,
        models: Mapping[str, Callable[[], Character]],
        *,
        characters: int = 1,
        foot_locks: Mapping[str, bool] | None = None,
        dress: Callable[[Character, Motion], Dress] | None = None,
        seed: int = 0,
        on_frame: Callable[[Shown], None] = lambda shown: None,
        on_change: Callable[[], None] = lambda: None,
    ) -> None:
        """Begins to load nothing yet: `run` does.

        Args:
          models: What loads each model that can be chosen, the first one first.
          foot_locks: Whether a model begins with locked feet; True where not given.
          dress: Makes another body for a model that has walked for a second.
          seed: Seeds starts and noise.
          on_frame: Called with every tick, in the session's thread.
          on_change: Called when `state` changed, in any thread.
        """
        if not 1 <= characters <= MOST_CHARACTERS:
            raise ValueError(
                f"{characters} characters, expected 1 to {MOST_CHARACTERS}"
            )
        self._models, self._seed = dict(models), seed
        self._foot_locks = dict(foot_locks or {})
        self._dress, self._dresses = dress, {}
        self.on_frame, self.on_change = on_frame, on_change
        self.settings = Settings(model=next(iter(models)), characters=characters)
        # Whether the model's own settings are still to be taken over.
        self._fresh = True
        self._inputs: dict[Any, Inputs] = {}
        self._active: Any = None
        self._lock, self._wake = threading.RLock(), threading.Event()
        self._closed, self._steps, self._resets = False, 0, False
        self._engine: Engine | None = None
        self._next: Engine | None = None
        self._programs: dict[tuple, Engine] = {}
        self._loaded: dict[str, Character] = {}
        self._builder: threading.Thread | None = None
        self._crowd: rollout.Crowd | None = None
        self._home = np.zeros((1, 2), np.float32)
        self._stand()
        self._tick, self.engine_number = 0, 0
        self._take: list[tuple[np.ndarray, np.ndarray]] | None = None
        self.note = ""
        # The last take, and whose skeleton it has: one value, for other threads.
        self.take: tuple[Skeleton, Motion] | None = None

    # What people do.

    def join(self, client: Any) -> None:
        """Somebody looks; ticks while somebody does."""
        with self._lock:
            self._inputs[client] = Inputs()
        self._wake.set()
        self.on_change()

    def leave(self, client: Any) -> None:
        """Somebody left; what he held is let go, and who holds something steers."""
        with self._lock:
            self._inputs.pop(client, None)
            if self._active == client:
                holding = (x for x, held in self._inputs.items() if held.held)
                self._active = next(holding, None)
        self.on_change()

    def steer(self, client: Any, inputs: Inputs) -> None:
        """What somebody holds down now; who touched a key last steers."""
        with self._lock:
            before = self._inputs.get(client)
            if before is None:
                return
            keys = lambda x: (x.held, x.target, x.path)  # noqa: E731
            touched = keys(before) != keys(inputs)
            self._inputs[client] = inputs
            if touched or self._active is None:
                self._active = client

    def change(self, name: str, value: Any) -> None:
        """Sets one of the settings.

        Raises:
          ValueError: if there is no such setting, or its value is out of range.
        """
        with self._lock:
            new = changed(self.settings, name, value, self.state())
            if name == "model":
                # The number of steps, the label and the scale are another model's.
                self._fresh = True
            self.settings = new
            if self.note.startswith("error"):
                self.note = ""
        self._wake.set()
        self.on_change()

    def reset(self) -> None:
        """Begins anew at the origin."""
        self._resets = True
        self._wake.set()

    def step(self) -> None:
        """One tick of who is paused."""
        self._steps += 1
        self._wake.set()

    def record(self) -> None:
        """Begins to record the first character, or ends it and keeps the take."""
        with self._lock:
            if self._take is None:
                self._take = []
            else:
                self._end_take(self._engine)
        self.on_change()

    def _end_take(self, engine: Engine | None) -> None:
        frames, self._take = self._take, None
        if frames and engine is not None:
            root, rotation = (
                jnp.asarray(np.stack(x)) for x in zip(*frames, strict=True)
            )
            character = engine.character
            motion = Motion(
                root_position=root, joint_rotation=rotation, fps=character.fps
            )
            dress = engine.dress
            skeleton = character.skeleton if dress is None else dress.skeleton
            self.take = (skeleton, motion)

    def close(self) -> None:
        """Ends `run`."""
        self._closed = True
        self._wake.set()

    # What people see.

    @property
    def skeleton(self) -> Skeleton | None:
        """Whose body is drawn; None until a model is loaded."""
        return None if self._engine is None else self._engine.character.skeleton

    @property
    def poses(self) -> np.ndarray | None:
        """Some rotations [characters, joints, 6] of whoever is drawn."""
        return None if self._engine is None else self._engine.poses

    @property
    def dress(self) -> Dress | None:
        """What is drawn instead of its own body."""
        return None if self._engine is None else self._engine.dress

    @property
    def fps(self) -> float:
        """Ticks per second; 0 until a model is loaded."""
        return 0.0 if self._engine is None else self._engine.character.fps

    def state(self) -> dict[str, Any]:
        """What the panel shows, as plain values."""
        with self._lock:
            engine, settings = self._engine, self.settings
            character = None if engine is None else engine.character
            tuning = None if character is None else character.tuning
            return {
                **dataclasses.asdict(settings),
                "engine": self.engine_number,
                "models": list(self._models),
                "labels": [] if character is None else list(character.labels),
                "fps": self.fps,
                "source": "" if character is None else character.source,
                "steps": [] if tuning is None else list(tuning.num_steps),
                "scales": None if tuning is None else list(tuning.scales),
                "lockable": tuning is not None and tuning.lockable,
                "planning": tuning is not None and tuning.patience > 0,
                "speeds": list(SPEEDS),
                "most_characters": MOST_CHARACTERS,
                "note": self.note,
                "recording": self._take is not None,
                "taken": 0.0 if self.take is None else _seconds(self.take[1]),
                "people": len(self._inputs),
            }

    # What happens.

    def run(self) -> None:
        """Ticks at the model's rate until `close`; for a thread."""
        due = time.perf_counter()
        while not self._closed:
            self._build()
            self._swap()
            with self._lock:
                idle = not self._inputs or (self.settings.paused and not self._steps)
                idle = (idle and not self._resets) or self._engine is None
            if idle:
                self._wake.wait(0.1)
                self._wake.clear()
                due = time.perf_counter()
                continue
            self.tick()
            engine = self._engine
            assert engine is not None  # checked above; only this thread changes it
            due += 1.0 / engine.character.fps
            late = time.perf_counter() - due
            if late > _CATCH_UP:
                due = time.perf_counter()
            elif late < 0:
                time.sleep(-late)

    def tick(self) -> Shown:
        """One tick of all characters, shown and recorded."""
        begin = time.perf_counter()
        engine = self._engine
        assert engine is not None  # the loop ticks where there is one
        with self._lock:
            settings = self.settings
            inputs = self._inputs.get(self._active, Inputs())
            self._steps = max(self._steps - 1, 0)
            if self._resets:
                if self._take:
                    self.record()
                self._begin(engine, keep=False)
        wish = self._wanted(inputs, settings.speed, engine.character)
        self._told = settled(self._told, wish, steady=wish == self._wish)
        self._wish = wish
        assert self._crowd is not None  # made with the engine
        self._crowd, made, more = engine.step(
            self._crowd, self._told, settings, seed=self._seed, n=self._tick
        )
        ball, plan = more["ball"], more["plan"]
        shift = np.insert(self._home, 1, 0.0, axis=1)
        leader = np.asarray(made[0])[0] + shift[0]
        worn = roots, rotations = _worn(engine.dress, *made)
        if engine.dress is not None:
            roots = engine.dress.scale * roots
        roots = roots + shift
        if plan is not None:
            path, ghost = jax.tree.map(np.asarray, plan)
            if engine.dress is not None:
                end, ghost = _worn(engine.dress, path[-1:], ghost[None])
                path = np.concatenate([path[:-1], engine.dress.scale * end])
                ghost = ghost[0]
            plan = path + shift[0], ghost
        shown = Shown(
            engine=self.engine_number,
            tick=self._tick,
            roots=roots,
            rotations=rotations,
            ball=None if ball is None else np.asarray(ball) + shift,
            plan=plan,
            told=self._told,
            planned=int(more["planned"]),
            milliseconds=(time.perf_counter() - begin) * 1e3,
        )
        moved = [
            (float(x) - before) * engine.character.fps
            for x, before in zip(leader[::2], self._leader, strict=True)
        ]
        self._velocity = tuple(
            goals.averaged(v, x, engine.character.fps)
            for v, x in zip(self._velocity, moved, strict=True)
        )
        self._leader = (float(leader[0]), float(leader[2]))
        self._tick += 1
        with self._lock:
            if self._take is not None:
                own = worn[0][0] if engine.dress is not None else roots[0]
                self._take.append((own, rotations[0]))
                if len(self._take) >= LONGEST_TAKE * engine.character.fps:
                    self.record()
        self.on_frame(shown)
        return shown

    def _begin(self, engine: Engine, *, keep: bool) -> None:
        """Characters at their start; with `keep`, those there are go on."""
        self._resets = False
        new = engine.start(min(self.settings.label, _last(engine)), self._seed)
        home = formation(engine.number)
        if keep and self._crowd is not None:
            old = len(self._home)
            shared = min(old, engine.number)
            put = lambda x, y: jnp.concatenate([x[:shared], y[shared:]])  # noqa: E731
            new = jax.tree.map(put, self._crowd, new)
            home[shared:] += np.array(self._leader, np.float32) - home[0]
            home[:shared] = self._home[:shared]
        else:
            self._stand()
        self._crowd, self._home = new, home

    def _stand(self) -> None:
        """The first character has been told nothing, at the origin."""
        self._wish, self._told, self._route = Wish(), Wish(), waypoints.Route()
        self._leader = self._velocity = (0.0, 0.0)

    def _wanted(self, inputs: Inputs, speed: float, character: Character) -> Wish:
        """What all are told: the first one goes along waypoints, the others beside."""
        self._route = waypoints.routed(self._route, inputs.path, self._leader)
        where: dict[str, Any] = dict(position=self._leader, speed=speed)
        if not self._route.points:
            return wanted(inputs, self._wish, seconds=1.0 / character.fps, **where)
        wish, self._route = waypoints.along(
            self._route,
            self._wish,
            velocity=self._velocity,
            ahead=character.ahead,
            **where,
        )
        return wish

    def _wanted_engine(self) -> tuple:
        now = self.settings
        return now.model, now.num_steps, now.characters, now.plan

    def _build(self) -> None:
        """Starts to make the program that the settings ask for, if there is none."""
        with self._lock:
            engine, wanted_engine = self._engine, self._wanted_engine()
            fits = engine is not None and self._programs.get(wanted_engine) is engine
            busy = self._builder is not None and self._builder.is_alive()
            if (fits and not self._fresh) or busy or self._next is not None:
                return
            if self.note.startswith("error"):
                return
            self._builder = threading.Thread(target=self._make, daemon=True)
            self._builder.start()

    def _tell(self, note: str) -> None:
        self.note = note
        self.on_change()

    def _make(self) -> None:
        """In a thread: loads and compiles; what fails there is told, not raised."""
        try:
            self._next = self._program()
            self._tell("")
        except (OSError, ValueError) as error:
            self._tell(f"error: {' '.join(str(error).split())}")
        finally:
            self._wake.set()

    def _program(self) -> Engine:
        name = self.settings.model
        if name not in self._loaded:
            self._tell(f"loading {name}")
            self._loaded[name] = self._models[name]()
        character, tuning = self._loaded[name], self._loaded[name].tuning
        with self._lock:
            same = self.settings.model == name
            if same and self._fresh:
                self._fresh = False
                self.settings = dataclasses.replace(
                    self.settings,
                    label=0,
                    num_steps=1 if tuning is None else tuning.own_steps,
                    scale=1.0 if tuning is None else tuning.scale,
                    foot_lock=self._foot_locks.get(name, True),
                )
            settings, key = self.settings, self._wanted_engine()
        if not same:  # another one was chosen meanwhile
            return self._program()
        if key not in self._programs:
            many = f"{key[2]} character{'s' * (key[2] > 1)}"
            self._tell(f"compiling {name}: {many}, {key[1]} diffusion steps")
            made = Engine(character, num_steps=key[1], number=key[2], show_plan=key[3])
            crowd = made.start(0, self._seed)
            done = made.step(crowd, Wish(), settings, seed=0, n=0)
            made.poses = np.asarray(done[1][1])
            made.step(done[0], Wish(), settings, seed=0, n=1)
            ahead = waypoints.Route(points=((0.0, 0.0), (0.0, 1.0)))
            here = (0.0, 0.0)
            waypoints.along(ahead, Wish(), position=here, velocity=here, speed=1.0)
            if self._dress is not None:
                made.dress = self._dressed(name, made)
            self._programs[key] = made
            while len(self._programs) > _KEPT_PROGRAMS:
                self._programs.pop(next(iter(self._programs)))
        return self._programs[key]

    def _dressed(self, name: str, engine: Engine) -> Dress:
        """A model's other body, and a tick of it, which compiles it."""
        if name not in self._dresses:
            crowd, frames = engine.start(0, self._seed), []
            ahead = Wish(velocity=(0.0, 1.2))
            for n in range(round(engine.character.fps)):
                crowd, made, _ = engine.step(
                    crowd, ahead, self.settings, seed=self._seed, n=n
                )
                frames.append([np.asarray(x)[0] for x in made])
            roots, turns = (jnp.asarray(np.stack(x)) for x in zip(*frames, strict=True))
            motion = Motion(
                root_position=roots, joint_rotation=turns, fps=engine.character.fps
            )
            dressed = self._dress(engine.character, motion)  # pyright: ignore
            self._dresses[name] = dressed
        dress = self._dresses[name]
        joints = engine.character.skeleton.num_joints
        for number in {1, engine.number}:
            dress.wear(jnp.zeros((number, 3)), jnp.zeros((number, joints, 6)))
        return dress

    def _swap(self) -> None:
        with self._lock:
            new, self._next = self._next, None
            if new is None:
                return
            old, self._engine = self._engine, new
            same = old is not None and old.character is new.character
            if not same:
                self.settings = _fitting(self.settings, new.character)
            if not same and self._take is not None:
                self._end_take(old)
            self.engine_number += 1
            self._begin(new, keep=same)
        self.on_change()


def _worn(dress: Dress | None, roots: Any, rotations: Any) -> tuple[Any, Any]:
    """Poses as NumPy arrays, of the other body if there is one."""
    if dress is not None:
        roots, rotations = dress.wear(jnp.asarray(roots), jnp.asarray(rotations))
    return np.asarray(roots), np.asarray(rotations)


def _fitting(settings: Settings, character: Character) -> Settings:
    """Settings that a model has, where they were chosen while it was compiled."""
    tuning, known = character.tuning, range(max(len(character.labels), 1))
    if settings.label not in known:
        settings = dataclasses.replace(settings, label=0)
    if tuning is None:
        return settings
    if settings.num_steps not in tuning.num_steps:
        settings = dataclasses.replace(settings, num_steps=tuning.own_steps)
    low, high = tuning.scales
    return dataclasses.replace(settings, scale=min(max(settings.scale, low), high))


def _last(engine: Engine) -> int:
    return max(len(engine.character.labels) - 1, 0)


def _seconds(motion: Motion) -> float:
    return motion.root_position.shape[0] / motion.fps


def changed(settings: Settings, name: str, value: Any, state: dict) -> Settings:
    """Settings with one of them changed.

    Args:
      state: From `Session.state`: says what can be chosen.

    Raises:
      ValueError: names the setting, its value and what is expected.
    """
    ranges = {
        "label": (0, max(len(state["labels"]) - 1, 0)),
        "speed": SPEEDS,
        "characters": (1, MOST_CHARACTERS),
        "scale": tuple(state["scales"] or (0.0, 0.0)),
    }
    kinds = {"label": int, "characters": int}
    choices = {
        "model": state["models"],
        "num_steps": state["steps"] or [1],
        "foot_lock": [False, True],
        "plan": [False, True],
        "paused": [False, True],
    }
    if name in choices:
        known = ", ".join(str(x) for x in choices[name])
        right = any(type(value) is type(x) and value == x for x in choices[name])
        expected = f"one of {known}"
    elif name in ranges:
        low, high = ranges[name]
        kind = kinds.get(name, int | float)
        right = isinstance(value, kind) and not isinstance(value, bool)
        right = right and low <= value <= high
        expected = f"{low:g} to {high:g}"
    else:
        known = ", ".join(sorted(choices | ranges))
        raise ValueError(f"unknown setting {str(name)[:40]!r}, expected one of {known}")
    if not right:
        raise ValueError(f"{name} is {str(value)[:40]!r}, expected {expected}")
    value = float(value) if name in ("speed", "scale") else value
    return dataclasses.replace(settings, **{name: value})
