"""What builders of clips with a ball add to those of clips.

Beside its motion each clip stores the ball's center, which joints touch it in every
frame, the numbers of those joints and the ball's radius.
"""

from collections.abc import Mapping, Sequence

import numpy as np
from jaxtyping import Bool, Float

from jaxmotion.data.ball_clips import BallClips, ball_clips
from jaxmotion.data.builders import base
from jaxmotion.motion.skeleton import Motion, Skeleton

FPS = 30.0
# (x, y, z) with z up becomes (x, z, -y) with y up, which keeps axes right-handed.
Y_UP_FROM_Z_UP = np.array([[1.0, 0.0, 0.0], [0.0, 0.0, 1.0], [0.0, -1.0, 0.0]])


class BallBuilder(base.MotionBuilder, skip_registration=True):
    """A set of labeled clips with a ball."""

    MORE_TENSORS = {
        "ball_position": ((None, 3), np.float32),
        "ball_touch": ((None, None), np.bool_),
        "ball_joints": ((None,), np.int32),
        "ball_radius": ((), np.float32),
    }


def ball_example(
    name: str,
    skeleton: Skeleton,
    motion: Motion,
    labels: Mapping[str, str],
    *,
    ball: Float[np.ndarray, "frames 3"],
    touch: Bool[np.ndarray, "frames touching"],
    joints: Sequence[int],
    radius: float,
) -> tuple[str, dict]:
    """Key and features of one clip with a ball, as a builder's generator yields them.

    The ball's center is in the world, meters, y up; `touch` says which of the joints
    touch it. Labels are one word a field; the name is unique.
    """
    _, features = base.example(name, skeleton, motion, labels)
    features |= {
        "ball_position": np.asarray(ball, np.float32),
        "ball_touch": touch,
        "ball_joints": np.array(joints, np.int32),
        "ball_radius": np.float32(radius),
    }
    return name, features


def ball_clips_from_source(
    builder: BallBuilder, *, tolerance: float = 1e-3
) -> BallClips:
    """All clips of a prepared builder, with their ball, sorted by name.

    Offsets of skeletons may differ by the tolerance, meters. A `ValueError` names two
    clips with different skeletons, rates, balls or touching joints.
    """
    records = base.read_records(builder)
    clips = base.clips_from_records(builder, records, tolerance=tolerance)
    balls = [
        (
            tuple(int(joint) for joint in record["ball_joints"]),
            # Stored as float32; 0.11 should come back as 0.11.
            round(float(record["ball_radius"]), 6),
        )
        for record in records
    ]
    for name, ball in zip(clips.clip_names, balls, strict=True):
        if ball != balls[0]:
            raise ValueError(
                f"clips {clips.clip_names[0]!r} and {name!r} have different balls: "
                f"touching joints and radius {balls[0]} and {ball}"
            )
    joints, radius = balls[0]
    return ball_clips(
        clips,
        np.concatenate([record["ball_position"] for record in records]),
        np.concatenate([record["ball_touch"] for record in records]),
        joints=joints,
        radius=radius,
    )
