"""A figure of four joints that walks in a circle."""

import numpy as np

PARENTS = (-1, 0, 1, 0)
NAMES = ("Hips", "Spine", "LeftHand", "RightFoot")
FPS = 30.0


def circle(frames=12, radius=1.0):
    """Positions [F, 4, 3] and the root's path [F, 2], metres."""
    angle = np.linspace(0, 1.5, frames)
    root = np.stack(
        [
            radius * np.sin(angle),
            0.9 + 0.02 * np.sin(7 * angle),
            radius * np.cos(angle),
        ],
        axis=-1,
    )
    bones = np.array([[0, 0, 0], [0, 0.5, 0], [0.4, 0.5, 0], [-0.1, -0.85, 0]])
    swing = np.sin(9 * angle)[:, None, None] * np.array([[0, 0, 0.3]])
    positions = root[:, None] + bones + swing * (np.arange(4) == 3)[:, None]
    return positions, root[:, ::2]
