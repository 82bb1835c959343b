"""Training of frozen evaluators, kind by kind, as the evaluations do it themselves.

With the same clips and seed, an evaluator of actions or with a ball is to the bit the
recogniser that an evaluation trains for itself.
"""

import functools

import jax
import jax.numpy as jnp
import numpy as np

from jaxmotion.data.ball_clips import BallClips
from jaxmotion.data.clips import Clips
from jaxmotion.evaluators import action as action_evaluator
from jaxmotion.evaluators import style as style_evaluator
from jaxmotion.evaluators.frozen import Evaluator, clips_fingerprint
from jaxmotion.systems.camdm.steering import WINDOW, data_windows
from jaxmotion.systems.emdm import action_evaluation as emdm_action_evaluation
from jaxmotion.systems.emdm.data import ActionArrays
from jaxmotion.systems.smgdiff import data as smgdiff_data
from jaxmotion.systems.smgdiff import evaluation as smgdiff_evaluation
from jaxmotion.systems.smgdiff import training as smgdiff_training

# Windows of clips with a ball: as many as `experiments/smgdiff.py evaluate` takes.
_BALL_WINDOWS = 1200
# Motions of each action for the accuracy.
_HELD_OUT = 40


def train_style(
    train: Clips, held_out: Clips, *, field: str, num_steps: int, seed: int
) -> Evaluator:
    """CAMDM's recogniser, of windows of 60 frames.

    Args:
      train: Training clips.
      held_out: Clips for its accuracy.
      field: Label field that it recognises.
      num_steps: Updates.
      seed: Of parameters and batches.

    Returns:
      The evaluator.

    Raises:
      ValueError: if a part has no clip as long as a window, or there is no such field.
    """
    key_fit, _ = jax.random.split(jax.random.key(seed))
    found = style_evaluator.fit_recognizer(
        key_fit, train, field=field, num_steps=num_steps
    )
    windows = data_windows(held_out, stride=WINDOW, field=field)
    _, hits = style_evaluator.recognized(train.skeleton, windows, found)
    return Evaluator(
        kind="style",
        params=found.params,
        field=field,
        labels=train.names(field),
        joints=train.skeleton.names,
        fps=train.fps,
        frames=WINDOW,
        source=train.source,
        clips=clips_fingerprint(train, field),
        seed=seed,
        updates=num_steps,
        accuracy=float(np.mean(hits)),
    )


def train_action(
    train: ActionArrays,
    held_out: ActionArrays,
    *,
    field: str,
    num_steps: int,
    seed: int,
) -> Evaluator:
    """EMDM's recogniser, of motions with actions drawn uniformly.

    Args:
      train: Training clips.
      held_out: Clips for its accuracy.
      field: Label field that is the action.
      num_steps: Updates.
      seed: Of parameters, batches and motions.

    Returns:
      The evaluator.
    """
    clips = train.clips
    config, params = emdm_action_evaluation.fit_recognizer(
        train, num_steps=num_steps, seed=seed
    )
    wanted = jnp.repeat(jnp.arange(config.num_classes), _HELD_OUT)
    key_motion, key_state = jax.random.split(jax.random.key(seed + 1))
    positions = emdm_action_evaluation.real_positions(key_motion, wanted, held_out)
    x = positions.reshape(*positions.shape[:2], -1)
    recognize = functools.partial(action_evaluator.recognize_actions, config=config)
    _, logits = jax.jit(recognize)(params, key_state, x)
    return Evaluator(
        kind="action",
        params=params,
        field=field,
        labels=clips.names(field),
        joints=clips.skeleton.names,
        fps=clips.fps,
        frames=train.frames,
        source=clips.source,
        clips=clips_fingerprint(clips, field),
        seed=seed,
        updates=num_steps,
        accuracy=float(jnp.mean(jnp.argmax(logits, axis=-1) == wanted)),
    )


def train_ball(
    train: BallClips,
    held_out: BallClips,
    *,
    frames: int,
    num_steps: int,
    seed: int,
) -> Evaluator:
    """SMGDiff's recogniser of skills, of joints and ball.

    Args:
      train: Training clips.
      held_out: Clips for its accuracy.
      frames: Frames of a plan.
      num_steps: Updates.
      seed: Of parameters, batches and windows.

    Returns:
      The evaluator.

    Raises:
      ValueError: if clips are too short or too few.
    """
    model = smgdiff_training.make_model(train, sizes={"future": frames})
    draw = functools.partial(smgdiff_evaluation.situations, model=model)
    known = draw(train, number=_BALL_WINDOWS, seed=seed)
    judge = smgdiff_evaluation.make_judge(
        jax.random.key(seed),
        known.future,
        known.label,
        representation=model.representation,
        num_labels=len(model.labels),
        num_steps=num_steps,
    )
    unseen = draw(held_out, number=_BALL_WINDOWS, seed=seed + 1)
    x = jax.jit(smgdiff_evaluation.recognizer_input)(
        unseen.future, model.representation
    )
    recognize = functools.partial(style_evaluator.recognize, config=judge.config)
    _, logits = jax.jit(recognize)(judge.params, x)
    return Evaluator(
        kind="ball",
        params=judge.params,
        field=smgdiff_data.FIELD,
        labels=model.labels,
        joints=model.representation.bones.names,
        fps=model.config.fps,
        frames=frames,
        source=train.clips.source,
        clips=clips_fingerprint(train, smgdiff_data.FIELD),
        seed=seed,
        updates=num_steps,
        accuracy=float(jnp.mean(jnp.argmax(logits, axis=-1) == unseen.label)),
    )
