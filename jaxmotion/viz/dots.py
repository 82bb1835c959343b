"""Dots with intervals, one line a method: two sources side by side for each metric."""

import dataclasses
import math
from pathlib import Path

import numpy as np
from jaxtyping import Float
from matplotlib.axes import Axes
from matplotlib.figure import Figure
from matplotlib.ticker import MaxNLocator, NullFormatter

from jaxmotion.viz import figure

# Values that differ by so much are drawn on logarithmic axes.
_LOG_FROM = 20.0
# Metrics next to each other, each with two pairs of axes.
_ACROSS = 3


@dataclasses.dataclass(frozen=True, kw_only=True, eq=False)
class Panel:
    """One metric of several methods, by two sources that need not compare.

    Attributes:
      title: The metric.
      left: Value, lower and upper end of each method; nan for none.
      right: Likewise, by the second source.
      target: Method whose value is drawn as a line; None for no line.
    """

    title: str
    left: Float[np.ndarray, "methods 3"]
    right: Float[np.ndarray, "methods 3"]
    target: int | None = None


def _scale(axes: Axes, values: np.ndarray) -> None:
    """Limits and ticks that show all values; long error bars may leave the axes."""
    middles = values[:, 0][np.isfinite(values[:, 0])]
    if not middles.size:
        axes.set_xticks([])
        return
    if middles.min() > 0 and middles.max() > _LOG_FROM * middles.min():
        axes.set_xscale("log", nonpositive="clip")
        shown = values[np.isfinite(values) & (values > middles.min() / 10)]
        axes.set_xlim(shown.min() / 2, 2 * shown.max())
        axes.xaxis.set_minor_formatter(NullFormatter())
        return
    shown = values[np.isfinite(values)]
    low, high = shown.min(), shown.max()
    room = 0.12 * (high - low) or 0.12 * abs(high) or 1.0
    axes.set_xlim(low - room, high + room)
    axes.xaxis.set_major_locator(MaxNLocator(3, steps=[1, 2, 2.5, 5, 10]))


def _draw(
    axes: Axes, values: np.ndarray, *, color: str, target: int | None, absent: str
) -> None:
    lines = np.arange(len(values))
    known = np.isfinite(values[:, 0])
    bars = np.abs(values[:, 1:] - values[:, :1]).T
    bars = np.where(np.isfinite(bars), bars, 0.0)
    axes.errorbar(
        values[known, 0], lines[known], xerr=bars[:, known], fmt="o", markersize=5,
        color=color, capsize=3, lw=1.4,
    )  # fmt: skip
    if target is not None and known[target]:
        axes.axvline(values[target, 0], color=figure.COMMANDED, lw=1, ls="--")
    _scale(axes, values)
    for line in lines[~known]:
        axes.annotate(
            absent, (0.5, line), xycoords=("axes fraction", "data"), fontsize=7,
            color="#888888", ha="center", va="center",
        )  # fmt: skip
    axes.set_ylim(len(values) - 0.5, -0.5)
    axes.tick_params(labelsize=8)
    axes.grid(alpha=0.3)


def write_dots(
    path: str | Path,
    methods: tuple[str, ...],
    panels: tuple[Panel, ...],
    *,
    sources: tuple[str, str],
    absent: tuple[str, str],
    title: str,
) -> None:
    """Draws two axes a metric, with one line a method and a scale of their own.

    Args:
      path: The picture.
      methods: Names, from above.
      panels: Metrics.
      sources: Names of the left and the right source of every panel.
      absent: What stands where the left or the right source has no value.
      title: Above the picture.

    Raises:
      OSError: if the file cannot be written.
    """
    path = figure.check_writable(path)
    across = min(_ACROSS, len(panels))
    down = math.ceil(len(panels) / across)
    size = (1.6 + 3.5 * across, 0.5 + down * (0.9 + 0.26 * len(methods)))
    canvas = Figure(figsize=size, dpi=110, layout="constrained")
    # Or the last tick of one axes runs into the first of the next.
    canvas.get_layout_engine().set(w_pad=0.08)
    canvas.suptitle(title, fontsize=11)
    grid = canvas.subplots(down, 2 * across, squeeze=False)
    pairs = grid.reshape(down * across, 2)
    for place, axes in enumerate(pairs):
        if place >= len(panels):
            for one in axes:
                one.set_axis_off()
            continue
        panel = panels[place]
        for one, values, color, name, word in zip(
            axes,
            (panel.left, panel.right),
            (figure.MIDDLE, figure.LEFT),
            sources,
            absent,
            strict=True,
        ):
            _draw(one, values, color=color, target=panel.target, absent=word)
            one.set_title(f"{panel.title}, {name}", fontsize=9, parse_math=False)
            one.set_yticks(range(len(methods)), [""] * len(methods))
        if place % across == 0:
            axes[0].set_yticks(range(len(methods)), methods, fontsize=8)
    canvas.savefig(path)
