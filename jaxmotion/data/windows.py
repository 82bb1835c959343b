"""Windows of clips, cut on the device inside jit.

`window_index` runs once on the host and lists where windows may start; everything else
is a gather that jit-compiles, so that data stays on the device for a whole training.
"""

import dataclasses
import functools
from typing import Any, Literal

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from jaxmotion.data.clips import Clips
from jaxmotion.motion import rotation, trajectory
from jaxmotion.motion.skeleton import Motion
from jaxmotion.typing import Key


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True, kw_only=True, eq=False)
class WindowIndex:
    """Where windows may start.

    Attributes:
      starts: First frame of each window, counted over all clips.
    """

    starts: Int[Array, "windows"]
    clips: Int[Array, "windows"]
    length: int = jax.tree.static()


def window_starts(
    offsets: Int[np.ndarray, "boundaries"], length: int, *, stride: int = 1
) -> tuple[Int[np.ndarray, "windows"], Int[np.ndarray, "windows"]]:
    """First frame (over all clips) and clip of all windows that lie within one clip.

    `offsets` are those of `Clips`; `stride` is between the starts of windows of one
    clip. Both are empty if no clip is long enough.
    """
    starts = [
        np.arange(a, b - length + 1, stride)
        for a, b in zip(offsets[:-1], offsets[1:], strict=True)
    ]
    owner = np.repeat(np.arange(len(starts)), [s.size for s in starts])
    return np.concatenate(starts), owner


def window_index(
    clips: Clips,
    length: int,
    *,
    stride: int = 1,
    short: Literal["error", "skip"] = "error",
) -> WindowIndex:
    """Lists all windows of a length that lie within one clip.

    `stride` is between the starts of windows of one clip. `ValueError` if no clip is
    long enough, or a clip is too short (named) and that is an error.
    """
    offsets = np.asarray(clips.offsets)
    lengths = np.diff(offsets)
    too_short = np.flatnonzero(lengths < length)
    if too_short.size and (short == "error" or too_short.size == lengths.size):
        first = int(too_short[0])
        name = clips.clip_names[first] if clips.clip_names else f"clip {first}"
        raise ValueError(
            f"{name} has {lengths[first]} frames, a window needs {length} "
            f"({too_short.size} of {lengths.size} clips are too short)"
        )
    starts, owner = window_starts(offsets, length, stride=stride)
    return WindowIndex(
        starts=jnp.asarray(starts, jnp.int32),
        clips=jnp.asarray(owner, jnp.int32),
        length=length,
    )


# Borders of the classes of `balance`, in m/s and radians.
SPEED_BORDERS = (0.2, 0.6, 1.1, 1.7, 2.3, 3.0)
TURN_BORDERS = (-np.pi / 2, -np.pi / 6, np.pi / 6, np.pi / 2)


def balance(
    clips: Clips, index: WindowIndex, *, last: int, power: float = 0.5
) -> tuple[WindowIndex, Float[np.ndarray, "classes 2"]]:
    """An index in which what happens rarely stands more often, and classes' shares.

    A window's class is its speed at frame `last`, its speed at the end, both over a
    third of a second, and the turn of the facing between them. Its number of entries
    grows with n^-power for a class of n windows. Recordings are mostly of steady
    walking: a model that has seen few stops slides into them.

    Args:
      last: Frame that the future begins after.
      power: 0 leaves the index as it is; 1 gives all classes the same share.

    Returns:
      The index, about twice as long, and each class's share before and after.
    """
    frames = Motion(
        root_position=clips.root_position,
        joint_rotation=clips.joint_rotation,
        fps=clips.fps,
    )
    course = jax.jit(trajectory.root_trajectory)(clips.skeleton, frames)
    position, facing = (
        np.asarray(x, np.float64) for x in (course.position, course.facing)
    )
    starts = np.asarray(index.starts)
    third = max(round(clips.fps / 3), 1)

    def speed(end: np.ndarray) -> np.ndarray:
        way = np.linalg.norm(position[end] - position[end - third], axis=-1)
        return way * clips.fps / third

    now, end = starts + last, starts + index.length - 1
    before = np.maximum(now, starts + third)
    angle = np.arctan2(facing[:, 0], facing[:, 1])
    kinds = motion_kinds(speed(before), speed(end), angle[end] - angle[now])
    chosen, shares = repeat_rare(kinds, power=power)
    return dataclasses.replace(
        index, starts=index.starts[chosen], clips=index.clips[chosen]
    ), shares


def motion_kinds(
    now: Float[np.ndarray, " windows"],
    end: Float[np.ndarray, " windows"],
    turned: Float[np.ndarray, " windows"],
) -> Int[np.ndarray, " windows"]:
    """Classes of windows by what changes in them.

    Speeds at the beginning and the end are in meters per second, the angle by which the
    facing turns between in radians.
    """
    speeds, turns = len(SPEED_BORDERS) + 1, len(TURN_BORDERS) + 1
    kinds = np.digitize(now, SPEED_BORDERS) * speeds + np.digitize(end, SPEED_BORDERS)
    turned = (turned + np.pi) % (2 * np.pi) - np.pi
    return kinds * turns + np.digitize(turned, TURN_BORDERS)


