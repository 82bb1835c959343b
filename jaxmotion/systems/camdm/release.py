"""The columns of CAMDM's released evaluation: whole clips, and what was told as told.

Source: released code of CAMDM (Chen et al. 2024), Evaluation/; see
`evaluation.camdm_release` for what the columns are.
"""

import dataclasses
import functools
from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from jaxmotion.control.frame import Frame
from jaxmotion.data import windows
from jaxmotion.data.clips import Clips
from jaxmotion.evaluation import frechet, table
from jaxmotion.evaluators.style import StyleEvaluator, features_and_hits, in_batches
from jaxmotion.motion import facing, trajectory
from jaxmotion.motion.skeleton import Motion, Skeleton, joint_positions

Count = int | Int[Array, ""]

LOW = 0.01  # meters above the clip's lowest toe, exclusive
_TOES = ("lefttoebase", "righttoebase", "lefttoe", "righttoe")


def toe_joints(skeleton: Skeleton) -> tuple[int, ...]:
    """ToeBase and Toe of both sides, which the scripts look for; else the feet."""
    plain = facing.plain_names(skeleton)
    return tuple(plain.index(name) for name in _TOES if name in plain) or skeleton.feet


def _is_own(frames: Count, number: int) -> Bool[Array, " number"]:
    return jnp.arange(number) < frames


def _steps(positions: Float[Array, "frames *joints n"]) -> Float[Array, "..."]:
    return jnp.linalg.norm(jnp.diff(positions, axis=0), axis=-1)


def _pace(root: Float[Array, "frames 3"], frames: Count) -> Float[Array, ""]:
    """Mean horizontal step, meters a frame; the scripts' 1 cm for one at rest."""
    step = _steps(root[:, ::2])
    pace = jnp.mean(step, where=_is_own(frames - 1, len(step)))
    return jnp.where(pace == 0, 0.01, pace)


def foot_slide(
    toes: Float[Array, "frames toes 3"],
    root: Float[Array, "frames 3"],
    frames: Count | None = None,
) -> Float[Array, ""]:
    """Ratio without unit; a low toe in the last frame adds a step of zero."""
    frames = len(toes) if frames is None else frames
    own = _is_own(frames, len(toes))[:, None]
    height = jnp.where(own, toes[..., 1], jnp.inf)
    step = jnp.pad(_steps(toes[..., ::2]), ((0, 1), (0, 0)))
    step = jnp.where(_is_own(frames - 1, len(toes))[:, None], step, 0.0)
    slid = jnp.mean(step, where=height - jnp.min(height) < LOW)
    return slid / _pace(root, frames)


def coherence(
    positions: Float[Array, "frames joints 3"], frames: Count | None = None
) -> Float[Array, ""]:
    """Ratio without unit, near 1 for walking; joint 0 is the root."""
    frames = len(positions) if frames is None else frames
    step = _steps(positions)
    own = _is_own(frames - 1, len(step))[:, None]
    return jnp.mean(step, where=own) / _pace(positions[:, 0], frames)


def _mean_turn(a: Array, b: Array, frames: Count) -> Float[Array, ""]:
    """Size of the mean difference of the polar angles of vectors (x, z)."""
    polar = jnp.arctan2(a[:, 1], a[:, 0]) - jnp.arctan2(b[:, 1], b[:, 0])
    return jnp.abs(jnp.mean(polar, where=_is_own(frames, len(polar))))


def trajectory_error(
    told: Float[Array, "frames 2"],
    position: Float[Array, "frames 2"],
    frames: Count | None = None,
) -> Float[Array, ""]:
    """Mean turn of a root's steps (x, z) against the commanded velocities.

    Radians, lengths do not matter; frames at rest count, with the polar angle 0. The
    last command is not used.
    """
    frames = len(told) if frames is None else frames
    step = jnp.diff(position, axis=0)
    return _mean_turn(_mirrored(told[:-1]), _mirrored(step), frames - 1)


def _mirrored(vector: Float[Array, "frames 2"]) -> Float[Array, "frames 2"]:
    # Zero stays positive, for it decides between the angles 0 and pi.
    x, z = vector[:, 0], vector[:, 1]
    return jnp.stack([jnp.where(x == 0, 0.0, -x), z], axis=-1)


def orientation_error(
    told: Float[Array, "frames 2"],
    facing: Float[Array, "frames 2"],
    frames: Count | None = None,
) -> Float[Array, ""]:
    """Mean turn of facings (x, z) of any length against the commanded ones; radians."""
    return _mean_turn(told, facing, len(told) if frames is None else frames)


def clip_metrics(
    skeleton: Skeleton,
    motion: Motion,
    frames: Count | None = None,
    command: trajectory.Command | None = None,
) -> dict[str, Float[Array, ""]]:
    """Slide and coherence of one clip, which `jax.vmap` maps over padded ones.

    With a command trajectory, and orientation if the skeleton has shoulders (found by
    name); radians.

    The motion [frames, ...] is in the world, meters; the first `frames` are the clip's
    own (None: all); the command is that of each frame, unsmoothed.
    """
    positions = joint_positions(skeleton, motion)
    root, toes = positions[:, 0], positions[:, jnp.array(toe_joints(skeleton))]
    found = {
        "slide": foot_slide(toes, root, frames),
        "coherence": coherence(positions, frames),
    }
    if command is None:
        return found
    found["trajectory"] = trajectory_error(command.velocity, root[:, ::2], frames)
    if facing.shoulder_joints(skeleton) is not None:
        faced = facing.body_facing(skeleton, positions)
        found["orientation"] = orientation_error(command.facing, faced, frames)
    return found


