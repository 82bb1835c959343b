"""Times of compiled programs.

A time is measured around a call that ends with its result ready; compiling is measured
apart; the first calls warm up and do not count.
"""

import dataclasses
import time
from collections.abc import Callable
from typing import Any

import jax
import numpy as np


@dataclasses.dataclass(frozen=True)
class Timing:
    """Times of one compiled program.

    Attributes:
      compile_s: Seconds of tracing, lowering and compiling.
      p50_ms: Median of the timed calls, milliseconds.
      p95_ms: 95th percentile, milliseconds.
      runs: Timed calls.
    """

    compile_s: float
    p50_ms: float
    p95_ms: float
    runs: int


def compile_program(function: Callable, *arguments: Any) -> tuple[Callable, float]:
    """Compiles a jitted function.

    Args:
      function: From `jax.jit`.
      *arguments: Of the call.

    Returns:
      The program, which cannot compile again, and the seconds it took.
    """
    start = time.perf_counter()
    program = function.lower(*arguments).compile()
    return program, time.perf_counter() - start


def time_calls(
    call: Callable[[], Any],
    *,
    runs: int = 50,
    warmup: int = 3,
    limit_s: float = 60.0,
    least: int = 5,
) -> np.ndarray:
    """Milliseconds of each of `runs` calls, fewer where the limit comes first.

    Args:
      call: Does the work; what it returns is waited for.
      runs: Calls to time.
      warmup: Calls before, fewer where they take a quarter of the limit.
      limit_s: Stop after so many seconds, but not before the least number of calls.
      least: That number.

    Returns:
      One time a call.
    """
    begin = time.perf_counter()
    for _ in range(warmup):
        jax.block_until_ready(call())
        if time.perf_counter() - begin > limit_s / 4:
            break
    times: list[float] = []
    begin = time.perf_counter()
    while len(times) < runs:
        start = time.perf_counter()
        jax.block_until_ready(call())
        times.append(1000 * (time.perf_counter() - start))
        if len(times) >= least and time.perf_counter() - begin > limit_s:
            break
    return np.array(times)


def time_in_turn(
    calls: dict[str, Callable[[], Any]], *, rounds: int, warmup: int, limit_s: float
) -> dict[str, np.ndarray]:
    """Times several calls in one run, so that what disturbs one disturbs all.

    Every round calls each once; the order moves on by one a round, so that none always
    runs behind the same other.

    Args:
      calls: By name; what they return is waited for if it is JAX's.
      rounds: Timed rounds.
      warmup: Rounds before.
      limit_s: Stop after so many seconds, but not before five rounds.

    Returns:
      For each name an array [rounds, 2]: milliseconds of wall clock, and of processor
      time of all threads of this process.
    """
    names = list(calls)
    times: dict[str, list[tuple[float, float]]] = {name: [] for name in names}
    begin = time.perf_counter()
    for i in range(warmup + rounds):
        turn = i % len(names)
        for name in names[turn:] + names[:turn]:
            start, start_cpu = time.perf_counter(), time.process_time()
            jax.block_until_ready(calls[name]())
            end, end_cpu = time.perf_counter(), time.process_time()
            if i >= warmup:
                times[name].append((1000 * (end - start), 1000 * (end_cpu - start_cpu)))
        if i >= warmup + 4 and time.perf_counter() - begin > limit_s:
            break
    return {name: np.array(rows) for name, rows in times.items()}


def measure(
    function: Callable, *arguments: Any, runs: int, limit_s: float, least: int = 5
) -> Timing:
    """Compiles a jitted function, and times it.

    Args:
      function: From `jax.jit`.
      *arguments: Of the call.
      runs: As of `time_calls`.
      limit_s: Likewise.
      least: Likewise.

    Returns:
      Times of compiling and of the calls.
    """
    program, seconds = compile_program(function, *arguments)
    times = time_calls(
        lambda: program(*arguments), runs=runs, limit_s=limit_s, least=least
    )
    p50, p95 = np.percentile(times, [50, 95])
    return Timing(seconds, float(p50), float(p95), len(times))
