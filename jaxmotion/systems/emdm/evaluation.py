"""Rows of a run beside real motions, with intervals over replications; single motions.

One evaluation, for the table of a run and for a sweep over numbers of steps.
"""

import dataclasses
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array

from jaxmotion.evaluation import bench, by_frame, table
from jaxmotion.evaluation.bench import Amount
from jaxmotion.evaluation.table import Cell, Row, Rows
from jaxmotion.learning import model_json, runs
from jaxmotion.motion import humanml_skeleton
from jaxmotion.motion.skeleton import Motion, Skeleton
from jaxmotion.systems.emdm import action_evaluation, text_evaluation
from jaxmotion.systems.emdm import data as emdm_data
from jaxmotion.systems.emdm import features as emdm_features
from jaxmotion.systems.emdm import model as emdm_model
from jaxmotion.systems.emdm import sampler as emdm_sampler
from jaxmotion.systems.emdm import text as emdm_text
from jaxmotion.systems.emdm import training as emdm_training
from jaxmotion.systems.emdm.scoring import Many, RowScorer, Settings
from jaxmotion.typing import Exported, Key

# Rows with so many steps a motion are replicated less often.
_LONG = 500
_CHUNK = 32


def chain_steps(config: emdm_model.Config, row: str) -> int:
    """Steps of the chain that makes a motion of a row."""
    samplers = emdm_training.SAMPLERS
    return samplers[row][1] if row in samplers else config.num_steps


def trained_rows(folder: Path) -> tuple[str, ...]:
    """Rows and samplers that a run folder can show."""
    rows = [
        row for row in emdm_training.ROWS if (folder / row / "checkpoints").is_dir()
    ]
    more = [name for name, (row, _) in emdm_training.SAMPLERS.items() if row in rows]
    return (*rows, *more)


def score_row(
    scorer: RowScorer, many: Many, settings: Settings, *, count: int
) -> tuple[Row, Key]:
    """Scores the first `count` replications; also returns the key of the first."""
    key = jax.random.key(settings.seed + 1)
    keys = jax.random.split(key, settings.replications)
    scores = [scorer.score(key, many) for key in keys[:count]]
    return table.row(scores), keys[0]


def evaluate_run(
    folder: Path,
    settings: Settings,
    *,
    rows: tuple[str, ...] = (),
    long_replications: int = 2,
) -> tuple[Rows, dict[str, by_frame.ByFrame], RowScorer]:
    """The table of a run's rows, jerk and slide by place in a token, and what scored.

    Without `rows` all that were trained; those with 500 steps and more have
    `long_replications`. `ValueError` if nothing was trained, or a row was not.
    """
    run = runs.load(folder, system=emdm_training.SYSTEM)
    rows = rows or trained_rows(folder)
    if not rows:
        raise ValueError(f"{folder}: no row was trained")
    kind = text_evaluation if run.settings["task"] == "text" else action_evaluation
    scorer = kind.row_scorer(folder, settings)
    found: Rows = dict(scorer.real)
    places: dict[str, by_frame.ByFrame] = {}
    for row in rows:
        begun = time.perf_counter()
        params, config = emdm_training.load_row(run, row)
        sample = emdm_training.row_sampler(params, config, row)
        steps, scale = chain_steps(config, row), scorer.scale
        count = long_replications if steps >= _LONG else settings.replications
        many = emdm_training.sample_many(sample, chunk=_CHUNK)
        cells, key = score_row(scorer, many, settings, count=count)
        one = jax.jit(lambda key: sample(key, scorer.one, scale=scale))  # noqa: B023
        found[row] = cells | {
            # Per frame, as the paper gives it.
            "frame_time": bench.call_time(one, parts=config.frames, least=3),
            # Guidance asks the network for the null condition, too.
            "network_calls": Cell(value=float(steps if scale is None else 2 * steps)),
        }
        if scorer.by_frame is not None:
            places[row] = scorer.by_frame(key, many, config.frames_per_token)
        seconds = time.perf_counter() - begun
        print(f"{row}: {count} x {scorer.samples}, {seconds:.0f} s", flush=True)
    return found, places, scorer


