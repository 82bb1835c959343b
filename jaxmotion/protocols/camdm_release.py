"""The columns of CAMDM's released evaluation: whole clips, and what was told as told.

Source: released code of CAMDM (Chen et al. 2024), Evaluation/; see
`evaluation.camdm_release` for what the columns are.
"""

import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Int

from jaxmotion.data.clips import Clips
from jaxmotion.evaluation import camdm_release, table
from jaxmotion.motion import skeleton, trajectory
from jaxmotion.protocols import camdm as protocol
from jaxmotion.protocols.camdm_styles import Recognized, in_batches, recognized
from jaxmotion.systems import camdm_control

COLUMNS = {
    "slide": ("slide_camdm_release", 1.0),
    "coherence": ("coherence_camdm_release", 1.0),
    "trajectory": ("trajectory_camdm_release_deg", 180.0 / np.pi),
    "orientation": ("orientation_camdm_release_deg", 180.0 / np.pi),
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
      windows: Of 60 frames, one behind the other from the first on; `group` is the
        recording.
    """

    motion: skeleton.Motion
    frames: Int[Array, " recordings"]
    label: Int[Array, " recordings"]
    command: trajectory.Command | None
    windows: protocol.Windows


def of_clips(clips: Clips, *, field: str) -> Recordings:
    """Real clips, whose style is the label `field`."""
    offsets = np.asarray(clips.offsets)
    frames = np.diff(offsets)
    place = np.minimum(np.arange(frames.max()), frames[:, None] - 1)
    place = offsets[:-1, None] + place
    return Recordings(
        motion=skeleton.Motion(
            root_position=clips.root_position[place],
            joint_rotation=clips.joint_rotation[place],
            fps=clips.fps,
        ),
        frames=jnp.asarray(frames),
        label=clips.labels[field],
        command=None,
        windows=protocol.data_windows(clips, stride=protocol.WINDOW, field=field),
    )


def of_rollouts(
    frames: camdm_control.Frame, commands: trajectory.Command, *, fps: float
) -> Recordings:
    """Rollouts from their first frame on, with the commands that steered them.

    Each one's style is that of its first command.
    """
    characters, ticks = commands.label.shape
    label = commands.label[:, 0]
    return Recordings(
        motion=skeleton.Motion(
            root_position=frames.root_position,
            joint_rotation=frames.joint_rotation,
            fps=fps,
        ),
        frames=jnp.full(characters, ticks),
        label=label,
        command=commands,
        windows=protocol.rollout_windows(frames, label, fps=fps, skip=0),
    )


def style_features(
    bones: skeleton.Skeleton, clips: Clips, recognizer: Recognized, *, field: str
) -> camdm_release.Groups:
    """Features of the training clips by style: what Fréchet distances are taken to."""
    found = protocol.data_windows(clips, stride=protocol.WINDOW, field=field)
    features, _ = recognized(bones, found, recognizer)
    number = len(clips.names(field))
    return camdm_release.in_groups(features, np.asarray(found.label), number)


@jax.jit
def _metrics(bones: skeleton.Skeleton, x: tuple) -> dict[str, Array]:
    return jax.vmap(functools.partial(camdm_release.clip_metrics, bones))(*x)


def metrics(bones: skeleton.Skeleton, found: Recordings) -> dict[str, np.ndarray]:
    """`camdm_release.clip_metrics` of each recording."""
    run = functools.partial(_metrics, bones)
    return in_batches(run, (found.motion, found.frames, found.command), size=16)


def distances(
    bones: skeleton.Skeleton,
    found: Recordings,
    recognizer: Recognized,
    styles: camdm_release.Groups,
) -> np.ndarray:
    """Fréchet distance of each recording to its style; NaN for a single window."""
    features, _ = recognized(bones, found.windows, recognizer)
    groups = camdm_release.in_groups(
        features, np.asarray(found.windows.group), found.label.size
    )
    return np.asarray(camdm_release.frechet_distances(groups, styles, found.label))


def row(
    values: dict[str, np.ndarray], group: np.ndarray | None = None
) -> dict[str, table.Cell]:
    """Columns of the table, with intervals over recordings or groups of them.

    Args:
      values: From `metrics`, and "fid" from `distances`; those that are not numbers
        are left out, as the scripts do.
      group: Of each recording, such as its replication; None for each on its own.

    Returns:
      Columns; angles in degrees.
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
