"""Shaded triangles with a depth buffer, in NumPy: pixels to entries of a palette."""

import dataclasses
import functools

import numpy as np

# Shades of each color, dark to light.
LEVELS = 12
# Where the light is from the camera: left of, above and behind it.
LIGHT = np.array([-0.42, 0.78, 0.46])


def shades(color: tuple[int, int, int] | np.ndarray) -> np.ndarray:
    """A color from its shade to its light, [LEVELS, 3] of 0 to 255."""
    at = np.linspace(0.0, 1.0, LEVELS)[:, None]
    base = np.array(color, float)
    dark, light = base * 0.52, base + 0.38 * (255 - base)
    low, high = np.clip(at / 0.6, 0, 1), np.clip((at - 0.6) / 0.4, 0, 1)
    return dark + low * (base - dark) + high * (light - base)


@dataclasses.dataclass(frozen=True, kw_only=True)
class Seen:
    """Pixels that show something, and what.

    Attributes:
      pixels: [n] row by row.
      faces: [n] which triangle.
      parts: [n, 3] how much of each of its corners.
    """

    pixels: np.ndarray
    faces: np.ndarray
    parts: np.ndarray

    def mean(self, values: np.ndarray, faces: np.ndarray) -> np.ndarray:
        """Values [n, d] there of those at vertices [V, d]."""
        found = values[faces[self.faces]]
        return np.einsum("nk,nkd->nd", self.parts, found)


