"""Very many samples in sets, of which nothing but moments is kept.

Memory is constant; what is stopped or killed goes on where it last wrote, at most
`SAVE_S` seconds before. Sets are merged in their order, so that a stream that was
killed ends with the same moments, to the bit, as one that was not. Several processes
make whole sets in turn and exchange moments, so theirs are the same bits, too: a set
that they shared would come from another program, which rounds otherwise.
"""

import dataclasses
import json
import time
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import jax
import numpy as np
import suite
from jax.experimental import multihost_utils
from tqdm import tqdm

from jaxmotion import files
from jaxmotion.evaluation import statistics
from jaxmotion.viz import plots

# Seconds between writings.
SAVE_S = 10.0


@dataclasses.dataclass(frozen=True)
class Stream:
    """What a stream has so far; its file has the same fields.

    Attributes:
      sets: Sets that were made.
      seconds: How long they took.
      spreads: Moments by name; those of "columns" have a sample per set.
      history: Samples, seconds, peak bytes; then each column's mean, and half its
        interval. A row each time it was written.
    """

    sets: int = 0
    seconds: float = 0.0
    spreads: dict[str, statistics.Spread] = dataclasses.field(default_factory=dict)
    history: tuple[tuple[float, ...], ...] = ()

    def add(self, found: dict[str, statistics.Spread], seconds: float) -> "Stream":
        """With the moments of one more set."""
        found = dict(found)
        for name, old in self.spreads.items():
            found[name] = statistics.merge(old, found[name])
        return Stream(self.sets + 1, self.seconds + seconds, found, self.history)

    def noted(self, size: int) -> "Stream":
        """With one more row of the history."""
        columns = self.spreads["columns"]
        row = float(size * self.sets), self.seconds, float(suite.peak()["bytes"])
        row = (*row, *columns.mean.tolist(), *columns.half_width().tolist())
        return dataclasses.replace(self, history=(*self.history, row))


def write(path: Path, stream: Stream, about: str) -> None:
    """Writes a stream, whole or not at all; of several processes the first one."""
    if jax.process_index():
        return
    fields = {
        f"{name}_{field}": value
        for name, one in stream.spreads.items()
        for field, value in one._asdict().items()
    }
    head = {"about": about, "sets": stream.sets, "seconds": stream.seconds}
    files.write_arrays(path, head | fields | {"history": np.array(stream.history)})


def read(path: Path, about: str) -> Stream:
    """A stream to go on with; an empty one if there is no file.

    Raises:
      OSError: if it cannot be read.
      ValueError: if it is no stream, or one of other samples; names the file.
    """
    if not path.exists():
        return Stream()
    found = files.read_arrays(path, name=str(path), what="stream")
    if (other := str(found.get("about"))) != about:
        raise ValueError(
            f"{path}: field 'about' is {other}, expected {about}: of other samples; "
            "use another --out"
        )
    names = [name.removesuffix("_mean") for name in found if name.endswith("_mean")]
    fields = statistics.Spread._fields
    spreads = {
        name: statistics.Spread(*(found[f"{name}_{field}"] for field in fields))
        for name in names
    }
    spreads = {name: x._replace(count=int(x.count)) for name, x in spreads.items()}
    history = tuple(map(tuple, found["history"].tolist()))
    return Stream(int(found["sets"]), float(found["seconds"]), spreads, history)


def of_all(found: dict[str, statistics.Spread]) -> list[dict[str, statistics.Spread]]:
    """What each process found, in their order."""
    if jax.process_count() == 1:
        return [found]
    leaves, structure = jax.tree.flatten(found)
    shapes = [np.shape(x) for x in leaves]
    flat = np.concatenate([np.ravel(np.float64(x)) for x in leaves])
    # As words, since JAX would make 32 bits of 64.
    words = multihost_utils.process_allgather(flat.view(np.uint32))
    ends = np.cumsum([np.prod(shape, dtype=int) for shape in shapes])[:-1]
    every = []
    for row in np.ascontiguousarray(words).view(np.float64):
        parts = [x.reshape(s) for x, s in zip(np.split(row, ends), shapes, strict=True)]
        spreads = jax.tree.unflatten(structure, parts)
        every.append({k: x._replace(count=int(x.count)) for k, x in spreads.items()})
    return every


def run(
    make: Callable[[int], Mapping[str, Any]],
    *,
    size: int,
    total: int,
    path: Path,
    about: dict[str, Any],
) -> Stream:
    """Makes sets, from the first that the file has not.

    Args:
      make: Samples by name, their axis first, of a set by its number; "columns" among
        them, one sample.
      size: Samples of a set, for the bar.
      total: Sets.
      path: Where it is kept.
      about: JSON of what the samples depend on; a file of others is refused.

    Raises:
      OSError: if the file cannot be read or written.
      ValueError: if it is of other samples.
      KeyboardInterrupt: after Ctrl-C, when what there is is written.
    """
    text = json.dumps(about)
    stream = read(path, text)
    bar = tqdm(
        total=size * total,
        initial=size * stream.sets,
        unit=" samples",
        unit_scale=True,
        disable=jax.process_index() > 0,
    )
    wrote = time.perf_counter()
    try:
        with bar:
            while stream.sets < total:
                begun = time.perf_counter()
                samples = make(stream.sets + jax.process_index())
                found = {name: statistics.spread(x) for name, x in samples.items()}
                every = of_all(found)[: total - stream.sets]
                seconds = (time.perf_counter() - begun) / len(every)
                for one in every:
                    stream = stream.add(one, seconds)
                bar.update(size * len(every))
                # At powers of two as well: what is drawn over a logarithm.
                late = time.perf_counter() - wrote > SAVE_S
                if late or stream.sets.bit_count() == 1 or stream.sets == total:
                    stream, wrote = stream.noted(size), time.perf_counter()
                    write(path, stream, text)
    except KeyboardInterrupt:
        if stream.sets:
            write(path, stream, text)
        raise KeyboardInterrupt(
            f"stopped at {size * stream.sets} of {size * total}; the same command goes "
            f"on from {path}"
        ) from None
    return stream


def memory(stream: Stream) -> str:
    """How much the process had used at most, soon and at the end."""
    rows = [row for row in stream.history if row[1] > SAVE_S] or stream.history
    soon, late = (
        f"{row[2] / suite.GIB:.3f} GiB at {row[0]:,.0f}" for row in (rows[0], rows[-1])
    )
    return f"peak of the process {soon}, {late}"


def draw(path: Path, stream: Stream, columns: tuple[str, ...]) -> None:
    """Draws how the intervals of the columns narrowed."""
    history = np.array(stream.history)[1:]  # one set has no interval
    if not len(history):
        return
    means = stream.spreads["columns"].mean
    percent = 100 * history[:, -len(columns) :] / means
    plots.plot_sweep(
        path,
        {name: (history[:, 0], percent[:, i], None) for i, name in enumerate(columns)},
        xlabel="samples",
        ylabel="half the 95 % interval, % of the mean",
    )
