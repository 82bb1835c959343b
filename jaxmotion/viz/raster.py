"""Shaded capsules with a depth buffer, in NumPy: pixels to entries of a palette."""

import numpy as np
from PIL import Image, ImageFilter

# Shades of each color, dark to light.
LEVELS = 6
# Where the light is from the camera: left of, above and behind it.
LIGHT = np.array([-0.42, 0.78, 0.46])


def shades(color: tuple[int, int, int] | np.ndarray) -> np.ndarray:
    """A color from its shade to its light, [LEVELS, 3] of 0 to 255."""
    at = np.linspace(0.0, 1.0, LEVELS)[:, None]
    base = np.array(color, float)
    dark, light = base * 0.52, base + 0.38 * (255 - base)
    low, high = np.clip(at / 0.6, 0, 1), np.clip((at - 0.6) / 0.4, 0, 1)
    return dark + low * (base - dark) + high * (light - base)


def capsules(
    ends: np.ndarray,
    radii: np.ndarray,
    colors: np.ndarray,
    *,
    width: int,
    height: int,
    soft: dict[int, float],
) -> np.ndarray:
    """Which shade of which color each pixel shows.

    Depth, like the rest, is in pixels: a parallel projection around the body.

    Args:
      ends: [S, 2, 3] right, down and toward the viewer.
      radii: [S, 2].
      colors: [S] number of the color.
      soft: Over how many pixels the light is smoothed, of colors where it is.

    Returns:
      [height, width] 1 + color * LEVELS + shade; 0 where nothing is.
    """
    seen = np.zeros((height, width), np.uint8)
    bright = np.zeros((height, width), np.uint8)
    depth = np.full((height, width), -np.inf, np.float32)
    # Seen along its axis, a tapered capsule is the ball at its thick end.
    steep = np.abs(np.diff(radii)[:, 0]) > 0.35 * np.linalg.norm(
        ends[:, 1, :2] - ends[:, 0, :2], axis=-1
    )
    balls = [ends[steep][:, [i, i]] for i in (0, 1)]
    ends = np.concatenate([ends, *balls])
    radii = np.concatenate([radii, *(radii[steep][:, [i, i]] for i in (0, 1))])
    colors = np.concatenate([colors, colors[steep], colors[steep]])
    low = np.floor((ends[..., :2] - radii[..., None]).min(axis=1)).astype(int)
    high = np.ceil((ends[..., :2] + radii[..., None]).max(axis=1)).astype(int) + 1
    low, high = np.maximum(low, 0), np.minimum(high, [width, height])
    light = (LIGHT / np.linalg.norm(LIGHT)).astype(np.float32)
    across, down = np.arange(width, dtype=np.float32), np.arange(height, dtype="f4")
    down = down[:, None]
    for s in range(len(ends)):
        (x0, y0), (x1, y1) = low[s], high[s]
        if x0 >= x1 or y0 >= y1:
            continue
        place = np.s_[y0:y1, x0:x1]
        (ax, ay, az), (dx, dy, dz) = ends[s, 0], ends[s, 1] - ends[s, 0]
        r0, dr = radii[s, 0], radii[s, 1] - radii[s, 0]
        px, py = across[x0:x1] - np.float32(ax), down[y0:y1] - np.float32(ay)
        flat = max(dx * dx + dy * dy, 1e-6)
        # Where the ray of a pixel passes the axis, and from there to the surface.
        t = px * np.float32(dx / flat) + py * np.float32(dy / flat)
        if dz * dz > 1e-4 * flat:
            m = px * np.float32(dy) - py * np.float32(dx)
            r = np.float32(r0) + np.float32(dr) * np.clip(t, 0, 1)
            m = r * r - m * m / np.float32(flat)
            k = dz / np.sqrt(flat * (flat + dz * dz))
            t += np.float32(k) * np.sqrt(np.maximum(m, 0))
        np.clip(t, 0, 1, out=t)
        r = np.float32(r0) + np.float32(dr) * t
        px = px - np.float32(dx) * t
        py = py - np.float32(dy) * t
        h = r * r - px * px - py * py
        inside = h > 0
        h = np.sqrt(np.maximum(h, 0))
        z = np.float32(az) + np.float32(dz) * t + h
        inside &= z > depth[place]
        facing = (px * light[0] - py * light[1] + h * light[2]) / r
        value = np.clip(facing * 158 + 107, 0, 255).astype(np.uint8)
        np.copyto(depth[place], z, where=inside)
        np.copyto(bright[place], value, where=inside)
        np.copyto(seen[place], np.uint8(1 + colors[s]), where=inside)
    for color, blur in soft.items():
        _soften(bright, seen == 1 + color, blur)
    codes = np.uint8(LEVELS) * (seen - (seen > 0)) + (bright // -(-256 // LEVELS)) + 1
    return np.where(seen > 0, codes, 0).astype(np.uint8)


def _soften(bright: np.ndarray, where: np.ndarray, blur: float) -> None:
    """Smooths the light on one color, in place: many capsules become one surface."""
    rows, columns = where.any(axis=1).nonzero()[0], where.any(axis=0).nonzero()[0]
    if not len(rows):
        return
    place = np.s_[rows[0] : rows[-1] + 1, columns[0] : columns[-1] + 1]
    inside = where[place]
    mean = lambda x: np.asarray(  # noqa: E731
        Image.fromarray(x.astype(np.uint8)).filter(ImageFilter.GaussianBlur(blur)), "f4"
    )
    level = 255 * mean(np.where(inside, bright[place], 0)) / mean(255 * inside).clip(1)
    np.copyto(bright[place], level.clip(0, 255).astype(np.uint8), where=inside)
