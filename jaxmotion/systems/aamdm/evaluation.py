"""Rollouts of AAMDM and its baselines, free and under control.

Every method is a stepper in a space, and goes through the same run-time, from the same
held-out poses, with the same commands.

Source: Li et al. 2024 (AAMDM), section 4.1.
"""

import dataclasses
import functools
from collections.abc import Callable
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxmotion.control import courses, rollout
from jaxmotion.control.frame import Frame
from jaxmotion.data import clips_io
from jaxmotion.evaluation import (
    alignment,
    bench,
    contact,
    diversity,
    frechet,
    health,
    smoothness,
    table,
    timing,
)
from jaxmotion.evaluation.bench import Amount
from jaxmotion.evaluation.table import Row
from jaxmotion.motion import features, ground, path_features, pose
from jaxmotion.motion.skeleton import Skeleton, forward_kinematics
from jaxmotion.motion.trajectory import Command, PlanarFrame, Trajectory
from jaxmotion.systems.aamdm import controller as aamdm_controller
from jaxmotion.systems.aamdm.controller import CharacterState, Stepper
from jaxmotion.systems.aamdm.data import PoseData, starts
from jaxmotion.systems.aamdm.embedding import character_positions
from jaxmotion.systems.aamdm.space import Space
from jaxmotion.systems.aamdm.training import (
    Run,
    load_chain,
    load_networks,
    load_run,
    load_space,
)
from jaxmotion.typing import Key


def start_states(
    run: Run, space: Space, step: Stepper, number: int, *, seed: int
) -> CharacterState:
    """Characters in held-out poses, each at the origin and facing +z."""
    return aamdm_controller.start_states(
        run.held_out,
        space,
        number,
        num_joints=run.skeleton.num_joints,
        seed=seed,
        memory=step.memory,
    )


def commands(
    run: Run, number: int, ticks: int, *, course: str, speed: float
) -> Command:
    """Commands [characters, ticks, ...], the same for every character; speed in m/s."""
    fps = run.train.fps
    one = courses.course_commands(
        course, seconds=ticks / fps, fps=fps, speed=speed, label=0
    )
    return jax.tree.map(lambda x: jnp.broadcast_to(x, (number, *x.shape)), one)


def roller(
    run: Run,
    space: Space,
    step: Stepper,
    *,
    steered: bool,
    bounded: bool = True,
) -> Callable[[Key, CharacterState, Command], tuple[CharacterState, Frame]]:
    """Jitted rollouts, `roll(key, states, commands) -> (states, frames)`."""
    driver = aamdm_controller.controller(
        step,
        space,
        num_joints=run.skeleton.num_joints,
        fps=run.train.fps,
        steered=steered,
        bounded=bounded,
    )
    return jax.jit(functools.partial(rollout.rollout, driver))


@jax.jit
def positions_of(skeleton: Skeleton, frames: Frame) -> jax.Array:
    """World positions [characters, ticks, joints, 3] of rollouts, meters."""
    return forward_kinematics(skeleton, frames.root_position, frames.joint_rotation)


def data_frames(
    run: Run, data: PoseData, number: int, ticks: int, *, seed: int
) -> Frame:
    """Windows of real frames as if they were rollouts that wanted their own path.

    `ValueError` if no clip is that long.
    """
    first = starts(data, ticks)
    chosen = np.random.default_rng(seed).integers(0, first.shape[0], number)
    joints, fps = run.skeleton.num_joints, data.fps

    @jax.jit
    def window(start: jax.Array) -> Frame:
        cut = functools.partial(
            jax.lax.dynamic_slice_in_dim, start_index=start, slice_size=ticks
        )
        poses, paths = cut(data.poses), cut(data.paths)
        origin = PlanarFrame(origin=jnp.zeros(2), facing=jnp.array([0.0, 1.0]))
        bone = pose.integrate_root(poses, origin, num_joints=joints, fps=fps)
        root, rot6d = pose.place(poses, bone, num_joints=joints)
        velocity = jnp.asarray(jnp.gradient(bone.origin, axis=0)) * fps
        return Frame(
            root_position=root,
            joint_rotation=rot6d,
            desired_velocity=velocity,
            desired_facing=bone.facing,
            planned=jnp.ones(ticks, bool),
            extra={
                "bone_origin": bone.origin,
                "bone_facing": bone.facing,
                "bone_velocity": velocity,
                "path": paths,
                "wanted_path": paths,
            },
            fps=fps,
        )

    return jax.lax.map(window, first[chosen])


