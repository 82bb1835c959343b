"""Plots: tables as dots with intervals, quality over time, curves, clouds, sweeps."""

import dataclasses
import io
import math
import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import matplotlib
import numpy as np
from jaxtyping import Bool, Float
from matplotlib.axes import Axes
from matplotlib.axis import Axis
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.ticker import LogLocator, NullFormatter

from jaxmotion.viz import figure

# Metrics next to each other, each with two pairs of axes.
_ACROSS = 3
# Axes whose largest value is so many times the smallest are logarithmic.
_WIDE_FROM = 5.0
# Colors of lines, in turn.
_CYCLE = (figure.LEFT, figure.RIGHT, figure.WALKED, "#8e5bb5", "#17a2a2", "#8c6d46")
# Markers of dots, changed where colors begin again.
_MARKERS = "osD^v"


def dots_svg(
    rows: dict[str, Float[np.ndarray, "_ 3"]],
    *,
    references: tuple[str, ...] = (),
    title: str,
    xlabel: str,
    logarithmic: bool = False,
    description: str = "",
) -> str:
    """Draws values with intervals, one line per row, as SVG that equal values repeat.

    Args:
      rows: Value, lower and upper end by row, one per training.
      references: Rows of data, with a dashed line through their first value.
      description: In the file's metadata.
    """
    with matplotlib.rc_context({"svg.hashsalt": "jaxmotion", "svg.fonttype": "path"}):
        canvas = Figure(figsize=(7.2, 0.9 + 0.32 * len(rows)), layout="constrained")
        axes = canvas.subplots()
        for line, (name, values) in enumerate(rows.items()):
            color = figure.COMMANDED if name in references else figure.LEFT
            apart = np.linspace(-0.16, 0.16, len(values)) * (len(values) > 1)
            for (value, low, high), off in zip(values, apart, strict=True):
                axes.errorbar(
                    value, line + off, xerr=[[value - low], [high - value]], fmt="o",
                    markersize=5, color=color, capsize=3, lw=1.4,
                )  # fmt: skip
            if name in references and len(values):
                axes.axvline(values[0, 0], color=color, lw=1, ls="--", alpha=0.6)
        axes.set_yticks(range(len(rows)), list(rows), fontsize=9)
        axes.set_ylim(len(rows) - 0.5, -0.5)
        axes.set_xlabel(xlabel, fontsize=9, parse_math=False)
        axes.set_title(title, fontsize=10, parse_math=False)
        axes.tick_params(axis="x", labelsize=8)
        if logarithmic:
            axes.set_xscale("log")
        axes.grid(alpha=0.3, axis="x")
        axes.spines[["top", "right", "left"]].set_visible(False)
        text = io.StringIO()
        about = {"Date": None, "Creator": None, "Description": description}
        canvas.savefig(text, format="svg", metadata=about)
    return re.sub(r"[ \t]+\n", "\n", text.getvalue())


def pareto_front(
    x: Float[np.ndarray, " points"], y: Float[np.ndarray, " points"]
) -> Bool[np.ndarray, " points"]:
    """Which points no other beats: none is as low in both costs, and lower in one."""
    no_worse = (x[:, None] <= x) & (y[:, None] <= y)
    lower = (x[:, None] < x) | (y[:, None] < y)
    return ~np.any(no_worse & lower, axis=0)


def _is_wide(values: Float[np.ndarray, "_"]) -> bool:
    return bool(values.min() > 0 and values.max() > _WIDE_FROM * values.min())


def _draw_references(axes: Axes, references: dict[str, np.ndarray]) -> None:
    colors = (figure.COMMANDED, figure.WALKED, figure.MIDDLE)
    for i, (name, (value, low, high)) in enumerate(references.items()):
        color = colors[i % len(colors)]
        axes.axhline(value, color=color, ls="--", lw=1.2, label=name)
        axes.axhspan(low, high, color=color, alpha=0.15, lw=0)


def _plain_ticks(axis: Axis) -> None:
    """1, 2, 5, 10, 20, ... on a logarithmic axis, instead of powers.

    Every digit where the axis is narrow.
    """
    low, high = axis.get_view_interval()
    every = [*range(1, 10)] if high < _WIDE_FROM * low else [1, 2, 5]
    axis.set_major_locator(LogLocator(subs=every))
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
      x: Value, lower and upper end of each point's first cost.
      y: The same of its second.
      references: Value, lower and upper end of second costs that are lines.
      broken: Names of points that fail in other ways: hollow, and beaten by all.
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


