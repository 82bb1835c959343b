"""Pose vectors and path features of clips, ready for AAMDM's training.

The last part of every clip is held out, after a gap of one second: frames next to each
other are nearly the same.
"""

import dataclasses
from collections.abc import Sequence

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from jaxmotion.data import simulation, windows
from jaxmotion.data.clips import Clips, clip_motion
from jaxmotion.motion import path_features, pose


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True, kw_only=True, eq=False)
class PoseData:
    """Frames of clips, concatenated; offsets are those of `Clips`."""

    poses: Float[Array, "frames features"]
    paths: Float[Array, "frames 12"]
    offsets: Int[Array, "boundaries"]
    fps: float = jax.tree.static()

    @property
    def num_frames(self) -> int:
        """Frames of all clips together."""
        return self.poses.shape[0]


def starts(data: PoseData, length: int, *, stride: int = 1) -> Int[Array, " windows"]:
    """First frames of all windows of `length` frames that lie within one clip.

    They are `stride` frames apart in a clip; `ValueError` if none is long enough.
    """
    found, _ = windows.window_starts(np.asarray(data.offsets), length, stride=stride)
    if not found.size:
        longest = int(np.diff(np.asarray(data.offsets)).max())
        raise ValueError(
            f"no clip has the {length} frames of a window: the longest has {longest}"
        )
    return jnp.asarray(found, jnp.int32)


def balanced_starts(
    data: PoseData, length: int, *, power: float
) -> Int[Array, " windows"]:
    """First frames of windows, those of rare speeds and turns more often.

    A window's class is what the path features of its first frame say: the speeds over
    the first third of a second and over the last of the second ahead, and the turn of
    the facing. The power is that of `windows.repeat_rare`; 0 lists each once, as
    `starts`.
    """
    first = np.asarray(starts(data, length))
    if not power:
        return jnp.asarray(first)
    ahead = np.asarray(data.paths, np.float64)[first].reshape(-1, 2, 3, 2)
    points, facing = ahead[:, 0], ahead[:, 1, -1]
    speeds = 3.0 * np.linalg.norm(np.diff(points, axis=1, prepend=0.0), axis=-1)
    turned = np.arctan2(facing[:, 0], facing[:, 1])
    kinds = windows.motion_kinds(speeds[:, 0], speeds[:, -1], turned)
    return jnp.asarray(first[windows.repeat_rare(kinds, power=power)[0]])


def take(data: PoseData, spans: list[tuple[int, int]]) -> PoseData:
    """Parts of the frames, each a clip of its own; a span's end is exclusive."""
    frames = np.concatenate([np.arange(a, b) for a, b in spans])
    lengths = [b - a for a, b in spans]
    return PoseData(
        poses=data.poses[frames],
        paths=data.paths[frames],
        offsets=jnp.asarray(np.cumsum([0, *lengths]), jnp.int32),
        fps=data.fps,
    )


def split_ends(
    data: PoseData, fraction: float, *, whole: Sequence[bool] = ()
) -> tuple[PoseData, PoseData]:
    """Holds out a part, in (0, 1), at the end of every clip, and a second before it.

    `whole` says of which clips nothing is held out, as of loops, whose ends were seen
    before; empty for none. `ValueError` if the part is out of range, or one would be
    empty.
    """
    if not 0.0 < fraction < 1.0:
        raise ValueError(f"fraction should be between 0 and 1, found {fraction}")
    offsets = np.asarray(data.offsets)
    gap = round(data.fps)
    train, held = [], []
    spans = zip(offsets[:-1].tolist(), offsets[1:].tolist(), strict=True)
    for (a, b), keeps in zip(spans, whole or [False] * (len(offsets) - 1), strict=True):
        cut = b - round((b - a) * fraction)
        if keeps:
            train.append((a, b))
        elif a < cut - gap and cut < b:
            train.append((a, cut - gap))
            held.append((cut, b))
    if not held:
        raise ValueError("no clip is long enough to hold a part of it out")
    return take(data, train), take(data, held)


def pose_data(clips: Clips, *, fps: float = 60.0) -> tuple[PoseData, tuple[str, ...]]:
    """Frames of clips at another rate, and the names of the clips that were used.

    Clips too short for a simulation bone are left out. `ValueError` if all are, the
    skeleton lacks a joint, or the rate cannot be reached.
    """
    skeleton = clips.skeleton
    least = simulation.least_frames(fps)
    rows, names = [], []
    for i in range(clips.num_clips):
        motion = clip_motion(clips, i)
        if motion.root_position.shape[0] < 2:
            continue
        motion = simulation.upsample(motion, fps)
        if motion.root_position.shape[0] < least:
            continue
        bone = simulation.simulation_bone(skeleton, motion)
        poses = pose.pose_vectors(skeleton, motion, bone)
        paths = path_features.path_features(bone, fps=fps)
        rows.append((poses, paths))
        names.append(clips.clip_names[i])
    if not rows:
        raise ValueError(f"no clip has {least} frames at {fps:g} frames per second")
    poses, paths = (jnp.concatenate(x) for x in zip(*rows, strict=True))
    lengths = [len(row[0]) for row in rows]
    boundaries = jnp.asarray(np.cumsum([0, *lengths]), jnp.int32)
    data = PoseData(poses=poses, paths=paths, offsets=boundaries, fps=float(fps))
    return data, tuple(names)