def _features(
    run: runs.Run,
    vectors: Array,
    *,
    row: str,
    frames: int | None,
    scale: float | None,
    seed: int,
) -> Array:
    """Features of one motion for each vector, cut to their length."""
    params, config = emdm_training.load_row(run, row)
    length = config.frames if frames is None else frames
    conditions = emdm_model.make_condition(
        vectors, (length,) * vectors.shape[0], config=config
    )
    sample = emdm_training.row_sampler(params, config, row)
    factor = emdm_training.guidance_scale(scale, task=config.condition)
    many = emdm_training.sample_many(sample, chunk=8)
    return many(jax.random.key(seed), conditions, factor)[:, :length]


def make_motions(
    folder: Path,
    *,
    actions: Sequence[str] = (),
    texts: Sequence[str] = (),
    row: str = "emdm",
    frames: int | None = None,
    scale: float | None = None,
    seed: int = 0,
) -> tuple[list[tuple[str, Skeleton, Motion]], str]:
    """Name, skeleton and motion for each action or sentence, and the data's source.

    One motion in all, named "motion", where a run has neither.

    By default motions have the model's longest length and the paper's guidance.
    `ValueError` if an action is unknown, a text is empty or too long, the length is out
    of range, or the run has another task.
    """
    record = runs.load(folder, system=emdm_training.SYSTEM)
    task, given = record.settings["task"], {"action": actions, "text": texts}
    for name, values in given.items():
        if values and name != task:
            raise ValueError(f"{folder} makes motions from {task!r}, not from {name!r}")
    if task in given and not given[task]:
        raise ValueError(f"expected --{task} for {folder}")
    options: dict[str, Any] = dict(row=row, frames=frames, scale=scale, seed=seed)
    if task == "text":
        run = emdm_text.load_run(folder)
        if run.motions.num_features != 263:
            raise ValueError(
                "only motions of HumanML3D's 22 joints can be written as BVH"
            )
        x = _features(record, emdm_text.encode(run, texts), **options)
        made = (
            humanml_skeleton.motion_from_joints(joints, run.motions.fps)
            for joints in emdm_text.joints(run, x)
        )
        found = [(text, *one) for text, one in zip(texts, made, strict=True)]
        return found, run.motions.source
    run = emdm_data.load_run(folder)
    for action in actions:
        if action not in run.actions:
            raise ValueError(
                f"unknown action {action!r}: expected one of {', '.join(run.actions)}"
            )
    vectors = jnp.zeros((1, 0))
    if actions:
        numbers = jnp.asarray([run.actions.index(a) for a in actions], jnp.int32)
        vectors = emdm_model.action_vectors(numbers, len(run.actions))
    x = _features(record, vectors, **options)
    motions = emdm_features.to_motion(x, run.representation)
    found = [
        (name, run.clips.skeleton, jax.tree.map(lambda x, i=i: x[i], motions))
        for i, name in enumerate(actions or ("motion",))
    ]
    return found, run.clips.source


def exports(
    folder: Path, *, row: str = "emdm", scale: float | None = None
) -> tuple[dict[str, Exported], emdm_model.Condition, dict[str, Any]]:
    """What can leave Python: "sample", from a condition to a motion.

    The folder may be an exported file; the row is of a run folder; the scale None is
    the paper's. With the function by its name come a condition, and what else a player
    must know. `CheckpointError` if the row was not trained, `ValueError` if there is
    none such.
    """
    emdm_training.check_rows((row,))
    if folder.is_file():
        model, params = emdm_sampler.load(folder)
        config = model.config
    else:
        record = runs.load(folder, system=emdm_training.SYSTEM)
        params, config = emdm_training.load_row(record, row)
    sample = emdm_training.row_sampler(params, config, row)
    factor = emdm_training.guidance_scale(scale, task=config.condition)
    vector = jnp.zeros((1, config.condition_size))
    condition = emdm_model.make_condition(vector, config=config)
    if config.condition == "text":
        run = emdm_text.load_run(folder)
        decode, gives = (lambda x: emdm_text.joints(run, x)), "joints"
        facts = {"fps": run.motions.fps, "source": run.motions.source}
    else:
        if folder.is_file():
            features, source, labels = model.representation, model.source, model.labels
        else:
            run = emdm_data.load_run(folder)
            features, source = run.representation, run.clips.source
            labels = run.actions if config.condition == "action" else ()
        decode = lambda x: emdm_features.to_motion(x, features)  # noqa: E731
        gives = "motion"
        facts = {
            "fps": features.fps,
            "source": source,
            "labels": list(labels),
            "skeleton": model_json.skeleton_to_json(features.skeleton),
        }

    def made(key: Key, condition: emdm_model.Condition) -> Any:
        return decode(sample(key, condition, scale=factor))

    function = Exported(made, ("key", "condition"), (gives,))
    return {"sample": function}, jax.tree.map(lambda x: x[0], condition), facts


