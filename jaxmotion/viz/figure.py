"""Stick figures on a ground grid, drawn by matplotlib without a display.

World axes are y up; matplotlib's are z up, so a point (x, y, z) is drawn at (x, -z, y)
in a right-handed view: what is on the character's left stays on its left.
"""

from pathlib import Path

import matplotlib
import numpy as np
from matplotlib.figure import Figure

matplotlib.use("Agg")

LEFT, RIGHT, MIDDLE = "#1f77b4", "#d62728", "#333333"
COMMANDED, WALKED = "#2ca02c", "#ff7f0e"


def check_writable(path: str | Path) -> Path:
    """Raises if a file cannot be written; called before anything is drawn.

    Args:
      path: The file.

    Returns:
      The path.

    Raises:
      OSError: names the file.
    """
    path = Path(path)
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        new = not path.exists()
        with open(path, "ab"):
            pass
        if new:
            path.unlink()
    except OSError as error:
        raise OSError(f"{path}: cannot write here: {error}") from error
    return path


def bone_colors(names: tuple[str, ...] | None, number: int) -> list[str]:
    """Blue for the left side, red for the right, grey for the rest.

    Args:
      names: Joint names; None to draw all grey.
      number: Joints.

    Returns:
      One colour a joint, for the bone that ends at it.
    """
    if names is None:
        return [MIDDLE] * number
    plain = [name.lower() for name in names]

    def color(name: str) -> str:
        if "left" in name or name.endswith("_l") or name.startswith("l_"):
            return LEFT
        if "right" in name or name.endswith("_r") or name.startswith("r_"):
            return RIGHT
        return MIDDLE

    return [color(name) for name in plain]


def project(points: np.ndarray, *, azimuth: float, elevation: float) -> np.ndarray:
    """Orthographic view of world points.

    Args:
      points: [..., 3] metres, y up.
      azimuth: Degrees about +y; 0 looks along -z (a character that faces +z walks
        towards the viewer).
      elevation: Degrees above the ground.

    Returns:
      [..., 2] right and up on the picture, metres.
    """
    a, e = np.deg2rad([azimuth, elevation])
    x, y, z = np.moveaxis(points, -1, 0)
    right = x * np.cos(a) - z * np.sin(a)
    depth = x * np.sin(a) + z * np.cos(a)
    return np.stack([right, y * np.cos(e) - depth * np.sin(e)], axis=-1)


def _ground(path: np.ndarray | None) -> np.ndarray | None:
    if path is None:
        return None
    return np.stack([path[:, 0], np.zeros(len(path)), path[:, 1]], axis=-1)


def plot_paths(
    path: str | Path,
    commanded: np.ndarray,
    walked: np.ndarray,
    *,
    title: str = "",
) -> None:
    """The commanded and the walked path from above, as a picture file.

    Args:
      path: File to write; its ending says the format.
      commanded: [F, 2] (x, z) metres.
      walked: [F, 2] metres.
      title: Above the picture.

    Raises:
      OSError: if the file cannot be written.
    """
    path = check_writable(path)
    figure = Figure(figsize=(5, 5), dpi=100)
    axes = figure.add_subplot()
    axes.plot(*commanded.T, color=COMMANDED, label="commanded")
    axes.plot(*walked.T, color=WALKED, label="walked")
    # Seen from above with z up the page, +x (the left of +z) points left.
    axes.invert_xaxis()
    axes.set(xlabel="x (m)", ylabel="z (m)", title=title, aspect="equal")
    axes.legend()
    figure.savefig(path)


def plot_sweep(
    path: str | Path,
    lines: dict[str, tuple[np.ndarray, np.ndarray, np.ndarray | None]],
    *,
    xlabel: str,
    ylabel: str,
    log: bool = True,
) -> None:
    """Lines with upper whiskers, such as latency over the number of steps.

    Args:
      path: File to write.
      lines: Label to (x, y, upper end of the whisker or None).
      xlabel: Quantity and unit.
      ylabel: Quantity and unit.
      log: Logarithmic axes.

    Raises:
      OSError: if the file cannot be written.
    """
    path = check_writable(path)
    figure = Figure(figsize=(6, 4), dpi=110, layout="constrained")
    axes = figure.add_subplot()
    for label, (x, y, upper) in lines.items():
        whisker = None if upper is None else np.stack([np.zeros(len(y)), upper - y])
        axes.errorbar(x, y, yerr=whisker, marker="o", capsize=3, label=label)
    if log:
        axes.set_xscale("log", base=2)
        axes.set_yscale("log")
    axes.set(xlabel=xlabel, ylabel=ylabel)
    axes.grid(alpha=0.3, which="both")
    axes.legend()
    figure.savefig(path)
