"""The host's side of a training: chunks, progress, checkpoints, and when to stop.

All arithmetic is in the compiled chunk (`training.train_chunk`); this loop starts it,
looks at the losses it returns, and writes checkpoints between chunks. In a run of
several processes all run it, on the same losses; the first one alone prints and writes,
and Orbax divides the checkpoints among them.
"""

import contextlib
import contextvars
import dataclasses
import json
import os
import signal
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jax.experimental import multihost_utils
from jaxtyping import Array
from tqdm import tqdm

from jaxmotion import files
from jaxmotion.learning import checkpoint
from jaxmotion.learning.training import Info
from jaxmotion.typing import Key

try:
    import fcntl
except ImportError:  # Windows
    fcntl = None

# What a user waits for before the first step, on two CPU cores.
COMPILING = "compiling the training step, about 40 s (once)"


class TrainingDiverged(FloatingPointError):
    """A loss is not finite."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class Loop:
    """How long to train, and what to write.

    Attributes:
      num_steps: Updates of the whole run, a resumed part included.
      chunk: Updates of one row of losses, and of a compiled call at most.
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

    def __post_init__(self):
        """Raises a `ValueError`, with the field, for what would fail after a chunk."""
        for name in ("num_steps", "chunk", "save_every"):
            if getattr(self, name) < 1:
                raise ValueError(
                    f"{name} is {getattr(self, name)}, expected at least 1"
                )


def check_writable(folder: str | Path) -> None:
    """Raises `OSError` if a folder cannot be written or made; leaves nothing behind."""
    there = Path(folder).absolute()
    try:
        while not there.exists():
            there = there.parent
        with tempfile.TemporaryFile(dir=there):
            pass
    except OSError as error:
        raise OSError(f"{folder}: cannot write here: {error}") from error


def check_finite(info: dict[str, Any], first_step: int, folder: Path) -> None:
    """Raises at the first loss of a chunk, one row per step, that is not finite.

    Steps are counted from 1. `TrainingDiverged` names the step, the losses and the last
    good checkpoint in the run's folder.
    """
    bad = np.flatnonzero(~np.isfinite(np.asarray(info["loss"])))
    if bad.size == 0:
        return
    row = int(bad[0])
    values = {name: float(np.asarray(x)[row]) for name, x in info.items()}
    raise TrainingDiverged(
        f"loss is not finite at step {first_step + row}: {values}; {_last_good(folder)}"
    )


def _last_good(folder: Path) -> str:
    good = checkpoint.latest_step(folder)
    where = f"there is none in {folder}" if good is None else f"{folder} step {good}"
    return f"last good checkpoint: {where}"


@jax.jit
def _finite(state: Any) -> Array:
    numbers = [
        x for x in jax.tree.leaves(state) if jnp.issubdtype(x.dtype, jnp.inexact)
    ]
    return jnp.all(jnp.stack([jnp.all(jnp.isfinite(x)) for x in numbers]))


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


@contextlib.contextmanager
def _alone(folder: Path) -> Iterator[None]:
    """Keeps other trainings out of a folder; a kill opens it again.

    Where the system has no such locks (Windows, some network disks) all come in.
    """
    if fcntl is None:
        yield
        return
    handle = os.open(folder, os.O_RDONLY)
    try:
        fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        os.close(handle)
        raise ValueError(f"{folder}: another training is under way here") from None
    except OSError:
        pass
    try:
        yield
    finally:
        os.close(handle)


def read_losses(path: Path) -> list[dict[str, Any]]:
    """Rows of a `losses.jsonl`, without a last one that a kill tore.

    Raises `ValueError`, with file and line, for a line that is no row with a step.
    """
    rows = []
    for number, line in enumerate(
        files.read_bytes(path).splitlines(keepends=True), start=1
    ):
        try:
            row = json.loads(line)
        except (ValueError, RecursionError):
            if not line.endswith(b"\n"):
                break
            row = None
        if not isinstance(row, dict) or not isinstance(row.get("step"), int):
            raise ValueError(
                f"{path}: line {number} is {line[:40]!r}, expected a JSON object with "
                "a whole number as 'step'"
            )
        rows.append(row)
    return rows


