"""Step counts T of EMDM's denoising-diffusion GAN, from actions."""

import dataclasses
from collections.abc import Callable
from pathlib import Path

import emdm as script
import jax
import jax.numpy as jnp
from jaxtyping import Array

from jaxmotion import reporting
from jaxmotion.evaluation import columns
from jaxmotion.learning import runs
from jaxmotion.motion import skeleton
from jaxmotion.systems.emdm import data as emdm_data
from jaxmotion.systems.emdm import features as emdm_features
from jaxmotion.systems.emdm import model as emdm_model
from jaxmotion.systems.emdm import training as emdm_training
from sweeps import points
from sweeps.budgets import Amount
from sweeps.points import Point
from sweeps.system import GROUND_TRUTH, NOISE_FLOOR, Bench, Job, Row, System

AMOUNTS = {
    "updates": Amount(quick=1000, full=5000, meaning="updates of each GAN"),
    "batch": Amount(quick=32, full=32, meaning="motions an update"),
    "width": Amount(quick=128, full=128, meaning="channels of a token"),
    "depth": Amount(quick=4, full=4, meaning="layers"),
    "hidden": Amount(quick=384, full=384, meaning="channels of feed-forward layers"),
    "discriminator_width": Amount(
        quick=128, full=128, meaning="channels of the discriminator's first layers"
    ),
    "frames": Amount(quick=60, full=60, meaning="longest motion, at 15 a second"),
    "least": Amount(quick=10, full=10, meaning="fewest clips of an action"),
    "held_out": Amount(
        quick=0.1, full=0.1, meaning="part of the clips kept for evaluation"
    ),
    "samples": Amount(
        quick=225,
        full=1000,
        meaning="motions of a replication, rounded down to as many of each action",
        training=False,
    ),
    "recognizer_updates": Amount(
        quick=500,
        full=1500,
        meaning="updates of the action recognizer, which the folder of models keeps",
    ),
}
ROW = "emdm"
CHUNK = 32


def _folder(job: Job, point: Point) -> Path:
    return job.models / point.folder


def _arguments(job: Job) -> script.Train:
    budget = job.budget
    return script.Train(
        task="action",
        data=job.data,
        out=job.models,
        # Labels that name one action, of the usual data; others have none.
        merge=script.Train.merge if job.data == SYSTEM.data else (),
        least=budget["least"],
        frames=budget["frames"],
        held_out=budget["held_out"],
        steps=budget["updates"],
        batch=budget["batch"],
        width=budget["width"],
        depth=budget["depth"],
        hidden=budget["hidden"],
        discriminator_width=budget["discriminator_width"],
        seed=job.seed,
    )


def trainer(job: Job) -> Callable[[Point], None]:
    """Trains the row "emdm" with other T; the data are in the folder above."""
    args = _arguments(job)
    task = script.setup.prepare(args)
    generator = runs.Budget(
        steps=args.steps,
        batch=args.batch,
        learning_rate=args.learning_rate,
        seed=args.seed,
    )
    discriminator = dataclasses.replace(
        generator, optimizer="adam", learning_rate=args.discriminator_rate
    )

    def train(point: Point) -> None:
        base = dataclasses.replace(task.base, num_steps=point.steps)
        emdm_training.train_row(
            _folder(job, point),
            dataclasses.replace(task, base=base),
            ROW,
            generator=generator,
            discriminator=discriminator,
        )

    return train


def _load(job: Job, point: Point) -> emdm_model.Sample:
    params, config = emdm_training.load_row(_folder(job, point), ROW)
    return emdm_training.row_sampler(params, config, ROW)


def write_motion(job: Job, run: emdm_data.ActionRun, point: Point, out: Path) -> None:
    """One motion of the first action."""
    condition = emdm_model.Condition(
        vector=emdm_model.action_vectors(jnp.zeros((), int), len(run.actions)),
        keep=jax.numpy.ones((), bool),
        mask=jax.numpy.ones(run.train.frames, bool),
    )
    sample = _load(job, point)
    make = jax.jit(lambda key: sample(key, condition, scale=None))
    motion = emdm_features.to_motion(make(jax.random.key(job.seed)), run.representation)
    motion = skeleton.Motion(
        root_position=motion.root_position,
        joint_rotation=motion.joint_rotation,
        fps=run.clips.fps,
    )
    title = f"{run.actions[0]}, {point.row}"
    reporting.write_rollout(
        out, run.clips.skeleton, motion, None, title=title, caption=run.clips.source
    )


def bench(job: Job) -> Bench:
    """The evaluation of `experiments/emdm.py`."""
    run, budget = emdm_data.load_run(job.models), job.budget
    judge = script.evaluation.actions.make_judge(
        script.Evaluate(
            run=job.models,
            samples=budget["samples"],
            replications=job.replications,
            evaluator_steps=budget["recognizer_updates"],
            evaluator=None if job.evaluator is None else job.evaluator.path,
            seed=job.seed,
        )
    )
    floor, truth = judge.real.values()

    def score(point: Point) -> Row:
        many = emdm_training.sample_many(_load(job, point), chunk=CHUNK)
        keys = jax.random.split(jax.random.key(job.seed + 1), job.replications)
        found = columns.row([judge.score(key, many) for key in keys])
        return {column: found[column] for column in truth}

    def sampler(point: Point) -> Callable[[Array], Array]:
        sample = _load(job, point)
        return jax.jit(lambda key: sample(key, judge.one, scale=judge.scale))

    return Bench(
        real={GROUND_TRUTH: truth, NOISE_FLOOR: floor},
        score=score,
        sampler=sampler,
        rollout=lambda point, folder: write_motion(job, run, point, folder),
        describe={
            "source": run.clips.source,
            "samples": f"{judge.samples} motions, {judge.samples // len(run.actions)} "
            f"of each of {len(run.actions)} actions; FID against as many real ones",
            "motions": judge.samples,
            "evaluator": judge.describe,
        },
    )


SYSTEM = System(
    data=(Path("data/bandai1.npz"), Path("data/bandai2.npz")),
    amounts=AMOUNTS,
    points=lambda texts, drafts: points.plain(texts),
    trainer=trainer,
    bench=bench,
    quality="FID",
    sample="one motion",
    judge="action",
)
