"""Ragged clips of one skeleton as flat arrays.

The frames of all clips are concatenated; clip c is frames
`offsets[c]:offsets[c + 1]`. That is one array to put on a device, from which windows
are gathered inside jit.
"""

import dataclasses
from collections.abc import Mapping, Sequence

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from jaxmotion.motion.skeleton import Motion, Skeleton, joint_positions


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True, kw_only=True, eq=False)
class Clips:
    """Ragged clips with labels.

    Attributes:
      root_position: World position of the root in every frame, meters, y up.
      joint_rotation: Parent-local rotations, two columns each.
      offsets: First frame of each clip, and the number of frames at the end.
      labels: One integer a clip for each label field ("style", "content", ...).
      label_names: For each label field, the name of each integer.
      source: Where the data came from and its license, for tables and cards.
    """

    root_position: Float[Array, "frames 3"]
    joint_rotation: Float[Array, "frames joints 6"]
    offsets: Int[Array, "boundaries"]
    labels: dict[str, Int[Array, "clips"]]
    skeleton: Skeleton
    fps: float = jax.tree.static(default=30.0)
    label_names: tuple[tuple[str, tuple[str, ...]], ...] = jax.tree.static(default=())
    clip_names: tuple[str, ...] = jax.tree.static(default=())
    source: str = jax.tree.static(default="")

    @property
    def titles(self) -> tuple[str, ...]:
        """Names of the clips; their numbers where they have none."""
        return self.clip_names or tuple(f"clip {i}" for i in range(self.num_clips))

    @property
    def num_clips(self) -> int:
        """Number of clips."""
        return self.offsets.shape[0] - 1

    @property
    def num_frames(self) -> int:
        """Number of frames of all clips together."""
        return self.root_position.shape[0]

    def names(self, field: str) -> tuple[str, ...]:
        """Names of a field such as "style"; a `ValueError` says which there are."""
        fields = dict(self.label_names)
        if field not in fields:
            raise ValueError(
                f"unknown label field {field!r}: the clips have {', '.join(fields)}"
            )
        return fields[field]


def check_skeletons(
    skeletons: Sequence[Skeleton], names: Sequence[str], tolerance: float
) -> None:
    """Raises unless all skeletons have the first one's joints and bones.

    Offsets may differ by the tolerance, meters; a `ValueError` names two clips and the
    joint.
    """
    first = skeletons[0]
    offsets = np.asarray(first.offsets)
    for name, other in zip(names, skeletons, strict=True):
        pair = f"clips {names[0]!r} and {name!r} have different skeletons"
        for field in ("names", "parents", "feet"):
            expected, found = getattr(first, field), getattr(other, field)
            if expected != found:
                raise ValueError(f"{pair}: {field} {expected} and {found}")
        change = np.abs(np.asarray(other.offsets) - offsets).max(axis=-1)
        if change.max() > tolerance:
            joint = int(change.argmax())
            raise ValueError(
                f"{pair}: the offset of joint {first.names[joint]!r} differs by "
                f"{change[joint]:.4g} m, more than {tolerance:g} m"
            )


def _check_motions(
    motions: Sequence[Motion], names: Sequence[str], num_joints: int
) -> None:
    """Raises unless all motions have frames, finite values and the first's rate."""
    for name, motion in zip(names, motions, strict=True):
        shape = motion.joint_rotation.shape
        if motion.root_position.ndim != 2 or shape[0] == 0:
            raise ValueError(f"clip {name!r} is not one clip with frames: {shape}")
        if shape[1] != num_joints:
            raise ValueError(
                f"clip {name!r} has {shape[1]} joints, the skeleton {num_joints}"
            )
        if motion.fps != motions[0].fps:
            raise ValueError(
                f"clips {names[0]!r} and {name!r} have different rates: "
                f"{motions[0].fps:g} and {motion.fps:g} frames per second"
            )
        for field in ("root_position", "joint_rotation"):
            finite = np.isfinite(np.asarray(getattr(motion, field)))
            if not finite.all():
                frame = int(np.argwhere(~finite)[0, 0])
                raise ValueError(f"clip {name!r}: {field} of frame {frame} is NaN")


def clips_from_motions(
    motions: Sequence[Motion],
    skeletons: Skeleton | Sequence[Skeleton],
    *,
    names: Sequence[str],
    labels: Mapping[str, Sequence[str]],
    label_names: Mapping[str, Sequence[str]] | None = None,
    source: str = "",
    tolerance: float = 1e-3,
) -> Clips:
    """Concatenates motions of one skeleton.

    Args:
      skeletons: The skeleton of all clips, or one a clip; then their mean is kept.
      labels: For each label field, the label of each clip in words.
      label_names: Order of the words of a field; by default those that occur, sorted.
      source: Where the data came from and its license.
      tolerance: Largest difference between the offsets of two skeletons, meters.

    Raises:
      ValueError: if there is no clip, the numbers of clips, names and labels differ,
        two skeletons or rates differ (names both clips), a value is not finite, or a
        label is not among `label_names`.
    """
    if not motions:
        raise ValueError("no clips: at least one motion is needed")
    per_clip = [skeletons] if isinstance(skeletons, Skeleton) else list(skeletons)
    if isinstance(skeletons, Skeleton):
        per_clip = per_clip * len(motions)
    for what, values in {"skeletons": per_clip, "names": names, **labels}.items():
        if len(values) != len(motions):
            raise ValueError(f"{len(values)} {what} for {len(motions)} motions")
    check_skeletons(per_clip, names, tolerance)
    _check_motions(motions, names, per_clip[0].num_joints)
    words = {
        field: tuple((label_names or {}).get(field, sorted(set(values))))
        for field, values in labels.items()
    }
    lengths = [motion.root_position.shape[0] for motion in motions]
    mean_offsets = np.mean([np.asarray(s.offsets, np.float64) for s in per_clip], 0)
    return Clips(
        root_position=_join([motion.root_position for motion in motions]),
        joint_rotation=_join([motion.joint_rotation for motion in motions]),
        offsets=jax.device_put(np.cumsum([0, *lengths], dtype=np.int32)),
        labels={
            field: _label_numbers(field, values, words[field], names)
            for field, values in labels.items()
        },
        skeleton=dataclasses.replace(
            per_clip[0], offsets=jnp.asarray(mean_offsets, jnp.float32)
        ),
        fps=float(motions[0].fps),
        label_names=tuple(words.items()),
        clip_names=tuple(names),
        source=source,
    )