def frames_per_second(
    run: Run, space: Space, step: Stepper, *, ticks: int = 300, repeats: int = 5
) -> float:
    """Frames per second of one character, generated one after the other.

    Decoding and placing are included, compilation is not; the median of `repeats`
    rollouts of `ticks` frames.
    """
    states = start_states(run, space, step, 1, seed=0)
    given = commands(run, 1, ticks, course="forward", speed=1.0)
    roll = roller(run, space, step, steered=False)
    times = timing.time_calls(
        roll,
        arguments=lambda i: (jax.random.key(i), states, given),
        rounds=repeats,
        warmup=1,
        least=repeats,
    )
    return 1000 * ticks / float(np.median(times))


PAIRS = 2000
STRIDE = 5  # frames; neighbors are nearly the same


@dataclasses.dataclass(frozen=True, kw_only=True)
class Reference:
    """What rows are compared with.

    Attributes:
      normalizer: Normalizer of joint positions in the character's axes.
      toe_height: Height of the resting toes, meters.
      root_height: Median height of the root, meters.
    """

    normalizer: features.Normalizer
    moments: frechet.Moments
    toe_height: float
    root_height: float


def make_reference(skeleton: Skeleton, data: PoseData) -> Reference:
    """The reference of every fifth training frame."""
    parents = skeleton.parents
    found = jax.jit(lambda x: character_positions(x, parents))(data.poses[::STRIDE])
    toes = np.asarray(found[:, jnp.array(skeleton.feet), 1])
    flat = found.reshape(len(found), -1)
    # A centimeter: the chest hardly leaves the bone's axis.
    normalizer = features.fit_normalizer(flat, floor=0.01)
    return Reference(
        normalizer=normalizer,
        moments=frechet.moments(features.normalize(normalizer, flat)),
        toe_height=float(np.percentile(toes, 5)),
        root_height=float(np.median(np.asarray(found[:, 0, 1]))),
    )


def _character_features(reference: Reference, frames: Frame, positions: Array) -> Array:
    """Normalized positions in the character's axes [characters, ticks, 3 J]."""
    origin = frames.extra["bone_origin"][..., None, :]
    facing = jnp.broadcast_to(
        frames.extra["bone_facing"][..., None, :], positions.shape[:-1] + (2,)
    )
    planar = ground.into_frame(positions[..., ::2] - origin, facing)
    local = jnp.stack([planar[..., 0], positions[..., 1], planar[..., 1]], axis=-1)
    flat = local.reshape(*local.shape[:2], -1)
    return features.normalize(reference.normalizer, flat)


def free_row(
    key: Key,
    skeleton: Skeleton,
    reference: Reference,
    frames: Frame,
    *,
    fps: float,
    groups: int = 4,
) -> Row:
    """Columns that need no commands, of frames [characters, ticks, ...].

    Of `groups` of rollouts, which divide their number (else `ValueError`), are div and
    fid; over rollouts ffr_mann, ffr_gmd, speed, acceleration and jerk; diverged is the
    number of those with numbers that no body shows. If a position is not finite there
    is no other column.
    """
    if frames.root_position.shape[0] % groups:
        raise ValueError(
            f"{frames.root_position.shape[0]} rollouts in {groups} groups: expected a "
            "number that they divide"
        )
    positions = positions_of(skeleton, frames)
    height = reference.root_height
    diverged = np.asarray(
        health.has_diverged(positions, fps=fps, min_root=0.1, max_root=2.5 * height)
    )
    row = {"diverged": table.Cell(value=float(diverged.sum()), samples=diverged.size)}
    if not bool(jnp.all(jnp.isfinite(positions))):
        return row
    embedded = _character_features(reference, frames, positions)
    parts = embedded[:, ::STRIDE].reshape(groups, -1, embedded.shape[-1])
    keys = jax.random.split(key, groups)
    spread = [
        diversity.diversity(k, x, num_pairs=PAIRS)
        for k, x in zip(keys, parts, strict=True)
    ]
    distance = [
        frechet.frechet_distance(frechet.moments(x), reference.moments) for x in parts
    ]
    feet = positions[..., jnp.array(skeleton.feet), :]
    feet = feet.at[..., 1].add(-reference.toe_height)
    speed = jnp.linalg.norm(frames.extra["bone_velocity"], axis=-1).mean(axis=1)
    return row | {
        "div": table.cell(jnp.stack(spread)),
        "fid": table.cell(jnp.stack(distance)),
        "ffr_mann": table.cell(
            contact.skating_frame_ratio(feet, fps), bounds=(0.0, 1.0)
        ),
        "ffr_gmd": table.cell(contact.skate_ratio(feet, fps), bounds=(0.0, 1.0)),
        "speed": table.cell(speed),
        "acceleration": table.cell(smoothness.acceleration(positions, fps)),
        "jerk": table.cell(smoothness.jerk(positions, fps)),
    }


