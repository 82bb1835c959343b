"""Step counts T of CAMDM."""

import dataclasses
import functools
import math
from collections.abc import Callable
from pathlib import Path

import camdm as script
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from jaxmotion.control import steering
from jaxmotion.data import windows
from jaxmotion.evaluation import table
from jaxmotion.evaluation.table import Cell
from jaxmotion.evaluators import frozen
from jaxmotion.evaluators import style as style_evaluator
from jaxmotion.motion.skeleton import Skeleton
from jaxmotion.systems.camdm import controller as camdm_controller
from jaxmotion.systems.camdm import evaluation as camdm_evaluation
from jaxmotion.systems.camdm import loss as camdm_loss
from jaxmotion.systems.camdm import model as camdm_model
from jaxmotion.systems.camdm import release as camdm_release
from jaxmotion.systems.camdm import training as camdm_training
from sweeps import points
from sweeps.budgets import Amount
from sweeps.points import Point
from sweeps.system import GROUND_TRUTH, NOISE_FLOOR, Bench, Job, Row, System

AMOUNTS = {
    "updates": Amount(quick=900, full=11000, meaning="optimizer updates of each model"),
    "batch": Amount(quick=48, full=48, meaning="windows per update"),
    "width": Amount(quick=128, full=192, meaning="channels of a token"),
    "depth": Amount(quick=4, full=4, meaning="layers"),
    "warmup": Amount(quick=100, full=300, meaning="updates of linear rise of the rate"),
    "held_out": Amount(
        quick=0.1, full=0.1, meaning="part of the clips kept for evaluation"
    ),
    "seconds": Amount(
        quick=14.0,
        full=30.0,
        meaning="length of a rollout; each replication has one for each style",
        training=False,
    ),
    "recognizer_updates": Amount(
        quick=400, full=1500, meaning="updates of the style recognizer", training=False
    ),
    "chunk": Amount(
        quick=10, full=10, meaning="characters to run at a time", training=False
    ),
    "rollout_seconds": Amount(
        quick=8.0,
        full=20.0,
        meaning="length of the rollout that is written to look at",
        training=False,
    ),
}
COURSE = "forward"
CONTENTS = script.Evaluate.contents


def _folder(job: Job, point: Point) -> Path:
    return job.models / point.folder


def trainer(job: Job) -> Callable[[Point], None]:
    """Trains with `experiments/camdm.py`."""
    budget = job.budget
    chunk = math.gcd(budget["updates"], 50)

    def train(point: Point) -> None:
        script.train(
            script.Train(
                data=job.data[0],
                out=_folder(job, point),
                held_out=budget["held_out"],
                steps=budget["updates"],
                batch=budget["batch"],
                warmup=budget["warmup"],
                chunk=chunk,
                save_every=10 * chunk,
                width=budget["width"],
                depth=budget["depth"],
                diffusion_steps=point.steps,
                seed=job.seed,
            )
        )

    return train


def _run_of(job: Job, run: camdm_training.Run, point: Point) -> camdm_training.Run:
    """The same clips with another model."""
    model, params, _ = camdm_model.load(_folder(job, point))
    return dataclasses.replace(run, model=model, params=params)


def condition_of(run: camdm_training.Run, *, seed: int) -> camdm_model.Condition:
    """One condition of a plan, from a held-out window."""
    config = run.model.config
    index = windows.window_index(run.held_out, config.window, short="skip")
    key_window, key_example = jax.random.split(jax.random.key(seed))
    motion, clip = windows.sample_windows(key_window, run.held_out, index, batch=1)
    label = run.held_out.labels[run.field][clip]
    first = functools.partial(jax.tree.map, lambda x: x[0])
    make = jax.jit(functools.partial(camdm_loss.example, config=config))
    return make(key_example, run.model.skeleton, first(motion), label[0])[0]


@dataclasses.dataclass(frozen=True, kw_only=True)
class Judge:
    """What all models are measured with.

    Attributes:
      recognizer: Of styles.
      reference: Features of the training windows.
      styles: The same by style, one window behind the other.
      height: Below it a foot joint should not move, meters.
      root: Median height of the root, meters.
      count: Windows of each Fréchet distance.
      labels: Style of each character; those of one style are neighbors.
    """

    recognizer: style_evaluator.Recognized
    reference: np.ndarray
    styles: camdm_release.Groups
    height: float
    root: float
    count: int
    labels: np.ndarray


