"""CAMDM's run-time: a character that plans, plays, and plans again when told.

One tick (1/30 s) of one character:

1. If the command changed, or M frames of the plan have been played, plan anew:
   a. the path the user wants: springs from the desired velocity and facing;
   b. the model's own path: the rest of the plan, extended by HFTE to its length;
   c. the blend of both is the condition, with the last 10 *displayed* poses;
   d. sample 45 poses; within the first plans after a change of style with
      classifier-free guidance on the past, which frees the model from its old style;
   e. an inertialized seam: the plan starts where the displayed motion is, with its
      velocity, and takes up the model's motion within 0.2 s.
2. Display the next pose of the plan, and move the springs on. A frame's `extra` has
   the "anchor", where the desired motion is: (x, z) meters.

Source: Chen et al. 2024 (CAMDM), section 3.2; the released Unity run-time for what the
paper does not say (noted at each constant).
"""

import dataclasses
import functools
from collections.abc import Callable
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from jaxmotion.control import inertia
from jaxmotion.control.frame import Frame, as_displayed
from jaxmotion.control.rollout import Controller, is_due
from jaxmotion.control.steering import (
    Character,
    Tuning,
    check_labels,
    chosen_starts,
)
from jaxmotion.data import windows
from jaxmotion.data.clips import Clips
from jaxmotion.diffusion import chain, schedule
from jaxmotion.diffusion.schedule import spread_steps
from jaxmotion.motion import features, spring, trajectory
from jaxmotion.motion.skeleton import Motion, Skeleton, joint_positions
from jaxmotion.systems.camdm import model as camdm_model
from jaxmotion.systems.camdm import training as camdm_training
from jaxmotion.typing import Key, Params


@dataclasses.dataclass(frozen=True, kw_only=True)
class Control:
    """Constants of the run-time; the defaults are the paper's where it has them.

    Attributes:
      apply: M, frames of a plan to play while the command stays (paper 15).
      replan_on_change: The lazy trigger of the paper; the release plans only every
        M frames (False).
      extend: Use HFTE; without it the user's path alone is the condition (ablation).
      reuse: K of HFTE, points reflected at a time (paper 15, released code 23).
      guidance_scale: Scale of the guidance on the past after a change of style (paper
        0.7, code 0.5).
      guided_plans: Plans that are guided after a change of style (paper: "when the
        style label has just changed", so 1; code 2).
      guide_start: The first plans after the start are guided as those after a change of
        style are (released code: its counter starts full).
      half_life: Half-life of the springs of velocity and facing, seconds (orangeduck
        0.27).
      bias_position: Exponent of the blend of positions (released scene 0.7, code
        0.4).
      bias_facing: Exponent of the blend of facings (released code 2.2).
      seam: Duration of the inertialized seam, seconds (released code 0.2); 0 for none.
      follow: Half-life, seconds, in which the wanted path returns to the commanded
        one, the integral of the desired velocity; 0 to steer by velocity alone, as
        the paper does. Ours: without it every rollout drifts off its course. Whoever
        is told to stand wants to stand where he comes to a stop.
      least: Frames of a plan to play before a small change of the command counts: as
        of `rollout.is_due`; 1 for at once (paper).
      sharp: A change of velocity, m/s, or of facing, as far apart as unit vectors are,
        that counts at once.
    """

    apply: int = 15
    replan_on_change: bool = True
    extend: bool = True
    reuse: int = 15
    guidance_scale: float | Float[Array, ""] = 0.7
    guided_plans: int = 1
    guide_start: bool = False
    half_life: float = 0.27
    bias_position: float = 0.7
    bias_facing: float = 2.2
    seam: float = 0.2
    follow: float = 0.0
    least: int = 1
    sharp: float = 0.5


# The released Unity run-time (its code; its scene has bias_position 0.7). It smooths
# commands by a linear interpolation instead of springs, which is not offered here.
RELEASED = Control(
    replan_on_change=False,
    reuse=23,
    guidance_scale=0.5,
    guided_plans=2,
    guide_start=True,
    bias_position=0.4,
)


# For models that ship: the walked path is the commanded one, which soon outweighs the
# path of the last plan. With the paper's exponents it would follow 0.2 s later: 27 cm
# off a figure eight, not 5. Small changes wait: who turns at 1.2 rad/s and is told so
# in every tick makes a sixth of the plans, and walks at 1.37 m/s, not 1.09, of 1.4.
OWN_STARTS = Control(follow=1.0, bias_position=3.0, bias_facing=3.0, least=8)

