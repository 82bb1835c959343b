"""Diversity of many rollouts from one start state under the same commands.

Columns: world_m is the mean distance in meters of a joint in one rollout to the same
joint in another, over pairs, frames and joints; pose_m the same with joints relative to
the root and turned to face +z; diversity_m the metric of that name, the mean Euclidean
distance in meters of whole poses of the same time; variance_m2 is CAMDM's metric 4.

Examples:
  python benchmarks/diversity.py --rollouts 64 256 1024 4096
  python benchmarks/diversity.py --rollouts 64 --guidance 0 0.5 1 1.5 --memory-gib 0.5
  python benchmarks/diversity.py --run runs/camdm8 --step-runs runs/camdm2 runs/camdm4
  python benchmarks/diversity.py --run locomotion --seconds 0.5 --stream 1000000
"""

import dataclasses
import functools
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
import streams
import suite
import workload
from jax.sharding import Mesh, NamedSharding, PartitionSpec
from jaxtyping import Array, Float

from jaxmotion import cli, files, reporting
from jaxmotion.control import courses, rollout, steering
from jaxmotion.data import selection
from jaxmotion.evaluation import diversity, table
from jaxmotion.evaluators import style as style_evaluator
from jaxmotion.learning import fingerprint
from jaxmotion.motion import trajectory
from jaxmotion.motion.skeleton import Motion, joint_positions
from jaxmotion.systems.camdm import controller as camdm_controller
from jaxmotion.systems.camdm import model as camdm_model
from jaxmotion.systems.camdm import training as camdm_training
from jaxmotion.typing import Key, Params

WALKER = Path(__file__).parents[1] / "jaxmotion" / "assets" / "walker.npz"
# More rollouts at a time leave a processor's cache, and are slower.
CPU_CHUNK = 16
COLUMNS = ("world_m", "pose_m", "diversity_m", "variance_m2")


@dataclasses.dataclass(frozen=True, kw_only=True)
class Config(suite.Settings):
    """Diversity against the number of rollouts, step count and guidance scale.

    Every rollout starts in the same state and gets the same commands; only its noise
    differs. A row is the mean over sets of rollouts with independent noise, with a 95 %
    interval (Student's t). All rollouts of a set are one compiled program, in which so
    many run at a time as the memory allows.

    Attributes:
      rollouts: Numbers of rollouts.
      sweep_rollouts: Rollouts of each row of the sweeps over steps and guidance; None
        for the largest number.
      run: Model of CAMDM: a shipped one ("locomotion"), an exported file of the
        procedural walker or with poses of its own, or a run folder of
        experiments/camdm.py (with the data it was trained on). None for the shipped
        walker.
      step_runs: Further models, trained for other numbers of diffusion steps.
      steps: Diffusion steps. A chain of another length needs parameters trained for it:
        numbers that no model has are rows that say so.
      guidance: Scales of classifier-free guidance on the past poses, in all plans; 1
        changes nothing. Less than 1 frees the motion from its past.
      visit: Steps of the first model's schedule that a plan visits; none: its own.
      style: Style; None for the model's first.
      course: Commands.
      speed: Meters per second; None for the style's median, or 1.2 without clips.
      seconds: Length of a rollout.
      every: Keep every so many frames, from the last one backwards.
      sets: Sets of rollouts, with seeds seed, seed + 1 and so on.
      seed: Seeds the first set's noise and the start pose.
      pairs: Random pairs of rollouts for each mean.
      memory_gib: Limit for each program: arguments, results and intermediate values.
      chunk: Rollouts at a time; None for as many as fit, but 16 on a CPU, whose cache
        more would not fit.
      stream: So many rollouts of the first model instead of the table, in sets of the
        largest of --rollouts, of which nothing but moments is kept:
        diversity_stream.npz. What was stopped or killed goes on from there.
      distributed: One of several processes, which share the rollouts: "auto", or
        address, number, index.
    """

    rollouts: tuple[int, ...] = (64, 256, 1024)
    sweep_rollouts: int | None = None
    run: Path | None = None
    step_runs: tuple[Path, ...] = ()
    steps: tuple[int, ...] = (2, 4, 8, 16, 32)
    guidance: tuple[float, ...] = (0.0, 0.5, 0.7, 1.0)
    visit: tuple[int, ...] = ()
    style: str | None = None
    course: str = "forward"
    speed: float | None = None
    seconds: float = 4.0
    every: int = 6
    sets: int = 20
    seed: int = 0
    pairs: int = 2000
    memory_gib: float = 4.0
    chunk: int | None = None
    stream: int | None = None
    distributed: cli.Distributed = ()


