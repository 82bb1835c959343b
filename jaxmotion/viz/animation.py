"""Animated GIF of a body on the ground, with the commanded and the walked path."""

import dataclasses
import functools
from pathlib import Path

import matplotlib
import numpy as np
from PIL import Image, ImageColor, ImageDraw, ImageFilter, ImageFont

from jaxmotion.viz import camera as cameras
from jaxmotion.viz import figure as drawing
from jaxmotion.viz import raster
from jaxmotion.viz import sketch as bodies

_GROUND, _TILE, _INK, _FAINT = "#f6f8fa", "#dde4ec", "#20262e", "#707884"
_PATH_COLORS = (drawing.COMMANDED, drawing.WALKED)
_TOUCH, _BALL = "#2fae4a", "#e8e4da"
_SHADOW = 0.3
# Trunk, head and feet are of many capsules: meters over which their light is smoothed.
_SOFT = {
    bodies.MIDDLE: 0.07,
    bodies.SKIN: 0.02,
    bodies.LEFT_DARK: 0.02,
    bodies.RIGHT_DARK: 0.02,
}
_TONES = 4
_MARK = 0.05  # radius of the mark of a joint in contact, meters
# Drawn so many times larger in both directions, then averaged.
_FINE = 2


def _rgb(color: str) -> np.ndarray:
    return np.array(ImageColor.getrgb(color), float)


def _mix(a: str, b: str, part: float) -> tuple[int, int, int]:
    return tuple(np.round(_rgb(a) * (1 - part) + _rgb(b) * part).astype(int).tolist())


@functools.cache
def _font(size: int) -> ImageFont.FreeTypeFont:
    folder = Path(matplotlib.get_data_path()) / "fonts" / "ttf"
    return ImageFont.truetype(str(folder / "DejaVuSans.ttf"), size)


def fit_text(text: str, width: int, *, size: int, least: int) -> tuple[str, int]:
    """One line that is at most so wide: shrunk, and if that is not enough elided.

    Args:
      width: Pixels.
      size: Size of the font, pixels, where there is room.
      least: The smallest size.

    Returns:
      What to write, and its size.
    """
    text = " ".join(text.split())
    for smaller in range(size, least - 1, -1):
        if _font(smaller).getlength(text) <= width:
            return text, smaller
    for keep in range(len(text) - 1, 0, -1):
        cut = text[:keep].rstrip() + "…"
        if _font(least).getlength(cut) <= width:
            return cut, least
    return "", least


@dataclasses.dataclass(frozen=True, kw_only=True)
class _Page:
    """Size, texts as (text, font size, upper left corner, color), and room left."""

    width: int
    height: int
    texts: tuple[tuple[str, int, tuple[int, int], str], ...]
    keys: tuple[tuple[tuple[int, int, int, int], str], ...]
    box: tuple[int, int, int, int]


