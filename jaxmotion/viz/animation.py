"""Animated GIF of a body on the ground, with the commanded and the walked path."""

import dataclasses
import functools
import io
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import matplotlib
import numpy as np
from PIL import Image, ImageColor, ImageDraw, ImageFilter, ImageFont

from jaxmotion import files
from jaxmotion.viz import camera as cameras
from jaxmotion.viz import figure as drawing
from jaxmotion.viz import raster
from jaxmotion.viz.stage import Stage

_GROUND, _TILE, _INK, _FAINT = "#f6f8fa", "#dde4ec", "#20262e", "#707884"
_PATH_COLORS = (drawing.COMMANDED, drawing.WALKED)
_TOUCH, _BALL = "#2fae4a", "#e8e4da"
_GHOST = "#8fa3b8"
_SHADOW = 0.3
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
    """A line at most so wide, and its font's size: shrunk, and if need be elided.

    Args:
      width: Pixels.
      size: Size of the font, pixels, where there is room.
      least: The smallest size.
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
class _Shot:
    """A stage before a camera.

    Attributes:
      paths: Ground paths [C, F, 3], and their colors.
    """

    page: _Page
    camera: cameras.Camera
    stage: Stage
    paths: tuple[tuple[np.ndarray, str], ...]

    @functools.cached_property
    def colors(self) -> tuple[str, ...]:
        """What has shades: the body's palette first."""
        more = () if self.stage.ball is None else (_TOUCH, _BALL)
        more += () if self.stage.ghost is None else (_GHOST,)
        return self.stage.body.palette + more

    @property
    def reach(self) -> float:
        """How far around the target the ground is drawn, meters."""
        return 0.65 * self.camera.distance


def _fade(shot: _Shot, points: np.ndarray, frame: int) -> np.ndarray:
    """1 near the target, 0 where the ground is no longer drawn."""
    target = shot.camera.targets[frame]
    far = np.linalg.norm((points - target)[..., [0, 2]], axis=-1) / shot.reach
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


def _draw_tiles(pen: ImageDraw.ImageDraw, shot: _Shot, frame: int) -> None:
    """A chequered ground that fades into the distance."""
    corners = tiles(shot.camera.targets[frame], shot.reach)
    level = np.round(_TONES * _fade(shot, corners.mean(axis=1), frame)).astype(int)
    pixels, _, near = shot.camera.project(corners, frame)
    ahead = near.max(axis=1) < 0.98 * shot.camera.distance  # not behind the camera
    shapes = pixels.reshape(-1, 8).tolist()
    for shape, tone in zip(shapes, (level * ahead).tolist(), strict=True):
        if tone:
            pen.polygon(shape, fill=_mix(_GROUND, _TILE, tone / _TONES))


def _draw_lines(
    pen: ImageDraw.ImageDraw,
    shot: _Shot,
    frame: int,
    points: np.ndarray,
    color: str,
    *,
    strength: float,
    width: int,
) -> None:
    """Lines [..., n, 3] on the ground that fade with their distance."""
    fade = _fade(shot, 0.5 * (points[..., 1:, :] + points[..., :-1, :]), frame)
    levels = np.ceil(4 * fade).astype(int)
    pixels = _FINE * shot.camera.project(points, frame)[0]
    ends = np.concatenate([pixels[..., :-1, :], pixels[..., 1:, :]], axis=-1)
    ramp = [_mix(_GROUND, color, strength * level / 4) for level in range(5)]
    # Pale ones first: where lines cross, the strong one is seen.
    for level in range(1, 5):
        for end in ends[levels == level].tolist():
            pen.line(end, fill=ramp[level], width=width)


@dataclasses.dataclass(frozen=True, kw_only=True)
class _Solid:
    """Triangles in the world: vertices [V, 3], normals, colors [V], faces [T, 3]."""

    vertices: np.ndarray
    normals: np.ndarray
    colors: np.ndarray
    faces: np.ndarray


def _joined(solids: list[_Solid]) -> _Solid:
    starts = np.cumsum([0, *(len(solid.vertices) for solid in solids)])
    pairs = zip(solids, starts, strict=False)
    return _Solid(
        vertices=np.concatenate([solid.vertices for solid in solids]),
        normals=np.concatenate([solid.normals for solid in solids]),
        colors=np.concatenate([solid.colors for solid in solids]),
        faces=np.concatenate([solid.faces + start for solid, start in pairs]),
    )


def _ball(center: np.ndarray, radius: float, color: int) -> _Solid:
    vertices, faces = raster.sphere()
    return _Solid(
        vertices=center + radius * vertices,
        normals=vertices,
        colors=np.full(len(vertices), color),
        faces=faces,
    )