@dataclasses.dataclass(frozen=True, kw_only=True)
class Load:
    """What all rollouts have in common.

    Attributes:
      name: File or folder of the model.
      model: The model.
      params: Its parameters.
      state: Where they start, one character.
      commands: What they are told, one a tick.
    """

    name: str
    model: camdm_model.Model
    params: Params
    state: camdm_controller.CharacterState
    commands: trajectory.Command


class Motions(NamedTuple):
    """Kept frames: joints in the world, and relative to the root, facing +z; meters."""

    world: Float[Array, "rollouts frames joints 3"]
    pose: Float[Array, "rollouts frames joints 3"]


@dataclasses.dataclass(frozen=True, kw_only=True)
class Program:
    """Rollouts of one model, compiled.

    Attributes:
      roll: `roll(key, scale) -> Motions`; every plan is guided with the scale, none if
        it is None.
      steps: Diffusion steps that a plan visits.
      memory: What it needs, in bytes, and the rollouts at a time.
    """

    roll: Callable[[Key, float | None], Motions]
    steps: int
    memory: dict[str, int]


def make_load(
    run: Path,
    *,
    style: str | None,
    course: str,
    speed: float | None,
    seconds: float,
    seed: int,
) -> Load:
    """Model, start state and commands; settings as in `Config`.

    Raises:
      OSError: if the run or its clips cannot be read.
      ValueError: if the run is none, or has no such style or course.
    """
    if not run.exists() and files.shipped(run) is None:
        raise ValueError(f"{run}: no such file or folder")
    clips, field = None, "style"
    if not run.is_dir():
        model, params = camdm_model.load(run)
        if model.starts is None:
            clips = workload.make_clips()
            model, params = workload.walker_model(run)
    else:
        found = camdm_training.load_run(run)
        model, params, clips, field = (
            found.model,
            found.params,
            found.train,
            found.field,
        )
    label = steering.label_indices(model.labels, style)
    if speed is not None or clips is None:
        speeds = np.array([1.2 if speed is None else speed])
    else:
        speeds = np.asarray(selection.label_speeds(clips, field=field))[label]
    commands = courses.course_batch(
        course, label, speeds, seconds=seconds, fps=model.config.fps
    )
    if clips is None:
        states = camdm_controller.own_states(model, label, seed=seed)
    else:
        states = camdm_controller.start_states(
            clips, model, label, field=field, seed=seed
        )
    state, command = jax.tree.map(lambda x: x[0], (states, commands))
    return Load(
        name=run.name, model=model, params=params, state=state, commands=command
    )


def check_same(a: Load, b: Load) -> None:
    """Raises unless two models start alike and are told the same.

    Raises:
      ValueError: says what differs.
    """
    pairs = {
        "joints": (a.model.skeleton.names, b.model.skeleton.names),
        "styles": (a.model.labels, b.model.labels),
        "past frames": (a.model.config.past, b.model.config.past),
    }
    for what, (expected, found) in pairs.items():
        if expected != found:
            raise ValueError(f"{b.name}: {what} {found}, {a.name} has {expected}")
    for x, y in zip(
        jax.tree.leaves((a.state.past, a.commands)),
        jax.tree.leaves((b.state.past, b.commands)),
        strict=True,
    ):
        if not np.allclose(x, y, atol=1e-4):
            raise ValueError(
                f"{b.name}: starts in another pose or is told to go at another speed "
                f"than {a.name}; were they trained on the same data?"
            )


