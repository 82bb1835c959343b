"""Gaits that go on: strides of recorded takes that end as they begin, repeated.

People are recorded in rooms, where nobody runs on for long. A model that sees only
such takes learns that runners are about to stop, and steering has to hold against it
in every frame.
"""

import dataclasses

import jax.numpy as jnp
import numpy as np
from jaxtyping import Float
from scipy.ndimage import uniform_filter1d
from scipy.spatial.transform import Rotation

from jaxmotion.data import resample, selection
from jaxmotion.data.clips import Clips, all_joints, clip_motion, clips_from_motions
from jaxmotion.motion import rotation
from jaxmotion.motion.facing import hip_facing
from jaxmotion.motion.skeleton import Motion

# Lengths of one stride or two, and the ends of a clip that are left, seconds.
_LENGTHS, _ENDS = (0.53, 1.65), 0.25
# What the last frame may differ from the first: joints (root mean square over them,
# meters, velocities over so many seconds), speed (part), turn (radians per second).
_DIFFERENCE, _AHEAD, _GAIN, _TURN = 0.065, 0.12, 0.06, 0.525
# Slowest jog, meters per second; strides of one clip begin so far apart, seconds, and
# are at most so many.
_SLOWEST, _APART, _MOST = 1.9, 0.3, 10
# Rates of the copies, and the least speed that a copy of that rate has then.
_RATES = ((0.85, 2.4), (1.0, 2.0), (1.12, 2.7), (1.24, 2.7))
# Fastest copies: meters per second, strides per second.
_FASTEST, _CADENCE = 4.1, 1.85
# Speeds from one to the next, and above the last, are shown for as long; m/s. Speed is
# that of the root, averaged over so many seconds.
_BANDS, _AVERAGED = (2.0, 2.5, 3.0, 3.5), 0.68


@dataclasses.dataclass(frozen=True, kw_only=True)
class Stride:
    """Frames of a motion; the one after the last is like the first.

    Attributes:
      start: The first.
      frames: How many, of one stride or two.
      turn: Yaw from the first to the one after the last, radians.
      speed: Mean speed of the root, meters per second.
      difference: Between the first frame and the one after the last: root mean square
        over joints and their velocities over 0.12 s, in the axes of the hips, meters.
    """

    start: int
    frames: int
    turn: float
    speed: float
    difference: float


def find_strides(
    joints: Float[np.ndarray, "frames joints 3"],
    facing: Float[np.ndarray, "frames 2"],
    *,
    fps: float,
) -> list[Stride]:
    """Strides at 1.9 m/s and more that end as they begin, those most alike first.

    At most ten, which begin 0.3 s apart or more; speed hardly changes in them, and they
    turn by at most 30 degrees per second. Joints in the world, the root first, and
    facings of the hips, as unit vectors.
    """
    low, high = (round(s * fps) for s in _LENGTHS)
    margin = round(_ENDS * fps)
    first = np.arange(margin, len(joints) - margin - high)
    if not first.size:
        return []
    yaw = np.unwrap(np.arctan2(facing[:, 0], facing[:, 1]))
    speed = _speeds(joints, fps)
    sides = np.stack([facing[:, ::-1] * [1, -1], facing], axis=1)

    def of_hips(x: np.ndarray) -> np.ndarray:
        planar = np.einsum("fij,fkj->fki", sides, x[..., ::2])
        return np.concatenate([planar, x[..., 1:2]], axis=-1).reshape(len(x), -1)

    above = joints - joints[:, :1] * [1.0, 0.0, 1.0]
    velocity = np.gradient(joints, axis=0) * fps
    state = np.concatenate([of_hips(above), _AHEAD * of_hips(velocity)], axis=1)
    found = []
    for frames in range(low, high + 1):
        last = first + frames
        steady = np.abs(speed[last] / np.maximum(speed[first], 1e-6) - 1.0) <= _GAIN
        turned = np.abs(yaw[last] - yaw[first]) <= _TURN * frames / fps
        for start in first[steady & turned & (speed[first] >= _SLOWEST)].tolist():
            part, gap = (
                speed[start : start + frames],
                state[start + frames] - state[start],
            )
            difference = float(np.sqrt(3.0 * np.mean(gap**2)))
            if difference <= _DIFFERENCE and part.min() >= 0.95 * _SLOWEST:
                stride = Stride(
                    start=start,
                    frames=frames,
                    turn=float(yaw[start + frames] - yaw[start]),
                    speed=float(part.mean()),
                    difference=difference,
                )
                found.append(stride)
    kept: list[Stride] = []
    for stride in sorted(found, key=lambda x: (x.difference, x.start, x.frames)):
        apart = all(abs(stride.start - x.start) > _APART * fps for x in kept)
        if apart and len(kept) < _MOST:
            kept.append(stride)
    return kept