# Seconds. Plans that go on from the last pose differ from it in velocity alone, which
# may be taken up sooner: a long seam moves planted feet.
VELOCITY_SEAM = 0.1


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True, kw_only=True, eq=False)
class CharacterState:
    """A character between two ticks; everything in the world.

    Attributes:
      past: The last displayed poses.
      plan: The poses being played.
      cursor: Next pose of the plan.
      velocity: Velocity of the desired motion (the spring), meters per second.
      acceleration: Acceleration of the desired motion, meters per second squared.
      facing: Desired facing (the spring), unit.
      turn_rate: Turn rate of the desired facing, radians per second.
      anchor: Where the desired motion is, (x, z) meters: the commanded path's end.
      command: What the plan was made for; its label is -1 before the first.
      guided: Plans that are still to be guided.
    """

    past: Motion
    plan: Motion
    cursor: Int[Array, "*batch"]
    velocity: Float[Array, "*batch 2"]
    acceleration: Float[Array, "*batch 2"]
    facing: Float[Array, "*batch 2"]
    turn_rate: Float[Array, "*batch"]
    anchor: Float[Array, "*batch 2"]
    command: trajectory.Command
    guided: Int[Array, "*batch"]


def init_state(
    skeleton: Skeleton, past: Motion, *, config: camdm_model.Config
) -> CharacterState:
    """State of a character that has shown `past` (world) and has no plan yet.

    The springs start at the mean velocity of the poses; `ValueError` for fewer of them.
    """
    frames = past.root_position.shape[-2]
    if frames < config.past:
        raise ValueError(f"past has {frames} frames, expected {config.past} or more")
    past = jax.tree.map(lambda x: x[-config.past :], past)
    position = past.root_position
    step = (position[-1] - position[0]) / (config.past - 1)
    ahead = jnp.arange(1, config.future + 1, dtype=position.dtype)[:, None]
    level = step * jnp.array([1.0, 0.0, 1.0])
    plan = Motion(
        root_position=position[-1:] + ahead * level[None],
        joint_rotation=jnp.repeat(past.joint_rotation[-1:], config.future, axis=0),
        fps=past.fps,
    )
    facing = trajectory.root_trajectory(skeleton, past).facing[-1]
    velocity = level[::2] * config.fps
    return CharacterState(
        past=past,
        plan=plan,
        cursor=jnp.zeros((), jnp.int32),
        velocity=velocity,
        acceleration=jnp.zeros(2),
        facing=facing,
        turn_rate=jnp.zeros(()),
        anchor=position[-1, ::2],
        command=trajectory.Command(
            velocity=velocity, facing=facing, label=jnp.full((), -1, jnp.int32)
        ),
        guided=jnp.zeros((), jnp.int32),
    )


def is_new_style(
    state: CharacterState, command: trajectory.Command, *, control: Control
) -> Bool[Array, ""]:
    """Whether a command changes the style; the first one does with `guide_start`."""
    started = (state.command.label >= 0) | control.guide_start
    return (state.command.label != command.label) & started


def plan_level(
    state: CharacterState, command: trajectory.Command, *, control: Control
) -> Int[Array, ""]:
    """Which plan a tick needs: 0 for none, 1 for a plan, 2 for a guided one."""
    old = state.command
    need = (old.label < 0) | (state.cursor >= control.apply)
    if control.replan_on_change:
        change = jnp.maximum(
            jnp.linalg.norm(old.velocity - command.velocity),
            jnp.linalg.norm(old.facing - command.facing),
        )
        need = need | is_due(
            change, state.cursor, least=control.least, sharp=control.sharp
        )
        need = need | (old.label != command.label)
    new_style = is_new_style(state, command, control=control) & (
        control.guided_plans > 0
    )
    guided = need & (new_style | (state.guided > 0))
    return need.astype(jnp.int32) + guided.astype(jnp.int32)


def plan_frame(
    skeleton: Skeleton, past: Motion, *, config: camdm_model.Config
) -> trajectory.PlanarFrame:
    """Frame of the next plan: at the last displayed pose (world).

    With heading "random" its axes are the world's, as in the release.
    """
    last = jax.tree.map(lambda x: x[-1:], past)
    here = trajectory.root_trajectory(skeleton, last)
    facing = here.facing[0] if config.heading == "facing" else jnp.array([0.0, 1.0])
    return trajectory.PlanarFrame(origin=here.position[0], facing=facing)