def repeat_rare(
    kinds: Int[np.ndarray, " windows"], *, power: float
) -> tuple[Int[np.ndarray, " chosen"], Float[np.ndarray, "classes 2"]]:
    """About twice as many windows' numbers, n^-power for each class of n windows.

    The power 0 draws all windows alike; 1 gives all classes the same share. With the
    numbers comes each class's share before and after.
    """
    _, kind, count = np.unique(kinds, return_inverse=True, return_counts=True)
    weight = count[kind] ** -float(power)
    times = 2.0 * kinds.size * weight / weight.sum()
    # Rounded so that the sum is right: the n-th entry lies where the sum passes n.
    edges = np.round(np.concatenate([[0.0], np.cumsum(times)])).astype(int)
    chosen = np.repeat(np.arange(kinds.size), np.diff(edges))
    shares = np.stack(
        [count / kinds.size, np.bincount(kind[chosen]) / chosen.size], axis=-1
    )
    return chosen, shares


def cut(clips: Clips, start: Int[Array, ""], length: int) -> Motion:
    """The `length` frames from `start`, counted over all clips."""
    take = lambda x: jax.lax.dynamic_slice_in_dim(x, start, length)  # noqa: E731
    return Motion(
        root_position=take(clips.root_position),
        joint_rotation=take(clips.joint_rotation),
        fps=clips.fps,
    )


@functools.partial(jax.jit, static_argnames=("length",))
def _cut_all(clips: Clips, starts: Int[Array, " windows"], length: int) -> Motion:
    return jax.vmap(lambda start: cut(clips, start, length))(starts)


def sample_windows(
    key: Key, clips: Clips, index: WindowIndex, *, batch: int
) -> tuple[Motion, Int[Array, "{batch}"]]:
    """Windows [batch, length, ...], uniformly over all starts, and the clip of each."""
    chosen = jax.random.randint(key, (batch,), 0, index.starts.shape[0])
    windows = _cut_all(clips, index.starts[chosen], index.length)
    return windows, index.clips[chosen]


EVAL_WINDOW = 60


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True, kw_only=True, eq=False)
class EvalWindows:
    """Windows of real or generated motion with what was wanted of them.

    Attributes:
      motion: Windows of 60 frames, world.
      velocity: Wanted velocity in each frame, meters per second.
      facing: Wanted facing in each frame.
      label: Style of each window.
      group: Clip or rollout of each window.
    """

    motion: Motion
    velocity: Float[Array, "windows frames 2"]
    facing: Float[Array, "windows frames 2"]
    label: Int[Array, "windows"]
    group: Int[Array, "windows"]


def eval_windows(clips: Clips, *, stride: int, field: str) -> EvalWindows:
    """Windows of real clips; what is wanted is their own path, smoothed.

    The path is filtered with sigma 10 frames, as in training. Clips shorter than a
    window are left out. The label field `field` is the style.
    """
    index = window_index(clips, EVAL_WINDOW, stride=stride, short="skip")
    motion = _cut_all(clips, index.starts, EVAL_WINDOW)
    path = trajectory.root_trajectory(clips.skeleton, motion)
    matrix = trajectory.smoothing_matrices(EVAL_WINDOW, (10.0,))[0]
    position = trajectory.smooth(path.position, matrix)
    facing = trajectory.smooth(path.facing, matrix)
    return EvalWindows(
        motion=motion,
        velocity=jnp.asarray(jnp.gradient(position, axis=-2)) * clips.fps,
        facing=rotation.safe_normalize(facing, jnp.array([0.0, 1.0])),
        label=clips.labels[field][index.clips],
        group=index.clips,
    )


def check_ticks(ticks: int, *, fps: float, skip: int) -> None:
    """Raises a `ValueError`, with the length needed, unless rollouts are as long."""
    if ticks < skip + EVAL_WINDOW:
        raise ValueError(
            f"rollouts of {ticks / fps:g} s are too short to measure: expected at "
            f"least {(skip + EVAL_WINDOW) / fps:g} s ({skip} frames left out, "
            f"then windows of {EVAL_WINDOW})"
        )


def rollout_windows(
    frames: Any, labels: Int[Array, " characters"], *, skip: int
) -> EvalWindows:
    """Consecutive windows of the rollouts' frames [characters, ticks, ...].

    Their group is the character. The first `skip` ticks, where the data's own pose
    still shows, are left out; `ValueError` if no window remains.
    """
    motion = frames.motion
    characters, ticks = motion.root_position.shape[:2]
    check_ticks(ticks, fps=motion.fps, skip=skip)
    number = (ticks - skip) // EVAL_WINDOW

    def cut(x: Array) -> Array:
        x = x[:, skip : skip + number * EVAL_WINDOW]
        return x.reshape(characters * number, EVAL_WINDOW, *x.shape[2:])

    return EvalWindows(
        motion=jax.tree.map(cut, motion),
        velocity=cut(frames.desired_velocity),
        facing=cut(frames.desired_facing),
        label=jnp.repeat(labels, number),
        group=jnp.repeat(jnp.arange(characters), number),
    )
