"""Step counts T of SMGDiff's motion model, without contact guidance."""

from collections.abc import Callable
from pathlib import Path

import jax
import smgdiff as script
from jaxtyping import Array

from jaxmotion.evaluation import columns
from jaxmotion.evaluators import frozen
from jaxmotion.systems.smgdiff import data as smgdiff_data
from jaxmotion.systems.smgdiff import evaluation as smgdiff_evaluation
from jaxmotion.systems.smgdiff import guidance as smgdiff_guidance
from jaxmotion.systems.smgdiff import training as smgdiff_training
from jaxmotion.systems.smgdiff.guidance import UNGUIDED, SamplePlan
from sweeps import points
from sweeps.budgets import Amount
from sweeps.points import Point
from sweeps.system import GROUND_TRUTH, NOISE_FLOOR, Bench, Job, Row, System

AMOUNTS = {
    "updates": Amount(quick=500, full=3000, meaning="updates of each motion model"),
    "draft_updates": Amount(
        quick=400,
        full=3500,
        meaning="updates before these in which displacements hardly count",
    ),
    "batch": Amount(quick=48, full=48, meaning="windows per update"),
    "width": Amount(quick=128, full=192, meaning="channels of a token"),
    "depth": Amount(quick=4, full=4, meaning="layers"),
    "held_out": Amount(
        quick=0.1, full=0.1, meaning="part of the recordings kept for evaluation"
    ),
    "windows": Amount(
        quick=160,
        full=600,
        meaning="held-out windows, at most; a replication plans for half of them",
        training=False,
    ),
    "recognizer_updates": Amount(
        quick=300, full=800, meaning="updates of the skill recognizer", training=False
    ),
    "chunk": Amount(quick=4, full=4, meaning="plans to make at a time", training=False),
    "rollout_seconds": Amount(
        quick=8.0,
        full=20.0,
        meaning="length of the rollout that is written to look at",
        training=False,
    ),
}


def _stage(point: Point) -> str:
    return f"motion_{point.steps}"


def trainer(job: Job) -> Callable[[Point], None]:
    """Trains with `experiments/smgdiff.py`, all in one run folder."""
    budget = job.budget

    def train(point: Point) -> None:
        script.train(
            script.Train(
                data=job.data[0],
                out=job.models,
                stages=(_stage(point),),
                width=budget["width"],
                depth=budget["depth"],
                held_out=budget["held_out"],
                steps=budget["updates"],
                draft_steps=budget["draft_updates"],
                batch=budget["batch"],
                seed=job.seed,
            )
        )

    return train


def bench(job: Job) -> Bench:
    """The evaluation of the paper's table 3."""
    run, budget = smgdiff_training.load_run(job.models), job.budget
    setting = smgdiff_evaluation.make_setting(
        run.train,
        run.held_out,
        run.model,
        number=budget["windows"],
        replications=job.replications,
        recognizer_steps=budget["recognizer_updates"],
        evaluator=job.evaluator,
        seed=job.seed,
    )
    ground_truth, noise_floor = script.tables.real_rows(run, setting).values()
    condition = jax.tree.map(lambda x: x[0], setting.known.condition)

    def plans_of(point: Point) -> SamplePlan:
        model, params = smgdiff_training.load_stage(run, _stage(point))
        return smgdiff_guidance.sampler(
            params,
            config=model.config,
            representation=model.representation,
            guided=UNGUIDED,
        )

    def score(point: Point) -> Row:
        many = smgdiff_evaluation.plan_many(
            plans_of(point), run.model, chunk=budget["chunk"]
        )
        found = columns.row(smgdiff_evaluation.score_plans(setting, many))
        return {column: found[column] for column in ground_truth}

    def sampler(point: Point) -> Callable[[Array], Array]:
        plan = plans_of(point)
        return jax.jit(lambda key: plan(key, condition))

    def rollout(point: Point, folder: Path) -> None:
        script.rollout(
            script.Rollout(
                run=job.models,
                seconds=budget["rollout_seconds"],
                paths="straight",
                steps=point.steps,
                schedule="none",
                out=folder,
                seed=job.seed,
            )
        )

    windows = int(setting.known.label.shape[0])
    return Bench(
        real={GROUND_TRUTH: ground_truth, NOISE_FLOOR: noise_floor},
        score=score,
        sampler=sampler,
        rollout=rollout,
        describe={
            "source": run.model.source,
            "samples": f"plans for {windows // 2} of {windows} held-out windows along "
            f"the path that was walked; Fréchet distances to {2 * windows} training "
            "windows",
            "windows": windows,
            "evaluator": frozen.describe(
                setting.judge.params,
                job.evaluator,
                reference=frozen.clips_fingerprint(run.train, smgdiff_data.FIELD),
            ),
        },
    )


SYSTEM = System(
    data=(Path("data/dribble.npz"),),
    amounts=AMOUNTS,
    points=lambda texts, drafts: points.plain(texts),
    trainer=trainer,
    bench=bench,
    quality="FID",
    sample="one plan of 45 frames",
    judge="ball",
)
