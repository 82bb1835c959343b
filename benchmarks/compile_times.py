"""Seconds to trace, lower and compile the programs of this library.

Example:
  python benchmarks/compile_times.py
"""

import dataclasses
import functools
import time
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import suite
import tyro

from jaxmotion.control import rollout
from jaxmotion.data import procedural, windows
from jaxmotion.diffusion import chain, schedule
from jaxmotion.learning import training
from jaxmotion.protocols import camdm as protocol
from jaxmotion.systems import camdm, camdm_control, camdm_model


@dataclasses.dataclass(frozen=True)
class Config:
    """Schedule, sampler (one scan, and unrolled), training chunk, rollout.

    Attributes:
      steps: Diffusion steps of the sampler.
      out: Folder for compile_times.json.
      gate: Report to compare with; exit status 1 if something is worse.
    """

    steps: int = 8
    out: Path = Path("runs/benchmarks")
    gate: Path | None = None


def phases(name: str, function, *given) -> list[suite.Metric]:
    """Seconds of the three phases of one program."""
    start = time.perf_counter()
    traced = function.trace(*given)
    middle = time.perf_counter()
    lowered = traced.lower()
    late = time.perf_counter()
    lowered.compile()
    end = time.perf_counter()
    times = {"trace": middle - start, "lower": late - middle, "compile": end - late}
    return [
        suite.Metric(f"{name} {phase}", seconds, "s", tolerance=0.6)
        for phase, seconds in times.items()
    ]


def unrolled(config: camdm.Config, params, key, condition):
    """The sampler with a Python loop over the steps, for comparison."""
    table = schedule.cosine_schedule(config.num_steps)
    net = camdm.network(config)
    given = condition.arguments(config)
    context = net.apply({"params": params}, *given, method="encode")

    def denoise(key, x, t):
        del key
        return net.apply({"params": params}, context, x, t, method="denoise")

    step = chain.ancestral_step(table, denoise)
    x = jax.random.normal(key, (config.future, config.num_features))
    for t in range(config.num_steps, 0, -1):
        x = step(jax.random.fold_in(key, t), x, jnp.int32(t))
    return x


def main() -> None:
    """Measures and writes the report."""
    args = tyro.cli(Config, description=__doc__)
    clips = procedural.make_clips(minutes=2)
    config = camdm.Config(num_joints=22, num_labels=8, num_steps=args.steps)
    params = camdm.init(jax.random.key(0), config)
    model = camdm_model.Model(
        config=config,
        bones=clips.skeleton,
        labels=clips.names("style"),
        source=clips.source,
    )
    labels = np.zeros(1, int)
    states = protocol.start_states(clips, model, labels, field="style", seed=0)
    commands = protocol.preset_batch("forward", labels, np.ones(1), seconds=2, fps=30.0)
    index = windows.window_index(clips, config.window)
    motion, _ = windows.sample_windows(jax.random.key(0), clips, index, batch=1)
    single = jax.tree.map(lambda x: x[0], motion)
    condition, _ = jax.jit(
        lambda w: camdm.example(
            jax.random.key(0), model.bones, w, jnp.int32(0), config=config
        )
    )(single)
    key = jax.random.key(1)

    optimizer = training.adamw_cosine(num_steps=100)
    loss = functools.partial(camdm.loss, bones=model.bones, config=config)

    def sample_batch(key, data):
        clips, index = data
        motion, clip = windows.sample_windows(key, clips, index, batch=32)
        return motion, clips.labels["style"][clip]

    run = training.train_chunk(
        training.make_update(loss, optimizer), sample_batch, num_steps=50
    )
    controller = camdm_control.controller(params, model.bones, config=config)

    metrics = phases("schedule", jax.jit(lambda: schedule.cosine_schedule(1000)), *())
    metrics += phases(
        "sampler (scan)",
        jax.jit(lambda p, k, c: camdm.planner(p, config=config)(k, c)),
        params,
        key,
        condition,
    )
    metrics += phases(
        "sampler (unrolled)",
        jax.jit(functools.partial(unrolled, config)),
        params,
        key,
        condition,
    )
    metrics += phases(
        "training chunk, 50 steps",
        run,
        training.init_train_state(params, optimizer),
        key,
        (clips, index),
    )
    metrics += phases(
        "rollout, 2 s",
        jax.jit(functools.partial(rollout.rollout, controller)),
        key,
        states,
        commands,
    )
    suite.report("compile_times", metrics, args.out, gate=args.gate)


if __name__ == "__main__":
    main()
