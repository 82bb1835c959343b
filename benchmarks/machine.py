"""What a report says about the machine, and how busy others kept it meanwhile."""

import datetime
import importlib.metadata
import os
import platform
import sys
import time
from pathlib import Path
from typing import Any

import jax

from jaxmotion import reporting


def busy() -> tuple[float, float, float] | None:
    """Where the clocks stand, for `other_load`.

    Returns:
      Seconds of wall clock, of all cores' work, and of this process's work; None where
      the system does not say (it is Linux that does).
    """
    try:
        fields = Path("/proc/stat").read_text().split("\n", 1)[0].split()[1:]
        ticks = [int(x) for x in fields]
    except (OSError, ValueError):
        return None
    idle = sum(ticks[3:5])
    # Guest time (behind the eighth field) is counted as user time already.
    used = (sum(ticks[:8]) - idle) / os.sysconf("SC_CLK_TCK")
    return time.perf_counter(), used, time.process_time()


_BEGIN = busy()


def other_load(since: tuple[float, float, float] | None = _BEGIN) -> float | None:
    """Cores that other processes kept busy on average.

    Args:
      since: From `busy`; by default the start of this process.

    Returns:
      0 on an idle machine; None where the system does not say.
    """
    now = busy()
    if now is None or since is None:
        return None
    clock, used, own = (b - a for a, b in zip(since, now, strict=True))
    return round(max(used - own, 0.0) / max(clock, 1e-9), 2)


def versions(*names: str) -> dict[str, str]:
    """Versions of installed distributions.

    Args:
      *names: Of the distributions; those that are not installed are left out.

    Returns:
      Version by name.
    """
    found = {}
    for name in names:
        try:
            found[name] = importlib.metadata.version(name)
        except importlib.metadata.PackageNotFoundError:
            continue
    return found


def use_cores(number: int) -> int:
    """Confines this process to so many cores; before jax starts its threads.

    Args:
      number: Cores.

    Returns:
      Cores it has now: fewer if there are fewer, all where the system cannot do it.
    """
    if not hasattr(os, "sched_setaffinity"):
        return os.cpu_count() or 1
    cores = sorted(os.sched_getaffinity(0))[:number]
    os.sched_setaffinity(0, cores)
    return len(cores)


def environment() -> dict[str, Any]:
    """Hardware, versions, command and date, for every report.

    Returns:
      A JSON object. "other_load" says how far the figures can be trusted.
    """
    return {
        "device": str(jax.devices()[0]),
        "devices": len(jax.devices()),
        "cpu": reporting.processor(),
        "cores": os.cpu_count(),
        "python": platform.python_version(),
        **versions("jax", "jaxlib", "flax", "numpy", "jaxmotion"),
        "other_load": other_load(),
        "command": " ".join(["python", *sys.argv]),
        "date": datetime.datetime.now(datetime.UTC).isoformat(timespec="seconds"),
    }