def _spans(low: np.ndarray, high: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Whole numbers from each low to below each high, and which range each is of."""
    count = np.maximum(high - low, 0)
    which = np.repeat(np.arange(len(low)), count)
    first = np.cumsum(count) - count
    return low[which] + np.arange(len(which)) - first[which], which


@dataclasses.dataclass(frozen=True, kw_only=True)
class _Inside:
    """Pixels inside of triangles, each as often as it is in one.

    Attributes:
      row, column: [n].
      of: [n] which of `which`.
      which: [m] triangles that have pixels.
      corner: [m, 3, 3] their corners.
      scale: [m] one over twice their signed area.
    """

    row: np.ndarray
    column: np.ndarray
    of: np.ndarray
    which: np.ndarray
    corner: np.ndarray
    scale: np.ndarray


def _inside(
    points: np.ndarray, faces: np.ndarray, width: int, height: int, two_sided: bool
) -> _Inside:
    corner = points.astype(np.float64)[faces]
    one, two = corner[:, 1] - corner[:, 0], corner[:, 2] - corner[:, 0]
    area = two[:, 0] * one[:, 1] - one[:, 0] * two[:, 1]
    low, high = corner.min(axis=1), corner.max(axis=1)
    useful = (np.abs(area) if two_sided else area) > 1e-9
    useful &= (high[:, :2] >= 0).all(axis=1)
    useful &= (low[:, :2] <= [width - 1, height - 1]).all(axis=1)
    which = np.flatnonzero(useful)
    corner, area = corner[which], area[which]
    top = np.ceil(np.maximum(low[which, 1], 0)).astype(int)
    end = np.floor(np.minimum(high[which, 1], height - 1)).astype(int) + 1
    row, of = _spans(top, end)
    left, right = np.zeros(len(row)), np.full(len(row), width - 1.0)
    for i in range(3):
        p, q = corner[:, i], corner[:, (i + 1) % 3]
        rise = (p[:, 1] - q[:, 1]) * np.sign(area)
        with np.errstate(divide="ignore", invalid="ignore"):
            slope = (q[:, 0] - p[:, 0]) / (q[:, 1] - p[:, 1])
            start = p[:, 0] - slope * p[:, 1]
            x = start[of] + row * slope[of]
        np.fmax(left, np.where((rise < 0)[of], x, left), out=left)
        np.fmin(right, np.where((rise > 0)[of], x, right), out=right)
    first = np.ceil(left - 1e-4).astype(int)
    column, span = _spans(first, np.floor(right + 1e-4).astype(int) + 1)
    return _Inside(
        row=row[span],
        column=column,
        of=of[span],
        which=which,
        corner=corner,
        scale=1.0 / area,
    )


def covered(
    points: np.ndarray, faces: np.ndarray, *, width: int, height: int
) -> np.ndarray:
    """Whether each pixel [height, width] is in a triangle, seen from whichever side.

    Points [V, 2 or more] are right and down, pixels.
    """
    inside = _inside(points, faces, width, height, two_sided=True)
    found = np.zeros((height, width), bool)
    found[inside.row, inside.column] = True
    return found


def triangles(
    points: np.ndarray, faces: np.ndarray, *, width: int, height: int
) -> Seen:
    """What is nearest in each pixel.

    Args:
      points: [V, 3] right, down and toward the viewer, pixels.
      faces: [T, 3] counterclockwise for who sees them; others are not drawn.
    """
    inside = _inside(points, faces, width, height, two_sided=False)
    a, one, two = (
        inside.corner[:, i] - (i > 0) * inside.corner[:, 0] for i in range(3)
    )
    # Shares of the second and third corner, and the depth, are linear in the pixel.
    scale = inside.scale
    second = np.stack([-two[:, 1] * scale, two[:, 0] * scale], axis=-1)
    third = np.stack([one[:, 1] * scale, -one[:, 0] * scale], axis=-1)
    slope = second * one[:, 2:] + third * two[:, 2:]
    start = a[:, 2] - np.sum(slope * a[:, :2], axis=-1)
    of, row, column = inside.of, inside.row, inside.column
    depth = start[of] + slope[of, 0] * column + slope[of, 1] * row
    pixel = row * width + column
    nearest = np.full(width * height, -np.inf)
    np.maximum.at(nearest, pixel, depth)
    winner = np.full(width * height, -1)
    ahead = np.flatnonzero(depth == nearest[pixel])
    winner[pixel[ahead]] = ahead
    shown = np.flatnonzero(winner >= 0)
    winner = winner[shown]
    of = of[winner]
    away = np.stack([column[winner], row[winner]], axis=-1) - a[of, :2]
    b = np.clip(np.sum(away * second[of], axis=-1), 0.0, 1.0)
    c = np.clip(np.sum(away * third[of], axis=-1), 0.0, 1.0 - b)
    return Seen(
        pixels=shown,
        faces=inside.which[of],
        parts=np.stack([1.0 - b - c, b, c], axis=-1),
    )


@functools.cache
def sphere() -> tuple[np.ndarray, np.ndarray]:
    """Vertices [V, 3] and faces [T, 3] of a unit sphere: a cube that was blown up."""
    side = np.tan(np.linspace(-1, 1, 9) * np.pi / 4)
    u, v = (x.ravel() for x in np.meshgrid(side, side, indexing="ij"))
    corner = (np.arange(8)[:, None] * 9 + np.arange(8)).ravel()
    face = corner[:, None] + [0, 9, 10, 0, 10, 1]
    vertices, faces = [], []
    for axis in range(3):
        for sign in (1.0, -1.0):
            plane = np.stack([u * sign, v, np.full(81, 1.0)], axis=-1)
            plane[:, 2] = sign
            faces.append(face.reshape(-1, 3) + 81 * len(vertices))
            vertices.append(np.roll(plane, axis, axis=1))
    found = np.concatenate(vertices)
    found /= np.linalg.norm(found, axis=1, keepdims=True)
    return found, np.concatenate(faces)


def codes(
    seen: Seen,
    normals: np.ndarray,
    colors: np.ndarray,
    faces: np.ndarray,
    *,
    width: int,
    height: int,
) -> np.ndarray:
    """Which shade of which color each pixel shows.

    Args:
      normals: [V, 3] right, up and toward the viewer.
      colors: [V] number of the color.
      faces: [T, 3].

    Returns:
      [height, width] 1 + color * LEVELS + shade; 0 where nothing is.
    """
    found = np.zeros(width * height, np.uint8)
    normal = seen.mean(normals.astype(np.float32), faces)
    length = np.linalg.norm(normal, axis=-1)
    facing = normal @ (LIGHT / np.linalg.norm(LIGHT)) / np.maximum(length, 1e-6)
    bright = np.clip(0.42 + 0.62 * facing, 0.0, 0.999)
    shade = (bright * LEVELS).astype(np.uint8)
    color = colors[faces[seen.faces, 0]].astype(np.uint8)
    found[seen.pixels] = 1 + color * np.uint8(LEVELS) + shade
    return found.reshape(height, width)
