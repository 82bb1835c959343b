"""Motions to look at."""

import re
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from jaxmotion import reporting
from jaxmotion.learning import runs
from jaxmotion.motion import humanml_skeleton
from jaxmotion.motion.skeleton import Motion
from jaxmotion.systems.emdm import data as emdm_data
from jaxmotion.systems.emdm import features as emdm_features
from jaxmotion.systems.emdm import model as emdm_model
from jaxmotion.systems.emdm import text as emdm_text
from jaxmotion.systems.emdm import training as emdm_training


def sample(args: Any, out: Path) -> None:
    """Makes one motion for each action or sentence, and writes it.

    Args:
      args: Of `emdm.py sample`.
      out: Folder.

    Raises:
      ValueError: if an action is unknown, a text is empty or too long, the length is
        out of range, or the run has another task.
    """
    run = runs.load(args.run, system=emdm_training.SYSTEM)
    task = run.settings["task"]
    given = {"action": args.action, "text": args.text}
    for name, values in given.items():
        if values and name != task:
            raise ValueError(
                f"{args.run} makes motions from {task!r}, not from {name!r}"
            )
    if task in given and not given[task]:
        raise ValueError(f"expected --{task} for {args.run}")
    (_from_texts if task == "text" else _from_actions)(args, out)


def _generate(args: Any, vectors: Any, scale: float) -> np.ndarray:
    """Features of one motion for each vector, cut to their length."""
    run = runs.load(args.run, system=emdm_training.SYSTEM)
    params, config = emdm_training.load_row(run, args.row)
    length = config.frames if args.frames is None else args.frames
    conditions = emdm_model.make_condition(
        vectors, (length,) * vectors.shape[0], config=config
    )
    run = emdm_training.sample_many(
        emdm_training.row_sampler(params, config, args.row), chunk=8
    )
    given = emdm_training.guidance_scale(args.scale, default=scale)
    return run(jax.random.key(args.seed), conditions, given)[:, :length]


def _file_name(text: str) -> str:
    return re.sub(r"[^a-z0-9]+", "_", text.lower()).strip("_")[:60]


def _from_actions(args: Any, out: Path) -> None:
    run = emdm_data.load_run(args.run)
    for action in args.action:
        if action not in run.actions:
            raise ValueError(
                f"unknown action {action!r}: expected one of {', '.join(run.actions)}"
            )
    numbers = jnp.asarray([run.actions.index(a) for a in args.action], jnp.int32)
    vectors = emdm_model.action_vectors(numbers, len(run.actions))
    if not args.action:
        vectors = jnp.zeros((1, 0))
    motions = emdm_features.to_motion(_generate(args, vectors, 1.0), run.representation)
    for i, title in enumerate(args.action or ("motion",)):
        motion = Motion(
            root_position=motions.root_position[i],
            joint_rotation=motions.joint_rotation[i],
            fps=run.clips.fps,
        )
        reporting.write_rollout(
            out,
            run.clips.skeleton,
            motion,
            None,
            title=f"{title}, {args.row}",
            caption=run.clips.source,
            name=_file_name(title),
        )


def _from_texts(args: Any, out: Path) -> None:
    run = emdm_text.load_run(args.run)
    if run.motions.num_features != 263:
        raise ValueError("only motions of HumanML3D's 22 joints can be written as BVH")
    x = _generate(args, emdm_text.encode(run, args.text), 2.5)
    positions = emdm_text.joints(run, x)
    for i, text in enumerate(args.text):
        skeleton, motion = humanml_skeleton.motion_from_joints(
            positions[i], run.motions.fps
        )
        reporting.write_rollout(
            out,
            skeleton,
            motion,
            None,
            title=text,
            caption=run.motions.source,
            name=_file_name(text),
        )