_ROW = "emdm"
_AMOUNTS = {
    "updates": Amount(quick=1000, full=5000, meaning="of each model"),
    "batch": Amount(quick=32, full=32, meaning="motions an update"),
    "width": Amount(quick=128, full=128, meaning="channels of a token"),
    "depth": Amount(quick=4, full=4, meaning="layers"),
    "hidden": Amount(quick=384, full=384, meaning="channels of feed-forward layers"),
    "discriminator_width": Amount(
        quick=128, full=128, meaning="channels of the discriminator's first layers"
    ),
    "frames": Amount(quick=60, full=60, meaning="longest motion, at 15 per second"),
    "least": Amount(quick=10, full=10, meaning="fewest clips of an action"),
    "held_out": Amount(quick=0.1, full=0.1, meaning="part for evaluation"),
    "samples": Amount(
        quick=225,
        full=1000,
        meaning="motions of a replication",
        training=False,
    ),
    "evaluator_updates": Amount(
        quick=500,
        full=1500,
        meaning="of the evaluator",
    ),
}
_DATA = (Path("data/bandai1.npz"), Path("data/bandai2.npz"))


def _folder(job: bench.Job, point: bench.Point) -> Path:
    return job.models / point.folder


def _train(job: bench.Job, point: bench.Point) -> tuple[str, dict[str, Any]]:
    budget = job.budget
    names = ("least", "frames", "held_out", "batch", "width", "depth", "hidden")
    options = {name: budget[name] for name in (*names, "discriminator_width")}
    if job.data != _DATA:
        options["merge"] = ()  # the usual data's labels that name one action
    return "train", options | dict(
        task="action",
        rows=(_ROW,),
        data=job.data,
        out=_folder(job, point),
        steps=budget["updates"],
        diffusion_steps=point.steps,
        seed=job.seed,
    )


def _show(job: bench.Job, point: bench.Point) -> tuple[str, dict[str, Any]]:
    run = emdm_data.load_run(_folder(job, point))
    return "sample", dict(run=run.record.folder, action=run.actions[:1], seed=job.seed)


def _prepare(job: bench.Job) -> bench.Evaluation:
    run, budget = emdm_data.load_run(_folder(job, job.points[0])), job.budget
    settings = Settings(
        samples=budget["samples"],
        replications=job.replications,
        evaluator_steps=budget["evaluator_updates"],
        evaluator=job.evaluator,
        seed=job.seed,
    )
    scorer = action_evaluation.row_scorer(run.record.folder, settings)
    floor, truth = scorer.real.values()

    def load(point: bench.Point) -> emdm_model.Sample:
        record = runs.load(_folder(job, point), system=emdm_training.SYSTEM)
        params, config = emdm_training.load_row(record, _ROW)
        return emdm_training.row_sampler(params, config, _ROW)

    def score(point: bench.Point) -> Row:
        many = emdm_training.sample_many(load(point), chunk=_CHUNK)
        found, _ = score_row(scorer, many, settings, count=job.replications)
        return {column: found[column] for column in truth}

    def sampler(point: bench.Point) -> Callable[[Key], Array]:
        sample = load(point)
        return jax.jit(lambda key: sample(key, scorer.one, scale=scorer.scale))

    actions, (_, config) = len(run.actions), emdm_training.load_row(run.record, _ROW)
    return bench.Evaluation(
        real={bench.GROUND_TRUTH: truth, bench.REFERENCE: floor},
        score=score,
        sampler=sampler,
        describe={
            "config": dataclasses.asdict(config),
            "source": run.clips.source,
            "samples": f"{scorer.samples} motions, {scorer.samples // actions} of each "
            f"of {actions} actions; FID against as many real ones",
            "motions": scorer.samples,
            "evaluator": scorer.describe,
        },
    )


BENCH = bench.Bench(
    data=_DATA,
    amounts=_AMOUNTS,
    points=bench.plain_points,
    train=_train,
    show=_show,
    prepare=_prepare,
    quality="fid",
    sample="one motion",
    evaluator="action",
)
