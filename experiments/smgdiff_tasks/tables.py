"""The tables of a run: guidance schedules, step counts, and paths."""

import dataclasses
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array

from jaxmotion import reporting
from jaxmotion.evaluation import by_frame, columns
from jaxmotion.evaluation.table import Cell
from jaxmotion.evaluators import frozen
from jaxmotion.motion import skeleton
from jaxmotion.reporting import arguments_json
from jaxmotion.systems.smgdiff import evaluation as smgdiff_evaluation
from jaxmotion.systems.smgdiff import guidance as smgdiff_guidance
from jaxmotion.systems.smgdiff import players as smgdiff_players
from jaxmotion.systems.smgdiff import training as smgdiff_training
from jaxmotion.systems.smgdiff import trajectory as smgdiff_trajectory
from jaxmotion.systems.smgdiff.evaluation import Setting
from jaxmotion.systems.smgdiff.guidance import SCHEDULES, UNGUIDED, Guidance, SamplePlan
from jaxmotion.systems.smgdiff.model import Model
from jaxmotion.systems.smgdiff.training import Run

Rows = dict[str, dict[str, Cell]]
Places = dict[str, by_frame.ByFrame]

_ORDER = (
    "FID",
    "foot slide m/s",
    "acceleration m/s2",
    "diversity m2",
    "trajectory error deg",
    "orientation error deg",
    "skill accuracy",
    "touches /min",
    "missed /min",
    "missed part",
    "touch distance cm",
    "ball in ground mm",
    "foot in ball mm",
    "free acceleration m/s2",
    "skate ratio",
    "jerk m/s3",
)


def _row(scores: list[dict[str, Array]]) -> dict[str, Cell]:
    return columns.row(scores, order=_ORDER)


def guidance_of(args: Any, schedule: str) -> Guidance:
    """Contact guidance as the command line asks for it.

    Args:
      args: With rate, last_sigma, min_acceleration, max_distance.
      schedule: Of `SCHEDULES`.

    Returns:
      The guidance.

    Raises:
      ValueError: if there is no such schedule.
    """
    if schedule not in SCHEDULES:
        raise ValueError(
            f"unknown schedule {schedule!r}: expected one of {', '.join(SCHEDULES)}"
        )
    start, end = SCHEDULES[schedule]
    names = ("rate", "last_sigma", "min_acceleration", "max_distance")
    return Guidance(
        start=start, end=end, **{name: getattr(args, name) for name in names}
    )


def _milliseconds(plan: SamplePlan, setting: Setting) -> Cell:
    """Time of one plan at batch 1; its parameters are constants of the program."""
    condition = jax.tree.map(lambda x: x[0], setting.known.condition)
    return columns.milliseconds(jax.jit(lambda key: plan(key, condition)))


def _plan_row(
    run: Run, setting: Setting, steps: int, guided: Guidance, chunk: int
) -> tuple[dict[str, Cell], by_frame.ByFrame]:
    model, params = smgdiff_training.load_stage(run, f"motion_{steps}")
    plan = smgdiff_guidance.sampler(
        params, config=model.config, representation=model.representation, guided=guided
    )
    many = smgdiff_evaluation.plan_many(plan, model, chunk=chunk)
    found = _row(smgdiff_evaluation.score_plans(setting, many))
    scenes = many(jax.random.key(setting.seed), setting.known.condition)
    positions = skeleton.joint_positions(model.representation.skeleton, scenes.motion)
    at = jnp.arange(model.config.future) % model.config.frames_per_token
    places = by_frame.by_frame(
        positions,
        model.representation.skeleton.feet,
        jnp.broadcast_to(at, positions.shape[:2]),
        model.config.fps,
        num_places=model.config.frames_per_token,
        contact_height=smgdiff_evaluation.limits(run.train, model).foot_height,
    )
    return found | {"ms a plan": _milliseconds(plan, setting)}, places


def real_rows(run: Run, setting: Setting) -> Rows:
    """What really happened in the held-out windows, and training clips in their place.

    Args:
      run: The run.
      setting: Of the table.

    Returns:
      Two rows.
    """
    number = setting.known.label.shape[0]
    seen = smgdiff_evaluation.situations(
        run.train, run.model, number=number, seed=setting.seed + 5
    )
    floor = dataclasses.replace(setting, known=seen)
    return {
        "real (held-out clips)": _row(smgdiff_evaluation.score_real(setting)),
        "real (training clips)": _row(smgdiff_evaluation.score_real(floor)),
    }


