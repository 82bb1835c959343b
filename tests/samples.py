"""Tiny clips of the procedural walker, and characters that walk like it."""

import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np

from jaxmotion.control import courses
from jaxmotion.control.frame import Frame
from jaxmotion.data import gaits, procedural, selection
from jaxmotion.evaluators import action as action_evaluator
from jaxmotion.evaluators import frozen
from jaxmotion.evaluators import style as style_evaluator
from jaxmotion.systems.camdm import model as camdm_model
from jaxmotion.systems.camdm import training as camdm_training
from tests import tiny

STYLES = ("neutral", "zombie")
SEED = 3


# Made once: modules that compile otherwise would round otherwise.
@functools.cache
def clips(minutes=0.4):
    """Half of them in each style, four seconds each."""
    some = {name: gaits.GAITS[name] for name in STYLES}
    return procedural.make_clips(
        seed=SEED, minutes=minutes, gaits=some, clip_seconds=4.0
    )


@functools.cache
def run():
    """A run with a random network of 16 channels and one layer."""
    model = camdm_training.make_model(
        clips(),
        field="style",
        width=16,
        depth=1,
        heads=2,
        hidden=32,
        num_steps=2,
        frames_per_token=5,
        heading="facing",
        dropout=0.0,
    )
    train, held_out = selection.split_clips(
        clips(), fraction=0.3, seed=0, field="style"
    )
    params = tiny.random_params(camdm_model.init, model.config, seed=1)
    return camdm_training.Run(
        model=model, params=params, train=train, held_out=held_out, field="style"
    )


def walking(labels, seconds=8.0):
    """Frames of characters that do as they are told: the procedural walker itself."""
    commands = courses.course_batch(
        "forward", labels, np.full(len(labels), 0.8), seconds=seconds, fps=30.0
    )
    made = []
    for number, label in enumerate(labels):
        own = jax.tree.map(lambda x, n=number: x[n], commands)
        gait = gaits.GAITS[STYLES[label]]
        motion = procedural.walk(own, gait, seed=100 + number).motion
        path, facing = procedural.follow_commands(
            own, jnp.float32(30.0), jnp.float32(0.27)
        )
        made.append(
            Frame(
                root_position=motion.root_position,
                joint_rotation=motion.joint_rotation,
                desired_velocity=jnp.gradient(path, axis=0) * 30.0,
                desired_facing=facing,
                planned=jnp.zeros(path.shape[0], bool),
                fps=30.0,
            )
        )
    return jax.tree.map(lambda *x: jnp.stack(x), *made)


def standing(frames):
    """The same commands, to characters frozen in the skeleton's rest pose, arms out."""
    six = jnp.array([1.0, 0.0, 0.0, 0.0, 1.0, 0.0])
    root = frames.root_position
    return dataclasses.replace(
        frames,
        root_position=jnp.broadcast_to(root[:, :1], root.shape),
        joint_rotation=jnp.broadcast_to(
            six.reshape(1, 1, 1, 6), frames.joint_rotation.shape
        ),
    )


def evaluator(kind="action", **changes):
    """A frozen evaluator that was not trained, of windows of 8 frames."""
    value = dict(
        kind=kind,
        field="style",
        labels=("calm", "brisk"),
        joints=tiny.NAMES,
        fps=30.0,
        frames=8,
        source="tests",
        clips="0" * 12,
        seed=3,
        updates=5,
        accuracy=0.75,
    )
    made = frozen.Evaluator(params={}, **value | changes)
    init = style_evaluator.init
    if kind == "action":
        init = action_evaluator.init
    params = tiny.random_params(init, made.config)
    return dataclasses.replace(made, params=params)
