"""Evaluation of SMGDiff: plans for held-out recordings, and steered players.

Tables 1, 3 and 4 of the paper take the trajectories of the test set: a plan continues
10 held-out frames along the path that was then walked (smoothed, as in training).
Every row sees the same windows and noise. A replication is a random half of the windows
with noise of its own; intervals run over replications.

Source: SMGDiff, section 5.
"""

import dataclasses
import functools
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from jaxmotion.data.ball_clips import BallClips
from jaxmotion.evaluation import bench, by_frame, table
from jaxmotion.evaluation.bench import Amount
from jaxmotion.evaluation.table import Row, Rows
from jaxmotion.evaluators import frozen as evaluators
from jaxmotion.evaluators import style as style_evaluator
from jaxmotion.evaluators.frozen import Evaluator, clips_fingerprint
from jaxmotion.motion.ball import Scene
from jaxmotion.motion.skeleton import joint_positions
from jaxmotion.systems.smgdiff import data as smgdiff_data
from jaxmotion.systems.smgdiff import guidance as smgdiff_guidance
from jaxmotion.systems.smgdiff import scene as smgdiff_scene
from jaxmotion.systems.smgdiff import scoring as smgdiff_scoring
from jaxmotion.systems.smgdiff import training as smgdiff_training
from jaxmotion.systems.smgdiff.guidance import UNGUIDED, Guidance, SamplePlan
from jaxmotion.systems.smgdiff.model import Condition, Model
from jaxmotion.systems.smgdiff.scoring import EvalWindows
from jaxmotion.systems.smgdiff.training import Run
from jaxmotion.typing import Key

# Part of the windows in a replication.
HALF = 0.5


def plan_many(
    plan: SamplePlan, model: Model, *, chunk: int
) -> Callable[[Key, Condition], Scene]:
    """`run(key, conditions) -> scenes`, in the frames of the plans; one program.

    Condition i draws from `fold_in(key, i)`.
    """

    @jax.jit
    def run(key: Key, conditions: Condition) -> Scene:
        number = conditions.label.shape[0]

        def one(i: Array) -> Scene:
            condition = jax.tree.map(lambda x: x[i], conditions)
            x = plan(jax.random.fold_in(key, i), condition)
            scene, _ = smgdiff_scene.to_scene(x, condition.ball, model.representation)
            return scene

        return jax.lax.map(one, jnp.arange(number), batch_size=chunk)

    return run


@dataclasses.dataclass(frozen=True, kw_only=True)
class Setting:
    """What all rows of a table share; the seed is that of windows and noise."""

    evaluator: smgdiff_scoring.SkillEvaluator
    score: smgdiff_scoring.Score
    known: EvalWindows
    replications: int
    seed: int

    @property
    def halves(self) -> list[Int[np.ndarray, " half"]]:
        """Windows of each replication."""
        pieces = np.asarray(self.known.piece)
        return halves(pieces, number=self.replications, seed=self.seed)


