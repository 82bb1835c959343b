"""Quality against time, with error bars and the points that none beats in both."""

from pathlib import Path

import numpy as np
from jaxtyping import Bool, Float
from matplotlib.axes import Axes
from matplotlib.axis import Axis
from matplotlib.figure import Figure
from matplotlib.ticker import LogLocator, NullFormatter

from jaxmotion.viz import figure

# Axes whose largest value is so many times the smallest are logarithmic.
_LOG_FROM = 5.0


def pareto_front(
    x: Float[np.ndarray, " points"], y: Float[np.ndarray, " points"]
) -> Bool[np.ndarray, " points"]:
    """Which points no other beats: none is as low in both, and lower in one.

    Args:
      x: First cost.
      y: Second cost.

    Returns:
      True for those of the front.
    """
    no_worse = (x[:, None] <= x) & (y[:, None] <= y)
    lower = (x[:, None] < x) | (y[:, None] < y)
    return ~np.any(no_worse & lower, axis=0)


def _is_wide(values: Float[np.ndarray, "_"]) -> bool:
    return bool(values.min() > 0 and values.max() > _LOG_FROM * values.min())


def _draw_references(axes: Axes, references: dict[str, np.ndarray]) -> None:
    colors = (figure.COMMANDED, figure.WALKED, figure.MIDDLE)
    for i, (name, (value, low, high)) in enumerate(references.items()):
        color = colors[i % len(colors)]
        axes.axhline(value, color=color, ls="--", lw=1.2, label=name)
        axes.axhspan(low, high, color=color, alpha=0.15, lw=0)


def _plain_ticks(axis: Axis) -> None:
    """1, 2, 5, 10, 20, ... on a logarithmic axis, instead of powers."""
    axis.set_major_locator(LogLocator(subs=(1.0, 2.0, 5.0)))
    axis.set_major_formatter("{x:g}")
    axis.set_minor_formatter(NullFormatter())


def write_pareto(
    path: str | Path,
    names: tuple[str, ...],
    x: Float[np.ndarray, "points 3"],
    y: Float[np.ndarray, "points 3"],
    *,
    references: dict[str, Float[np.ndarray, "3"]],
    xlabel: str,
    ylabel: str,
    title: str = "",
    broken: tuple[str, ...] = (),
) -> None:
    """Draws named points with error bars in both directions, lower left is best.

    Args:
      path: The picture.
      names: Of the points; written beside them.
      x: Value, lower and upper end of each point's first cost.
      y: Likewise, of its second.
      references: Value, lower and upper end of second costs that are lines.
      xlabel: Quantity and unit.
      ylabel: Quantity and unit.
      title: Above the picture.
      broken: Names of points that fail in other ways: hollow, and beaten by all.

    Raises:
      OSError: if the file cannot be written.
      ValueError: if a broken name is of no point.
    """
    unknown = set(broken) - set(names)
    if unknown:
        raise ValueError(f"broken: no point is named {', '.join(sorted(unknown))}")
    path = figure.check_writable(path)
    canvas = Figure(figsize=(7.5, 5), dpi=120, layout="constrained")
    axes = canvas.add_subplot()
    sound = np.array([name not in broken for name in names])
    whole = np.flatnonzero(sound)
    front = whole[pareto_front(x[whole, 0], y[whole, 0])]
    front = front[np.argsort(x[front, 0])]
    axes.plot(x[front, 0], y[front, 0], color=figure.LEFT, lw=1, alpha=0.5)
    bars = [np.abs(z[:, 1:] - z[:, :1]).T for z in (x, y)]
    labels = "95 % intervals; line: none is better in both", "fails in other ways"
    for which, label, fill in zip(
        (sound, ~sound), labels, ("full", "none"), strict=True
    ):
        if which.any():
            axes.errorbar(
                x[which, 0], y[which, 0], xerr=bars[0][:, which],
                yerr=bars[1][:, which], fmt="o", color=figure.LEFT, capsize=3,
                fillstyle=fill, label=label,
            )  # fmt: skip
    for name, place in zip(names, zip(x[:, 0], y[:, 0], strict=True), strict=True):
        axes.annotate(
            name, place, xytext=(7, 7), textcoords="offset points", fontsize=11,
            fontweight="bold",
        )  # fmt: skip
    _draw_references(axes, references)
    if _is_wide(x[:, 0]):
        axes.set_xscale("log")
        _plain_ticks(axes.xaxis)
    if _is_wide(np.concatenate([y.ravel(), *references.values()])):
        axes.set_yscale("log")
        _plain_ticks(axes.yaxis)
    axes.set(xlabel=xlabel, ylabel=ylabel)
    axes.set_title(title, parse_math=False)
    axes.margins(0.12)
    axes.grid(alpha=0.3, which="both")
    axes.legend(fontsize=8)
    canvas.savefig(path)