def _judge(job: Job, run: camdm_training.Run) -> tuple[Judge, dict[str, Row]]:
    """Trains the recognizer; scores the clips."""
    skeleton, field = run.model.skeleton, run.field
    styles, budget = len(run.model.labels), job.budget
    ticks = round(budget["seconds"] * run.model.config.fps)
    windows.check_ticks(ticks, fps=run.model.config.fps, skip=camdm_evaluation.SKIP)
    key_fit, _ = jax.random.split(jax.random.key(job.seed))
    recognizer = camdm_evaluation.recognizer(
        key_fit, run, job.evaluator, num_steps=budget["recognizer_updates"]
    )
    real = windows.eval_windows(run.held_out, stride=windows.EVAL_WINDOW, field=field)
    dense = windows.eval_windows(run.train, stride=10, field=field)
    feature, hits = style_evaluator.recognized(skeleton, real, recognizer)
    reference, _ = style_evaluator.recognized(skeleton, dense, recognizer)
    own = camdm_evaluation.random_half(
        np.asarray(dense.group), np.asarray(dense.label), job.seed
    )
    made = styles * ((ticks - camdm_evaluation.SKIP) // windows.EVAL_WINDOW)
    height = camdm_evaluation.contact_height(skeleton, real)
    judge = Judge(
        recognizer=recognizer,
        reference=reference,
        styles=camdm_release.style_features(
            skeleton, run.train, recognizer, field=field
        ),
        height=height,
        root=float(np.median(np.asarray(real.motion.root_position)[..., 1])),
        count=min(made, len(feature), int(own.sum()), int((~own).sum())),
        labels=np.repeat(np.arange(styles), job.replications),
    )
    distances = functools.partial(
        camdm_evaluation.frechet_cells,
        count=judge.count,
        seed=job.seed,
        repeats=job.replications,
    )
    whole = camdm_release.of_clips(run.held_out, field=field)
    return judge, {
        GROUND_TRUTH: distances(feature, reference)
        | camdm_evaluation.metric_row(skeleton, real, hits, height=height)
        | _released(judge, skeleton, whole),
        NOISE_FLOOR: distances(reference[own], reference[~own]),
    }


def _released(
    judge: Judge,
    skeleton: Skeleton,
    whole: camdm_release.Recordings,
    group: np.ndarray | None = None,
) -> Row:
    """Columns of the released evaluation."""
    values = camdm_release.metrics(skeleton, whole)
    fid = camdm_release.distances(skeleton, whole, judge.recognizer, judge.styles)
    return camdm_release.row(values | {"fid": fid}, group)


def _fid(job: Job, judge: Judge, features: np.ndarray, owner: np.ndarray) -> Cell:
    """Fréchet distance of each replication's windows to the training windows."""
    found = [
        camdm_evaluation.frechet_cell(
            features[owner == i],
            judge.reference,
            count=judge.count,
            seed=job.seed,
            repeats=1,
        ).value
        for i in range(job.replications)
    ]
    return table.cell(jnp.asarray(found, jnp.float32))


def score(job: Job, judge: Judge, run: camdm_training.Run) -> Row:
    """Steers one character a style in each replication, and measures them."""
    model, skeleton, fps = run.model, run.model.skeleton, run.model.config.fps
    _, commands = camdm_evaluation.course_of_run(
        run, COURSE, judge.labels, seconds=job.budget["seconds"], speed=None
    )
    states = camdm_controller.start_states(
        run.held_out, model, judge.labels, field=run.field, seed=job.seed
    )
    _, key = jax.random.split(jax.random.key(job.seed))
    frames = steering.steered_rollouts(
        camdm_controller.character(run.params, model),
        key,
        states,
        commands,
        chunk=job.budget["chunk"],
    )
    made = windows.rollout_windows(
        frames, jnp.asarray(judge.labels), skip=camdm_evaluation.SKIP
    )
    features, hits = style_evaluator.recognized(skeleton, made, judge.recognizer)
    owner = np.asarray(made.group) % job.replications
    # Of each replication, not of each character: these are what is independent.
    grouped = dataclasses.replace(made, group=jnp.asarray(owner))
    health = camdm_evaluation.rollout_health(
        skeleton, frames, fps=fps, height=judge.root
    )
    row = {"fid": _fid(job, judge, features, owner)}
    row |= camdm_evaluation.unbiased_cells(features, judge.reference, seed=job.seed)
    row |= camdm_evaluation.metric_row(skeleton, grouped, hits, height=judge.height)
    whole = camdm_release.of_rollouts(frames, commands, fps=fps)
    replication = np.arange(judge.labels.size) % job.replications
    row |= _released(judge, skeleton, whole, replication)
    row["diversity_m2"] = camdm_evaluation.repeat_diversity(
        skeleton, made, repeats=job.replications
    )
    for name in ("diverged", "frozen"):
        row[name] = Cell(value=float(health[name]), samples=health["rollouts"])
    return row


def bench(job: Job) -> Bench:
    """The evaluation of `experiments/camdm.py`, in replications."""
    run = camdm_training.load_run(_folder(job, job.points[0]), None, CONTENTS)
    judge, real = _judge(job, run)

    def sampler(point: Point) -> Callable[[Array], Array]:
        own = _run_of(job, run, point)
        condition = condition_of(own, seed=job.seed)
        plan = camdm_model.sampler(own.params, config=own.model.config)
        return jax.jit(lambda key: plan(key, condition))

    def rollout(point: Point, folder: Path) -> None:
        script.rollout(
            script.Rollout(
                run=_folder(job, point),
                style=run.model.labels[0],
                seconds=job.budget["rollout_seconds"],
                out=folder,
                seed=job.seed,
            )
        )

    return Bench(
        real=real,
        score=lambda point: score(job, judge, _run_of(job, run, point)),
        sampler=sampler,
        rollout=rollout,
        describe={
            "source": run.model.source,
            "samples": f"one rollout of {job.budget['seconds']:g} s for each of "
            f"{len(run.model.labels)} styles, course {COURSE!r}; Fréchet distances of "
            f"{judge.count} windows to {len(judge.reference)}; the clips' distances "
            "are of as many random subsets, their other intervals over clips; "
            "fid_unbiased is extrapolated to infinitely many windows from a row's "
            "subsets of at least as many windows as features",
            "fid_windows": judge.count,
            "fid_reference_windows": len(judge.reference),
            "rollouts": int(judge.labels.size),
            "evaluator": frozen.describe(
                judge.recognizer.params,
                job.evaluator,
                reference=frozen.clips_fingerprint(run.train, run.field),
            ),
        },
    )


SYSTEM = System(
    data=(Path("data/bandai2.npz"),),
    amounts=AMOUNTS,
    points=lambda texts, drafts: points.plain(texts),
    trainer=trainer,
    bench=bench,
    quality="fid",
    sample="one plan of 45 frames",
    judge="style",
)