def wanted_trajectory(
    skeleton: Skeleton,
    state: CharacterState,
    command: trajectory.Command,
    *,
    config: camdm_model.Config,
    control: Control,
) -> trajectory.Trajectory:
    """Steps 1a to 1c: the user's path, blended with the model's own."""
    here = trajectory.PlanarFrame(
        origin=state.past.root_position[-1, ::2], facing=state.facing
    )
    desired = trajectory.desired_trajectory(
        here,
        state.velocity,
        command,
        num_frames=config.future,
        fps=config.fps,
        half_life=control.half_life,
        acceleration=state.acceleration,
        turn_rate=state.turn_rate,
    )
    if control.follow > 0:
        ahead = jnp.arange(1, config.future + 1) / config.fps
        returned = 1.0 - 0.5 ** (ahead / control.follow)
        pull = returned[:, None] * (state.anchor - here.origin)[None]
        desired = dataclasses.replace(desired, position=desired.position + pull)
    if not control.extend:
        return desired
    own = trajectory.root_trajectory(skeleton, state.plan)
    ahead = trajectory.rest_of(own, state.cursor, config.future, reuse=control.reuse)
    return trajectory.blend(
        ahead,
        desired,
        bias_position=control.bias_position,
        bias_facing=control.bias_facing,
    )


def replan(
    sample: camdm_model.Sample,
    key: Key,
    skeleton: Skeleton,
    state: CharacterState,
    command: trajectory.Command,
    *,
    config: camdm_model.Config,
    control: Control,
    guided: bool,
) -> CharacterState:
    """Step 1: a new plan, none of it displayed yet.

    With `guided`, a character that needs no guidance gets the scale that changes
    nothing (it may stand beside a guided one in a batch).
    """
    frame = plan_frame(skeleton, state.past, config=config)
    wanted = wanted_trajectory(skeleton, state, command, config=config, control=control)
    is_new = is_new_style(state, command, control=control)
    left = jnp.where(is_new, control.guided_plans, state.guided)
    condition = camdm_model.Condition(
        past=camdm_model.to_features(
            features.to_frame(state.past, frame), config=config
        ),
        trajectory=trajectory.to_local(wanted, frame),
        label=command.label,
        keep_past=jnp.ones((), bool),
    )
    scale = jnp.where(left > 0, control.guidance_scale, 1.0) if guided else None
    poses = sample(key, condition, scale=scale)
    chunk = features.from_frame(camdm_model.to_motion(poses, config=config), frame)
    if control.seam > 0:
        shown = jax.tree.map(lambda x: x[-2:], state.past)
        chunk = inertia.inertialize(shown, chunk, duration=control.seam)
    return dataclasses.replace(
        state,
        plan=chunk,
        cursor=jnp.zeros_like(state.cursor),
        command=command,
        guided=jnp.maximum(left - 1, 0),
    )


def advance(
    state: CharacterState,
    command: trajectory.Command,
    *,
    config: camdm_model.Config,
    control: Control,
) -> tuple[CharacterState, Frame]:
    """Step 2: displays the next pose, and moves the springs on."""
    pose = jax.tree.map(
        lambda x: jax.lax.dynamic_slice_in_dim(x, state.cursor, 1), state.plan
    )
    past = jax.tree.map(
        lambda old, new: jnp.concatenate([old[1:], new]), state.past, pose
    )
    times = {"half_life": control.half_life, "dt": 1.0 / config.fps}
    anchor, velocity, acceleration = spring.velocity_spring(
        state.anchor, state.velocity, state.acceleration, command.velocity, **times
    )
    facing, turn_rate = spring.facing_spring(
        state.facing, state.turn_rate, command.facing, **times
    )
    stops = trajectory.is_still(command.velocity) & ~trajectory.is_still(state.velocity)
    anchor = jnp.where(stops, pose.root_position[0, ::2], anchor)
    frame = Frame(
        root_position=pose.root_position[0],
        joint_rotation=pose.joint_rotation[0],
        desired_velocity=velocity,
        desired_facing=facing,
        planned=state.cursor == 0,
        extra={"anchor": anchor},
        fps=config.fps,
    )
    # A style that changes while the old plan still plays arms the next plans.
    armed = is_new_style(state, command, control=control) & (state.cursor > 0)
    return dataclasses.replace(
        state,
        past=past,
        guided=jnp.where(armed, control.guided_plans, state.guided),
        cursor=state.cursor + 1,
        velocity=velocity,
        acceleration=acceleration,
        facing=facing,
        turn_rate=turn_rate,
        anchor=anchor,
    ), frame


