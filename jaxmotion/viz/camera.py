"""The camera of an animation: perspective, of one direction, following smoothly."""

import dataclasses
from typing import Any

import numpy as np

# Focal length in heights of the picture: a field of view of 28 degrees.
_FOCAL = 2.0


@dataclasses.dataclass(frozen=True, kw_only=True)
class Camera:
    """Where each frame is seen from.

    Attributes:
      axes: [3, 3] right, up and toward the viewer, rows.
      targets: [F, 3] what the middle of the picture shows, world, meters.
      distance: From the target, meters.
      focal: Pixels.
      middle: Pixel (x, y) of the target.
    """

    axes: np.ndarray
    targets: np.ndarray
    distance: float
    focal: float
    middle: tuple[float, float]

    def project(
        self, points: np.ndarray, frame: int | np.ndarray
    ) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Pixels of world points.

        Points [..., 3] are in meters; an array of frames must broadcast against them.
        Given are [..., 2] pixels from the upper left; [...] pixels a meter there; [...]
        meters toward the viewer, seen from the target.
        """
        local = (points - self.targets[frame]) @ self.axes.T
        near = local[..., 2]
        # What lies behind the camera gets a huge scale and is far outside.
        scale = self.focal / np.maximum(self.distance - near, 1e-2 * self.distance)
        x = self.middle[0] + local[..., 0] * scale
        y = self.middle[1] - local[..., 1] * scale
        return np.stack([x, y], axis=-1), scale, near


def view_axes(*, azimuth: float, elevation: float) -> np.ndarray:
    """Right, up and toward the viewer of a view in the world, rows of [3, 3].

    Args:
      azimuth: Degrees about +y; 0 looks along -z (a character that faces +z walks
        toward the viewer).
      elevation: Degrees above the ground.
    """
    a, e = np.deg2rad([azimuth, elevation])
    right = [np.cos(a), 0.0, -np.sin(a)]
    up = [-np.sin(e) * np.sin(a), np.cos(e), -np.sin(e) * np.cos(a)]
    toward = [np.cos(e) * np.sin(a), np.sin(e), np.cos(e) * np.cos(a)]
    return np.array([right, up, toward])


def toward(walked: np.ndarray) -> float:
    """Azimuth, degrees, toward which paths [characters, F, 2], (x, z), come in all."""
    way = (walked[:, -1] - walked[:, 0]).mean(axis=0)
    moved = np.linalg.norm(way) > 0.3
    return 35.0 + (float(np.rad2deg(np.arctan2(*way))) if moved else 0.0)


def smooth(values: np.ndarray, frames: float) -> np.ndarray:
    """Gaussian mean [F, D] of that deviation, frames; straight on beyond both ends."""
    reach = max(int(3 * frames), 1)
    weights = np.exp(-0.5 * (np.arange(-reach, reach + 1) / max(frames, 1e-3)) ** 2)
    mode: dict[str, Any] = {"reflect_type": "odd"} if len(values) > 1 else {}
    padded = np.pad(values, ((reach, reach), (0, 0)), mode="reflect", **mode)
    columns = [np.convolve(c, weights / weights.sum(), "valid") for c in padded.T]
    return np.stack(columns, axis=-1)


def follow(
    points: np.ndarray,
    *,
    fps: float,
    azimuth: float,
    elevation: float,
    box: tuple[int, int, int, int],
) -> Camera:
    """The nearest camera that has all bodies whole in a box in all frames.

    Args:
      points: [characters, F, P, 3] between which they are, world, meters.
      azimuth: Degrees about +y; 0 looks along -z.
      elevation: Degrees above the ground.
      box: Left, top, right and bottom, pixels.
    """
    axes = view_axes(azimuth=azimuth, elevation=elevation)
    points = np.moveaxis(points, 1, 0).reshape(points.shape[1], -1, 3)
    middle = 0.5 * (points.min(axis=1) + points.max(axis=1))
    level = smooth(middle[:, [0, 2]], 0.35 * fps)
    up = smooth(middle[:, 1:2], 1.0 * fps)
    targets = np.concatenate([level[:, :1], up, level[:, 1:]], axis=-1)
    local = (points - targets[:, None]) @ axes.T
    half = 0.5 * np.array([box[2] - box[0], box[3] - box[1]])
    focal = _FOCAL * 2 * half[1]
    # A little more than they reach: points between them may stand out.
    needed = local[..., 2:] + 1.02 * focal * np.abs(local[..., :2]) / half
    return Camera(
        axes=axes,
        targets=targets,
        distance=float(needed.max()),
        focal=float(focal),
        middle=(0.5 * (box[0] + box[2]), 0.5 * (box[1] + box[3])),
    )