def seconds_of(rows: list[dict[str, Any]]) -> np.ndarray:
    """Seconds of training at each row of losses.

    The first row waits for the compiler: it counts as the median of the others does.
    """
    updates = np.diff([0, *(row["step"] for row in rows)])
    each = 1 / np.array([row["steps_per_second"] for row in rows], np.float64)
    if len(each) > 1:
        each[0] = min(each[0], np.median(each[1:]))
    return np.cumsum(updates * each)


def _forget_lost_steps(path: Path, done: int) -> None:
    """Drops rows after the checkpoint that a run goes on from, and a torn last row."""
    if not path.exists():
        return
    kept = [json.dumps(row) + "\n" for row in read_losses(path) if row["step"] <= done]
    files.write_text(path, "".join(kept))


def _append(path: Path, row: dict[str, Any]) -> None:
    try:
        with open(path, "a") as log:
            log.write(json.dumps(row) + "\n")
    except OSError as error:
        raise OSError(error.errno, error.strerror, str(path)) from error


def _save(folder: Path, step: int, state: Any, config: dict[str, Any]) -> None:
    try:
        checkpoint.save(folder, step, state, config)
    except Exception as error:  # a full disk is orbax's or tensorstore's to report
        good = checkpoint.latest_step(folder)
        raise OSError(
            f"{folder}: cannot write step {step}: {' '.join(str(error).split())}; last "
            f"good checkpoint: {'there is none' if good is None else f'step {good}'}"
        ) from error


class _Pieces:
    """How many updates to run before the bar moves: what takes about a second."""

    def __init__(self, chunk: int):
        # Of several processes each must run the same pieces, whatever its clock says.
        self.alone = jax.process_count() == 1
        self.size = 1 if self.alone else chunk
        self.first = True

    def note(self, count: int, seconds: float) -> None:
        """Takes in how long the last piece took."""
        if self.alone and not self.first:  # whose time is the compiler's
            fitting = count / max(seconds, 1e-3)
            self.size = int(np.clip(fitting, 1, 4 * self.size))
        self.first = False


def _any_process(stop: bool, pieces: int) -> bool:
    """Whether any process is to stop: by Ctrl-C, or SIGTERM where there are several.

    `stop` says whether this one is, `pieces` how often all of them have asked.
    """
    if jax.process_count() == 1:
        return stop
    anyone = multihost_utils.process_allgather(np.array(stop)).any()
    return bool(anyone) or multihost_utils.reached_preemption_sync_point(pieces)


@dataclasses.dataclass(frozen=True, kw_only=True)
class Training:
    """What `train` takes: a training that has not begun, or goes on."""

    run_chunk: Callable[..., tuple[Any, Info]]
    state: Any
    key: Key | None  # of several trainings their data have it
    data: Any
    loop: Loop


# Who trains instead of `train`, in this thread: see `together`.
_trainer: contextvars.ContextVar[Callable[[Training], Any] | None] = (
    contextvars.ContextVar("trainer", default=None)
)