def controller(
    params: Params,
    skeleton: Skeleton,
    *,
    config: camdm_model.Config,
    control: Control | None = None,
    table: schedule.Schedule | None = None,
    step: chain.StepFactory = chain.ancestral_step,
    steps: tuple[int, ...] | None = None,
) -> Controller:
    """The run-time of one character, for `rollout.tick` and `rollout.rollout`.

    Its second planner is the guided one. `steps` are those of the schedule (None: the
    cosine one) to visit, increasing; None for all. `ValueError` if `control.apply` is
    not in 1..`config.future`.
    """
    control = Control() if control is None else control
    if not 1 <= control.apply <= config.future:
        raise ValueError(f"apply is {control.apply}, expected 1..{config.future}")
    sample = camdm_model.sampler(
        params, config=config, table=table, step=step, steps=steps
    )

    def plan(guided: bool) -> Callable:
        return lambda key, state, command: replan(
            sample,
            key,
            skeleton,
            state,
            command,
            config=config,
            control=control,
            guided=guided,
        )

    return Controller(
        plan_level=functools.partial(plan_level, control=control),
        plans=(plan(False), plan(True)),
        advance=functools.partial(advance, config=config, control=control),
        shown=lambda state, frame: dataclasses.replace(
            state, past=as_displayed(state.past, frame)
        ),
    )


@dataclasses.dataclass(frozen=True, kw_only=True)
class Method:
    """What makes a controller of `(network's parameters, skeleton)`; hashable."""

    config: camdm_model.Config
    control: Control | None = None
    step: chain.StepFactory = chain.ancestral_step
    steps: tuple[int, ...] | None = None

    def __call__(self, params: tuple[Params, Skeleton]) -> Controller:
        """The controller."""
        return controller(
            *params,
            config=self.config,
            control=self.control,
            step=self.step,
            steps=self.steps,
        )


def _tuning(method: Method, *, all_steps: bool) -> Tuning:
    control = Control() if method.control is None else method.control
    every = tuple(range(1, method.config.num_steps + 1))
    own = method.steps or every
    offered = every if all_steps else own

    def tuned(num_steps: int, scale: Any) -> Method:
        places = spread_steps(len(offered), num_steps)
        some = tuple(offered[i - 1] for i in places)
        return dataclasses.replace(
            method,
            control=dataclasses.replace(control, guidance_scale=scale),
            steps=method.steps if num_steps == len(own) else some,
        )

    return Tuning(
        method=tuned,
        num_steps=tuple(range(1, len(offered) + 1)),
        own_steps=len(own),
        scale=float(control.guidance_scale),
        scales=(0.0, 2.0),
        patience=method.config.future - control.apply,
    )


def character(
    params: Params,
    model: camdm_model.Model,
    *,
    control: Control | None = None,
    step: chain.StepFactory = chain.ancestral_step,
    steps: int | tuple[int, ...] | None = None,
) -> Character:
    """A model as a character to be steered.

    Args:
        model: Without poses of its own (`starts`) it starts from clips alone.
      control: Constants of the run-time; None for `OWN_STARTS` where the model has
        poses of its own, else for the paper's.
      step: Makes the chain's step, such as `chain.dpm_solver_step`. Another
        `functools.partial` is another program: make one once.
      steps: Steps of the schedule to visit, increasing up to T, or how many of them,
        evenly spread; None for the model's.

    `ValueError` if the steps are none of its schedule.
    """
    if control is None and model.starts is not None:
        control = OWN_STARTS
        if model.config.seam_half_life:
            control = dataclasses.replace(control, seam=VELOCITY_SEAM)
    if isinstance(steps, int | np.integer) and not isinstance(steps, bool):
        steps = spread_steps(model.config.num_steps, int(steps))
    if steps is not None:
        steps = camdm_model.check_steps(steps, config=model.config)

    method = Method(
        config=model.config, control=control, step=step, steps=steps or model.steps
    )

    def clip_starts(clips: Clips, labels: np.ndarray, seed: int) -> CharacterState:
        own, field = camdm_model.fitting_clips(model, clips)
        return start_states(own, model, labels, field=field, seed=seed)

    return Character(
        skeleton=model.skeleton,
        labels=model.labels,
        fps=model.config.fps,
        source=model.source,
        params=(params, model.skeleton),
        method=method,
        tuning=_tuning(method, all_steps=model.all_steps),
        starts=lambda labels, seed: own_states(model, labels, seed=seed),
        clip_starts=clip_starts,
        toe_height=model.toe_height,
    )


