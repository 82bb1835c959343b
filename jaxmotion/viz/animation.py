"""Animated GIF of a stick figure with the commanded and the walked path."""

import dataclasses
import functools
import io
import textwrap
from collections.abc import Callable
from pathlib import Path

import numpy as np
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.collections import LineCollection
from matplotlib.figure import Figure
from matplotlib.patches import Circle
from PIL import Image

from jaxmotion.viz import figure as drawing

_PATH_COLORS = (drawing.COMMANDED, drawing.WALKED)


def _grid(centre: np.ndarray, size: float) -> np.ndarray:
    """Segments of a metre grid on the ground around a point, [n, 2, 3]."""
    low, high = np.floor(centre - size), np.ceil(centre + size)
    xs = np.arange(low[0], high[0] + 1)
    zs = np.arange(low[1], high[1] + 1)
    along_z = [[(x, 0, zs[0]), (x, 0, zs[-1])] for x in xs]
    along_x = [[(xs[0], 0, z), (xs[-1], 0, z)] for z in zs]
    return np.array(along_z + along_x, float)


@dataclasses.dataclass(frozen=True, kw_only=True)
class _Scene:
    """What is drawn; bones and paths are in world coordinates."""

    view: Callable[[np.ndarray], np.ndarray]
    positions: np.ndarray
    parents: list[int]
    colors: list[str]
    paths: list[tuple[np.ndarray, str, str]]
    contacts: tuple[tuple[int, ...], np.ndarray] | None
    ball: np.ndarray | None
    radius: float


def _draw(axes: Axes, scene: _Scene, frame: int) -> None:
    """One frame; the camera follows the root on the ground."""
    view, pose = scene.view, scene.positions[frame]
    centre = pose[0, [0, 2]]
    axes.clear()
    axes.set_axis_off()
    grid = view(_grid(centre, 3.0))
    axes.add_collection(LineCollection(grid, colors="#dddddd", linewidths=0.8))
    for line, color, label in scene.paths:
        axes.plot(*view(line).T, color=color, lw=0.8, alpha=0.35)
        axes.plot(*view(line[: frame + 1]).T, color=color, lw=2, label=label)
    bones = np.stack([view(pose[scene.parents]), view(pose[1:])], axis=1)
    axes.add_collection(
        LineCollection(bones, colors=scene.colors, linewidths=2.5, capstyle="round")
    )
    if scene.ball is not None:
        place = view(scene.ball[frame])
        axes.add_patch(
            Circle(place, scene.radius, fc="#f2f2f2", ec="#222222", zorder=3)
        )
    if scene.contacts is not None:
        feet, down = scene.contacts
        axes.scatter(
            *view(pose[list(feet)][down[frame]]).T, color="#2ca02c", s=25, zorder=4
        )
    middle = view(np.array([centre[0], 0.85, centre[1]]))
    axes.set_xlim(middle[0] - 1.5, middle[0] + 1.5)
    axes.set_ylim(middle[1] - 1.5, middle[1] + 1.5)
    if scene.paths:
        axes.legend(loc="lower left", fontsize=7, framealpha=0.9)


def _picture(title: str, size: int) -> tuple[Figure, Axes]:
    """A square figure whose title is wrapped, and shrunk if that is not enough."""
    picture = Figure(figsize=(size / 100, size / 100), dpi=100)
    FigureCanvasAgg(picture)
    text = picture.text(
        0.5,
        0.99,
        textwrap.fill(title, max(size // 6, 1)),
        fontsize=8,
        ha="center",
        va="top",
        parse_math=False,
    )
    # Widths of small letters are whole pixels: one shrinking may not be enough.
    for _ in range(8):
        box = text.get_window_extent()
        room = min(0.96 * size / max(box.width, 1), 0.25 * size / max(box.height, 1))
        if room >= 1.0:
            break
        text.set_fontsize(0.98 * room * text.get_fontsize())
    top = text.get_window_extent().y0 / size if title else 1.0
    return picture, picture.add_axes((0, 0, 1, top - 0.01))


def _draw_all(scene: _Scene, frames: range, title: str, size: int) -> list[Image.Image]:
    """Pictures of 64 colours."""
    picture, axes = _picture(title, size)
    images = []
    for frame in frames:
        _draw(axes, scene, frame)
        buffer = io.BytesIO()
        picture.savefig(buffer, format="rgba")
        whole = picture.canvas.get_width_height()
        image = Image.frombytes("RGBA", whole, buffer.getvalue())
        images.append(image.convert("RGB").quantize(64))
    return images


def _lines(
    ground: dict[str, np.ndarray | None],
) -> list[tuple[np.ndarray, str, str]]:
    """Paths in the world with colour and label, of those that are given."""
    return [
        (drawing.on_ground(line), color, name)
        for (name, line), color in zip(ground.items(), _PATH_COLORS, strict=True)
        if line is not None
    ]


def _durations(number: int, seconds: float) -> list[int]:
    """Milliseconds of each picture; a GIF counts hundredths, so these must vary."""
    times = np.round(100 * seconds * np.arange(number + 1)).astype(int)
    return (10 * np.maximum(np.diff(times), 1)).tolist()


def _contacts(
    contact: np.ndarray | None, feet: tuple[int, ...] | None, frames: int
) -> tuple[tuple[int, ...], np.ndarray] | None:
    if contact is None:
        return None
    expected = (frames, len(feet or ()))
    if not feet or np.shape(contact) != expected:
        raise ValueError(
            f"contact is {np.shape(contact)} of feet {feet}, expected feet and "
            "[frames, feet]"
        )
    return feet, np.asarray(contact, bool)


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
    ball: np.ndarray | None = None,
    radius: float = 0.11,
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
      ball: [F, 3] world position of a ball's centre, or None.
      radius: Of the ball, metres.
      title: Above the picture.
      every: Draw every so many frames; the speed stays true.
      azimuth: Of the camera, degrees about +y.
      elevation: Of the camera, degrees.
      size: Pixels of a side.

    Raises:
      ValueError: if an array has a wrong shape or is not finite (names it), or `every`
        is not positive.
      OSError: if the file cannot be written.
    """
    ground = {"commanded": commanded, "walked": walked}
    positions = drawing.check_motion(positions, parents, fps=fps, paths=ground)
    marks = _contacts(contact, feet, len(positions))
    if every < 1 or size < 64:
        raise ValueError(
            f"every {every}, size {size}: expected every >= 1 and size >= 64 pixels"
        )
    ball = drawing.check_ball(ball, len(positions))
    path = drawing.check_writable(path)
    scene = _Scene(
        view=functools.partial(drawing.project, azimuth=azimuth, elevation=elevation),
        positions=positions,
        parents=list(parents[1:]),
        colors=drawing.bone_colors(names, len(parents))[1:],
        paths=_lines(ground),
        contacts=marks,
        ball=ball,
        radius=radius,
    )
    images = _draw_all(scene, range(0, len(positions), every), title, size)
    times = _durations(len(images), every / fps)
    images[0].save(
        path, save_all=True, append_images=images[1:], duration=times, loop=0
    )