def _page(
    title: str, caption: str, lines: list[tuple[str, str]], width: int, height: int
) -> _Page:
    """Title above, caption below, and above that what the lines' colors mean."""
    margin = max(width // 60, 3)
    room = width - 2 * margin
    texts, keys = [], []
    title, size = fit_text(
        title, room, size=max(height // 22, 8), least=max(height // 36, 7)
    )
    top = margin
    if title:
        left = (width - _font(size).getlength(title)) / 2
        texts.append((title, size, (round(left), margin), _INK))
        top += round(1.4 * size)
    small = max(height // 34, 7)
    caption, size = fit_text(caption, room, size=small, least=max(small - 3, 6))
    bottom = height - margin
    if caption:
        bottom -= round(1.3 * size)
        texts.append((caption, size, (margin, bottom), _FAINT))
    x, y = margin, bottom - round(1.5 * small)
    for label, color in lines:
        keys.append(((x, y + small // 2, x + small, y + small // 2 + 2), color))
        texts.append((label, small, (x + small + small // 2, y), _FAINT))
        x += round(2.5 * small + _font(small).getlength(label))
    return _Page(
        width=width,
        height=height,
        texts=tuple(texts),
        keys=tuple(keys),
        box=(2 * margin, top + margin, width - 2 * margin, bottom - margin),
    )


@dataclasses.dataclass(frozen=True, kw_only=True)
class _Scene:
    """What is drawn; capsules and paths are in world coordinates."""

    page: _Page
    camera: cameras.Camera
    body: bodies.Body
    paths: tuple[tuple[np.ndarray, str], ...]
    contacts: tuple[tuple[int, ...], np.ndarray] | None
    ball: np.ndarray | None
    radius: float

    @property
    def colors(self) -> list[str]:
        """What has shades."""
        found = {*self.body.colors}
        found |= set() if self.contacts is None else {_TOUCH}
        return sorted(found | (set() if self.ball is None else {_BALL}))

    @property
    def reach(self) -> float:
        """How far around the target the ground is drawn, meters."""
        return 0.85 * self.camera.distance


def _fade(scene: _Scene, points: np.ndarray, frame: int) -> np.ndarray:
    """1 near the target, 0 where the ground is no longer drawn."""
    target = scene.camera.targets[frame]
    far = np.linalg.norm((points - target)[..., [0, 2]], axis=-1) / scene.reach
    return np.clip((1.0 - far) / 0.6, 0.0, 1.0)


def tiles(center: np.ndarray, reach: float) -> np.ndarray:
    """Every other square meter of the ground around a point: corners [n, 4, 3]."""
    low, high = np.floor(center - reach), np.ceil(center + reach)
    x, z = np.meshgrid(
        np.arange(low[0], high[0]), np.arange(low[2], high[2]), indexing="ij"
    )
    corner = np.stack([x, 0 * x, z], axis=-1)[(x + z) % 2 == 0]
    square = np.array([[0, 0, 0], [1, 0, 0], [1, 0, 1], [0, 0, 1]], float)
    return corner[:, None] + square


def _draw_tiles(pen: ImageDraw.ImageDraw, scene: _Scene, frame: int) -> None:
    """A chequered ground that fades into the distance."""
    corners = tiles(scene.camera.targets[frame], scene.reach)
    level = np.round(_TONES * _fade(scene, corners.mean(axis=1), frame)).astype(int)
    pixels, _, near = scene.camera.project(corners, frame)
    ahead = near.max(axis=1) < 0.98 * scene.camera.distance  # not behind the camera
    shapes = pixels.reshape(-1, 8).tolist()
    for shape, tone in zip(shapes, (level * ahead).tolist(), strict=True):
        if tone:
            pen.polygon(shape, fill=_mix(_GROUND, _TILE, tone / _TONES))


def _draw_lines(
    pen: ImageDraw.ImageDraw,
    scene: _Scene,
    frame: int,
    points: np.ndarray,
    color: str,
    *,
    strength: float,
    width: int,
) -> None:
    """Lines [..., n, 3] on the ground that fade with their distance."""
    fade = _fade(scene, 0.5 * (points[..., 1:, :] + points[..., :-1, :]), frame)
    levels = np.ceil(4 * fade).astype(int)
    pixels = _FINE * scene.camera.project(points, frame)[0]
    ends = np.concatenate([pixels[..., :-1, :], pixels[..., 1:, :]], axis=-1)
    ramp = [_mix(_GROUND, color, strength * level / 4) for level in range(5)]
    # Pale ones first: where lines cross, the strong one is seen.
    for level in range(1, 5):
        for end in ends[levels == level].tolist():
            pen.line(end, fill=ramp[level], width=width)


def _capsules(scene: _Scene, frame: int) -> tuple[np.ndarray, np.ndarray, list[str]]:
    """Ends [S, 2, 3] and radii [S, 2] of body, marks and ball, meters, and colors."""
    ends, radii = [scene.body.points[frame, scene.body.ends]], [scene.body.radii]
    colors = list(scene.body.colors)
    if scene.contacts is not None:
        feet, down = scene.contacts
        marks = scene.body.points[frame, np.array(feet)[down[frame]]]
        ends.append(np.stack([marks, marks], axis=1))
        radii.append(np.full((len(marks), 2), _MARK))
        colors += [_TOUCH] * len(marks)
    if scene.ball is not None:
        ends.append(scene.ball[[frame, frame]][None])
        radii.append(np.full((1, 2), scene.radius))
        colors.append(_BALL)
    return np.concatenate(ends), np.concatenate(radii), colors


def _draw_shadow(scene: _Scene, frame: int, picture: Image.Image) -> None:
    """What the light casts on the ground, soft."""
    ends, radii, _ = _capsules(scene, frame)
    light = scene.camera.axes.T @ raster.LIGHT
    ground = (ends - ends[..., 1:2] / light[1] * light)[..., [0, 2]]
    along = ground[:, 1] - ground[:, 0]
    angles = np.arctan2(along[:, 1], along[:, 0])[:, None]
    angles = angles + np.linspace(-0.5, 0.5, 7) * np.pi
    arc = np.stack([np.cos(angles), np.sin(angles)], axis=-1)
    far = ground[:, 1, None] + radii[:, 1, None, None] * arc
    near = ground[:, 0, None] - radii[:, 0, None, None] * arc
    rims = np.concatenate([far, near], axis=1)
    points = np.stack([rims[..., 0], 0 * rims[..., 0], rims[..., 1]], axis=-1)
    pixels = scene.camera.project(points, frame)[0]
    mask = Image.new("L", picture.size)
    pen = ImageDraw.Draw(mask)
    for polygon in pixels.reshape(len(pixels), -1).tolist():
        pen.polygon(polygon, fill=round(255 * _SHADOW))
    mask = mask.filter(ImageFilter.GaussianBlur(picture.height / 120))
    # Few steps: a shadow of many would cost more bytes than the body.
    picture.paste(_INK, mask=mask.point([16 * round(v / 16) for v in range(256)]))


def _draw_body(scene: _Scene, frame: int, picture: Image.Image) -> None:
    """Body, marks of touching joints, and ball."""
    ends, radii, colors = _capsules(scene, frame)
    number = {color: i for i, color in enumerate(scene.colors)}
    pixels, scale, near = scene.camera.project(ends, frame)
    usual = scene.camera.focal / scene.camera.distance
    seen = raster.capsules(
        _FINE * np.concatenate([pixels, near[..., None] * usual], axis=-1),
        _FINE * radii * scale,
        np.array([number[color] for color in colors]),
        width=picture.width,
        height=picture.height,
        soft={number[c]: _FINE * m * usual for c, m in _SOFT.items() if c in number},
    )
    shades = [raster.shades(_rgb(color)) for color in scene.colors]
    table = np.round(np.concatenate([np.zeros((1, 3)), *shades])).astype(np.uint8)
    mask = Image.fromarray(np.where(seen > 0, 255, 0).astype(np.uint8))
    picture.paste(Image.fromarray(table[seen]), mask=mask)


def _draw(scene: _Scene, frame: int) -> Image.Image:
    """One frame."""
    page = scene.page
    picture = Image.new("RGB", (page.width, page.height), _GROUND)
    _draw_tiles(ImageDraw.Draw(picture), scene, frame)
    _draw_shadow(scene, frame, picture)
    fine = (_FINE * page.width, _FINE * page.height)
    picture = picture.resize(fine, Image.Resampling.NEAREST)
    pen = ImageDraw.Draw(picture)
    for line, color in scene.paths:
        if color == drawing.COMMANDED:  # what is still to come of it
            rest = line[frame:]
            _draw_lines(pen, scene, frame, rest, color, strength=0.6, width=_FINE)
        _draw_lines(
            pen, scene, frame, line[: frame + 1], color, strength=1.0, width=2 * _FINE
        )
    _draw_body(scene, frame, picture)
    picture = picture.reduce(_FINE)
    pen = ImageDraw.Draw(picture)
    for key, color in page.keys:
        pen.rectangle(key, fill=color)
    for text, size, place, color in page.texts:
        halo = dict(stroke_width=2, stroke_fill=_GROUND)
        pen.text(place, text, fill=color, font=_font(size), **halo)
    return picture


def _palette(scene: _Scene) -> np.ndarray:
    """The colors of a GIF [n, 3]; each with what lies between it and the ground."""
    ramps = [(_TILE, _TONES), (_INK, 6), (_FAINT, 2)]
    ramps += [(color, 4) for _, color in scene.paths]
    found = [_mix(_GROUND, _GROUND, 0.0)]
    found += [_mix(_GROUND, c, i / n) for c, n in ramps for i in range(1, n + 1)]
    found += [_mix(_GROUND, _INK, _SHADOW * i / 4) for i in range(1, 5)]
    for color in scene.colors:
        table = raster.shades(_rgb(color))
        found += [*table, 0.5 * (table[1] + _rgb(_GROUND))]
    return np.round(np.array(found))


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
    caption: str = "",
    every: int | None = None,
    azimuth: float | None = None,
    elevation: float = 16.0,
    size: int | tuple[int, int] = (480, 360),
) -> None:
    """Writes an animated GIF whose camera follows the character.

    The ground grid has meter squares and stands still, so that sliding feet show.

    Args:
      path: File to write.
      positions: [F, J, 3] world positions, meters, y up.
      fps: Frames per second of the motion.
      names: Joint names, to find the head and color left and right; None for guesses
        and gray.
      commanded: [F, 2] commanded path (x, z), or None.
      walked: [F, 2] walked path, or None.
      feet: Joints to mark while they are in contact.
      contact: [F, feet] bool, or None.
      ball: [F, 3] world position of a ball's center, or None.
      radius: Radius of the ball, meters.
      title: Above the picture, in one line: shrunk, then elided.
      caption: Below it, small: the source of the data and its license.
      every: Draw every so many frames; the speed stays true. None for at most 20
        pictures per second.
      azimuth: Azimuth of the camera, degrees about +y. None for one toward which the
        character comes, all in all.
      elevation: Elevation of the camera, degrees.
      size: Width and height, or the side of a square, pixels.

    Raises:
      ValueError: if an array has a wrong shape or is not finite (names it), or `every`
        is not positive.
      OSError: if the file cannot be written.
    """
    ground = {"commanded": commanded, "walked": walked}
    positions = drawing.check_motion(positions, parents, fps=fps, paths=ground)
    marks = _contacts(contact, feet, len(positions))
    every = max(int(np.ceil(fps / 20.0)), 1) if every is None else every
    width, height = (size, size) if isinstance(size, int) else size
    if every < 1 or min(width, height) < 64:
        raise ValueError(
            f"every {every}, size {size}: expected every >= 1 and size >= 64 pixels"
        )
    ball = drawing.check_ball(ball, len(positions))
    path = drawing.check_writable(path)
    shown = [
        (name, color, drawing.on_ground(line))
        for (name, line), color in zip(ground.items(), _PATH_COLORS, strict=True)
        if line is not None
    ]
    page = _page(title, caption, [line[:2] for line in shown], width, height)
    body = bodies.build(positions, parents, names)
    way = positions[-1, 0] - positions[0, 0]
    if azimuth is None:
        moved = np.hypot(way[0], way[2]) > 0.3
        azimuth = 35.0 + (np.rad2deg(np.arctan2(way[0], way[2])) if moved else 0.0)
    scene = _Scene(
        page=page,
        camera=cameras.follow(
            body, fps=fps, azimuth=azimuth, elevation=elevation, box=page.box
        ),
        body=body,
        paths=tuple((line, color) for _, color, line in shown),
        contacts=marks,
        ball=ball,
        radius=radius,
    )
    palette = Image.new("P", (1, 1))
    palette.putpalette(_palette(scene).astype(np.uint8).ravel().tolist())
    frames = range(0, len(positions), every)
    images = [
        _draw(scene, frame).quantize(palette=palette, dither=Image.Dither.NONE)
        for frame in frames
    ]
    times = _durations(len(images), every / fps)
    images[0].save(
        path, save_all=True, append_images=images[1:], duration=times, loop=0
    )