def write_scatter(
    path: str | Path,
    clouds: dict[str, Float[np.ndarray, "_ 2"]],
    *,
    marks: Float[np.ndarray, "marks 2"],
    title: str,
    shown: int = 20_000,
    seed: int = 0,
) -> None:
    """Draws one panel a cloud, all with the same axes.

    Axes end where the marks end, plus half as much again; points outside are counted
    in the panel's title, not drawn.

    Args:
      marks: Points drawn as crosses in every panel.
      shown: Points drawn of a cloud, at most.
      seed: Seeds the choice of these.
    """
    path = figure.check_writable(path)
    center = (marks.max(axis=0) + marks.min(axis=0)) / 2
    reach = 1.5 * max(float(np.abs(marks - center).max()), 1e-6)
    canvas = Figure(figsize=(3 * len(clouds), 3.4), layout="constrained")
    canvas.suptitle(title)
    generator = np.random.default_rng(seed)
    for axes, (name, points) in zip(
        canvas.subplots(1, len(clouds), squeeze=False)[0], clouds.items(), strict=True
    ):
        inside = (np.abs(points - center) <= reach).all(axis=-1)
        drawn = generator.permutation(points[inside])[:shown]
        axes.plot(*drawn.T, ".", markersize=1, alpha=0.3, color=figure.LEFT)
        axes.plot(*marks.T, "x", markersize=6, color=figure.RIGHT)
        axes.set(
            xlim=(center[0] - reach, center[0] + reach),
            ylim=(center[1] - reach, center[1] + reach),
            aspect="equal",
            title=name if inside.all() else f"{name} ({(~inside).mean():.0%} outside)",
        )
    canvas.savefig(path, dpi=110)


def plot_sweep(
    path: str | Path,
    lines: dict[str, tuple[np.ndarray, np.ndarray, np.ndarray | None]],
    *,
    xlabel: str,
    ylabel: str,
    log: bool = True,
    ticks: tuple[str, ...] = (),
) -> None:
    """Lines with upper whiskers, such as latency over the number of steps.

    Args:
      lines: Label to (x, y, upper end of the whisker or None).
      ticks: What stands below x = 0, 1, 2, ...; none for numbers.
    """
    path = figure.check_writable(path)
    drawing = Figure(figsize=(6, 4), dpi=110, layout="constrained")
    axes = drawing.add_subplot()
    for label, (x, y, upper) in lines.items():
        whisker = None if upper is None else np.stack([np.zeros(len(y)), upper - y])
        axes.errorbar(x, y, yerr=whisker, marker="o", capsize=3, label=label)
    if log:
        axes.set_xscale("log", base=2)
        axes.set_yscale("log")
    if ticks:
        axes.set_xticks(range(len(ticks)), ticks, rotation=45, ha="right")
    axes.set(xlabel=xlabel, ylabel=ylabel)
    axes.grid(alpha=0.3, which="both")
    axes.legend(fontsize="small")
    drawing.savefig(path)


@dataclasses.dataclass(frozen=True, kw_only=True, eq=False)
class Costs:
    """One panel of `costs_svg`: quality over time; lower left is best.

    Attributes:
      points: By sampler and label, time and quality: value, lower and upper end.
      data: The quality of held-out data, its lower and its upper end.
      peers: Times of a call elsewhere, by name.
      call: What call that is.
    """

    title: str
    xlabel: str
    ylabel: str
    points: dict[str, dict[str, Float[np.ndarray, "2 3"]]]
    data: Float[np.ndarray, "3"]
    peers: dict[str, float]
    call: str