def _label_numbers(
    field: str, values: Sequence[str], words: tuple[str, ...], names: Sequence[str]
) -> Array:
    """Number of each clip's label among the words."""
    for name, value in zip(names, values, strict=True):
        if value not in words:
            raise ValueError(
                f"clip {name!r}: unknown {field} {value!r}, expected one of "
                f"{', '.join(words)}"
            )
    return jax.device_put(np.array([words.index(value) for value in values], np.int32))


def _join(arrays: Sequence[Array]) -> Array:
    """Concatenates on the host: thousands of device arrays would compile for ever."""
    return jax.device_put(np.concatenate([np.asarray(array) for array in arrays]))


def clip_motion(clips: Clips, index: int) -> Motion:
    """One clip as a motion; `ValueError` if there is no such clip."""
    if not 0 <= index < clips.num_clips:
        raise ValueError(f"clip {index} of {clips.num_clips}: expected 0 <= index")
    start, stop = (int(frame) for frame in clips.offsets[index : index + 2])
    return Motion(
        root_position=clips.root_position[start:stop],
        joint_rotation=clips.joint_rotation[start:stop],
        fps=clips.fps,
    )


def take_clips(clips: Clips, indices: Sequence[int] | np.ndarray) -> Clips:
    """The clips of those numbers, in that order, with all label names.

    `ValueError` if there is no such clip, or none is asked for.
    """
    indices = np.asarray(indices, np.int64)
    if indices.size == 0:
        raise ValueError("no clips are left: the selection is empty")
    if indices.min() < 0 or indices.max() >= clips.num_clips:
        raise ValueError(
            f"clip numbers {indices.min()}..{indices.max()} are not all in "
            f"0..{clips.num_clips - 1}"
        )
    offsets = np.asarray(clips.offsets)
    return stretches(
        clips,
        indices,
        offsets[indices],
        np.diff(offsets)[indices],
        names=tuple(clips.titles[i] for i in indices),
    )


def stretches(
    clips: Clips,
    owners: Int[np.ndarray, " stretches"],
    firsts: Int[np.ndarray, " stretches"],
    lengths: Int[np.ndarray, " stretches"],
    *,
    names: tuple[str, ...],
) -> Clips:
    """Stretches of frames, each as one clip with the labels of the clip it is from.

    A stretch is its clip's number and its first frame, counted over all clips.
    """
    frames = np.concatenate(
        [np.arange(a, a + n) for a, n in zip(firsts, lengths, strict=True)]
    )
    return dataclasses.replace(
        clips,
        root_position=jax.device_put(np.asarray(clips.root_position)[frames]),
        joint_rotation=jax.device_put(np.asarray(clips.joint_rotation)[frames]),
        offsets=jax.device_put(np.cumsum([0, *lengths], dtype=np.int32)),
        labels={
            field: jax.device_put(np.asarray(values)[owners])
            for field, values in clips.labels.items()
        },
        clip_names=names,
    )


# Frames at a time.
_BLOCK = 4096


def all_joints(clips: Clips) -> Float[np.ndarray, "frames joints 3"]:
    """World positions in all frames, block by block: one shape, compiled once."""
    extra = -clips.num_frames % _BLOCK
    root = np.pad(np.asarray(clips.root_position), ((0, extra), (0, 0)), "edge")
    turns = np.asarray(clips.joint_rotation)
    turns = np.pad(turns, ((0, extra), (0, 0), (0, 0)), "edge")
    place = jax.jit(joint_positions)
    found = [
        place(
            clips.skeleton,
            Motion(
                root_position=jnp.asarray(root[a : a + _BLOCK]),
                joint_rotation=jnp.asarray(turns[a : a + _BLOCK]),
                fps=clips.fps,
            ),
        )
        for a in range(0, len(root), _BLOCK)
    ]
    return np.concatenate(found)[: clips.num_frames].astype(np.float64)


def toe_height(clips: Clips, *, every: int = 1) -> float:
    """Where toes rest, meters: the first percentile of the feet's heights.

    Of one in `every` frames. `ValueError` if the skeleton names no feet.
    """
    if not clips.skeleton.feet:
        raise ValueError("the skeleton names no feet")
    some = Motion(
        root_position=clips.root_position[::every],
        joint_rotation=clips.joint_rotation[::every],
        fps=clips.fps,
    )
    places = jax.jit(joint_positions)(clips.skeleton, some)
    return float(np.percentile(places[:, jnp.array(clips.skeleton.feet), 1], 1))


def measured_toes(clips: Clips) -> float | None:
    """What a model of these clips knows of `toe_height`: of 10,000 frames, about.

    None where the skeleton names no feet.
    """
    every = max(clips.num_frames // 10_000, 1)
    return toe_height(clips, every=every) if clips.skeleton.feet else None