def _realized(frames: Frame, fps: float) -> tuple[Array, Array]:
    """Path features that came true, and those asked for, at the same ticks."""
    bone = Trajectory(
        position=frames.extra["bone_origin"], facing=frames.extra["bone_facing"]
    )
    found = jax.vmap(lambda x: path_features.path_features(x, fps=fps))(bone)
    last = max(path_features.path_offsets(fps))
    # What was asked for at tick i + 1 was asked of the bone after tick i.
    return found[:, : -last - 1], frames.extra["wanted_path"][:, 1:-last]


def control_row(frames: Frame, *, fps: float) -> Row:
    """Columns of how well commands were followed.

    te_promised: mean absolute difference of the 12 path features of the frame and those
    wanted, meters and components of unit vectors together, as the paper's |x|;
    te_realized: the same of where the character went; trajectory_error: angle between
    the commanded and the actual velocity.
    """
    promised = jnp.abs(frames.extra["path"] - frames.extra["wanted_path"]).mean(
        axis=(1, 2)
    )
    found, wanted = _realized(frames, fps)
    realized = jnp.abs(found - wanted).mean(axis=(1, 2))
    angle = alignment.trajectory_error(
        frames.desired_velocity, frames.extra["bone_origin"], fps
    ).error
    return {
        "te_promised": table.cell(promised),
        "te_realized": table.cell(realized),
        "trajectory_error": table.cell(angle, scale=180.0 / np.pi),
    }


def long_health(
    positions: Float[Array, "characters frames joints 3"],
    desired_velocity: Float[Array, "characters frames 2"] | None,
    reference: Reference,
    *,
    fps: float,
) -> dict[str, int]:
    """How many of all long "rollouts" "diverged" or were "frozen".

    Diverged: root below 0.1 m or above 2.5 times its median height, a joint faster than
    20 m/s, or no number. Frozen, without a desired velocity: limbs move at less than
    0.05 m/s on average through 30 s; under control, 2 s of that while 0.3 m/s are
    wanted are enough. Positions are in the world.
    """
    height = reference.root_height
    diverged = health.has_diverged(
        positions, fps=fps, min_root=0.1, max_root=2.5 * height
    )
    free = desired_velocity is None
    wanted = jnp.ones((*positions.shape[:2], 2)) if free else desired_velocity
    frozen = health.is_frozen(positions, wanted, fps=fps, seconds=30.0 if free else 2.0)
    return {
        "diverged": int(diverged.sum()),
        "frozen": int(frozen.sum()),
        "rollouts": int(frozen.size),
    }


def score_stepper(
    run: Run,
    space: Space,
    step: Stepper,
    reference: Reference,
    *,
    rollouts: int,
    ticks: int,
    course: str,
    speed: float,
    seed: int,
    groups: int = 4,
) -> Row:
    """Row of free rollouts, with columns of steered ones whose names end in "_uc".

    Free and steered characters each last so many ticks after a first second, where the
    data's own pose still shows. The speed is in m/s. Columns are those of `free_row`,
    these "_uc", and those of `control_row`.
    """
    fps, row = run.train.fps, {}
    skip = round(fps)
    given = commands(run, rollouts, ticks + skip, course=course, speed=speed)
    for i, steered in enumerate((False, True)):
        key, key_pairs = jax.random.split(jax.random.key(seed + i))
        states = start_states(run, space, step, rollouts, seed=seed)
        roll = roller(run, space, step, steered=steered)
        frames = jax.tree.map(lambda x: x[:, skip:], roll(key, states, given)[1])
        found = free_row(
            key_pairs, run.skeleton, reference, frames, fps=fps, groups=groups
        )
        if steered:
            is_finite = "fid" in found
            found = {f"{name}_uc": cell for name, cell in found.items()}
            if is_finite:
                found |= control_row(frames, fps=fps)
        row |= found
    return row


