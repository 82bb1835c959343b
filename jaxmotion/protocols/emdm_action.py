"""EMDM from actions, or from nothing: the data of a run, and its task."""

import dataclasses
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp

from jaxmotion.data import clips_io, selection
from jaxmotion.data.clips import Clips
from jaxmotion.protocols import emdm_data, emdm_runs
from jaxmotion.protocols.emdm_data import ActionArrays
from jaxmotion.systems import emdm, emdm_loss, emdm_motion
from jaxmotion.systems.emdm_motion import Representation
from jaxmotion.typing import Key

# Motions from which means and deviations of features are taken.
_FIT = 2048


@dataclasses.dataclass(frozen=True, kw_only=True)
class ActionRun:
    """Data of a run folder.

    Attributes:
      folder: The folder.
      config: JSON of how the data were made.
      clips: All clips, at the run's rate.
      train: Training clips on the device.
      held_out: Clips that no network saw.
      representation: Features of the skeleton's motions.
      field: Label field that is the action.
    """

    folder: Path
    config: dict[str, Any]
    clips: Clips
    train: ActionArrays
    held_out: ActionArrays
    representation: Representation
    field: str

    @property
    def actions(self) -> tuple[str, ...]:
        """Names of the actions."""
        return self.clips.names(self.field)


def load_run(folder: Path) -> ActionRun:
    """Loads the data of a run folder.

    Args:
      folder: Its path.

    Returns:
      The run.

    Raises:
      OSError: if the clips cannot be read.
      ValueError: if it is no run folder of EMDM with actions; names the field.
    """
    value = emdm_runs.read_config(folder)
    try:
        field, frames = value["field"], value["frames"]
        clips = clips_io.load_clips(folder / "data.npz")
        parts = selection.split_clips(
            clips, fraction=value["held_out"], seed=0, field=field
        )
        train, held_out = (
            emdm_data.action_arrays(part, field=field, frames=frames) for part in parts
        )
    except KeyError as error:
        raise ValueError(
            f"{folder / 'config.json'}: field {error} is missing: no run of actions"
        ) from error
    actions = jnp.arange(_FIT) % train.counts.shape[0]
    motions = emdm_data.sample_motions(jax.random.key(0), train, actions)
    return ActionRun(
        folder=folder,
        config=value,
        clips=clips,
        train=train,
        held_out=held_out,
        representation=emdm_motion.fit(clips.skeleton, motions),
        field=field,
    )


def make_task(
    run: ActionRun, base: emdm.Config, *, conditional: bool
) -> emdm_runs.Task:
    """What models of a run are trained on.

    Args:
      run: The run.
      base: Sizes and weights; features, frames and condition are set here.
      conditional: Motions from actions; else from nothing.

    Returns:
      The task.
    """
    number = len(run.actions) if conditional else 0
    representation = run.representation
    base = dataclasses.replace(
        base,
        features=representation.num_features,
        frames=run.train.frames,
        condition="action" if conditional else "none",
        condition_size=number,
    )

    def batch(key: Key, data: ActionArrays, size: int) -> emdm_loss.Batch:
        key_action, key_motion = jax.random.split(key)
        actions = jax.random.randint(key_action, (size,), 0, data.counts.shape[0])
        motions = emdm_data.sample_motions(key_motion, data, actions)
        return emdm_loss.Batch(
            x_0=emdm_motion.to_features(motions, representation),
            vector=emdm.action_vectors(actions, number),
            mask=jnp.ones((size, data.frames), bool),
        )

    return emdm_runs.Task(
        base=base,
        data=run.train,
        batch=batch,
        geometry=emdm_motion.geometry(representation, relative=base.geometry == "root"),
        source=run.folder / "data.npz",
        describe={
            "task": base.condition,
            "actions": list(run.actions),
            "source": run.clips.source,
            "fps": run.clips.fps,
        },
    )