def one_rollout(
    params: Params,
    key: Key,
    load: Load,
    *,
    control: camdm_controller.Control,
    guided: Array | int,
    every: int,
) -> Motions:
    """One rollout, to be mapped over keys and nothing else.

    Then when to plan depends on nothing that is mapped, and stays a condition, where
    otherwise every planner would run in every tick.

    Args:
      params: The network's parameters.
      key: Consumed.
      load: Start and commands.
      control: Constants of the controller.
      guided: How many plans are guided.
      every: Keep every so many frames, the last one among them.

    Returns:
      Kept frames, without the axis of rollouts.
    """
    skeleton, config = load.model.skeleton, load.model.config
    driver = camdm_controller.controller(
        params,
        skeleton,
        config=config,
        control=control,
        steps=load.model.steps,
    )
    start = dataclasses.replace(load.state, guided=jnp.asarray(guided, jnp.int32))

    def body(state: Any, xs: tuple) -> tuple[Any, tuple[Array, Array]]:
        i, command = xs
        tick_key = jax.random.fold_in(key, i)
        state, frame = rollout.tick(driver, tick_key, state, command)
        return state, (frame.root_position, frame.joint_rotation)

    ticks = load.commands.label.shape[0]
    _, shown = jax.lax.scan(body, start, (jnp.arange(ticks), load.commands))
    root, rotation = jax.tree.map(lambda x: x[(ticks - 1) % every :: every], shown)
    motion = Motion(root_position=root, joint_rotation=rotation, fps=config.fps / every)
    world = joint_positions(skeleton, motion)
    pose = style_evaluator.window_input(skeleton, motion).reshape(world.shape)
    return Motions(world=world, pose=pose)


def _function(
    load: Load, number: int, every: int, chunk: int, devices: Sequence[jax.Device]
) -> Callable:
    """All rollouts: (params, key, guided, scale) -> Motions.

    Each device has its share of them, and all get the motions.
    """

    def roll(
        rows: Array, params: Params, key: Key, guided: Array, scale: Array
    ) -> Motions:
        # The scale is traced: one program serves all of them.
        control = dataclasses.replace(camdm_controller.Control(), guidance_scale=scale)

        def one(i: Array) -> Motions:
            return one_rollout(
                params,
                jax.random.fold_in(key, i),
                load,
                control=control,
                guided=guided,
                every=every,
            )

        return jax.lax.map(one, rows, batch_size=chunk)

    def whole(*given: Any) -> Motions:
        return roll(jnp.arange(number), *given)

    if len(devices) == 1:
        return jax.jit(whole)
    mesh = Mesh(np.array(devices), ("rollouts",))
    split, copy = PartitionSpec("rollouts"), PartitionSpec()
    roll = jax.shard_map(
        roll,
        mesh=mesh,
        in_specs=(split, *4 * (copy,)),
        out_specs=split,
        check_vma=False,
    )
    return jax.jit(whole, out_shardings=NamedSharding(mesh, copy))


