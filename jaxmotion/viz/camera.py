"""The camera of an animation: perspective, of one direction, following smoothly."""

import dataclasses

import numpy as np

from jaxmotion.viz.figure import view_axes
from jaxmotion.viz.sketch import Body

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

        Args:
          points: [..., 3] meters.
          frame: Frame of the camera; an array of frames must broadcast against
            `points`.

        Returns:
          [..., 2] pixels from the upper left; [...] pixels a meter there; [...] meters
          toward the viewer, seen from the target.
        """
        local = (points - self.targets[frame]) @ self.axes.T
        near = local[..., 2]
        # What lies behind the camera gets a huge scale and is far outside.
        scale = self.focal / np.maximum(self.distance - near, 1e-2 * self.distance)
        x = self.middle[0] + local[..., 0] * scale
        y = self.middle[1] - local[..., 1] * scale
        return np.stack([x, y], axis=-1), scale, near


def smooth(values: np.ndarray, frames: float) -> np.ndarray:
    """Gaussian mean over time, continued straight beyond both ends.

    Args:
      values: [F, D].
      frames: Standard deviation.
    """
    reach = max(int(3 * frames), 1)
    weights = np.exp(-0.5 * (np.arange(-reach, reach + 1) / max(frames, 1e-3)) ** 2)
    mode = {"reflect_type": "odd"} if len(values) > 1 else {}
    padded = np.pad(values, ((reach, reach), (0, 0)), mode="reflect", **mode)
    columns = [np.convolve(c, weights / weights.sum(), "valid") for c in padded.T]
    return np.stack(columns, axis=-1)


def follow(
    body: Body,
    *,
    fps: float,
    azimuth: float,
    elevation: float,
    box: tuple[int, int, int, int],
) -> Camera:
    """The nearest camera that has the whole body in a box in all frames.

    Args:
      azimuth: Degrees about +y; 0 looks along -z.
      elevation: Degrees above the ground.
      box: Left, top, right and bottom, pixels.
    """
    axes = view_axes(azimuth=azimuth, elevation=elevation)
    points, radii = body.points[:, body.ends.ravel()], body.radii.ravel()
    heights = points[..., 1]
    middle = 0.5 * ((heights - radii).min(axis=1) + (heights + radii).max(axis=1))
    root = smooth(body.points[:, 0], 0.35 * fps)
    up = smooth(middle[:, None], 1.0 * fps)[:, 0]
    targets = np.stack([root[:, 0], up, root[:, 2]], axis=-1)
    local = (points - targets[:, None]) @ axes.T
    half = 0.5 * np.array([box[2] - box[0], box[3] - box[1]])
    focal = _FOCAL * 2 * half[1]
    # A ball's picture is a little wider than its radius at its middle.
    reach = np.abs(local[..., :2]) + 1.05 * radii[:, None]
    needed = local[..., 2:] + radii[:, None] + focal * reach / half
    return Camera(
        axes=axes,
        targets=targets,
        distance=float(needed.max()),
        focal=float(focal),
        middle=(0.5 * (box[0] + box[2]), 0.5 * (box[1] + box[3])),
    )
