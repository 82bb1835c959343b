"""Animated GIF of a stick figure with the commanded and the walked path."""

import io
from pathlib import Path

import numpy as np
from matplotlib.collections import LineCollection
from matplotlib.figure import Figure
from PIL import Image

from jaxmotion.viz import figure as drawing


def _grid(centre: np.ndarray, size: float) -> np.ndarray:
    """Segments of a metre grid on the ground around a point, [n, 2, 3]."""
    low, high = np.floor(centre - size), np.ceil(centre + size)
    xs = np.arange(low[0], high[0] + 1)
    zs = np.arange(low[1], high[1] + 1)
    along_z = [[(x, 0, zs[0]), (x, 0, zs[-1])] for x in xs]
    along_x = [[(xs[0], 0, z), (xs[-1], 0, z)] for z in zs]
    return np.array(along_z + along_x, float)


def _draw(axes, view, positions, frame, parents, colors, paths, contacts, legend):
    """One frame; the camera follows the root on the ground."""
    pose = positions[frame]
    centre = pose[0, [0, 2]]
    axes.clear()
    axes.set_axis_off()
    grid = view(_grid(centre, 3.0))
    axes.add_collection(LineCollection(grid, colors="#dddddd", linewidths=0.8))
    for line, color, label in paths:
        axes.plot(*view(line).T, color=color, lw=0.8, alpha=0.35)
        axes.plot(*view(line[: frame + 1]).T, color=color, lw=2, label=label)
    bones = np.stack(
        [view(pose[list(parents[1:])]), view(pose[1:])],
        axis=1,
    )
    axes.add_collection(
        LineCollection(bones, colors=colors[1:], linewidths=2.5, capstyle="round")
    )
    if contacts is not None:
        feet, down = contacts
        axes.scatter(*view(pose[list(feet)][down[frame]]).T, color="#2ca02c", s=25)
    middle = view(np.array([centre[0], 0.85, centre[1]]))
    axes.set_xlim(middle[0] - 1.5, middle[0] + 1.5)
    axes.set_ylim(middle[1] - 1.5, middle[1] + 1.5)
    if legend:
        axes.legend(loc="lower left", fontsize=7, framealpha=0.9)


def save_gif(
    path: str | Path,
    positions: np.ndarray,
    parents: tuple[int, ...],
    *,
    fps: float,
    names: tuple[str, ...] | None = None,
    commanded: np.ndarray | None = None,
    walked: np.ndarray | None = None,
    feet: tuple[int, ...] | None = None,
    contact: np.ndarray | None = None,
    title: str = "",
    every: int = 2,
    azimuth: float = 35.0,
    elevation: float = 20.0,
    size: int = 360,
) -> None:
    """Writes an animated GIF whose camera follows the character.

    The ground grid has metre squares and stands still, so that sliding feet show.

    Args:
      path: File to write.
      positions: [F, J, 3] world positions, metres, y up.
      parents: Parent of each joint.
      fps: Frames a second of the motion.
      names: Joint names, to colour left and right; None for grey.
      commanded: [F, 2] commanded path (x, z), or None.
      walked: [F, 2] walked path, or None.
      feet: Foot joints to mark while they are in contact.
      contact: [F, feet] bool, or None.
      title: Above the picture.
      every: Draw every so many frames; the speed stays true.
      azimuth: Of the camera, degrees about +y.
      elevation: Of the camera, degrees.
      size: Pixels of a side.

    Raises:
      ValueError: if positions are not [F, J, 3] with as many joints as parents.
      OSError: if the file cannot be written.
    """
    positions = np.asarray(positions, float)
    if positions.ndim != 3 or positions.shape[1:] != (len(parents), 3):
        raise ValueError(
            f"positions are {positions.shape}, expected [frames, {len(parents)}, 3]"
        )
    path = drawing.check_writable(path)
    picture = Figure(figsize=(size / 100, size / 100), dpi=100)
    axes = picture.add_axes((0, 0, 1, 0.94))
    picture.suptitle(title, fontsize=8)
    lines = [
        (drawing._ground(np.asarray(line, float)), color, label)
        for line, color, label in (
            (commanded, drawing.COMMANDED, "commanded"),
            (walked, drawing.WALKED, "walked"),
        )
        if line is not None
    ]
    colors = drawing.bone_colors(names, len(parents))
    marks = None if contact is None else (feet, np.asarray(contact, bool))

    def view(points: np.ndarray) -> np.ndarray:
        return drawing.project(points, azimuth=azimuth, elevation=elevation)

    images = []
    for frame in range(0, len(positions), every):
        _draw(axes, view, positions, frame, parents, colors, lines, marks, bool(lines))
        buffer = io.BytesIO()
        picture.savefig(buffer, format="rgba")
        image = Image.frombytes("RGBA", (size, size), buffer.getvalue())
        images.append(image.convert("RGB").quantize(64))
    images[0].save(
        path,
        save_all=True,
        append_images=images[1:],
        duration=round(1000 * every / fps),
        loop=0,
    )