def _draw_costs(axes: Axes, panel: Costs, colors: Mapping[str, str]) -> None:
    value, low, high = panel.data
    axes.axhline(value, color=figure.COMMANDED, lw=1.2, ls="--")
    axes.axhspan(low, high, color=figure.COMMANDED, alpha=0.12, lw=0)
    every = np.stack([x for points in panel.points.values() for x in points.values()])
    front = every[pareto_front(*every[:, :, 0].T), :, 0]
    axes.plot(*front[np.argsort(front[:, 0])].T, color=figure.MIDDLE, lw=0.9)
    for sampler, points in panel.points.items():
        color = colors[sampler]
        for place, (label, ends) in enumerate(points.items()):
            (x, y), bars = ends[:, 0], np.abs(ends[:, 1:] - ends[:, :1])[:, :, None]
            axes.errorbar(
                x, y, xerr=bars[0], yerr=bars[1], fmt="o", markersize=4.5, color=color,
                elinewidth=1.2, capsize=2.5,
            )  # fmt: skip
            # On both sides in turn, since neighbors can be near each other.
            side, shift = (("left", (5, 6)), ("right", (-5, -12)))[place % 2]
            axes.annotate(
                label, (x, y), xytext=shift, textcoords="offset points", ha=side,
                fontsize=8, color=color, fontweight="bold",
            )  # fmt: skip
    axes.set_xscale("log")
    axes.set_yscale("log")
    axes.margins(0.14)
    axes.set_title(panel.title, fontsize=9.5, parse_math=False)
    axes.set_ylabel(panel.ylabel, fontsize=8.5)
    axes.tick_params(labelbottom=False)


def _draw_peers(axes: Axes, panel: Costs, marks: dict[str, str]) -> None:
    for name, height in zip(
        panel.peers, np.linspace(0.6, -0.6, len(panel.peers)), strict=True
    ):
        axes.plot(
            [panel.peers[name]], [height], marks[name], markersize=5, mfc="none",
            color=figure.MIDDLE, markeredgewidth=1.2,
        )  # fmt: skip
    axes.set_xscale("log")
    axes.set_ylim(-1.3, 1.3)
    axes.set_yticks([])
    axes.set_xlabel(panel.xlabel, fontsize=8.5)
    axes.set_title(panel.call, fontsize=7.5, loc="left", color=figure.MIDDLE, pad=2)
    axes.spines["left"].set_visible(False)


def costs_svg(panels: tuple[Costs, ...], *, title: str, description: str = "") -> str:
    """Draws quality over time, two panels across, as SVG that equal values repeat.

    Strips below the panels, with the same axes of time, mark what peers take.

    Args:
      description: In the file's metadata.
    """
    down = math.ceil(len(panels) / 2)
    samplers = dict.fromkeys(name for panel in panels for name in panel.points)
    colors = dict(zip(samplers, _CYCLE, strict=False))
    peers = dict.fromkeys(name for panel in panels for name in panel.peers)
    marks = dict(zip(peers, "o^sDXvP*", strict=False))
    with matplotlib.rc_context({"svg.hashsalt": "jaxmotion", "svg.fonttype": "path"}):
        canvas = Figure(figsize=(9.0, 3.7 * down + 0.9), layout="constrained")
        canvas.suptitle(title, fontsize=11, parse_math=False)
        grid = canvas.subplots(2 * down, 2, squeeze=False, height_ratios=[5, 1] * down)
        pairs = grid.reshape(down, 2, 2).swapaxes(1, 2).reshape(-1, 2)
        for panel, pair in zip(panels, pairs, strict=False):
            _draw_costs(pair[0], panel, colors)
            _draw_peers(pair[1], panel, marks)
            times = np.array([*panel.peers.values(), *pair[0].get_xlim()])
            for axes in pair:
                axes.set_xlim(times.min() / 1.1, times.max() * 1.1)
                axes.grid(alpha=0.3)
                axes.tick_params(labelsize=8)
                axes.spines[["top", "right"]].set_visible(False)
                for axis in (axes.xaxis, axes.yaxis)[: 1 + (axes is pair[0])]:
                    _plain_ticks(axis)
        for axes in pairs[len(panels) :].ravel():
            axes.set_axis_off()
        handles = [
            *(Line2D([], [], color=colors[x], marker="o", lw=0) for x in samplers),
            Line2D([], [], color=figure.MIDDLE, lw=0.9),
            Line2D([], [], color=figure.COMMANDED, ls="--"),
            *(
                Line2D([], [], color=figure.MIDDLE, marker=marks[x], mfc="none", lw=0)
                for x in peers
            ),
        ]
        names = [*samplers, "none is better in both", "held-out data", *peers]
        canvas.legend(handles, names, loc="outside lower center", ncols=4, fontsize=8)
        text = io.StringIO()
        about = {"Date": None, "Creator": None, "Description": description}
        canvas.savefig(text, format="svg", metadata=about)
    return re.sub(r"[ \t]+\n", "\n", text.getvalue())


