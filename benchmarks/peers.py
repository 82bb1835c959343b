"""One plan: ours against the same network built from torch.nn.TransformerEncoder.

Same parameters, same condition, same number of threads, measured in turn in one run.
The PyTorch side runs as the released code does, every token in every step. Needs torch
(`pip install -e ".[parity]"`).

Example:
  python benchmarks/peers.py
  python benchmarks/peers.py --threads 1
"""

import dataclasses
import os
import signal
import time
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
import suite
import workload

from jaxmotion import cli
from jaxmotion.evaluation import timing
from jaxmotion.systems.camdm import model as camdm_model

try:
    import torch
    import torch_camdm
except ModuleNotFoundError as error:
    raise SystemExit(
        f'error: peers.py needs {error.name}: pip install -e ".[parity]"'
    ) from None

EAGER = "torch eager"
OURS = "ours, constants"
COLUMNS = {
    "name": "",
    "p50_ms": "p50 ms",
    "p95_ms": "p95 ms",
    "ratio": "/ eager",
    "ratio_spread": "spread",
    "cpu_ms": "cpu ms",
    "cpu_ratio": "/ eager",
    "cpu_spread": "spread",
}
# Cores of other processes up to which wall clock times of several threads count.
IDLE = 0.15


@dataclasses.dataclass(frozen=True, kw_only=True)
class Config(suite.Settings):
    """Milliseconds of one plan at batch 1, and ratios to PyTorch in eager mode.

    Rows: ours with the parameters as arguments and as constants of the program; PyTorch
    eager as the released code lays it out (tokens first), with the batch first (which
    lets PyTorch use its fused inference kernels), and through torch.compile.

    A ratio is the median over the rounds of ours / eager in the same round; its spread
    is from the 25th to the 75th percentile. It is compared by wall clock, on an idle
    machine: two threads that wait for each other suffer out of proportion when
    another process takes a core, PyTorch's much more than ours. With one thread it is
    compared by processor time, which hardly depends on the neighbors.

    Attributes:
      steps: Diffusion steps.
      threads: Threads (and cores) of both.
      rounds: Timed rounds; each runs every row once.
      limit: Seconds of rounds, at most, but five rounds.
      compile_limit: Seconds that torch.compile may take; 0 to leave it out.
      target: Greatest ratio of "ours, constants" that passes; exit status 1 beyond
        it, and 2 where the machine was too busy to tell. 0 for no target.
    """

    steps: int = 8
    threads: int = 2
    rounds: int = 100
    limit: float = 120.0
    compile_limit: int = 60
    target: float = 0.65


def use_cores(number: int) -> int:
    """Confines this process to so many cores, before jax starts its threads.

    Returns:
      Cores it has now: fewer if there are fewer, all where the system cannot do it.
    """
    if not hasattr(os, "sched_setaffinity"):
        return os.cpu_count() or 1
    cores = sorted(os.sched_getaffinity(0))[:number]
    os.sched_setaffinity(0, cores)
    return len(cores)


def our_calls(
    config: camdm_model.Config, params: Any, given: tuple
) -> dict[str, Callable]:
    """Compiled plans: parameters as arguments, and as constants."""
    free = jax.jit(lambda p, k, c: camdm_model.sampler(p, config=config)(k, c))
    bound = jax.jit(lambda k, c: camdm_model.sampler(params, config=config)(k, c))
    free, _ = timing.compile_program(free, params, *given)
    bound, _ = timing.compile_program(bound, *given)
    return {
        "ours, arguments": lambda: free(params, *given),
        OURS: lambda: bound(*given),
    }


def compiled_call(
    net: torch.nn.Module,
    config: camdm_model.Config,
    condition: camdm_model.Condition,
    limit: int,
) -> tuple[Callable | None, str]:
    """The same through torch.compile, if that works within `limit` seconds.

    Returns:
      The call, or None; and what happened, in words.
    """

    def stop(*_: Any) -> None:
        raise TimeoutError(f"not done within {limit} s")

    start = time.perf_counter()
    old = signal.signal(signal.SIGALRM, stop)
    signal.alarm(limit)
    try:
        call = torch_camdm.plan_call(torch.compile(net), config, condition)
        call()
        call()
    except Exception as error:  # whatever a compiler raises: the rest still counts
        return None, f"torch.compile: {type(error).__name__}: {error}".split("\n")[0]
    finally:
        signal.alarm(0)
        signal.signal(signal.SIGALRM, old)
    return call, f"torch.compile took {time.perf_counter() - start:.0f} s"


