"""What the evaluation scripts of CAMDM's release compute, to be set beside its tables.

They differ from the definitions of its paper (`alignment`, `contact`, `smoothness`):

* "foot sliding" is the mean horizontal step of low toes divided by that of the root,
  and low is within a centimetre of the *clip's own* lowest toe: a floating clip scores
  as if it stood;
* "coherence", the table's acceleration, is the mean step of all joints divided by the
  root's horizontal one: no second difference is taken;
* errors of direction and facing are differences of polar angles that are not wrapped,
  and the size of their mean: left and right cancel, and a step across the cut counts
  as a turn. Directions have their cut at +x, since the scripts mirror x for them, and
  facings at -x;
* facing is that of hips and shoulders; what was wanted is the preset, unsmoothed;
* Fréchet distances are each clip's own, to its style, divided by the features' number.

All are of whole clips. Clips of different lengths may be padded: `frames` says how many
are a clip's own.

Source: released code of CAMDM (Chen et al. 2024), Evaluation/.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from jaxmotion.evaluation import frechet
from jaxmotion.motion import facing, skeleton, trajectory

Count = int | Int[Array, ""]

LOW = 0.01  # metres above the clip's lowest toe, exclusive
_TOES = ("lefttoebase", "righttoebase", "lefttoe", "righttoe")


def toe_joints(bones: skeleton.Skeleton) -> tuple[int, ...]:
    """ToeBase and Toe of both sides, which the scripts look for; else the feet."""
    plain = facing.plain_names(bones)
    return tuple(plain.index(name) for name in _TOES if name in plain) or bones.feet


def _is_own(frames: Count, number: int) -> Bool[Array, " number"]:
    return jnp.arange(number) < frames


def _steps(positions: Float[Array, "frames *joints n"]) -> Float[Array, "..."]:
    return jnp.linalg.norm(jnp.diff(positions, axis=0), axis=-1)


def _pace(root: Float[Array, "frames 3"], frames: Count) -> Float[Array, ""]:
    """Mean horizontal step, metres a frame; the scripts' 1 cm for one at rest."""
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
    """Of the steps of a root (x, z) against commanded velocities of any length.

    Radians; frames at rest count, with the polar angle 0. The last command is not used.
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
    """Of facings (x, z) of any length against the commanded ones; radians."""
    return _mean_turn(told, facing, len(told) if frames is None else frames)


def clip_metrics(
    bones: skeleton.Skeleton,
    motion: skeleton.Motion,
    frames: Count | None = None,
    command: trajectory.Command | None = None,
) -> dict[str, Float[Array, ""]]:
    """All of one clip, which `jax.vmap` maps over padded ones.

    Args:
      bones: Its shoulders are found by name.
      motion: [frames, ...], world, metres.
      frames: That are the clip's own; None for all.
      command: Told in each frame, unsmoothed; None for clips that nobody steered.

    Returns:
      slide and coherence, and with a command trajectory, and orientation if the
      skeleton has shoulders; radians.
    """
    positions = skeleton.joint_positions(bones, motion)
    root, toes = positions[:, 0], positions[:, jnp.array(toe_joints(bones))]
    found = {
        "slide": foot_slide(toes, root, frames),
        "coherence": coherence(positions, frames),
    }
    if command is None:
        return found
    found["trajectory"] = trajectory_error(command.velocity, root[:, ::2], frames)
    if facing.shoulder_joints(bones) is not None:
        faced = facing.body_facing(bones, positions)
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

    Args:
      clips: Features of windows, by clip.
      styles: The same of the reference, by style.
      label: Style of each clip.

    Returns:
      Squared units of the features; NaN where either has fewer than two windows.
    """

    def of_one(x: tuple[Groups, Array]) -> Array:
        clip, label = x
        style = Groups(rows=styles.rows[label], count=styles.count[label])
        return frechet.frechet_distance_of_rows(*clip, *style)

    return jax.lax.map(of_one, (clips, label)) / clips.rows.shape[-1]
