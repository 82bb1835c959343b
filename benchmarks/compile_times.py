"""Seconds to trace, lower and compile the programs of this library.

Example:
  python benchmarks/compile_times.py
  python benchmarks/compile_times.py --steps 32
"""

import dataclasses
import functools
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import suite
import tyro
import workload
from jaxtyping import Array

from jaxmotion import cli
from jaxmotion.control import rollout
from jaxmotion.data import windows
from jaxmotion.data.clips import Clips
from jaxmotion.diffusion import chain, schedule
from jaxmotion.learning import training
from jaxmotion.systems.camdm import controller as camdm_controller
from jaxmotion.systems.camdm import loss as camdm_loss
from jaxmotion.systems.camdm import model as camdm_model
from jaxmotion.systems.camdm import training as camdm_training
from jaxmotion.typing import Key, Params

COLUMNS = {
    "program": "program",
    "trace": "trace s",
    "lower": "lower s",
    "compile": "compile s",
    "total": "total s",
}


@dataclasses.dataclass(frozen=True)
class Config:
    """Schedule, sampler (one scan, and unrolled), training chunk, rollout.

    Seconds of each phase of one program; JAX's caches are emptied before each. The
    parameters are arguments.

    Attributes:
      steps: Diffusion steps of the sampler.
      updates: Optimizer steps of the training chunk.
      batch: Windows of an update.
      characters: Of the rollout.
      seconds: Length of the rollout.
      width: Channels of a token.
      out: Folder for compile_times.json.
      gate: Report to compare with; exit status 1 if something is worse.
    """

    steps: int = 8
    updates: int = 50
    batch: int = 32
    characters: int = 16
    seconds: float = 2.0
    width: int = 256
    out: Path = Path("runs/benchmarks")
    gate: Path | None = None


def phases(name: str, function: Callable, given: tuple) -> dict[str, Any]:
    """Seconds of the three phases of one program.

    Args:
      name: Of the program.
      function: From `jax.jit`.
      given: Its arguments.

    Returns:
      One row of the report.
    """
    jax.clear_caches()
    clock = [time.perf_counter()]
    traced = function.trace(*given)
    clock.append(time.perf_counter())
    lowered = traced.lower()
    clock.append(time.perf_counter())
    lowered.compile()
    clock.append(time.perf_counter())
    return {
        "program": name,
        "trace": clock[1] - clock[0],
        "lower": clock[2] - clock[1],
        "compile": clock[3] - clock[2],
        "total": clock[3] - clock[0],
    }


def unrolled(
    config: camdm_model.Config,
    params: Params,
    key: Key,
    condition: camdm_model.Condition,
) -> Array:
    """The sampler with a Python loop over the steps, for comparison.

    Args:
      config: The network.
      params: Its parameters.
      key: Consumed.
      condition: Of one character.

    Returns:
      Clean features.
    """
    table = schedule.cosine_schedule(config.num_steps)
    net = camdm_model.network(config)
    arguments = condition.arguments(config)
    context = net.apply({"params": params}, *arguments, method="encode")

    def denoise(key: Key, x: Array, t: Array) -> Array:
        del key
        return net.apply({"params": params}, context, x, t, method="denoise")

    step = chain.ancestral_step(table, denoise)
    key_start, key_chain = jax.random.split(key)
    x = jax.random.normal(key_start, (config.future, config.num_features))
    for t in range(config.num_steps, 0, -1):
        x = step(jax.random.fold_in(key_chain, t), x, jnp.int32(t))
    return x


def training_program(
    args: Config, model: camdm_model.Model, params: Params, clips: Clips
) -> tuple[Callable, tuple]:
    """A chunk of training.

    Args:
      args: The settings.
      model: The model.
      params: Its first parameters.
      clips: The data.

    Returns:
      The jitted function and its arguments.
    """
    optimizer = training.make_optimizer("adamw", learning_rate=1e-4, num_steps=1000)
    loss = functools.partial(
        camdm_loss.loss, skeleton=model.skeleton, config=model.config
    )

    sample_batch = camdm_training.window_sampler(field="style", batch=args.batch)
    update = training.make_update(loss, optimizer)
    run = training.train_chunk(update, sample_batch, num_steps=args.updates)
    state = training.init_train_state(params, optimizer)
    index = windows.window_index(clips, model.config.window)
    return run, (state, jax.random.key(0), (clips, index))


def programs(args: Config) -> Iterator[tuple[str, Callable, tuple]]:
    """The programs to measure.

    Args:
      args: The settings.

    Yields:
      Name, jitted function and arguments.
    """
    clips = workload.make_clips()
    model, params = workload.walker_model(
        clips, None, steps=args.steps, width=args.width
    )
    config = model.config
    yield (
        "schedule, 1000 steps",
        jax.jit(lambda: schedule.cosine_schedule(1000)),
        (),
    )

    def scanned(params: Params, key: Key, condition: camdm_model.Condition) -> Array:
        return camdm_model.sampler(params, config=config)(key, condition)

    condition = jax.tree.map(lambda x: x[0], workload.conditions(config, 1))
    given = (params, jax.random.key(1), condition)
    yield f"sampler, {args.steps} steps, scan", jax.jit(scanned), given
    loop = jax.jit(functools.partial(unrolled, config))
    yield f"sampler, {args.steps} steps, unrolled", loop, given
    name = f"training, {args.updates} updates"
    yield name, *training_program(args, model, params, clips)

    def rolled(params: Params, key: Key, states: Any, commands: Any) -> Any:
        controller = camdm_controller.controller(params, model.skeleton, config=config)
        return rollout.rollout(controller, key, states, commands)

    steered = workload.steered(model, clips, args.characters, seconds=args.seconds)
    name = f"rollout, {args.characters} x {args.seconds:g} s"
    yield name, jax.jit(rolled), (params, jax.random.key(2), *steered)


def main() -> None:
    """Measures and writes the report."""
    args = tyro.cli(Config, description=__doc__)
    suite.prepare(args)
    rows = [phases(*program) for program in programs(args)]
    suite.print_table(rows, COLUMNS)
    metrics = [
        suite.Metric(f"{row['program']}: {phase}", row[phase], "s", tolerance=0.6)
        for row in rows
        for phase in ("trace", "lower", "compile")
    ]
    suite.report("compile_times", metrics, args, rows=rows)


if __name__ == "__main__":
    cli.start(main)