def _solid(shot: _Shot, frame: int, *, ghost: bool = False) -> _Solid:
    """All bodies, balls, and marks of what touches them; or all ghosts."""
    stage, body = shot.stage, shot.stage.body
    pose = stage.positions, stage.rotations
    if ghost and stage.ghost_pose is not None:
        pose = stage.ghost_pose
    vertices, normals = body.skin(*(values[:, frame] for values in pose))
    colors = body.materials
    if ghost:
        colors = np.full(len(colors), shot.colors.index(_GHOST))
    found = [
        _Solid(vertices=v, normals=n, colors=colors, faces=body.faces)
        for v, n in zip(vertices, normals, strict=True)
    ]
    if stage.ball is not None and not ghost:
        for joint in stage.ball.touching(frame):
            touch = shot.colors.index(_TOUCH)
            found.append(_ball(stage.positions[0, frame, joint], _MARK, touch))
        color, radius = shot.colors.index(_BALL), stage.ball.radius
        places = stage.ball.position[:, frame]
        found += [_ball(place, radius, color) for place in places]
    return _joined(found)


def _draw_shadow(shot: _Shot, frame: int, picture: Image.Image, solid: _Solid) -> None:
    """What the light casts on the ground, soft."""
    light = shot.camera.axes.T @ raster.LIGHT
    ground = solid.vertices - solid.vertices[:, 1:2] / light[1] * light
    pixels = shot.camera.project(ground, frame)[0]
    points = np.concatenate([pixels, 0 * pixels[:, :1]], axis=1)
    mask = raster.covered(
        points, solid.faces, width=picture.width, height=picture.height
    )
    mask = Image.fromarray(np.where(mask, round(255 * _SHADOW), 0).astype(np.uint8))
    mask = mask.filter(ImageFilter.GaussianBlur(picture.height / 120))
    # Few steps: a shadow of many would cost more bytes than the body.
    picture.paste(_INK, mask=mask.point([16 * round(v / 16) for v in range(256)]))


def _draw_solid(
    shot: _Shot, frame: int, picture: Image.Image, solid: _Solid, *, opacity: int = 255
) -> None:
    """What stands on the ground; one sees through ghosts."""
    pixels, _, near = shot.camera.project(solid.vertices, frame)
    usual = shot.camera.focal / shot.camera.distance
    size = dict(width=picture.width, height=picture.height)
    points = _FINE * np.concatenate([pixels, usual * near[:, None]], axis=-1)
    codes = raster.codes(
        raster.triangles(points, solid.faces, **size),
        solid.normals @ shot.camera.axes.T,
        solid.colors,
        solid.faces,
        **size,
    )
    shades = [raster.shades(_rgb(color)) for color in shot.colors]
    table = np.round(np.concatenate([np.zeros((1, 3)), *shades])).astype(np.uint8)
    mask = Image.fromarray(np.where(codes > 0, opacity, 0).astype(np.uint8))
    picture.paste(Image.fromarray(table[codes]), mask=mask)


def _draw(shot: _Shot, frame: int) -> Image.Image:
    """One frame."""
    page = shot.page
    picture = Image.new("RGB", (page.width, page.height), _GROUND)
    _draw_tiles(ImageDraw.Draw(picture), shot, frame)
    solid = _solid(shot, frame)
    _draw_shadow(shot, frame, picture, solid)
    fine = (_FINE * page.width, _FINE * page.height)
    picture = picture.resize(fine, Image.Resampling.NEAREST)
    pen = ImageDraw.Draw(picture)
    for lines, color in shot.paths:
        for line in lines:
            if color == drawing.COMMANDED:  # what is still to come of it
                rest = line[frame:]
                _draw_lines(pen, shot, frame, rest, color, strength=0.6, width=_FINE)
            done = line[: frame + 1]
            _draw_lines(pen, shot, frame, done, color, strength=1.0, width=2 * _FINE)
    if shot.stage.ghost is not None:
        pale = _solid(shot, frame, ghost=True)
        _draw_solid(shot, frame, picture, pale, opacity=110)
    _draw_solid(shot, frame, picture, solid)
    picture = picture.reduce(_FINE)
    pen = ImageDraw.Draw(picture)
    for key, color in page.keys:
        pen.rectangle(key, fill=color)
    for text, size, place, color in page.texts:
        halo: dict[str, Any] = dict(stroke_width=2, stroke_fill=_GROUND)
        pen.text(place, text, fill=color, font=_font(size), **halo)
    return picture


def _palette(shot: _Shot) -> np.ndarray:
    """The colors of a GIF [n, 3]; each with what lies between it and the ground."""
    ramps = [(_TILE, _TONES), (_INK, 6), (_FAINT, 2)]
    ramps += [(color, 4) for _, color in shot.paths]
    found = [_mix(_GROUND, _GROUND, 0.0)]
    found += [_mix(_GROUND, c, i / n) for c, n in ramps for i in range(1, n + 1)]
    found += [_mix(_GROUND, _INK, _SHADOW * i / 4) for i in range(1, 5)]
    used = {shot.colors[i] for i in np.unique(shot.stage.body.materials)}
    for color in sorted(used | {*shot.colors[len(shot.stage.body.palette) :]}):
        table = raster.shades(_rgb(color))
        found += [*table, 0.5 * (table[1] + _rgb(_GROUND))]
        if color == _GHOST:
            found += [*(0.43 * table + 0.57 * _rgb(_GROUND))]
    return np.round(np.array(found))