# Commands of an evaluation that is given no others.
COURSE, SPEED = "forward", 1.2
# Clips that are used, where the data have this field.
FIELD, LABELS = "theme", ("walk", "run")
# Columns of a sweep that rollouts under control have.
_STEERED = ("fid_uc", "te_promised", "te_realized", "trajectory_error")
_AMOUNTS = {
    "autoencoder_updates": Amount(
        quick=4000,
        full=20000,
        meaning="of the shared pose autoencoder",
    ),
    "polisher_updates": Amount(
        quick=2000, full=5000, meaning="of each diffusion model"
    ),
    "generator_updates": Amount(
        quick=3000, full=8000, meaning="of each denoising-diffusion GAN"
    ),
    "batch": Amount(quick=64, full=64, meaning="windows per update"),
    "width": Amount(quick=256, full=256, meaning="channels of the networks"),
    "held_out": Amount(quick=0.1, full=0.1, meaning="part for evaluation"),
    "characters": Amount(
        quick=16, full=16, meaning="rollouts of a replication", training=False
    ),
    "seconds": Amount(
        quick=4.0,
        full=4.0,
        meaning="of a rollout after its first, within the held-out ends",
        training=False,
    ),
    "rollout_seconds": Amount(
        quick=8.0,
        full=20.0,
        meaning="to look at",
        training=False,
    ),
}


def _train(job: bench.Job, point: bench.Point) -> tuple[str, dict[str, Any]]:
    """All models lie in one run folder."""
    budget = job.budget
    has = FIELD in dict(clips_io.load_clips(job.data[0]).label_names)
    return "train", dict(
        data=job.data[0],
        out=job.models,
        rows=(point.folder,),
        labels=LABELS if has else (),
        held_out=budget["held_out"],
        autoencoder_steps=budget["autoencoder_updates"],
        polisher_steps=budget["polisher_updates"],
        generator_steps=budget["generator_updates"],
        batch=budget["batch"],
        width=budget["width"],
        seed=job.seed,
    )


def _show(job: bench.Job, point: bench.Point) -> tuple[str, dict[str, Any]]:
    seconds = job.budget["rollout_seconds"]
    return "rollout", dict(
        run=job.models, row=point.folder, seconds=seconds, seed=job.seed
    )


def _prepare(job: bench.Job) -> bench.Evaluation:
    """Free and steered rollouts beside recorded windows."""
    run, budget, seed = load_run(job.models), job.budget, job.seed
    space = load_space(run, "embedded")
    reference = make_reference(run.skeleton, run.train)
    rollouts = budget["characters"] * job.replications
    ticks = round(budget["seconds"] * run.train.fps)

    def stepper(point: bench.Point) -> Stepper:
        polishes, drafts = point.parts
        chain = load_chain(run, "embedded", space, drafts=drafts, polishes=polishes)
        return aamdm_controller.guided(
            chain,
            scale=aamdm_controller.SCALE,
            guided_steps=aamdm_controller.GUIDED_STEPS,
        )

    def real(data: PoseData) -> Row:
        frames = data_frames(run, data, rollouts, ticks, seed=seed)
        return free_row(
            jax.random.key(seed),
            run.skeleton,
            reference,
            frames,
            fps=run.train.fps,
            groups=job.replications,
        )

    truth = real(run.held_out)
    polishes, drafts = job.points[0].parts
    _, config = load_networks(run, "embedded", space, drafts=drafts, polishes=polishes)

    def score(point: bench.Point) -> Row:
        row = score_stepper(
            run,
            space,
            stepper(point),
            reference,
            rollouts=rollouts,
            ticks=ticks,
            course=COURSE,
            speed=SPEED,
            seed=seed,
            groups=job.replications,
        )
        return {name: row[name] for name in (*truth, *_STEERED) if name in row}

    def sampler(point: bench.Point) -> Callable[[Key], Any]:
        step = stepper(point)
        roll = roller(run, space, step, steered=False)
        states = start_states(run, space, step, 1, seed=seed)
        given = commands(run, 1, 1, course=COURSE, speed=SPEED)
        return lambda key: roll(key, states, given)

    return bench.Evaluation(
        real={bench.GROUND_TRUTH: truth, bench.REFERENCE: real(run.train)},
        score=score,
        sampler=sampler,
        describe={
            "config": dataclasses.asdict(config),
            "source": run.source,
            "samples": f"{budget['characters']} rollouts of {budget['seconds']:g} s, "
            f"free and steered (course {COURSE!r}, {SPEED:g} m/s); Fréchet distances "
            f"of every fifth frame to those of {run.train.num_frames} training "
            "frames, no evaluator; other intervals over rollouts",
            "rollouts": rollouts,
            "frames_of_a_rollout": ticks,
        },
    )


BENCH = bench.Bench(
    data=(Path("data/lafan1.npz"),),
    amounts=_AMOUNTS,
    points=bench.paired_points,
    train=_train,
    show=_show,
    prepare=_prepare,
    quality="fid",
    sample="one frame",
)