def halves(
    pieces: Int[np.ndarray, " windows"], *, number: int, seed: int
) -> list[Int[np.ndarray, " half"]]:
    """Halves of the windows, shuffled: those of random pieces, of one not all.

    Windows of one piece overlap, and are not independent.
    """
    generator, found = np.random.default_rng(seed), []
    for _ in range(number):
        place = generator.permutation(pieces.max() + 1)[pieces]
        half = np.argsort(place, kind="stable")[: len(pieces) // 2]
        found.append(generator.permutation(half))
    return found


def make_setting(
    train: BallClips,
    held_out: BallClips,
    model: Model,
    *,
    number: int,
    replications: int,
    evaluator_steps: int,
    seed: int,
    evaluator: evaluators.Evaluator | None = None,
) -> Setting:
    """Trains the evaluator and draws the windows.

    There are at most `number` windows of either part; replications are `halves` of the
    held-out ones. A frozen evaluator must fit (`ValueError`); None to train one.
    """
    frozen = evaluators.params_for(
        evaluator,
        kind="ball",
        labels=model.labels,
        joints=model.representation.skeleton.names,
        fps=model.config.fps,
        frames=model.config.future,
    )
    reference = smgdiff_scoring.eval_windows(train, model, number=2 * number, seed=seed)
    chosen = smgdiff_scoring.make_evaluator(
        jax.random.key(seed),
        reference.future,
        reference.label,
        representation=model.representation,
        num_labels=len(model.labels),
        num_steps=evaluator_steps,
        frozen=frozen,
    )
    known = smgdiff_scoring.eval_windows(held_out, model, number=number, seed=seed + 1)
    # Held-out clips have another mix of skills than those for training: to these a
    # player who does not move his legs is nearer than they are.
    happened = smgdiff_scoring.moments(
        chosen.params, known.future, chosen.representation, config=chosen.config
    )
    limits = smgdiff_scoring.limits(train)
    return Setting(
        evaluator=chosen,
        score=smgdiff_scoring.scorer(chosen, limits, happened),
        known=known,
        replications=replications,
        seed=seed,
    )


def score_scenes(
    setting: Setting, scenes_of: Callable[[int, Array], Scene]
) -> list[dict[str, Float[Array, ""]]]:
    """Scores of each replication's held-out windows, a dictionary each.

    `scenes_of` maps a replication and its windows to scenes.
    """
    found = []
    for number, half in enumerate(setting.halves):
        chosen = jnp.asarray(half)
        known = jax.tree.map(lambda x: x[chosen], setting.known)  # noqa: B023
        wanted = known.condition.trajectory
        found.append(setting.score(scenes_of(number, chosen), wanted, known.label))
    return found


def score_real(setting: Setting) -> list[dict[str, Float[Array, ""]]]:
    """Scores of what really happened, a dictionary per replication."""
    future = setting.known.future
    return score_scenes(
        setting, lambda _, chosen: jax.tree.map(lambda x: x[chosen], future)
    )


def score_plans(
    setting: Setting, run: Callable[[Key, Condition], Scene]
) -> list[dict[str, Float[Array, ""]]]:
    """Scores of what `plan_many` runs, a dictionary per replication."""
    key = jax.random.key(setting.seed + 2)

    def scenes_of(number: int, chosen: Array) -> Scene:
        conditions = jax.tree.map(lambda x: x[chosen], setting.known.condition)
        return run(jax.random.fold_in(key, number), conditions)

    return score_scenes(setting, scenes_of)


# Windows of clips with a ball: as many as `experiments/smgdiff.py evaluate` takes.
_BALL_WINDOWS = 1200


def train_ball(
    train: BallClips,
    held_out: BallClips,
    *,
    frames: int,
    num_steps: int,
    seed: int,
) -> Evaluator:
    """SMGDiff's evaluator of skills, of joints and ball.

    The held-out clips give its accuracy; `frames` is the length of a plan. `ValueError`
    if clips are too short or too few.
    """
    model = smgdiff_training.make_model(train, sizes={"future": frames})
    draw = functools.partial(smgdiff_scoring.eval_windows, model=model)
    known = draw(train, number=_BALL_WINDOWS, seed=seed)
    chosen = smgdiff_scoring.make_evaluator(
        jax.random.key(seed),
        known.future,
        known.label,
        representation=model.representation,
        num_labels=len(model.labels),
        num_steps=num_steps,
    )
    unseen = draw(held_out, number=_BALL_WINDOWS, seed=seed + 1)
    x = jax.jit(smgdiff_scoring.evaluator_input)(unseen.future, model.representation)
    recognize = functools.partial(style_evaluator.classify, config=chosen.config)
    _, logits = jax.jit(recognize)(chosen.params, x)
    return Evaluator(
        kind="ball",
        params=chosen.params,
        field=smgdiff_data.FIELD,
        labels=model.labels,
        joints=model.representation.skeleton.names,
        fps=model.config.fps,
        frames=frames,
        source=train.clips.source,
        clips=clips_fingerprint(train, smgdiff_data.FIELD),
        seed=seed,
        updates=num_steps,
        accuracy=float(jnp.mean(jnp.argmax(logits, axis=-1) == unseen.label)),
    )


Places = dict[str, by_frame.ByFrame]


def real_rows(run: Run, setting: Setting) -> Rows:
    """What happened in the held-out windows, and in training clips in their place."""
    number = setting.known.label.shape[0]
    seen = smgdiff_scoring.eval_windows(
        run.train, run.model, number=number, seed=setting.seed + 5
    )
    floor = dataclasses.replace(setting, known=seen)
    return {
        "real (held-out clips)": table.row(score_real(setting), part=HALF),
        "real (training clips)": table.row(score_real(floor), part=HALF),
    }


def _sampler(run: Run, stage: str, guided: Guidance) -> tuple[Model, SamplePlan]:
    model, params = smgdiff_training.load_stage(run, stage)
    return model, smgdiff_guidance.sampler(
        params, config=model.config, representation=model.representation, guided=guided
    )


def _timed(plan: SamplePlan, setting: Setting) -> Callable[[Key], Array]:
    """One plan at batch 1; its parameters are constants of the program."""
    condition = jax.tree.map(lambda x: x[0], setting.known.condition)
    return jax.jit(lambda key: plan(key, condition))


def _plan_row(
    run: Run, setting: Setting, steps: int, guided: Guidance, chunk: int
) -> tuple[Row, by_frame.ByFrame]:
    model, plan = _sampler(run, f"motion_{steps}", guided)
    many = plan_many(plan, model, chunk=chunk)
    found = table.row(score_plans(setting, many), part=HALF)
    scenes = many(jax.random.key(setting.seed), setting.known.condition)
    positions = joint_positions(model.representation.skeleton, scenes.motion)
    at = jnp.arange(model.config.future) % model.config.frames_per_token
    places = by_frame.by_frame(
        positions,
        model.representation.skeleton.feet,
        jnp.broadcast_to(at, positions.shape[:2]),
        model.config.fps,
        num_places=model.config.frames_per_token,
        contact_height=smgdiff_scoring.limits(run.train).foot_height,
    )
    return found | {"plan_time": bench.call_time(_timed(plan, setting))}, places


def schedule_table(
    run: Run,
    setting: Setting,
    names: Sequence[str],
    *,
    steps: int,
    guided: Guidance,
    chunk: int,
) -> tuple[Rows, Places]:
    """Table 4: where in a chain of `steps` guidance acts, by names of `SCHEDULES`.

    With the rows come jerk and slide by place in a token.
    """
    rows, places = real_rows(run, setting), {}
    for name in names:
        own = smgdiff_guidance.on_schedule(guided, name)
        rows[name], places[name] = _plan_row(run, setting, steps, own, chunk)
        print(f"{name}: done", flush=True)
    return rows, places


def step_table(run: Run, setting: Setting, *, chunk: int) -> tuple[Rows, Places]:
    """Table 3: all models of other step counts that were trained, unguided."""
    rows, places = real_rows(run, setting), {}
    trained = sorted(
        int(folder.name.removeprefix("motion_"))
        for folder in run.record.folder.glob("motion_*")
        if folder.name.removeprefix("motion_").isdecimal()
    )
    for number in trained:
        name = f"{number} steps"
        rows[name], places[name] = _plan_row(run, setting, number, UNGUIDED, chunk)
        print(f"{name}: done", flush=True)
    return rows, places


def describe_evaluator(
    run: Run, setting: Setting, evaluator: Evaluator | None
) -> dict[str, Any]:
    """Who scored a table, for what stands beside it."""
    reference = clips_fingerprint(run.train, smgdiff_data.FIELD)
    return evaluators.describe(setting.evaluator.params, evaluator, reference=reference)


_AMOUNTS = {
    "updates": Amount(quick=500, full=3000, meaning="of each model"),
    "draft_updates": Amount(
        quick=400,
        full=3500,
        meaning="before these, displacements hardly count",
    ),
    "batch": Amount(quick=48, full=48, meaning="windows per update"),
    "width": Amount(quick=128, full=192, meaning="channels of a token"),
    "depth": Amount(quick=4, full=4, meaning="layers"),
    "held_out": Amount(quick=0.1, full=0.1, meaning="part for evaluation"),
    "windows": Amount(
        quick=160,
        full=600,
        meaning="held out, half of them in a replication",
        training=False,
    ),
    "evaluator_updates": Amount(
        quick=300, full=800, meaning="of the evaluator", training=False
    ),
    "chunk": Amount(quick=4, full=4, meaning="plans to make at a time", training=False),
    "rollout_seconds": Amount(
        quick=8.0,
        full=20.0,
        meaning="to look at",
        training=False,
    ),
}


def _stage(point: bench.Point) -> str:
    return f"motion_{point.steps}"


def _train(job: bench.Job, point: bench.Point) -> tuple[str, dict[str, Any]]:
    """All models lie in one run folder."""
    budget = job.budget
    return "train", dict(
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


def _show(job: bench.Job, point: bench.Point) -> tuple[str, dict[str, Any]]:
    return "rollout", dict(
        run=job.models,
        seconds=job.budget["rollout_seconds"],
        paths="straight",
        steps=point.steps,
        schedule="none",
        seed=job.seed,
    )


def _prepare(job: bench.Job) -> bench.Evaluation:
    """The evaluation of the paper's table 3."""
    run, budget = smgdiff_training.load_run(job.models), job.budget
    setting = make_setting(
        run.train,
        run.held_out,
        run.model,
        number=budget["windows"],
        replications=job.replications,
        evaluator_steps=budget["evaluator_updates"],
        evaluator=job.evaluator,
        seed=job.seed,
    )
    truth, floor = real_rows(run, setting).values()

    def score(point: bench.Point) -> Row:
        _, plan = _sampler(run, _stage(point), UNGUIDED)
        many = plan_many(plan, run.model, chunk=budget["chunk"])
        found = table.row(score_plans(setting, many), part=HALF)
        return {column: found[column] for column in truth}

    windows = int(setting.known.label.shape[0])
    model, _ = smgdiff_training.load_stage(run, _stage(job.points[0]))
    return bench.Evaluation(
        real={bench.GROUND_TRUTH: truth, bench.REFERENCE: floor},
        score=score,
        sampler=lambda point: _timed(
            _sampler(run, _stage(point), UNGUIDED)[1], setting
        ),
        describe={
            "config": dataclasses.asdict(model.config),
            "source": run.model.source,
            "samples": f"plans for {windows // 2} of {windows} held-out windows along "
            f"the path that was walked; Fréchet distances to {2 * windows} training "
            "windows",
            "windows": windows,
            "evaluator": describe_evaluator(run, setting, job.evaluator),
        },
    )


BENCH = bench.Bench(
    data=(Path("data/dribble.npz"),),
    amounts=_AMOUNTS,
    points=bench.plain_points,
    train=_train,
    show=_show,
    prepare=_prepare,
    quality="fid",
    sample="one plan of 45 frames",
    evaluator="ball",
)