def _durations(number: int, seconds: float) -> list[int]:
    """Milliseconds of each picture; a GIF counts hundredths, so these must vary."""
    times = np.round(100 * seconds * np.arange(number + 1)).astype(int)
    return (10 * np.maximum(np.diff(times), 1)).tolist()


def save_gif(
    path: str | Path,
    stage: Stage,
    *,
    title: str = "",
    caption: str = "",
    every: int | None = None,
    azimuth: float | None = None,
    elevation: float | None = None,
    size: int | tuple[int, int] = (480, 360),
) -> None:
    """Writes an animated GIF whose camera follows the characters.

    All bodies stay in the picture whole. The ground grid has meter squares and stands
    still, so that sliding feet show.

    Args:
      title: Above the picture, in one line: shrunk, then elided.
      caption: Below it, small: the source of the data and its license.
      every: Draw every so many frames, at most 100 pictures per second; the speed stays
        true. None for at most 20 pictures per second.
      azimuth: Azimuth of the camera, degrees about +y. None for one toward which the
        characters come, all in all.
      elevation: Elevation of the camera, degrees. None for 16, or 28 over a crowd.
      size: Width and height, or the side of a square, pixels.

    Raises:
      ValueError: if `every` or the size is too small.
      OSError: if the file cannot be written.
    """
    every = max(int(np.ceil(stage.fps / 20.0)), 1) if every is None else every
    width, height = (size, size) if isinstance(size, int) else size
    least = max(int(np.ceil(stage.fps / 100.0)), 1)
    if every < least or min(width, height) < 64:
        raise ValueError(
            f"every {every}, size {size}: expected every >= {least} (at {stage.fps:g} "
            "frames per second) and size >= 64 pixels"
        )
    path = drawing.check_writable(path)
    shown = [("walked", drawing.WALKED, stage.walked)]
    if stage.wanted is not None:
        shown.insert(0, ("commanded", drawing.COMMANDED, stage.wanted))
    keys = [line[:2] for line in shown]
    keys += [] if stage.ghost is None else [("plan", _GHOST)]
    page = _page(title, caption, keys, width, height)
    many = len(stage.positions) > 3
    camera = cameras.follow(
        stage.outline,
        fps=stage.fps,
        azimuth=cameras.toward(stage.walked) if azimuth is None else azimuth,
        elevation=(28.0 if many else 16.0) if elevation is None else elevation,
        box=page.box,
    )
    shot = _Shot(
        page=page,
        camera=camera,
        stage=stage,
        paths=tuple((_on_ground(line), color) for _, color, line in shown),
    )
    palette = Image.new("P", (1, 1))
    palette.putpalette(_palette(shot).astype(np.uint8).ravel().tolist())
    frames = range(0, stage.positions.shape[1], every)
    images = [
        _draw(shot, frame).quantize(palette=palette, dither=Image.Dither.NONE)
        for frame in frames
    ]
    times = _durations(len(images), every / stage.fps)
    with files.replacing(path) as file:
        file.write(_encoded(images, times))


def save_pictures(
    path: str | Path, pictures: Iterable[np.ndarray], *, fps: float
) -> None:
    """Writes pictures [height, width, 3] of another renderer as an animated GIF.

    A GIF's times are hundredths of a second. `ValueError` if there are none.
    """
    path = drawing.check_writable(path)
    images = [Image.fromarray(picture) for picture in pictures]
    if not images:
        raise ValueError(f"{path}: no pictures")
    # One palette for all: colors that change from one picture to the next flicker.
    some = images[:: max(len(images) // 8, 1)]
    sheet = Image.new("RGB", (images[0].width, images[0].height * len(some)))
    for number, image in enumerate(some):
        sheet.paste(image, (0, number * image.height))
    palette = sheet.quantize(128, Image.Quantize.MEDIANCUT)
    images = [
        image.quantize(palette=palette, dither=Image.Dither.NONE) for image in images
    ]
    with files.replacing(path) as file:
        file.write(_encoded(images, _durations(len(images), 1.0 / fps)))


def _encoded(images: list[Image.Image], times: list[int]) -> bytes:
    """A GIF in fewest bytes: unchanged pixels as holes pay where the camera stands."""
    found = []
    for holes in (True, False):
        file = io.BytesIO()
        options = dict(save_all=True, duration=times, loop=0, optimize=holes)
        images[0].save(file, "GIF", append_images=images[1:], **options)
        found.append(file.getvalue())
    return min(found, key=len)


def _on_ground(paths: np.ndarray) -> np.ndarray:
    """World points [..., 3] of ground paths [..., 2], meters."""
    return np.stack([paths[..., 0], 0 * paths[..., 0], paths[..., 1]], axis=-1)
