"""Scores of motions made from actions, or from nothing."""

from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array

from emdm_tasks.judge import Judge
from emdm_tasks.scores import ORDER
from jaxmotion.evaluation import by_frame, columns
from jaxmotion.evaluation.table import Cell
from jaxmotion.evaluators import frozen as evaluators
from jaxmotion.motion import skeleton
from jaxmotion.systems.emdm import action_evaluation as emdm_action_evaluation
from jaxmotion.systems.emdm import data as emdm_data
from jaxmotion.systems.emdm import features as emdm_features
from jaxmotion.systems.emdm import model as emdm_model
from jaxmotion.systems.emdm import training as emdm_training
from jaxmotion.systems.emdm.data import ActionArrays


def make_judge(args: Any) -> Judge:
    """The recognizer of a run, and real motions' scores.

    Motions made from nothing are compared with real ones of all actions; they have no
    accuracy and no multimodality.

    Args:
      args: Of `emdm.py evaluate`.

    Returns:
      The judge.

    Raises:
      ValueError: if the run has other data, there are too few samples, or a frozen
        evaluator does not fit.
    """
    for name in ("matcher", "glove"):
        if (found := getattr(args, name)) is not None:
            raise ValueError(
                f"{name} is {found}, but {args.run} does not make motions from texts: "
                "expected none"
            )
    if args.padding != "zeros":
        raise ValueError(
            f"padding is {args.padding!r}, but {args.run} does not make motions from "
            "texts: expected 'zeros'"
        )
    run = emdm_data.load_run(args.run)
    number = len(run.actions)
    each = args.samples // number
    if each < 2:
        raise ValueError(
            f"samples is {args.samples}, expected at least 2 for each of {number} "
            "actions"
        )
    frozen = None if args.evaluator is None else evaluators.load(args.evaluator)
    steps = 1500 if args.evaluator_steps is None else args.evaluator_steps
    recognizer = emdm_action_evaluation.load_recognizer(
        run, num_steps=steps, seed=0, evaluator=frozen
    )
    trained = (run.clips.source, steps, 0)
    if frozen is not None:
        trained = (frozen.source, frozen.updates, frozen.seed)
    wanted = jnp.repeat(jnp.arange(number), each)
    key_motion, key_state, *keys_real = jax.random.split(jax.random.key(args.seed), 4)
    truth = emdm_action_evaluation.real_positions(key_motion, wanted, run.train)
    reference = emdm_action_evaluation.moments(recognizer, run)(key_state, truth)
    ground = emdm_action_evaluation.ground_height(run)
    score = emdm_action_evaluation.scorer(recognizer, run, reference, ground=ground)

    def score_real(key: Array, part: ActionArrays) -> dict[str, Cell]:
        def once(key: Array) -> dict[str, Array]:
            key_motion, key_score = jax.random.split(key)
            positions = emdm_action_evaluation.real_positions(key_motion, wanted, part)
            return score(key_score, positions, wanted)

        keys = jax.random.split(key, args.replications)
        return columns.row([once(key) for key in keys], order=ORDER)

    conditional = run.config["task"] == "action"
    conditions = emdm_model.Condition(
        vector=emdm_model.action_vectors(wanted, number if conditional else 0),
        keep=jnp.ones(wanted.shape, bool),
        mask=jnp.ones((*wanted.shape, run.train.frames), bool),
    )

    @jax.jit
    def positions_of(x: Array) -> Array:
        motion = emdm_features.to_motion(x, run.representation)
        return skeleton.joint_positions(run.clips.skeleton, motion)

    def score_row(key: Array, many) -> dict[str, Array]:
        key_sample, key_score = jax.random.split(key)
        x = many(key_sample, conditions, scale)
        found = score(key_score, positions_of(x), wanted)
        if not conditional:
            found = {
                k: found[k] for k in found if k not in ("accuracy", "multimodality")
            }
        return found

    def places(key: Array, many, frames_per_token: int) -> by_frame.ByFrame:
        positions = positions_of(many(key, conditions, scale))
        at = jnp.arange(positions.shape[1]) % frames_per_token
        return by_frame.by_frame(
            positions,
            run.clips.skeleton.feet,
            jnp.broadcast_to(at, positions.shape[:2]),
            run.clips.fps,
            num_places=frames_per_token,
            contact_height=ground + 0.05,
        )

    scale = emdm_training.guidance_scale(args.scale, default=1.0)
    return Judge(
        by_frame=places,
        real={
            "real (training clips)": score_real(keys_real[0], run.train),
            "real (held-out clips)": score_real(keys_real[1], run.held_out),
        },
        score=score_row,
        scale=scale,
        one=jax.tree.map(lambda x: x[0], conditions),
        samples=each * number,
        describe={
            "recognizer": "GRU 2 x 128, tanh 30, joint positions; trained on "
            "{}, {} updates, seed {}".format(*trained),
            "reference": f"{each * number} real motions of training clips, actions "
            "uniform",
            "ground height m": ground,
        }
        | evaluators.describe(
            recognizer,
            frozen,
            reference=evaluators.clips_fingerprint(run.train.clips, run.field),
        ),
    )
