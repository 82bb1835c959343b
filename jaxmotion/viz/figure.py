"""What pictures share: the view, colors, and checks.

Figures are made without pyplot, so that neither a display is needed nor the backend of
a notebook changed.
"""

from pathlib import Path

import numpy as np

LEFT, RIGHT, MIDDLE = "#2878c8", "#d63a3a", "#6b7480"
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


def check_motion(
    positions: np.ndarray,
    parents: tuple[int, ...],
    *,
    fps: float,
    paths: dict[str, np.ndarray | None],
) -> np.ndarray:
    """Raises unless a motion can be drawn.

    Args:
      positions: [F, J, 3] world positions, meters.
      parents: Parent of each joint.
      fps: Frames per second.
      paths: Ground paths [F, 2] by name; None for one that is not drawn.

    Returns:
      The positions as floats.

    Raises:
      ValueError: names what has a wrong shape or value, and what was expected.
    """
    positions = np.asarray(positions, float)
    if positions.ndim != 3 or positions.shape[1:] != (len(parents), 3):
        raise ValueError(
            f"positions are {positions.shape}, expected [frames, {len(parents)}, 3]"
        )
    if not (np.isfinite(fps) and fps > 0 and len(positions)):
        raise ValueError(
            f"{len(positions)} frames at {fps} fps, expected at least one frame and a "
            "positive rate"
        )
    arrays = {"positions": positions} | {
        k: v for k, v in paths.items() if v is not None
    }
    for name, found in arrays.items():
        shape, expected = np.shape(found), (len(positions), 2)
        if name != "positions" and shape != expected:
            raise ValueError(f"{name} path is {shape}, expected {expected}")
        finite = np.isfinite(np.asarray(found, float)).reshape(len(positions), -1)
        if not finite.all():
            frame = int((~finite.all(axis=1)).argmax())
            raise ValueError(f"{name}: frame {frame} is not finite")
    return positions


def check_ball(ball: np.ndarray | None, frames: int) -> np.ndarray | None:
    """Raises unless a ball can be drawn.

    Args:
      ball: [F, 3] world position of its center, meters; None for no ball.
      frames: F.

    Returns:
      The positions as floats, or None.

    Raises:
      ValueError: if the shape is wrong or a frame is not finite.
    """
    if ball is None:
        return None
    ball = np.asarray(ball, float)
    if ball.shape != (frames, 3):
        raise ValueError(f"ball is {ball.shape}, expected {(frames, 3)}")
    finite = np.isfinite(ball).all(axis=1)
    if not finite.all():
        raise ValueError(f"ball: frame {int((~finite).argmax())} is not finite")
    return ball


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


def on_ground(path: np.ndarray) -> np.ndarray:
    """World points of a ground path.

    Args:
      path: [F, 2] (x, z) meters.

    Returns:
      [F, 3] meters, y = 0.
    """
    path = np.asarray(path, float)
    return np.stack([path[:, 0], np.zeros(len(path)), path[:, 1]], axis=-1)
