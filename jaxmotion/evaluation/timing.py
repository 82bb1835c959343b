"""Times of calls: the only loop that measures any.

A time is measured around a call that ends with its result ready; compiling is measured
apart; the first calls warm up and do not count. What is compared is timed in turn, so
that what disturbs one call disturbs all.
"""

import dataclasses
import time
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np


@dataclasses.dataclass(frozen=True)
class Timing:
    """Times of one compiled program.

    Attributes:
      compile_s: Seconds of tracing, lowering and compiling.
      p50_ms: Median of the timed calls, milliseconds.
      p95_ms: 95th percentile, milliseconds.
      memory_mib: What the program needs at its peak, as its compiler says: arguments,
        results and what lies between, MiB. Constants of the program are not in it.
    """

    compile_s: float
    p50_ms: float
    p95_ms: float
    runs: int
    memory_mib: float


def peak_mib(program: Any) -> float:
    """MiB of a compiled program's arguments, results and what lies between."""
    found = program.memory_analysis()
    parts = ("argument", "output", "temp")
    return sum(getattr(found, f"{part}_size_in_bytes") for part in parts) / 2**20


def matmul_rate(*, size: int = 1024, **options: Any) -> float:
    """FLOP per second of a float32 product of square matrices, the machine's floor.

    Further options are those of `time_in_turn`.
    """
    x = jnp.ones((size, size), jnp.float32)
    program, _ = compile_program(jax.jit(jnp.matmul), x, x)
    options = {"rounds": 20, "limit_s": 5.0} | options
    times = time_calls(lambda: program(x, x), **options)
    return 2.0 * size**3 / (float(np.median(times)) / 1000)


def compiler_options() -> dict[str, Any]:
    """Vectors as wide as a CPU has them: XLA's default stops at 256 bits."""
    if jax.default_backend() == "cpu":
        return {"xla_cpu_prefer_vector_width": 512}
    return {}


def compile_program(function: Callable, *arguments: Any) -> tuple[Callable, float]:
    """A jitted function as a program that cannot compile, and the seconds it took."""
    start = time.perf_counter()
    lowered = function.lower(*arguments)
    program = lowered.compile(compiler_options=compiler_options())
    return program, time.perf_counter() - start


def time_in_turn(
    calls: dict[str, Callable[..., Any]],
    *,
    arguments: Callable[[int], tuple] = lambda i: (),
    rounds: int = 50,
    warmup: int = 3,
    limit_s: float = 60.0,
    least: int = 5,
) -> dict[str, np.ndarray]:
    """Times several calls in one run, so that what disturbs one disturbs all.

    Every round calls each once, in an order of its own, so that none always runs after
    the same other.

    Arguments are of the calls of round i, warm-up included; making them is not timed.
    Warm-up is shorter where it takes a quarter of the limit (seconds), after which only
    the least number of rounds is made. Given is for each name an array [rounds, 2]:
    milliseconds of wall clock, and of processor time of all threads of this process.
    """
    names, made = list(calls), 0

    def one_round() -> list[tuple[float, float]]:
        nonlocal made
        found = {}
        for name in np.random.default_rng(made).permutation(names).tolist():
            given = arguments(made)
            start, start_cpu = time.perf_counter(), time.process_time()
            jax.block_until_ready(calls[name](*given))
            end, end_cpu = time.perf_counter(), time.process_time()
            found[name] = 1000 * (end - start), 1000 * (end_cpu - start_cpu)
        made += 1
        return [found[name] for name in names]

    begin = time.perf_counter()
    for _ in range(warmup):
        one_round()
        if time.perf_counter() - begin > limit_s / 4:
            break
    times: list[list[tuple[float, float]]] = []
    begin = time.perf_counter()
    while len(times) < rounds:
        times.append(one_round())
        if len(times) >= least and time.perf_counter() - begin > limit_s:
            break
    return dict(zip(names, np.array(times).transpose(1, 0, 2), strict=True))


def time_calls(call: Callable[..., Any], **options: Any) -> np.ndarray:
    """Milliseconds of wall clock of each call; options as for `time_in_turn`."""
    return time_in_turn({"": call}, **options)[""][:, 0]


def measure(function: Callable, *arguments: Any, **options: Any) -> Timing:
    """Compiles a jitted function, and times it; options as for `time_in_turn`."""
    program, seconds = compile_program(function, *arguments)
    times = time_calls(lambda: program(*arguments), **options)
    p50, p95 = np.percentile(times, [50, 95])
    return Timing(seconds, float(p50), float(p95), len(times), peak_mib(program))