def largest_difference(
    config: camdm_model.Config,
    params: Any,
    net: torch.nn.Module,
    condition: camdm_model.Condition,
) -> float:
    """Largest absolute difference of the two forward passes, at the last step."""
    given = condition.arguments(config)
    x_t = np.ones((config.future, config.num_features), np.float32)
    t = config.num_steps
    ours = jax.jit(camdm_model.network(config).apply)(
        {"params": params}, x_t, jnp.int32(t), *given
    )
    theirs = [torch.from_numpy(np.array(x)[None]) for x in given[:4]]
    theirs[3] = theirs[3].long()
    with torch.inference_mode():
        found = net(torch.from_numpy(x_t)[None], torch.tensor([t]), *theirs)
    return float(np.abs(np.asarray(ours) - found[0].numpy()).max())


def rows_of(times: dict[str, np.ndarray]) -> list[dict[str, Any]]:
    """Percentiles and ratios to eager PyTorch, by wall clock and by processor time."""
    rows = []
    for name, values in times.items():
        ratio = values / times[EAGER]
        low, middle, high = np.percentile(ratio, [25, 50, 75], axis=0)
        p50, p95 = np.percentile(values, [50, 95], axis=0)
        rows.append(
            {
                "name": name,
                "rounds": len(values),
                "p50_ms": float(p50[0]),
                "p95_ms": float(p95[0]),
                "ratio": float(middle[0]),
                "ratio_spread": f"{low[0]:.2f}-{high[0]:.2f}",
                "cpu_ms": float(p50[1]),
                "cpu_ratio": float(middle[1]),
                "cpu_spread": f"{low[1]:.2f}-{high[1]:.2f}",
            }
        )
    return rows


def check_target(
    row: dict[str, Any], target: float, *, threads: int, load: float | None
) -> None:
    """Says whether the target is reached.

    Args:
      row: Row of `rows_of`.
      target: Greatest ratio that passes.
      threads: Threads of both sides; one is compared by processor time.
      load: Cores that other processes kept busy meanwhile; None if unknown.

    Raises:
      SystemExit: with status 1 if it is not, 2 if nothing can be said.
    """
    if threads > 1 and (load or 0.0) > IDLE:
        print(
            f"Not compared: other processes used {load} cores during the rounds. Run "
            "it on an idle machine, or with --threads 1."
        )
        raise SystemExit(2)
    ratio = row["ratio"] if threads > 1 else row["cpu_ratio"]
    passed = ratio <= target
    print(
        f"ratio {ratio:.2f}, at most {target:.2f}: {'passed' if passed else 'FAILED'}"
    )
    if not passed:
        raise SystemExit(1)


def main() -> None:
    """Measures, writes the report, and checks the target."""
    args = suite.parse(Config, __doc__)
    suite.at_least(args, steps=1, threads=1, rounds=1)
    threads = use_cores(args.threads)
    torch.set_num_threads(threads)
    config = workload.camdm_config(workload.Sizes(steps=args.steps))
    params = camdm_model.init(jax.random.key(0), config)
    condition = jax.tree.map(lambda x: x[0], workload.camdm_conditions(config, 1))
    nets = [
        torch_camdm.load(torch_camdm.TorchCamdm(config, batch_first=first), params)
        for first in (False, True)
    ]
    difference = largest_difference(config, params, nets[0], condition)

    calls = our_calls(config, params, (jax.random.key(1), condition))
    calls[EAGER] = torch_camdm.plan_call(nets[0], config, condition)
    calls["torch eager, batch first"] = torch_camdm.plan_call(
        nets[1], config, condition
    )
    note = "torch.compile: left out"
    if args.compile_limit:
        call, note = compiled_call(nets[0], config, condition, args.compile_limit)
        if call is not None:
            calls["torch.compile"] = call
    since = suite.busy()
    times = timing.time_in_turn(calls, rounds=args.rounds, warmup=3, limit_s=args.limit)
    load = suite.other_load(since)

    rows = rows_of(times)
    print(
        f"One plan of {args.steps} steps, batch 1, {threads} threads, "
        f"{rows[0]['rounds']} rounds; forward passes differ by {difference:.1e}; {note}"
    )
    suite.print_table(rows, COLUMNS)
    metrics = []
    for row in rows:
        metrics += [
            suite.Metric(f"{row['name']} p50", row["p50_ms"], "ms"),
            suite.Metric(f"{row['name']} ratio", row["ratio"], "of eager"),
            suite.Metric(f"{row['name']} cpu ratio", row["cpu_ratio"], "of eager"),
        ]
    suite.report(
        "peers",
        metrics,
        args,
        rows=rows,
        threads=threads,
        torch=torch.__version__,
        torch_compile=note,
        largest_difference=difference,
        other_load_of_rounds=load,
    )
    if args.target:
        ours = next(row for row in rows if row["name"] == OURS)
        check_target(ours, args.target, threads=threads, load=load)


if __name__ == "__main__":
    cli.start(main)