def repeat_stride(motion: Motion, stride: Stride, *, frames: int) -> Motion:
    """So many frames of a motion's stride again and again, from the origin on.

    Each goes on where the one before ended, and turns on as it turned. What the ends
    still differ in is spread over the stride.
    """
    part = slice(stride.start, stride.start + stride.frames + 1)
    position = np.array(motion.root_position[part], np.float64)
    rot6d = motion.joint_rotation[part]
    local = np.asarray(rotation.matrix_from_rot6d(rot6d), np.float64)
    last = local[-1].copy()
    last[0] = _about_up(-stride.turn) @ last[0]
    left = Rotation.from_matrix(np.swapaxes(local[0], -1, -2) @ last).as_rotvec()
    share = np.arange(stride.frames + 1) / stride.frames - 0.5
    spread = Rotation.from_rotvec((-share[:, None, None] * left).reshape(-1, 3))
    local = local @ spread.as_matrix().reshape(local.shape)
    position[:, 1] -= share * (position[-1, 1] - position[0, 1])
    step = (position[-1] - position[0]) * [1.0, 0.0, 1.0]
    again = -(-frames // stride.frames)
    turns = np.stack([_about_up(k * stride.turn) for k in range(again)])
    begins = np.cumsum(turns @ step, axis=0) - turns @ step
    around = position[:-1] - position[0] * [1.0, 0.0, 1.0]
    moved = np.einsum("kij,fj->kfi", turns, around) + begins[:, None]
    turned = np.repeat(local[None, :-1], again, axis=0)
    turned[:, :, 0] = np.einsum("kij,fjl->kfil", turns, local[:-1, 0])
    joints = turned.reshape(-1, *local.shape[1:])[:frames]
    return Motion(
        root_position=jnp.asarray(moved.reshape(-1, 3)[:frames], jnp.float32),
        joint_rotation=rotation.rot6d_from_matrix(jnp.asarray(joints, jnp.float32)),
        fps=motion.fps,
    )


def _speeds(
    joints: Float[np.ndarray, "frames joints 3"], fps: float
) -> Float[np.ndarray, " frames"]:
    """Averaged speed of the root, meters per second."""
    root = uniform_filter1d(joints[:, 0, ::2], round(_AVERAGED * fps), axis=0)
    return np.linalg.norm(np.gradient(root, axis=0), axis=1) * fps


def _cadence(stride: Stride, fps: float) -> float:
    """Strides per second."""
    return (1 if stride.frames < 0.93 * fps else 2) / stride.frames * fps


def _about_up(yaw: float) -> Float[np.ndarray, "3 3"]:
    return Rotation.from_rotvec([0.0, yaw, 0.0]).as_matrix()


def with_loops(clips: Clips, *, seconds: float, held_out: float = 0.1) -> Clips:
    """The clips, and strides of theirs repeated, slower and faster, too.

    Each half of a meter per second from 2 m/s to 4.1 is then to be learned from for so
    many seconds, its loops as long as each other; one of which the clips have as much
    gets none. Learned from is what is left of a clip when the last part of it is held
    out, and the second before that; strides come from there, and loops are learned from
    whole. A loop has its clip's labels, and its name followed by the loop's number and
    rate: "Run1_loop3x1.12". Copies at 0.85, 1.12 and 1.24 times the speed are made
    where people still move so: of runs, up to 4.1 m/s and 1.85 strides per second.

    `ValueError` if no clip has such a stride, nothing is to be added, or a hip joint is
    missing.
    """
    fps, joints = clips.fps, np.asarray(all_joints(clips), np.float64)
    facing = np.asarray(hip_facing(clips.skeleton, clips.joint_rotation), np.float64)
    offsets, found = np.asarray(clips.offsets), []
    missing = np.full(len(_BANDS), seconds * fps)
    for clip, (start, stop) in enumerate(zip(offsets[:-1], offsets[1:], strict=True)):
        kept = int((stop - start) * (1.0 - held_out)) - round(fps)
        if kept <= 1:
            continue
        part = slice(start, start + kept)
        missing -= np.histogram(_speeds(joints[part], fps), (*_BANDS, np.inf))[0]
        strides = find_strides(joints[part], facing[part], fps=fps)
        found += [(stride.speed, clip, stride) for stride in strides]
    if not found:
        raise ValueError(
            f"no clip has a stride at {_SLOWEST:g} m/s or more that ends as it begins"
        )
    found.sort(key=lambda x: (x[0], x[1], x[2].start))
    copies = [
        (number, rate, np.searchsorted(_BANDS, rate * speed, side="right") - 1)
        for number, (speed, _, stride) in enumerate(found)
        for rate, least in _RATES
        if rate * _cadence(stride, fps) <= _CADENCE
        and least <= rate * speed <= _FASTEST
    ]
    made = np.bincount([band for _, _, band in copies], minlength=len(_BANDS))
    each = np.round(missing / np.maximum(made, 1))
    lengths = np.where((made > 0) & (missing > 0), each, 0)
    if not lengths.any():
        raise ValueError(
            f"nothing to add: the clips show each speed for {seconds:g} s already"
        )
    motions, names, whose = [], [], []
    for number, rate, band in copies:
        _, clip, stride = found[number]
        length = int(lengths[band])
        if not length:
            continue
        longer = repeat_stride(
            clip_motion(clips, clip), stride, frames=int(length * rate) + 2
        )
        motion = resample.resample(dataclasses.replace(longer, fps=fps * rate), fps)
        motions.append(
            dataclasses.replace(
                motion,
                root_position=motion.root_position[:length],
                joint_rotation=motion.joint_rotation[:length],
            )
        )
        names.append(f"{clips.clip_names[clip]}_loop{number}x{rate:g}")
        whose.append(clip)
    loops = clips_from_motions(
        motions,
        clips.skeleton,
        names=names,
        labels={
            field: [words[i] for i in np.asarray(clips.labels[field])[whose]]
            for field, words in clips.label_names
        },
        label_names=dict(clips.label_names),
        source=clips.source,
    )
    return selection.concatenate([clips, loops])
