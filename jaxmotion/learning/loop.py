"""The host's side of a training: chunks, progress, checkpoints, and when to stop.

All arithmetic is in the compiled chunk (`training.train_chunk`); this loop starts it,
looks at the losses it returns, and writes checkpoints between chunks.
"""

import contextlib
import dataclasses
import json
import signal
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import jax
import numpy as np
from tqdm import tqdm

from jaxmotion.learning import checkpoint
from jaxmotion.learning.training import Info
from jaxmotion.typing import Key


class TrainingDiverged(FloatingPointError):
    """A loss is not finite."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class Loop:
    """How long to train, and what to write.

    Attributes:
      num_steps: Updates of the whole run, a resumed part included.
      chunk: Updates of one compiled call; divides num_steps.
      save_every: Updates between checkpoints; a multiple of chunk.
      folder: Run folder: checkpoints in `checkpoints`, losses in `losses.jsonl`.
      config: JSON that rebuilds the model, stored with each checkpoint.
      show: Names of the values on the progress bar.
    """

    num_steps: int
    chunk: int
    save_every: int
    folder: Path
    config: dict[str, Any]
    show: tuple[str, ...] = ("loss",)


def check_writable(folder: str | Path) -> None:
    """Raises if a folder cannot be made or written; called before any work.

    Args:
      folder: The folder; made if missing.

    Raises:
      OSError: names the folder.
    """
    folder = Path(folder)
    try:
        folder.mkdir(parents=True, exist_ok=True)
        probe = folder / ".writable"
        probe.touch()
        probe.unlink()
    except OSError as error:
        raise OSError(f"{folder}: cannot write here: {error}") from error


def check_finite(info: Info, first_step: int, folder: Path) -> None:
    """Raises at the first loss that is not finite.

    Args:
      info: Values of a chunk, one row a step.
      first_step: Step of the first row, counted from 1.
      folder: The run's checkpoint folder, to name the last good checkpoint.

    Raises:
      TrainingDiverged: names the step, the losses and the last good checkpoint.
    """
    bad = np.flatnonzero(~np.isfinite(np.asarray(info["loss"])))
    if bad.size == 0:
        return
    row = int(bad[0])
    values = {name: float(np.asarray(x)[row]) for name, x in info.items()}
    good = checkpoint.latest_step(folder)
    where = "there is none" if good is None else f"{folder} step {good}"
    raise TrainingDiverged(
        f"loss is not finite at step {first_step + row}: {values}; "
        f"last good checkpoint: {where}"
    )


@contextlib.contextmanager
def _held_interrupt() -> Iterator[list[int]]:
    """Notes the first Ctrl-C instead of raising; a second one raises at once.

    A chunk donates its state: an exception in the midst of it would leave nothing to
    save. Outside the main thread nothing is changed.
    """
    seen: list[int] = []
    if threading.current_thread() is not threading.main_thread():
        yield seen
        return

    def note(number: int, _: Any) -> None:
        if seen:
            raise KeyboardInterrupt
        seen.append(number)

    before = signal.signal(signal.SIGINT, note)
    try:
        yield seen
    finally:
        signal.signal(signal.SIGINT, before)


def _forget_lost_steps(path: Path, done: int) -> None:
    """Drops rows behind the checkpoint that a run goes on from, and a torn last row."""
    if not path.exists():
        return
    kept = []
    for line in path.read_text().splitlines():
        with contextlib.suppress(ValueError, KeyError):
            if json.loads(line)["step"] <= done:
                kept.append(line + "\n")
    path.write_text("".join(kept))


def train(
    run_chunk: Callable[[Any, Key, Any], tuple[Any, Info]],
    state: Any,
    key: Key,
    data: Any,
    *,
    loop: Loop,
) -> Any:
    """Trains to `loop.num_steps`, from a new or a restored state.

    The first Ctrl-C lets the running chunk end and saves it. A kill at any moment
    leaves the last checkpoint whole.

    Args:
      run_chunk: From `train_chunk`, with `loop.chunk` steps.
      state: New, or restored from `<folder>/checkpoints`; donated.
      key: The same for all parts of a run.
      data: Arrays on the device.
      loop: How long, and what to write.

    Returns:
      The last state.

    Raises:
      TrainingDiverged: if a loss is not finite; nothing of that chunk is saved.
      ValueError: if the chunk does not divide the steps that are left.
      OSError: if the folder cannot be written.
      KeyboardInterrupt: after Ctrl-C, when the state is saved.
    """
    checkpoints = loop.folder / "checkpoints"
    check_writable(checkpoints)
    done = int(state.step)
    if (loop.num_steps - done) % loop.chunk or loop.save_every % loop.chunk:
        raise ValueError(
            f"steps left ({loop.num_steps - done}) and save_every "
            f"({loop.save_every}) must be multiples of the chunk ({loop.chunk})"
        )
    losses = loop.folder / "losses.jsonl"
    _forget_lost_steps(losses, done)
    stop = False
    bar = tqdm(total=loop.num_steps, initial=done, unit="step", smoothing=0.1)
    with bar, open(losses, "a", buffering=1) as log, _held_interrupt() as interrupts:
        while done < loop.num_steps and not stop:
            start = time.perf_counter()
            state, info = jax.block_until_ready(run_chunk(state, key, data))
            check_finite(info, done + 1, checkpoints)
            done += loop.chunk
            means = {name: float(np.mean(x)) for name, x in info.items()}
            rate = loop.chunk / (time.perf_counter() - start)
            row = {"step": done, **means, "steps_per_second": rate}
            log.write(json.dumps(row) + "\n")
            bar.set_postfix({name: f"{means[name]:.4f}" for name in loop.show})
            bar.update(loop.chunk)
            stop = bool(interrupts)
            if done % loop.save_every == 0 or done >= loop.num_steps or stop:
                checkpoint.save(checkpoints, done, state, loop.config)
    if stop and done < loop.num_steps:
        raise KeyboardInterrupt(f"stopped at step {done}; saved in {checkpoints}")
    return state
