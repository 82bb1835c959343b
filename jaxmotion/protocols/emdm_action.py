"""EMDM from actions, or from nothing: its task, and what its motions are scored with.

Every set that is scored, real or generated, has the same number of motions with actions
drawn uniformly, and goes through one recogniser that was trained on real motions only.

Source: Zhou et al. 2024 (EMDM), section 4.3; the evaluation of Guo et al. 2020
(Action2Motion) with uniform actions.
"""

import dataclasses
from collections.abc import Callable
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from jaxmotion.data import clips_io, selection
from jaxmotion.data.clips import Clips
from jaxmotion.evaluation import contact, diversity, frechet, plausibility, smoothness
from jaxmotion.learning import action_recognition as recognition
from jaxmotion.learning import checkpoint
from jaxmotion.motion import skeleton
from jaxmotion.protocols import emdm_data, emdm_runs
from jaxmotion.protocols.emdm_data import ActionArrays
from jaxmotion.systems import emdm, emdm_loss, emdm_motion
from jaxmotion.systems.emdm_motion import Representation
from jaxmotion.typing import Key, Params

# Motions from which means and deviations of features are taken.
_FIT = 2048
# Motions that the recogniser is trained on: most windows of the clips.
_RECOGNIZED = 12288


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
            vector=jax.nn.one_hot(actions, number),
            mask=jnp.ones((size, data.frames), bool),
        )

    return emdm_runs.Task(
        base=base,
        data=run.train,
        batch=batch,
        geometry=emdm_motion.geometry(representation, relative=base.geometry == "root"),
        describe={
            "task": base.condition,
            "actions": list(run.actions),
            "source": run.clips.source,
            "fps": run.clips.fps,
        },
    )


def recognizer_config(run: ActionRun) -> recognition.ActionRecognizerConfig:
    """Size of a run's recogniser.

    Args:
      run: The run.

    Returns:
      The size.
    """
    return recognition.ActionRecognizerConfig(
        num_classes=len(run.actions), num_joints=run.clips.skeleton.num_joints
    )


def load_recognizer(run: ActionRun, *, num_steps: int, seed: int) -> Params:
    """The run's recogniser, trained on its training clips if it is not there yet.

    Args:
      run: The run.
      num_steps: Updates.
      seed: Of parameters and batches.

    Returns:
      Its parameters.

    Raises:
      ValueError: if the folder's was trained otherwise; names the field.
    """
    folder = run.folder / "recognizer"
    config = recognizer_config(run)
    value = {
        "system": "emdm",
        "stage": "recognizer",
        "steps": num_steps,
        "seed": seed,
        "actions": list(run.actions),
        "source": run.clips.source,
    }
    if checkpoint.latest_step(folder) is None:
        key_data, key_train = jax.random.split(jax.random.key(seed))
        actions = jnp.arange(_RECOGNIZED) % len(run.actions)
        x = _flat(real_positions(run, run.train, key_data, actions))
        params, _ = recognition.train_action_recognizer(
            key_train, x, actions, config=config, num_steps=num_steps
        )
        checkpoint.save(folder, num_steps, {"params": params}, value)
    found = checkpoint.load_config(folder)
    for field, expected in value.items():
        if found.get(field) != expected:
            raise ValueError(
                f"{folder}: field {field!r} is {found.get(field)!r}, expected "
                f"{expected!r}"
            )
    like = jax.eval_shape(
        lambda: recognition.init_action_recognizer(jax.random.key(0), config)
    )
    return checkpoint.restore(folder, {"params": like})["params"]


def _flat(positions: Array) -> Array:
    """What the recogniser sees of motions that start at the origin facing +z."""
    return positions.reshape(*positions.shape[:-2], -1)


def real_positions(
    run: ActionRun, part: ActionArrays, key: Key, actions: Int[Array, " batch"]
) -> Float[Array, "batch frames joints 3"]:
    """Joint positions of recorded motions.

    Args:
      run: The run.
      part: Its training or held-out clips.
      key: Consumed.
      actions: Wanted actions.

    Returns:
      Positions, metres.
    """
    motions = emdm_data.sample_motions(key, part, actions)
    return skeleton.joint_positions(run.clips.skeleton, motions)


def moments(run: ActionRun, params: Params) -> Callable[[Key, Array], frechet.Moments]:
    """Moments of the recogniser's features of a set of motions.

    Args:
      run: The run.
      params: The recogniser's.

    Returns:
      `(key, positions) -> moments`, jitted.
    """
    config = recognizer_config(run)

    @jax.jit
    def of(key: Key, positions: Array) -> frechet.Moments:
        features, _ = recognition.recognize_actions(
            params, key, _flat(positions), config=config
        )
        return frechet.moments(features)

    return of


def scorer(
    run: ActionRun, params: Params, reference: frechet.Moments
) -> Callable[[Key, Array, Int[Array, " batch"]], dict[str, Array]]:
    """Scores of a set of motions, as one compiled program.

    Args:
      run: The run.
      params: The recogniser's.
      reference: Moments of the real features.

    Returns:
      `score(key, positions, actions) -> scores`. The actions are in ascending order,
      each as often as the others.
    """
    config, bones = recognizer_config(run), run.clips.skeleton
    toes_of, ground = jnp.asarray(bones.feet), ground_height(run)

    @jax.jit
    def score(
        key: Key, positions: Array, actions: Int[Array, " batch"]
    ) -> dict[str, Array]:
        key_state, key_pairs, key_modes = jax.random.split(key, 3)
        features, logits = recognition.recognize_actions(
            params, key_state, _flat(positions), config=config
        )
        by_action = features.reshape(config.num_classes, -1, features.shape[-1])
        fps = run.clips.fps
        toes = positions[..., toes_of, :]
        return {
            "FID": frechet.frechet_distance(frechet.moments(features), reference),
            "accuracy": jnp.mean(jnp.argmax(logits, -1) == actions),
            "diversity": diversity.diversity(key_pairs, features, num_pairs=200),
            "multimodality": diversity.multimodality(
                key_modes, by_action, num_pairs=20
            ),
            "penetration mm": jnp.mean(
                plausibility.penetration(positions, ground=ground)
            ),
            "float mm": jnp.mean(plausibility.floating(positions, ground=ground)),
            "skate mm": jnp.mean(
                plausibility.skating(positions[..., toes_of, :], ground=ground)
            ),
            "skate ratio": jnp.mean(
                contact.skate_ratio(toes, fps, max_height=ground + 0.05)
            ),
            "jerk m/s^3": jnp.mean(smoothness.jerk(positions, fps)),
        }

    return score


def ground_height(run: ActionRun) -> float:
    """Height of the lowest joint of a person who stands in the run's clips, metres.

    The median over frames of the height of the lowest joint.

    Args:
      run: The run.

    Returns:
      The height.
    """
    motion = skeleton.Motion(
        root_position=run.clips.root_position,
        joint_rotation=run.clips.joint_rotation,
        fps=run.clips.fps,
    )
    positions = skeleton.joint_positions(run.clips.skeleton, motion)
    return float(jnp.median(jnp.min(positions[..., 1], axis=-1)))
