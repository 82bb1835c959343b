"""Polish and draft steps of AAMDM."""

import dataclasses
import functools
from collections.abc import Callable
from pathlib import Path
from typing import Any

import aamdm as script
import jax
from jaxtyping import Array

from jaxmotion.control.frame import Frame
from jaxmotion.data import clips_io
from jaxmotion.systems.aamdm import evaluation as aamdm_evaluation
from jaxmotion.systems.aamdm import training as aamdm_training
from jaxmotion.systems.aamdm.controller import Stepper
from jaxmotion.systems.aamdm.data import PoseData
from jaxmotion.systems.aamdm.space import Space
from sweeps import points
from sweeps.budgets import Amount
from sweeps.points import Point
from sweeps.system import GROUND_TRUTH, NOISE_FLOOR, Bench, Job, Row, System

AMOUNTS = {
    "autoencoder_updates": Amount(
        quick=4000,
        full=20000,
        meaning="updates of the pose autoencoder, which all models share",
    ),
    "polisher_updates": Amount(
        quick=2000, full=5000, meaning="updates of each diffusion model"
    ),
    "generator_updates": Amount(
        quick=3000, full=8000, meaning="updates of each denoising-diffusion GAN"
    ),
    "batch": Amount(quick=64, full=64, meaning="windows per update"),
    "width": Amount(quick=256, full=256, meaning="channels of the networks"),
    "held_out": Amount(
        quick=0.1, full=0.1, meaning="part of each clip, at its end, for evaluation"
    ),
    "characters": Amount(
        quick=16, full=16, meaning="rollouts of a replication", training=False
    ),
    "seconds": Amount(
        quick=4.0,
        full=4.0,
        meaning="length of a rollout behind its first second, no longer than the "
        "held-out ends",
        training=False,
    ),
    "rollout_seconds": Amount(
        quick=8.0,
        full=20.0,
        meaning="length of the rollout that is written to look at",
        training=False,
    ),
}
FIELD, LABELS = script.Train.field, script.Train.labels
COURSE, SPEED = script.Evaluate.course, script.Evaluate.speed


def _selected(data: Path) -> dict[str, Any]:
    """Walks and runs; all clips of data without such labels."""
    has = FIELD in dict(clips_io.load_clips(data).label_names)
    return {} if has else {"labels": ()}


def trainer(job: Job) -> Callable[[Point], None]:
    """Trains with `experiments/aamdm.py`, all in one run folder."""
    budget, selected = job.budget, _selected(job.data[0])

    def train(point: Point) -> None:
        script.train(
            script.Train(
                data=job.data[0],
                out=job.models,
                rows=(point.folder,),
                held_out=budget["held_out"],
                autoencoder_steps=budget["autoencoder_updates"],
                polisher_steps=budget["polisher_updates"],
                generator_steps=budget["generator_updates"],
                batch=budget["batch"],
                width=budget["width"],
                seed=job.seed,
                **selected,
            )
        )

    return train


@dataclasses.dataclass(frozen=True, kw_only=True)
class Setting:
    """What all rows share.

    Attributes:
      job: The sweep.
      run: Data of the run folder.
      space: Space of the chains.
      reference: What frames are compared with.
    """

    job: Job
    run: aamdm_training.Run
    space: Space
    reference: aamdm_evaluation.Reference

    @property
    def rollouts(self) -> int:
        """Characters of all replications."""
        return self.job.budget["characters"] * self.job.replications

    @property
    def ticks(self) -> int:
        """Frames of a rollout that count."""
        return round(self.job.budget["seconds"] * self.run.train.fps)


def _stepper(setting: Setting, point: Point) -> Stepper:
    return script.rows.load_row(
        point.folder, setting.run, setting.space, scale=script.Evaluate.scale
    )


def _frames_row(setting: Setting, key: Array, frames: Frame) -> Row:
    return aamdm_evaluation.free_row(
        key,
        setting.run.skeleton,
        setting.reference,
        frames,
        fps=setting.run.train.fps,
        groups=setting.job.replications,
    )


def real_row(setting: Setting, data: PoseData) -> Row:
    """Recorded windows, as many and as long as the rollouts."""
    seed = setting.job.seed
    frames = aamdm_evaluation.data_frames(
        setting.run, data, setting.rollouts, setting.ticks, seed=seed
    )
    return _frames_row(setting, jax.random.key(seed), frames)


def score(setting: Setting, point: Point) -> Row:
    """Free and steered rollouts, as in `experiments/aamdm.py`, in replications."""
    run, number, seed = setting.run, setting.rollouts, setting.job.seed
    skip = round(run.train.fps)  # where the data's own pose still shows
    given = aamdm_evaluation.commands(
        run, number, skip + setting.ticks, course=COURSE, speed=SPEED
    )
    step, row = _stepper(setting, point), {}
    for i, steered in enumerate((False, True)):
        key, key_pairs = jax.random.split(jax.random.key(seed + i))
        states = aamdm_evaluation.start_states(run, setting.space, number, seed=seed)
        roll = aamdm_evaluation.roller(run, setting.space, step, steered=steered)
        frames = jax.tree.map(lambda x: x[:, skip:], roll(key, states, given)[1])
        found = _frames_row(setting, key_pairs, frames)
        if not steered:
            row |= found
        elif "fid" in found:
            row |= {"fid_uc": found["fid"]}
            row |= aamdm_evaluation.control_row(frames, fps=run.train.fps)
    return row


def sampler(setting: Setting, point: Point) -> Callable[[Array], Any]:
    """One tick of one free character."""
    run, space = setting.run, setting.space
    roll = aamdm_evaluation.roller(run, space, _stepper(setting, point), steered=False)
    states = aamdm_evaluation.start_states(run, space, 1, seed=setting.job.seed)
    given = aamdm_evaluation.commands(run, 1, 1, course=COURSE, speed=SPEED)
    return lambda key: roll(key, states, given)


def write_rollout(job: Job, point: Point, folder: Path) -> None:
    """A steered character."""
    script.rollout(
        script.Rollout(
            run=job.models,
            row=point.folder,
            seconds=job.budget["rollout_seconds"],
            out=folder,
            seed=job.seed,
        )
    )


def bench(job: Job) -> Bench:
    """Free and steered rollouts beside recorded windows."""
    run, budget = aamdm_training.load_run(job.models), job.budget
    setting = Setting(
        job=job,
        run=run,
        space=aamdm_training.load_space(run, "embedded"),
        reference=aamdm_evaluation.make_reference(run.skeleton, run.train),
    )
    return Bench(
        real={
            GROUND_TRUTH: real_row(setting, run.held_out),
            NOISE_FLOOR: real_row(setting, run.train),
        },
        score=functools.partial(score, setting),
        sampler=functools.partial(sampler, setting),
        rollout=functools.partial(write_rollout, job),
        describe={
            "source": run.source,
            "samples": f"{budget['characters']} rollouts of {budget['seconds']:g} s, "
            f"free and steered (course {COURSE!r}, {SPEED:g} m/s); Fréchet distances "
            f"of every fifth frame to those of {run.train.num_frames} training "
            "frames, no recognizer; other intervals over rollouts",
            "rollouts": setting.rollouts,
            "frames_of_a_rollout": setting.ticks,
        },
    )


SYSTEM = System(
    data=(Path("data/lafan1.npz"),),
    amounts=AMOUNTS,
    points=points.pairs,
    trainer=trainer,
    bench=bench,
    quality="fid",
    sample="one frame",
)