def load_character(
    path: Path,
    *,
    control: Control | None = None,
    step: chain.StepFactory = chain.ancestral_step,
    steps: int | tuple[int, ...] | None = None,
) -> Character:
    """The character of a run folder or an exported file; see `character`.

    It starts in the model's own poses where it has some, else in the mean pose of its
    data where it knows that, else in poses of the clips that the run was trained on.

    `CheckpointError` if there is no whole checkpoint, `ValueError` for another system.
    """
    model, params = camdm_model.load(path)
    made = character(params, model, control=control, step=step, steps=steps)
    if model.starts is not None:
        return made

    def starts(labels: np.ndarray, seed: int) -> CharacterState:
        if model.config.rotation_mean and model.config.heading == "facing":
            check_labels(labels, model.labels)
            one, many = mean_pose(model), len(labels)
            same = jax.tree.map(lambda x: jnp.broadcast_to(x, (many, *x.shape)), one)
            return _states_of(model.skeleton, same, config=model.config)
        run = camdm_training.load_run(path)
        return start_states(run.train, model, labels, field=run.field, seed=seed)

    return dataclasses.replace(made, starts=starts)


def start_states(
    clips: Clips, model: camdm_model.Model, labels: np.ndarray, *, field: str, seed: int
) -> CharacterState:
    """States of characters that start with real poses of their style, batch axis first.

    Each is moved so that it stands at the origin and faces +z. The label field `field`
    is the style. A `ValueError` names a style without a clip that is long enough.
    """
    past = model.config.past
    index = windows.window_index(clips, past, short="skip")
    owner = np.asarray(clips.labels[field])[np.asarray(index.clips)]
    generator = np.random.default_rng(seed)
    starts = []
    check_labels(labels, model.labels)
    for label in labels:
        known = np.flatnonzero(owner == label)
        if known.size == 0:
            raise ValueError(
                f"no clip of style {model.labels[label]!r} to start from: expected one "
                f"of {past} frames among those given (of a run, those held out)"
            )
        starts.append(int(index.starts[generator.choice(known)]))
    cut = jax.vmap(lambda start: windows.cut(clips, start, past))
    return _states_of(model.skeleton, cut(jnp.asarray(starts)), config=model.config)


def own_states(
    model: camdm_model.Model, labels: np.ndarray, *, seed: int = 0
) -> CharacterState:
    """States of characters that start with the model's own poses of their style."""
    if model.starts is None:
        raise ValueError("the model has no poses to start from: give clips")
    chosen = chosen_starts(model.starts, labels, model.labels, seed=seed)
    return _states_of(model.skeleton, chosen, config=model.config)


def mean_pose(model: camdm_model.Model) -> Motion:
    """A character that stands at the origin in the mean pose of its data, facing +z.

    As many equal frames as a plan wants to see; the lowest joint is on the ground. The
    model has a mean pose (`Config.rotation_mean`) of samples that face +z.
    """
    config = model.config
    zeros = jnp.zeros((config.past, config.num_features))
    motion = camdm_model.to_motion(zeros, config=config)
    lowest = jnp.min(joint_positions(model.skeleton, motion)[..., 1])
    raised = motion.root_position.at[:, 1].set(-lowest)
    return dataclasses.replace(motion, root_position=raised)


def at_origin(skeleton: Skeleton, motion: Motion) -> Motion:
    """A motion moved so that its last pose stands at the origin and faces +z."""
    path = trajectory.root_trajectory(skeleton, motion)
    frame = trajectory.PlanarFrame(origin=path.position[-1], facing=path.facing[-1])
    return features.to_frame(motion, frame)


@functools.partial(jax.jit, static_argnames="config")
def _states_of(
    skeleton: Skeleton, motions: Motion, *, config: camdm_model.Config
) -> CharacterState:
    def state(motion: Motion) -> CharacterState:
        return init_state(skeleton, at_origin(skeleton, motion), config=config)

    return jax.vmap(state)(motions)
