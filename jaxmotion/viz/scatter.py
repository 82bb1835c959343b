"""Clouds of points side by side."""

from pathlib import Path

import numpy as np
from jaxtyping import Float
from matplotlib.figure import Figure

from jaxmotion.viz import figure


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
      path: The PNG.
      clouds: Points by name.
      marks: Points drawn as crosses in every panel.
      title: Over all panels.
      shown: Points drawn of a cloud, at most.
      seed: Of the choice of these.

    Raises:
      OSError: if the file cannot be written.
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