def fit_program(
    load: Load,
    number: int,
    *,
    every: int,
    limit: float,
    chunk: int | None,
    devices: Sequence[jax.Device] | None = None,
) -> Program:
    """Compiles rollouts, with the largest chunk whose program fits the limit.

    Args:
      load: What to roll out.
      number: Rollouts.
      every: Frames between kept ones.
      limit: Bytes.
      chunk: Rollouts at a time; None to choose it.
      devices: That share them; None for those of all processes.

    Raises:
      ValueError: if it does not fit.
    """
    devices = jax.devices() if devices is None else devices
    cap = CPU_CHUNK if jax.default_backend() == "cpu" else number
    if number % len(devices):
        raise ValueError(
            f"--rollouts {number}: expected a multiple of the {len(devices)} "
            "devices that share them"
        )
    size = min(number // len(devices), cap if chunk is None else chunk)

    def compiled(size: int) -> Any:
        given = load.params, jax.random.key(0), jnp.int32(0), jnp.float32(1.0)
        return _function(load, number, every, size, devices).lower(*given).compile()

    program, needs = suite.fit(compiled, size, limit=limit, shrink=chunk is None)
    ticks = load.commands.label.shape[0]

    def roll(key: Key, scale: float | None) -> Motions:
        guided = 0 if scale is None else ticks
        given = jnp.int32(guided), jnp.float32(1.0 if scale is None else scale)
        return program(load.params, key, *given)

    calls = len(load.model.steps or range(load.model.config.num_steps))
    return Program(roll=roll, steps=calls, memory=needs)


def measure(
    key: Key, motions: Motions, *, num_pairs: int
) -> dict[str, Float[Array, ""]]:
    """Columns of the table, of one set of rollouts and random pairs of it."""
    found = _measure(key, motions, num_pairs)
    # Compiled functions return dictionaries in alphabetical order.
    return {name: found[name] for name in COLUMNS}


@functools.partial(jax.jit, static_argnums=2)
def _measure(key: Key, motions: Motions, num_pairs: int) -> dict[str, Array]:
    key_world, key_pose, key_frames = jax.random.split(key, 3)
    frames = jnp.swapaxes(motions.pose, 0, 1)
    frames = frames.reshape(*frames.shape[:2], -1)

    def of_frame(x: tuple[Array, Array]) -> Array:
        return diversity.diversity(*x, num_pairs=num_pairs)

    keys = jax.random.split(key_frames, frames.shape[0])
    distance = diversity.joint_distance
    return {
        "world_m": distance(key_world, motions.world, num_pairs=num_pairs),
        "pose_m": distance(key_pose, motions.pose, num_pairs=num_pairs),
        "diversity_m": jnp.mean(jax.lax.map(of_frame, (keys, frames))),
        "variance_m2": diversity.intra_style_variance(motions.pose),
    }


def check(args: Config) -> None:
    """Raises before any work if an argument makes no sense.

    Raises:
      ValueError: names the option.
    """
    suite.at_least(
        args, rollouts=2, sweep_rollouts=2, steps=1, every=1, sets=2, pairs=1, chunk=1,
        stream=2,
    )  # fmt: skip
    if args.course not in courses.COURSES:
        known = ", ".join(courses.COURSES)
        raise ValueError(f"--course {args.course}: there are {known}")
    if not args.memory_gib > 0:
        raise ValueError(f"--memory-gib {args.memory_gib}: expected more than 0")


def _cells(
    args: Config,
    program: Program,
    numbers: tuple[int, ...],
    *,
    scale: float | None = None,
) -> dict[int, dict[str, table.Cell]]:
    """Columns for each number of rollouts, of the same sets."""
    found: dict[int, list[dict[str, Any]]] = {number: [] for number in numbers}
    for seed in range(args.seed, args.seed + args.sets):
        print(f"set with seed {seed}", end="\r", flush=True)
        key_roll, key_pairs = jax.random.split(jax.random.key(seed))
        motions = program.roll(key_roll, scale)
        for number in numbers:
            # Rollout i has the same noise whatever their number.
            part = jax.tree.map(lambda x: x[:number], motions)  # noqa: B023
            key = jax.random.fold_in(key_pairs, number)
            found[number].append(measure(key, part, num_pairs=args.pairs))
    return {
        number: {
            column: table.cell(jnp.stack([row[column] for row in rows]))
            for column in rows[0]
        }
        for number, rows in found.items()
    }


def sweep(
    args: Config, load: Load, others: list[Load]
) -> tuple[dict[str, dict[str, table.Cell]], list[dict[str, Any]]]:
    """The table of the first model and of those for other step counts.

    Returns:
      Its rows, and what each program needs of the memory.
    """
    largest, needs = max(args.rollouts), []
    number = largest if args.sweep_rollouts is None else args.sweep_rollouts

    def program(load: Load, number: int) -> Program:
        made = fit_program(
            load,
            number,
            every=args.every,
            limit=args.memory_gib * suite.GIB,
            chunk=args.chunk,
        )
        needs.append({"model": load.name, **made.memory})
        print(suite.describe(needs[-1]), flush=True)
        return made

    main = program(load, largest)
    by_number = _cells(args, main, tuple(sorted(set(args.rollouts))))
    if number != largest:
        main = program(load, number)
    own = by_number.get(number) or _cells(args, main, (number,))[number]
    by_steps = [(main.steps, load.name, own)]
    for other in others:
        made = program(other, number)
        cells = _cells(args, made, (number,))[number]
        by_steps.append((made.steps, other.name, cells))
    known = {steps for steps, *_ in by_steps}
    missing = set(args.steps) - known
    by_steps += [(n, "no parameters: give --step-runs", {}) for n in missing]
    rows = {f"{n} rollouts": cells for n, cells in by_number.items()}
    rows |= {
        f"{steps} steps ({name})": cells
        for steps, name, cells in sorted(by_steps, key=lambda x: x[0])
    }
    for scale in args.guidance:
        found = _cells(args, main, (number,), scale=scale)
        rows[f"guidance {scale:g}"] = found[number]
    return rows, needs


def stream(args: Config, load: Load) -> streams.Stream:
    """Very many rollouts: each set is rolled out, measured, and forgotten.

    Every process makes whole sets on its own devices.

    Set number s draws from `fold_in(key, s)`.
    """
    size, limit = max(args.rollouts), args.memory_gib * suite.GIB
    own = jax.local_devices()
    program = fit_program(
        load, size, every=args.every, limit=limit, chunk=args.chunk, devices=own
    )
    told = ("visit", "style", "course", "speed", "seconds", "every", "seed", "pairs")
    about = {name: suite.settings(args)[name] for name in told} | {
        "set": size,
        "chunk": program.memory["chunk"],
        "devices": len(own),
        "params": fingerprint.fingerprint(load.params),
    }

    def make(number: int) -> dict[str, np.ndarray]:
        key = jax.random.fold_in(jax.random.key(args.seed), number)
        key_roll, key_pairs = jax.random.split(key)
        motions = program.roll(key_roll, None)
        row = measure(key_pairs, motions, num_pairs=args.pairs)
        columns = np.array([[row[name] for name in COLUMNS]])
        return {"columns": columns, "world": motions.world, "pose": motions.pose}

    path = args.out / "diversity_stream.npz"
    total = -(-args.stream // size)
    return streams.run(make, size=size, total=total, path=path, about=about)


def report_stream(args: Config, found: streams.Stream) -> None:
    """Prints a stream, draws how its intervals narrowed, and writes the report."""
    columns, pose = found.spreads["columns"], found.spreads["pose"]
    values, halves = columns.mean.tolist(), columns.half_width().tolist()
    cells = {
        name: table.Cell(value=x, low=x - half, high=x + half, samples=found.sets)
        for name, x, half in zip(COLUMNS, values, halves, strict=True)
    }
    rows = {f"{pose.count} rollouts": cells}
    whole = float(np.mean(pose.variance.sum(axis=-1)))
    rate = pose.count / found.seconds
    print(
        table.to_markdown(rows),
        f"variance_m2 of all rollouts as one set: {whole:.6g}",
        f"{found.seconds:.0f} s, {rate:,.0f} rollouts/s; {streams.memory(found)}",
        sep="\n",
    )
    streams.draw(args.out / "diversity_stream.png", found, COLUMNS)
    metric = suite.Metric("stream", rate, "rollouts/s", "higher")
    more = dict(variance_m2=whole, seconds=found.seconds, sets=found.sets)
    suite.report("diversity_stream", [metric], args, rows=table.to_json(rows), **more)


def main() -> None:
    """Measures, prints the table and writes the report."""
    args = suite.parse(Config, __doc__)
    check(args)
    cli.join_processes(args.distributed)
    options = dict(
        style=args.style,
        course=args.course,
        speed=args.speed,
        seconds=args.seconds,
        seed=args.seed,
    )
    load = make_load(args.run or WALKER, **options)
    model = camdm_model.with_steps(load.model, args.visit)
    load = dataclasses.replace(load, model=model)
    if args.stream is not None:
        found = stream(args, load)
        if jax.process_index() == 0:
            report_stream(args, found)
        return
    others = [make_load(run, **options) for run in args.step_runs]
    for other in others:
        check_same(load, other)
    rows, needs = sweep(args, load, others)
    if jax.process_index():
        return
    text = table.to_markdown(rows)
    used = suite.peak()
    print(text, f"{used['what']}: {used['bytes'] / suite.GIB:.2f} GiB", sep="\n")
    files.write_text(args.out / "diversity.md", text + "\n")
    metrics = [
        suite.Metric(f"memory {x['model']}", x["total"] / suite.GIB, "GiB")
        for x in needs
    ]
    suite.report(
        "diversity",
        metrics,
        args,
        rows=table.to_json(rows),
        memory=needs,
        peak_memory=used,
        seeds=list(range(args.seed, args.seed + args.sets)),
        commit=reporting.git_commit(),
    )


if __name__ == "__main__":
    cli.start(main)
