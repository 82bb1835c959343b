"""What compiled programs need of the memory, and chunks that fit a limit."""

import sys
from collections.abc import Callable
from typing import Any

import jax

GIB = float(2**30)


def needs_of(compiled: Any, chunk: int) -> dict[str, int]:
    """What a program needs, as its compiler says.

    Args:
      compiled: The program.
      chunk: What it does at a time.

    Returns:
      Bytes by name, their total, and the chunk.
    """
    found = compiled.memory_analysis()
    parts = {
        "arguments": found.argument_size_in_bytes,
        "results": found.output_size_in_bytes,
        "intermediate": found.temp_size_in_bytes,
    }
    return {"chunk": chunk, **parts, "total": sum(parts.values())}


def next_chunk(needs: dict[str, int], limit: float) -> int:
    """Fewer rollouts at a time, that should fit.

    Args:
      needs: Of a program that does not fit, bytes.
      limit: Bytes.

    Returns:
      At most half as many; what is not intermediate does not shrink with them.

    Raises:
      ValueError: if no number would fit.
    """
    chunk = needs["chunk"]
    room = limit - needs["arguments"] - needs["results"]
    if chunk == 1 or room <= 0:
        need = needs["total"] if chunk == 1 else needs["total"] - needs["intermediate"]
        raise ValueError(
            f"--memory-gib {limit / GIB:g}: one rollout at a time needs "
            f"{need / GIB:.3g} GiB or more, {needs['results'] / GIB:.3g} of it for "
            "the frames that are kept: expected a higher limit, fewer or shorter "
            "rollouts, or a larger --every"
        )
    fits = int(room / (needs["intermediate"] / chunk))
    return max(1, min(chunk // 2, fits))


def fit(
    compiled: Callable[[int], Any], size: int, *, limit: float, shrink: bool
) -> tuple[Any, dict[str, int]]:
    """Compiles a program with the largest chunk that fits a limit.

    The compiler is asked what a program needs; what does not fit is compiled again with
    a smaller chunk.

    Args:
      compiled: Compiles the program for a chunk.
      size: Chunk to begin with.
      limit: Bytes.
      shrink: Whether smaller chunks are allowed.

    Returns:
      The program, and what it needs.

    Raises:
      ValueError: if it does not fit.
    """
    while True:
        program = compiled(size)
        needs = needs_of(program, size)
        if needs["total"] <= limit:
            return program, needs
        if not shrink:
            raise ValueError(
                f"--chunk {size}: {needs['total'] / GIB:.3g} GiB, more than "
                f"--memory-gib {limit / GIB:g}"
            )
        size = next_chunk(needs, limit)


def describe(needs: dict[str, Any]) -> str:
    """One line about a program.

    Args:
      needs: From `needs_of`, and the name of the model.

    Returns:
      The line.
    """
    parts = ", ".join(
        f"{needs[name] / GIB:.3f} {name}"
        for name in ("arguments", "results", "intermediate")
    )
    return (
        f"{needs['model']}: {needs['chunk']} rollouts at a time, "
        f"{needs['total'] / GIB:.3f} GiB ({parts})"
    )


def peak() -> dict[str, Any]:
    """The most that was used at once, so far.

    Returns:
      Bytes, and of what: the accelerator, or the process where the device keeps no
      account; 0 bytes where the system keeps none either.
    """
    stats = jax.devices()[0].memory_stats()
    if stats and "peak_bytes_in_use" in stats:
        return {"what": "peak of the device", "bytes": stats["peak_bytes_in_use"]}
    try:
        import resource
    except ImportError:  # Windows
        return {"what": "peak unknown", "bytes": 0}
    used = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    unit = 1 if sys.platform == "darwin" else 1024
    return {
        "what": "peak of the process, JAX and compiler included",
        "bytes": used * unit,
    }