def schedules(args: Any, run: Run, setting: Setting) -> tuple[Rows, Places]:
    """Table 4: where in the chain guidance acts.

    Args:
      args: Of the command line.
      run: The run.
      setting: Of the table.

    Returns:
      The rows, and jerk and slide by place in a token.
    """
    rows, places = real_rows(run, setting), {}
    for name in args.schedules:
        guided = guidance_of(args, name)
        rows[name], places[name] = _plan_row(
            run, setting, args.steps, guided, args.chunk
        )
        print(f"{name}: done", flush=True)
    return rows, places


def steps(args: Any, run: Run, setting: Setting) -> tuple[Rows, Places]:
    """Table 3: models of other step counts, unguided.

    Args:
      args: Of the command line.
      run: The run.
      setting: Of the table.

    Returns:
      The rows, and jerk and slide by place in a token.

    Raises:
      ValueError: if no such model was trained.
    """
    rows, places = real_rows(run, setting), {}
    trained = sorted(
        int(folder.name.removeprefix("motion_"))
        for folder in run.folder.glob("motion_*")
        if folder.name.removeprefix("motion_").isdecimal()
    )
    for number in trained:
        name = f"{number} steps"
        rows[name], places[name] = _plan_row(run, setting, number, UNGUIDED, args.chunk)
        print(f"{name}: done", flush=True)
    return rows, places


def _generators(run: Run) -> dict[str, tuple[Model, Any]]:
    """Trained trajectory generators by name."""
    found = {}
    for folder in sorted(run.folder.glob("paths_*")):
        model, params = smgdiff_training.load_stage(run, folder.name)
        found[f"generator, T = {model.paths.num_steps}"] = smgdiff_trajectory.sampler(
            params, config=model.paths
        )
    return found


def paths(args: Any, run: Run, setting: Setting) -> tuple[Rows, dict[str, Any]]:
    """Table 2: steered players with and without generated paths and guidance.

    Args:
      args: Of the command line.
      run: The run.
      setting: Of the table.

    Returns:
      The rows, and how much each generator's paths depend on their noise.
    """
    model, params = smgdiff_training.load_stage(run, f"motion_{args.steps}")
    generators = _generators(run)
    shares = {
        name: {
            k: float(v)
            for k, v in smgdiff_players.noise_share(
                jax.random.key(args.seed), generate, setting.known, model, repeats=8
            ).items()
        }
        for name, generate in generators.items()
    }
    rows = real_rows(run, setting)
    every = {"straight paths": smgdiff_players.straight(model)} | generators
    for name, generate in every.items():
        for schedule in ("none", "end 2"):
            plan = smgdiff_guidance.sampler(
                params,
                config=model.config,
                representation=model.representation,
                guided=guidance_of(args, schedule),
            )
            play = smgdiff_players.player(
                generate,
                plan,
                model,
                ticks=2 * model.config.future,
                repeats=args.repeats,
                chunk=args.chunk,
            )
            scores = smgdiff_players.score_players(
                setting, model, play, repeats=args.repeats, starts=args.starts
            )
            rows[f"{name}, guidance {schedule}"] = _row(scores)
            print(f"{name}, guidance {schedule}: done", flush=True)
    return rows, {"noise of the paths": shares}


def write(
    out: Path,
    name: str,
    rows: Rows,
    args: Any,
    run: Run,
    more: dict,
    places: Places | None = None,
) -> None:
    """Writes one table into a folder of its own.

    Args:
      out: Folder of the evaluation.
      name: Of the table.
      rows: The table.
      args: Of the command line.
      run: The run.
      more: What belongs beside the table; "evaluator" says who judged.
      places: Jerk and slide by place in a token, for a second table below.
    """
    folder = out / name
    folder.mkdir(parents=True, exist_ok=True)
    report = {"arguments": arguments_json(args), "source": run.model.source} | more
    notes = (frozen.note(more["evaluator"]),)
    if places:
        report["by_frame_of_the_token"] = by_frame.to_json(places)
        notes += (by_frame.to_markdown(places),)
    reporting.write_table(folder, rows, report | reporting.provenance(), notes)
