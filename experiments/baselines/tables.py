"""AAMDM's tables 1 and 2, measured."""

import json
from pathlib import Path
from typing import Any

import jax
import numpy as np

from baselines import rows
from jaxmotion import cli, files, reporting
from jaxmotion.evaluation import table
from jaxmotion.evaluation.table import Row
from jaxmotion.learning import checkpoint
from jaxmotion.systems.aamdm import evaluation as aamdm_evaluation
from jaxmotion.systems.aamdm import training as aamdm_training

# Columns of steered rollouts that neither the paper's tables nor ours have.
_LEFT_OUT = tuple(f"{name}_uc" for name in ("div", "speed", "acceleration", "jerk"))


def trained_rows(
    run: aamdm_training.Run, names: tuple[str, ...], args: Any
) -> dict[str, tuple[Any, Any]]:
    """Steppers and spaces of rows; without names, of all that the folder has."""
    found, spaces = {}, {}
    for name in names or (*rows.ALL, *rows.MORE):
        where = rows.space_of(name)
        scale = args.amdm_scale if name.startswith("amdm") else args.scale
        try:
            if where not in spaces:
                spaces[where] = aamdm_training.load_space(run, where)
            step = rows.load_row(
                name,
                run,
                spaces[where],
                scale=scale,
                guided_steps=args.guided_steps,
                half_life=args.noise_half_life,
            )
            found[name] = (step, spaces[where])
        except checkpoint.CheckpointError as error:
            if names:
                raise checkpoint.CheckpointError(
                    f"row {name!r} was not trained: {error}"
                ) from error
            print(f"{name}: not trained here, left out")
    if not found:
        raise ValueError(
            f"{args.run}: no row was trained to its end; aamdm.py train goes on with it"
        )
    return found


def _unbounded(
    run: aamdm_training.Run, space: Any, step: Any, reference: Any, args: Any
) -> table.Cell:
    """Free rollouts that diverge if nothing keeps them within the data's bounds."""
    ticks = round(args.seconds * run.train.fps)
    states = aamdm_evaluation.start_states(
        run, space, step, args.rollouts, seed=args.seed
    )
    given = aamdm_evaluation.commands(
        run, args.rollouts, ticks, course=args.course, speed=args.speed
    )
    roll = aamdm_evaluation.roller(run, space, step, steered=False, bounded=False)
    frames = roll(jax.random.key(args.seed), states, given)[1]
    positions = aamdm_evaluation.positions_of(run.skeleton, frames)
    found = aamdm_evaluation.long_health(positions, None, reference, fps=run.train.fps)
    return table.Cell(value=float(found["diverged"]), samples=found["rollouts"])


def measure(
    name: str,
    run: aamdm_training.Run,
    space: Any,
    step: Any,
    reference: aamdm_evaluation.Reference,
    args: Any,
) -> Row:
    """One row: free, steered, and frames per second."""
    ticks = round(args.seconds * run.train.fps)
    row = aamdm_evaluation.score_stepper(
        run,
        space,
        step,
        reference,
        rollouts=args.rollouts,
        ticks=ticks,
        course=args.course,
        speed=args.speed,
        seed=args.seed,
    )
    row = {name: row[name] for name in row if name not in _LEFT_OUT}
    row["diverged_unbounded"] = _unbounded(run, space, step, reference, args)
    ticks = 20 if name.startswith("amdm200") else 300
    rate = aamdm_evaluation.frames_per_second(run, space, step, ticks=ticks)
    print(f"{name}: {rate:.0f} frames/s", flush=True)
    return row | {"fps": table.Cell(value=rate, samples=5)}


def data_rows(
    run: aamdm_training.Run, reference: aamdm_evaluation.Reference, args: Any
) -> dict[str, Row]:
    """Rows of real frames: those trained on, and those held out.

    The held-out ends of clips are short, and the fewer frames a row has, the larger is
    its FID. So frames that were trained on are there as short, too: held-out frames
    are to be compared with these, and never with a model's.
    """
    found, ticks = {}, round(args.seconds * run.train.fps)
    longest = int(np.diff(np.asarray(run.held_out.offsets)).max())
    short = min(ticks, round(3 * run.train.fps), longest)
    for name, data, length in (
        ("data (trained on)", run.train, ticks),
        ("data (trained on, as short)", run.train, short),
        ("data (held out)", run.held_out, short),
    ):
        frames = aamdm_evaluation.data_frames(
            run, data, args.rollouts, length, seed=args.seed
        )
        key = jax.random.key(args.seed)
        found[name] = aamdm_evaluation.free_row(
            key, run.skeleton, reference, frames, fps=run.train.fps
        )
        print(f"{name}: {args.rollouts} windows of {length} frames")
    return found


def long_rollouts(
    run: aamdm_training.Run,
    space: Any,
    step: Any,
    reference: aamdm_evaluation.Reference,
    args: Any,
) -> dict[str, Any]:
    """Health of rollouts of many minutes, free and steered."""
    ticks = round(args.long_minutes * 60 * run.train.fps)
    number, found = args.long_rollouts, {"ticks": ticks}
    given = aamdm_evaluation.commands(
        run, number, ticks, course=args.course, speed=args.speed
    )
    states = aamdm_evaluation.start_states(run, space, step, number, seed=args.seed)
    for steered in (False, True):
        roll = aamdm_evaluation.roller(run, space, step, steered=steered)
        frames = roll(jax.random.key(args.seed), states, given)[1]
        positions = aamdm_evaluation.positions_of(run.skeleton, frames)
        found["steered" if steered else "free"] = aamdm_evaluation.long_health(
            positions,
            frames.desired_velocity if steered else None,
            reference,
            fps=run.train.fps,
        )
        print(f"{number} rollouts of {ticks} frames, steered {steered}: {found}")
    return found


def evaluate(
    run: aamdm_training.Run, args: Any, out: Path
) -> tuple[dict[str, Row], dict[str, Any]]:
    """The table, and what belongs beside it; rows.json has what is done so far."""
    steppers = trained_rows(run, cli.chosen_rows(args), args)
    reference = aamdm_evaluation.make_reference(run.skeleton, run.train)
    found = data_rows(run, reference, args)
    for name, (step, space) in steppers.items():
        found[name] = measure(name, run, space, step, reference, args)
        files.write_text(out / "rows.json", json.dumps(table.to_json(found), indent=1))
    report = {"source": run.source} | reporting.provenance(args)
    if args.long_minutes and "aamdm" in steppers:
        step, space = steppers["aamdm"]
        report["long"] = long_rollouts(run, space, step, reference, args)
    return found, report
