"""Seconds to trace, lower and compile the programs of a system.

Example:
  python benchmarks/compile_times.py
  python benchmarks/compile_times.py --steps 32
  python benchmarks/compile_times.py --system aamdm
"""

import dataclasses
import time
from collections.abc import Callable, Iterator
from typing import Any

import jax
import jax.numpy as jnp
import suite
import workload
from jaxtyping import Array

from jaxmotion import cli
from jaxmotion.control import rollout
from jaxmotion.diffusion import chain, schedule
from jaxmotion.learning import training
from jaxmotion.systems.camdm import model as camdm_model
from jaxmotion.typing import Key, Params

COLUMNS = {
    "program": "program",
    "trace": "trace s",
    "lower": "lower s",
    "compile": "compile s",
    "total": "total s",
}


@dataclasses.dataclass(frozen=True, kw_only=True)
class Config(suite.Settings):
    """Schedule, sampler (one scan, and unrolled), training chunk, rollout.

    Seconds of each phase of one program; JAX's caches are emptied before each. The
    parameters are arguments.

    Attributes:
      system: What to compile: camdm or aamdm (the sampler unrolled is CAMDM's).
      steps: Diffusion steps of the sampler.
      updates: Optimizer steps of the training chunk.
      batch: Windows of an update.
      characters: Characters of the rollout.
      seconds: Length of the rollout.
      width: Channels of a token.
    """

    system: str = "camdm"
    steps: int = 8
    updates: int = 50
    batch: int = 32
    characters: int = 16
    seconds: float = 2.0
    width: int = 256


def phases(name: str, function: Callable, given: tuple) -> dict[str, Any]:
    """Seconds of the three phases of one jitted function: a row of the report."""
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
    """CAMDM's sampler with a Python loop over the steps, for comparison."""
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


def programs(args: Config) -> Iterator[tuple[str, Callable, tuple]]:
    """The programs to measure: name, jitted function and arguments."""
    parts = ("samples", "rollouts", "training")
    samples, rollouts, train = (workload.of(args.system, part) for part in parts)
    sizes = workload.Sizes(steps=args.steps, width=args.width)
    yield "schedule, 1000 steps", jax.jit(lambda: schedule.cosine_schedule(1000)), ()

    scanned, given = samples(sizes).program(1, arguments=True)
    yield f"sampler, {args.steps} steps, scan", scanned, given
    if args.system == "camdm":
        config = workload.camdm_config(sizes)
        params, keys, conditions = given
        condition = jax.tree.map(lambda x: x[0], conditions)
        loop = jax.jit(lambda *given: unrolled(config, *given))
        name = f"sampler, {args.steps} steps, unrolled"
        yield name, loop, (params, keys[0], condition)

    program = train(sizes, args.batch)
    run = training.train_chunk(program.update, program.sample, num_steps=args.updates)
    state = program.init(jax.random.key(0))
    name = f"training, {args.updates} updates"
    yield name, run, (state, jax.random.key(0), program.data)

    load = rollouts(sizes, None, args.seconds, False)

    def rolled(params: Params, key: Key, states: Any, commands: Any) -> Any:
        return rollout.rollout(load.controller(params), key, states, commands)

    given = (load.params, jax.random.key(2), *load.start(args.characters))
    name = f"rollout, {args.characters} x {args.seconds:g} s"
    yield name, jax.jit(rolled), given


def main() -> None:
    """Measures and writes the report."""
    args = suite.parse(Config, __doc__)
    suite.at_least(args, steps=1, updates=1, batch=1, characters=1, width=1)
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