def leave_to(trainer: Callable[[Training], Any]) -> None:
    """Leaves the trainings of this thread to another; it returns their last state."""
    _trainer.set(trainer)


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
      run_chunk: From `train_chunk`, with `loop.chunk` steps; called for fewer of them
        at a time where a chunk takes longer than about a second.
      state: New, or restored from `<folder>/checkpoints`; donated.
      key: The same for all parts of a run.

    Raises:
      TrainingDiverged: if a loss is not finite; nothing of that chunk is saved.
      ValueError: if more steps are done than asked for, another training is under way
        in the folder, or a line of `losses.jsonl` is no row.
      OSError: if the folder cannot be written; names the last good checkpoint.
      KeyboardInterrupt: after Ctrl-C, when the state is saved.
    """
    training = Training(run_chunk=run_chunk, state=state, key=key, data=data, loop=loop)
    if (trainer := _trainer.get()) is not None:
        return trainer(training)
    return train_all(training, (loop,), lambda tree, _: tree)


def train_all(
    training: Training, loops: Sequence[Loop], part: Callable[[Any, int], Any]
) -> Any:
    """`train`, of one program that may be several trainings, each with its own folder.

    Args:
      loops: One per training, with the lengths of `training.loop`. Of several, each
        value that a chunk reports has an axis of them first.
      part: `(state, i)` -> state of training i.

    Returns:
      The state of all.
    """
    loop, state = training.loop, training.state
    done = int(state.step)
    first = jax.process_index() == 0
    for one in loops:
        check_writable(one.folder / "checkpoints")
        if done > one.num_steps:
            raise ValueError(
                f"{one.folder}: has {done} steps, expected at most the "
                f"{one.num_steps} to train"
            )
        one.folder.mkdir(parents=True, exist_ok=True)
    with contextlib.ExitStack() as held:
        if first:
            for one in loops:
                held.enter_context(_alone(one.folder))
                _forget_lost_steps(one.folder / "losses.jsonl", done)
        return state if done >= loop.num_steps else _run(training, loops, part)


def _run(
    training: Training, loops: Sequence[Loop], part: Callable[[Any, int], Any]
) -> Any:
    """`train_all`, in folders that nobody else trains in."""
    loop, state = training.loop, training.state
    done, first = int(state.step), jax.process_index() == 0
    stop, asked, pieces = False, 0, _Pieces(loop.chunk)
    began = time.perf_counter()
    if first:
        print(COMPILING, file=sys.stderr, flush=True)
    bar = tqdm(
        total=loop.num_steps,
        initial=done,
        unit="step",
        smoothing=0.1,
        disable=not first,
    )
    with bar, _held_interrupt() as interrupts:
        while done < loop.num_steps and not stop:
            start, made = time.perf_counter(), 0
            infos: list[list[dict[str, Any]]] = [[] for _ in loops]
            # As long as whoever resumes here would make it.
            to_save = loop.save_every - done % loop.save_every
            length = min(loop.chunk, to_save, loop.num_steps - done)
            while made < length:
                before = time.perf_counter()
                count = min(pieces.size, length - made)
                made_now = training.run_chunk(state, training.key, training.data, count)
                state, info = jax.block_until_ready(made_now)
                info = {name: np.asarray(x) for name, x in info.items()}
                for i, one in enumerate(loops):
                    own = {
                        name: (x if len(loops) == 1 else x[i])[:count]
                        for name, x in info.items()
                    }
                    check_finite(own, done + made + 1, one.folder / "checkpoints")
                    infos[i].append(own)
                made += count
                bar.update(count)
                if pieces.first and first:
                    seconds = time.perf_counter() - began
                    bar.write(f"first step after {seconds:.0f} s", file=sys.stderr)
                pieces.note(count, time.perf_counter() - before)
            done += length
            rate = length / (time.perf_counter() - start)
            means = [_means(own) for own in infos]
            for one, mean in zip(loops, means, strict=True):
                if first:
                    row = {"step": done, **mean, "steps_per_second": rate}
                    _append(one.folder / "losses.jsonl", row)
            shown = {x: float(np.mean([mean[x] for mean in means])) for x in loop.show}
            bar.set_postfix({name: f"{value:.4f}" for name, value in shown.items()})
            asked += 1
            stop = _any_process(bool(interrupts), asked)
            if done % loop.save_every == 0 or done >= loop.num_steps or stop:
                for i, one in enumerate(loops):
                    place, own = one.folder / "checkpoints", part(state, i)
                    # A finite loss may have a gradient that is not.
                    if not _finite(own):
                        raise TrainingDiverged(
                            f"parameters are not finite after step {done}; "
                            f"{_last_good(place)}"
                        )
                    _save(place, done, own, one.config)
    if stop:
        places = ", ".join(str(one.folder / "checkpoints") for one in loops)
        raise KeyboardInterrupt(f"stopped at step {done}; saved in {places}")
    return state


def _means(infos: list[dict[str, Any]]) -> dict[str, float]:
    return {
        name: float(np.mean(np.concatenate([info[name] for info in infos])))
        for name in infos[0]
    }