@dataclasses.dataclass(frozen=True, kw_only=True, eq=False)
class Curves:
    """One pair of axes of `write_curves`.

    Attributes:
      lines: Label to x, and value, lower and upper end at each x; nan for no interval.
      references: Label to the value of a line across, its lower and its upper end.
      noisy: The lines are smoothed, with the values thin behind; else each point is a
        dot.
    """

    title: str
    xlabel: str
    ylabel: str
    lines: dict[str, tuple[Float[np.ndarray, " points"], Float[np.ndarray, "points 3"]]]
    references: dict[str, Float[np.ndarray, "3"]] = dataclasses.field(
        default_factory=dict
    )
    noisy: bool


def smoothed(
    values: Float[np.ndarray, " points"], *, part: float = 0.05
) -> Float[np.ndarray, " points"]:
    """Means over a part of the points around each.

    Narrower at the start, where losses fall; cut off at the end, where they are noise.
    """
    count = len(values)
    places = np.arange(count)
    reach = np.minimum(int(part * count / 2), places)
    first, last = places - reach, np.minimum(places + reach, count - 1)
    sums = np.concatenate([[0.0], np.cumsum(values)])
    return (sums[last + 1] - sums[first]) / (last + 1 - first)


def _lines_below(curves: Curves) -> int:
    """Lines of a legend below the axes: 0 where few names fit in between the curves."""
    names = len(curves.lines) + len(curves.references)
    return math.ceil(names / 2) if names > 5 else 0


def _draw_curves(axes: Axes, curves: Curves, *, wide: bool) -> None:
    shown = [value[:1] for value in curves.references.values()]
    _draw_references(axes, curves.references)
    for i, (label, (x, y)) in enumerate(curves.lines.items()):
        color, value = _CYCLE[i % len(_CYCLE)], y[:, 0]
        marker = _MARKERS[i // len(_CYCLE) % len(_MARKERS)]
        if curves.noisy:
            axes.plot(x, value, color=color, lw=0.6, alpha=0.35)
            value = smoothed(value)
            axes.plot(x, value, color=color, lw=1.6, label=label)
        else:
            bars = np.abs(y[:, 1:] - y[:, :1]).T
            bars = np.where(np.isfinite(bars), bars, 0.0)
            axes.errorbar(
                x, value, yerr=bars, fmt=f"{marker}-", markersize=4, capsize=3,
                color=color, lw=1.2, label=label,
            )  # fmt: skip
        shown.append(value[np.isfinite(value)])
    if _is_wide(np.concatenate(shown)):
        axes.set_yscale("log")
        _plain_ticks(axes.yaxis)
    if wide:
        axes.set_xscale("log")
        _plain_ticks(axes.xaxis)
    axes.set_title(curves.title, fontsize=9, parse_math=False)
    axes.set_xlabel(curves.xlabel, fontsize=8)
    axes.set_ylabel(curves.ylabel, fontsize=8)
    below: dict[str, Any] = dict(
        loc="upper center", bbox_to_anchor=(0.5, -0.16), ncols=2
    )
    axes.legend(fontsize=7, **below if _lines_below(curves) else {})
    axes.tick_params(labelsize=8)
    axes.grid(alpha=0.3, which="both")


def write_curves(path: str | Path, panels: tuple[Curves, ...], *, title: str) -> None:
    """Draws one pair of axes a panel.

    Axes are logarithmic where what is drawn differs by much: upright each for itself,
    across all of them where some lines are much longer than others.
    """
    path = figure.check_writable(path)
    across = min(_ACROSS, len(panels))
    down = math.ceil(len(panels) / across)
    height = 3.2 + 0.15 * max(map(_lines_below, panels))
    size = (4.0 * across + 0.4, height * down + 0.5)
    canvas = Figure(figsize=size, dpi=110, layout="constrained")
    canvas.suptitle(title, fontsize=11)
    grid = canvas.subplots(down, across, squeeze=False).ravel()
    ends = np.array([x[-1] for panel in panels for x, _ in panel.lines.values()])
    for axes, panel in zip(grid, panels, strict=False):
        _draw_curves(axes, panel, wide=_is_wide(ends))
    for axes in grid[len(panels) :]:
        axes.set_axis_off()
    canvas.savefig(path)