class Groups(NamedTuple):
    """Rows of groups, padded to the most; `count` says how many are a group's own."""

    rows: Float[Array, "groups most features"]
    count: Int[Array, " groups"]


def in_groups(
    features: Float[np.ndarray, "rows features"],
    groups: Int[np.ndarray, " rows"],
    number: int,
) -> Groups:
    """Sorts rows into groups 0 .. number - 1; on the host."""
    groups = np.asarray(groups)
    count = np.bincount(groups, minlength=number)
    rows = np.zeros((number, count.max(), features.shape[-1]), np.float32)
    for group in range(number):
        rows[group, : count[group]] = features[groups == group]
    return Groups(rows=jnp.asarray(rows), count=jnp.asarray(count))


@jax.jit
def frechet_distances(
    clips: Groups, styles: Groups, label: Int[Array, " clips"]
) -> Float[Array, " clips"]:
    """Fréchet distance of each clip to its style, divided by the features' number.

    A clip has few windows, which makes its distance large: compare clips of one length.
    Squared units of the features; NaN where either has fewer than two windows.
    """

    def of_one(x: tuple[Groups, Array]) -> Array:
        clip, label = x
        style = Groups(rows=styles.rows[label], count=styles.count[label])
        return frechet.frechet_distance_of_rows(*clip, *style)

    return jax.lax.map(of_one, (clips, label)) / clips.rows.shape[-1]


COLUMNS = {
    "slide": ("slide_camdm_release", 1.0),
    "coherence": ("coherence_camdm_release", 1.0),
    "trajectory": ("trajectory_camdm_release", 180.0 / np.pi),
    "orientation": ("orientation_camdm_release", 180.0 / np.pi),
    "fid": ("fid_camdm_release", 1.0),
}


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True, kw_only=True, eq=False)
class Recordings:
    """Whole clips, padded with their last pose to the length of the longest.

    Attributes:
      motion: [recordings, frames, ...], world.
      frames: That are each one's own.
      label: Style of each.
      command: Told in each frame; None where nobody steered.
      windows: Windows of 60 frames, one after the other from the first on; `group` is
        the recording.
    """

    motion: Motion
    frames: Int[Array, " recordings"]
    label: Int[Array, " recordings"]
    command: trajectory.Command | None
    windows: windows.EvalWindows


def of_clips(clips: Clips, *, field: str) -> Recordings:
    """Real clips, whose style is the label `field`."""
    offsets = np.asarray(clips.offsets)
    frames = np.diff(offsets)
    place = np.minimum(np.arange(frames.max()), frames[:, None] - 1)
    place = offsets[:-1, None] + place
    return Recordings(
        motion=Motion(
            root_position=clips.root_position[place],
            joint_rotation=clips.joint_rotation[place],
            fps=clips.fps,
        ),
        frames=jnp.asarray(frames),
        label=clips.labels[field],
        command=None,
        windows=windows.eval_windows(clips, stride=windows.EVAL_WINDOW, field=field),
    )


def of_rollouts(frames: Frame, commands: trajectory.Command) -> Recordings:
    """Rollouts from their first frame on, with the commands that steered them.

    Each one's style is that of its first command.
    """
    characters, ticks = commands.label.shape
    label = commands.label[:, 0]
    return Recordings(
        motion=frames.motion,
        frames=jnp.full(characters, ticks),
        label=label,
        command=commands,
        windows=windows.rollout_windows(frames, label, skip=0),
    )


def style_features(
    skeleton: Skeleton, clips: Clips, evaluator: StyleEvaluator, *, field: str
) -> Groups:
    """Features of the training clips by style: what Fréchet distances are taken to."""
    found = windows.eval_windows(clips, stride=windows.EVAL_WINDOW, field=field)
    features, _ = features_and_hits(skeleton, found, evaluator)
    number = len(clips.names(field))
    return in_groups(features, np.asarray(found.label), number)


@jax.jit
def _metrics(skeleton: Skeleton, x: tuple) -> dict[str, Array]:
    return jax.vmap(functools.partial(clip_metrics, skeleton))(*x)


def metrics(skeleton: Skeleton, found: Recordings) -> dict[str, np.ndarray]:
    """`camdm_release.clip_metrics` of each recording."""
    run = functools.partial(_metrics, skeleton)
    return in_batches(run, (found.motion, found.frames, found.command), size=16)


def distances(
    skeleton: Skeleton,
    found: Recordings,
    evaluator: StyleEvaluator,
    styles: Groups,
) -> np.ndarray:
    """Fréchet distance of each recording to its style; NaN for a single window."""
    features, _ = features_and_hits(skeleton, found.windows, evaluator)
    groups = in_groups(features, np.asarray(found.windows.group), found.label.size)
    return np.asarray(frechet_distances(groups, styles, found.label))


def row(
    values: dict[str, np.ndarray], group: np.ndarray | None = None
) -> dict[str, table.Cell]:
    """Columns, with intervals over recordings or groups of them; angles in degrees.

    Values are those of `metrics`, and "fid" of `distances`; what is not a number is
    left out, as the scripts do. A group is such as a replication; None for each by
    itself.
    """
    found = {}
    for name, (column, scale) in COLUMNS.items():
        if name in values:
            known = np.isfinite(values[name])
            own = np.arange(known.size) if group is None else group
            means = jnp.zeros(0)
            if known.any():
                means = table.group_means(values[name][known], own[known])
            found[column] = table.cell(means, scale=scale)
    return found
