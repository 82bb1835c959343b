"""SMGDiff's run-time: a player and a ball that are steered.

One tick (1/30 s) of one player:

1. If the command is not the plan's any more, or M frames have been played, plan anew:
   a. the trajectory generator turns the wish (a target point and a skill) into a path;
      with `Control.follow` the point leads back to where the commands should have
      taken the player, with `Control.agile` it is one that a person reaches (ours);
   b. the rest of the plan's own path, extended by HFTE, is blended into it;
   c. the motion model makes 45 frames of body, ball and contacts for that path, with
      contact guidance in some of its steps;
   d. an inertialized seam: body and ball start where they are displayed.
   With `Control.fetch`, who has lost the ball runs to it first (ours).
2. Display the next frame of the plan.

The paper blends when the control changes; here at every plan, as CAMDM does, since a
path that jumps at a regular plan would be no better.

What frames hold as `extra`: the center of the displayed ball ("ball", meters, world),
and how sure the model is that each joint touches it ("touch", 0..1).

Source: SMGDiff, section 3; Chen et al. 2024 (CAMDM) for HFTE and the seam.
"""

import dataclasses
import functools
from collections.abc import Callable
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from jaxmotion.control import inertia
from jaxmotion.control.frame import Frame, as_displayed
from jaxmotion.control.rollout import Controller, is_due
from jaxmotion.control.steering import (
    ARRIVE,
    Character,
    Tuning,
    calmest,
    check_labels,
    chosen_starts,
)
from jaxmotion.data.ball_clips import BallClips
from jaxmotion.diffusion import chain
from jaxmotion.diffusion.schedule import spread_steps
from jaxmotion.motion import ground, trajectory
from jaxmotion.motion.ball import Scene, rolled
from jaxmotion.motion.rotation import length
from jaxmotion.motion.skeleton import Skeleton, joint_positions
from jaxmotion.systems.smgdiff import data as smgdiff_data
from jaxmotion.systems.smgdiff import guidance as smgdiff_guidance
from jaxmotion.systems.smgdiff import model as smgdiff_model
from jaxmotion.systems.smgdiff import scene as smgdiff_scene
from jaxmotion.systems.smgdiff import training as smgdiff_training
from jaxmotion.systems.smgdiff import trajectory as smgdiff_trajectory
from jaxmotion.systems.smgdiff.guidance import SamplePlan
from jaxmotion.systems.smgdiff.model import Condition, Config, Model
from jaxmotion.systems.smgdiff.scene import Representation
from jaxmotion.systems.smgdiff.trajectory import SamplePath, Wish
from jaxmotion.typing import Key, Params

# As near the ball's surface a joint may push the ball, meters: half a foot, and 2 cm.
_TOUCH_MARGIN = 0.07
# Who fetches a ball runs so fast, m/s, meets one that rolls after a second at most, and
# has it again within this part of the distance at which he had lost it.
_RUN, _FORESEEN, _AGAIN = 3.0, 1.0, 0.6
# Of the limit on a wish, what may change until its second target: of people who
# reverse, the change within half a second by that within 1.5 s.
_SOON_PART = 0.43


@dataclasses.dataclass(frozen=True, kw_only=True)
class Control:
    """Constants of the run-time.

    Attributes:
      apply: M, frames of a plan to play while the command stays (CAMDM's 15).
      least: Frames of a plan to play before a small change of the command counts: as
        of `rollout.is_due`; 1 for at once (paper).
      sharp: A change of the commanded velocity that counts at once, m/s, or of the
        facing of who stands, as far apart as unit vectors are.
      reuse: K of HFTE, points reflected at a time.
      bias_position: Exponent of the blend of positions (CAMDM's).
      bias_facing: Exponent of the blend of facings (CAMDM's).
      seam: Duration of the inertialized seam of the body, seconds; 0 for no seam, of
        the ball either.
      ball_seam: Duration of the ball's. A ball that is drawn to its new place within
        the body's 0.2 s is pushed by nobody: 10 cm are 14 m/s^2.
      follow: Half-life, seconds, in which a wish returns to the commanded path, the
        integral of the commanded velocity; 0 to wish for a velocity alone, as the
        paper does. Ours: without it every player drifts off his course. Whoever is told
        to stand wants to stand where he is. Paths are played `in_time` then.
      leash: The commanded path's end is no farther away, meters: who had to turn around
        does not race after it.
      hurry: Nor does he wish to go faster than so many times the commanded speed.
      turn: Half-life, seconds, of the spring by which who stands turns to the
        commanded facing; 0 for as the path faces, which knows no wish for it (paper).
      answer: Half-life, seconds, of the spring by which the second target of a path,
        if the generator takes one, takes up the command.
      agile: A wish slows down and turns by a change of velocity of so much at most,
        m/s, and that part of the present speed more, .43 of it until the second
        target. 0 for no limit (paper). With .8, three quarters of the takes' dribbles
        that reverse ask for no more, and 96 in 100 that slow down.
      fetch: Who is farther than this from the ball, meters, has lost it: told to go
        anywhere with it, he runs to it first. 0 for never (paper).
      fetches_as: Index of the skill, of who has no ball, by which he does.
      deceleration: Of a ball that is lost, or as far from who goes without one, m/s^2;
        it rolls to rest. Ours: that of the balls in the training data
        (`jaxmotion.data.dribble`).
    """

    apply: int = 15
    least: int = 1
    sharp: float = 0.5
    reuse: int = 15
    bias_position: float = 0.7
    bias_facing: float = 2.2
    seam: float = 0.2
    ball_seam: float = 0.5
    follow: float = 0.0
    leash: float = 1.0
    hurry: float = 1.1
    turn: float = 0.0
    answer: float = 0.1
    agile: float = 0.0
    fetch: float = 0.0
    fetches_as: int = -1
    deceleration: float = 0.8


# For models that ship: the walked path is the commanded one, which outweighs the last
# plan's sooner, and who stands faces as he is told. With exponents of 3, as CAMDM ships
# with, he turns as fast but misses twice as many touches while he does.
OWN_STARTS = Control(least=8, follow=1.0, turn=0.27, bias_position=1.5, agile=0.8)

# The skill of who has no ball, by which whoever lost it fetches it.
ALONE = "off_ball"

# Seconds of a path that a player looks ahead: what he is told shows after .4 s. With .4
# and .6 he is no nearer to it.
AHEAD = 0.5


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True, kw_only=True, eq=False)
class PlayerState:
    """A player and a ball between two ticks; everything in the world.

    Attributes:
      past: The last displayed frames.
      plan: The frames being played.
      cursor: Next frame of the plan.
      anchor: Where the commands should have taken him, (x, z) meters.
      command: What the plan was made for; its label is -1 before the first.
    """

    past: Scene
    plan: Scene
    cursor: Int[Array, "*batch"]
    anchor: Float[Array, "*batch 2"]
    command: trajectory.Command


def init_state(skeleton: Skeleton, past: Scene, *, config: Config) -> PlayerState:
    """State of a player that has shown `past` (world) and has no plan yet.

    Until its first plan it would go on with its mean velocity. `ValueError` for fewer
    frames.
    """
    frames = past.ball.shape[-2]
    if frames < config.past:
        raise ValueError(f"past has {frames} frames, expected {config.past} or more")
    past = jax.tree.map(lambda x: x[-config.past :], past)
    root = past.motion.root_position
    step = (root[-1] - root[0]) / (config.past - 1) * jnp.array([1.0, 0.0, 1.0])
    ahead = jnp.arange(1, config.future + 1, dtype=root.dtype)[:, None] * step[None]
    held = jax.tree.map(lambda x: jnp.repeat(x[-1:], config.future, axis=0), past)
    motion = dataclasses.replace(
        held.motion, root_position=held.motion.root_position + ahead
    )
    return PlayerState(
        past=past,
        plan=dataclasses.replace(held, motion=motion),
        cursor=jnp.zeros((), jnp.int32),
        anchor=root[-1, ::2],
        command=trajectory.Command(
            velocity=step[::2] * config.fps,
            facing=trajectory.root_trajectory(skeleton, past.motion).facing[-1],
            label=jnp.full((), -1, jnp.int32),
        ),
    )


def _away(state: PlayerState) -> Float[Array, ""]:
    """How far he is from the ball, on the ground."""
    gap = state.past.ball[-1] - state.past.motion.root_position[-1]
    return length(gap[::2])


def fetching(
    state: PlayerState, command: trajectory.Command, *, control: Control
) -> trajectory.Command:
    """What he is told: the command, or to run to the ball that he has lost.

    He aims at where it will roll, faces there, and slows down in front of it. Who is
    told to stand, or to go without a ball, does so.
    """
    if control.fetch == 0:
        return command
    ball, fps = state.past.ball, state.past.motion.fps
    here = state.past.motion.root_position[-1, ::2]
    away = _away(state)
    alone = command.label == control.fetches_as
    already = (state.command.label == control.fetches_as) & ~alone
    lost = away > jnp.where(already, _AGAIN, 1.0) * control.fetch
    lost &= ~alone & ~trajectory.is_still(command.velocity)

    number = round(_FORESEEN * fps)
    coming = rolled(ball, fps, num_frames=number, deceleration=control.deceleration)
    speed = jnp.maximum(length(command.velocity), _RUN)
    frames = jnp.round(away / speed * fps).astype(jnp.int32)
    gap = coming[jnp.clip(frames, 1, number) - 1, ::2] - here
    speed = jnp.minimum(speed, away / ARRIVE)
    heading = ground.unit(gap, command.facing)
    fetch = trajectory.Command(
        velocity=speed * heading,
        facing=heading,
        label=jnp.full_like(command.label, control.fetches_as),
    )
    return jax.tree.map(lambda a, b: jnp.where(lost, a, b), fetch, command)


def kicked(
    state: PlayerState, place: Float[Array, "2"], velocity: Float[Array, "2"]
) -> PlayerState:
    """The state after somebody else brought the ball to a place on the ground, (x, z).

    Meters, m/s. The next tick makes a plan.
    """
    ball, fps = state.past.ball, state.past.motion.fps
    ago = jnp.arange(ball.shape[0] - 1, -1, -1, dtype=ball.dtype)[:, None] / fps
    past = dataclasses.replace(
        state.past, ball=ball.at[:, ::2].set(place[None] - ago * velocity[None])
    )
    nobody = dataclasses.replace(
        state.command, label=jnp.full_like(state.command.label, -1)
    )
    return dataclasses.replace(state, past=past, command=nobody)


def plan_level(
    state: PlayerState, command: trajectory.Command, *, control: Control
) -> Int[Array, ""]:
    """Whether a tick needs a plan: 0 for no, 1 for yes."""
    old = state.command
    change = jnp.linalg.norm(old.velocity - command.velocity)
    if control.turn > 0:
        turned = jnp.linalg.norm(old.facing - command.facing)
        turned = jnp.where(trajectory.is_still(command.velocity), turned, 0.0)
        change = jnp.maximum(change, turned)
    due = is_due(change, state.cursor, least=control.least, sharp=control.sharp)
    due = due | (old.label != command.label) | (state.cursor >= control.apply)
    return due.astype(jnp.int32)


def in_time(
    path: trajectory.Trajectory, wish: Wish, *, num_frames: int, fps: float
) -> trajectory.Trajectory:
    """A path that is made shorter if its first frames, which are played, are too long.

    They may be as long as the wish asks; who is faster slows down evenly meanwhile, and
    who wants to stand stops as the path says. People who come as far as a sprinter in
    1.5 s slow down at the end of it, so paths begin faster than they are on the mean:
    played in thirds, those of 3.5 m/s make 3.8.
    """
    moved = wish.past.position[-1] - wish.past.position[-2]
    now, asked = length(moved) * fps, length(wish.velocity)
    most = (asked + jnp.maximum(asked, now)) / 2 * num_frames / fps
    part = jnp.minimum(most / length(path.position[num_frames - 1]), 1.0)
    part = jnp.where(trajectory.is_still(wish.velocity), 1.0, part)
    return dataclasses.replace(path, position=part * path.position)


def _at_most(vector: Float[Array, "2"], most: Array) -> Float[Array, "2"]:
    """The vector, made shorter if it is longer than so much."""
    return vector * jnp.minimum(most / length(vector), 1.0)


def walkable(wish: Wish, *, soon: int, fps: float, control: Control) -> Wish:
    """A wish as people walk, with the second target after so many frames; 0 for none.

    Targets that nobody would reach (turn around, at a run, within a path) are answered
    at once and with all force: feet slide, and the ball goes on without a foot.
    Speeding up has no limit, or he falls behind at every start. And with a target at a
    path's end alone he may take all of it to turn, of which only the first frames are
    played: who steers on is answered late.
    """
    position = wish.past.position
    moved = (position[-1] - position[-4]) * (fps / 3)

    def within(velocity: Array, part: float = 1.0) -> Array:
        if control.agile == 0:
            return velocity
        most = part * (control.agile + control.agile * length(moved))
        onward = ground.unit(moved + 0.25 * velocity)
        change = velocity - moved
        faster = jnp.maximum(jnp.sum(change * onward), 0.0) * onward
        turn = change - faster
        return moved + faster + _at_most(turn, most)

    wish = dataclasses.replace(wish, velocity=within(wish.velocity))
    if soon == 0:
        return wish
    here = trajectory.PlanarFrame(origin=jnp.zeros(2), facing=wish.past.facing[-1])
    told = trajectory.Command(
        velocity=wish.velocity, facing=here.facing, label=wish.label
    )
    path = trajectory.desired_trajectory(
        here, moved, told, num_frames=soon, fps=fps, half_life=control.answer
    )
    velocity = path.position[-1] * (fps / soon)
    return dataclasses.replace(wish, soon=within(velocity, _SOON_PART))


def wanted_trajectory(
    generate: SamplePath,
    key: Key,
    skeleton: Skeleton,
    state: PlayerState,
    command: trajectory.Command,
    *,
    config: Config,
    control: Control,
    soon: int = 0,
) -> trajectory.Trajectory:
    """Steps 1a and 1b: the generated path, blended with the plan's own.

    It has the next `config.future` frames, in the frame of the plan.
    """
    frame = smgdiff_scene.plan_frame(skeleton, state.past.motion)
    past = trajectory.root_trajectory(skeleton, state.past.motion)
    velocity = command.velocity
    if control.follow > 0:
        seconds = config.future / config.fps
        returned = 1.0 - 0.5 ** (seconds / control.follow)
        velocity += returned / seconds * (state.anchor - frame.origin)
        most = control.hurry * length(command.velocity)
        velocity = _at_most(velocity, most)
    wish = Wish(
        past=trajectory.to_local(past, frame),
        velocity=ground.into_frame(velocity, frame.facing),
        label=command.label,
    )
    wish = walkable(wish, soon=soon, fps=config.fps, control=control)
    wanted = generate(key, wish)
    if control.follow > 0:
        wanted = in_time(wanted, wish, num_frames=control.apply, fps=config.fps)
    if control.turn > 0:
        turning = trajectory.desired_trajectory(
            frame,
            command.velocity,
            command,
            num_frames=config.future,
            fps=config.fps,
            half_life=control.turn,
        )
        turned = trajectory.to_local(turning, frame).facing
        still = trajectory.is_still(command.velocity)
        facing = jnp.where(still, turned, wanted.facing)
        wanted = dataclasses.replace(wanted, facing=facing)
    own = trajectory.root_trajectory(skeleton, state.plan.motion)
    ahead = trajectory.rest_of(own, state.cursor, config.future, reuse=control.reuse)
    return trajectory.blend(
        trajectory.to_local(ahead, frame),
        wanted,
        bias_position=control.bias_position,
        bias_facing=control.bias_facing,
    )


def replan(
    generate: SamplePath,
    sample: SamplePlan,
    key: Key,
    state: PlayerState,
    command: trajectory.Command,
    *,
    representation: Representation,
    config: Config,
    control: Control,
    soon: int = 0,
) -> PlayerState:
    """Step 1: a new plan, none of it displayed yet."""
    key_path, key_motion = jax.random.split(key)
    skeleton = representation.skeleton
    wanted = wanted_trajectory(
        generate,
        key_path,
        skeleton,
        state,
        command,
        config=config,
        control=control,
        soon=soon,
    )
    frame = smgdiff_scene.plan_frame(skeleton, state.past.motion)
    past = smgdiff_scene.to_frame(state.past, frame)
    condition = Condition(
        past=smgdiff_scene.to_features(past, representation),
        trajectory=wanted,
        label=command.label,
        ball=past.ball[-1],
    )
    x = sample(key_motion, condition)
    scene, _ = smgdiff_scene.to_scene(x, past.ball[-1], representation)
    chunk = smgdiff_scene.from_frame(scene, frame)
    if control.seam > 0:
        chunk = join(state.past, chunk, representation, control=control)
    if control.fetch > 0:
        lost = _away(state) > _AGAIN * control.fetch
        lost &= command.label == control.fetches_as
        rolls = rolled(
            state.past.ball,
            config.fps,
            num_frames=config.future,
            deceleration=control.deceleration,
        )
        chunk = dataclasses.replace(chunk, ball=jnp.where(lost, rolls, chunk.ball))
    cursor = jnp.zeros_like(state.cursor)
    return dataclasses.replace(state, plan=chunk, cursor=cursor, command=command)


def join(
    past: Scene, chunk: Scene, representation: Representation, *, control: Control
) -> Scene:
    """Step 1d: a chunk that starts where body and ball are displayed.

    Its differences from `past`, of at least two displayed frames, are faded out. The
    ball keeps its velocity, too, unless a joint is near enough to push it.
    """
    fps = chunk.motion.fps
    shown = jax.tree.map(lambda x: x[-2:], past.motion)
    motion = inertia.inertialize(shown, chunk.motion, duration=control.seam)
    step, moved = chunk.ball[1] - chunk.ball[0], past.ball[-1] - past.ball[-2]
    offset = past.ball[-1] - (chunk.ball[0] - step)
    # Where a foot is at the ball, the ball's velocity may jump: a touch is no error.
    first = jax.tree.map(lambda x: x[:2], motion)
    feet = joint_positions(representation.skeleton, first)
    feet = feet[:, jnp.array(representation.joints)]
    away = length(feet - past.ball[None, -1:])
    touched = jnp.min(away) < representation.radius + _TOUCH_MARGIN
    drift = jnp.where(touched, 0.0, (moved - step) * fps)
    times = jnp.arange(1, chunk.ball.shape[0] + 1, dtype=offset.dtype) / fps
    fade = inertia.decay(offset, drift, times, duration=control.ball_seam)
    return dataclasses.replace(chunk, motion=motion, ball=chunk.ball + fade)


def advance(
    state: PlayerState,
    command: trajectory.Command,
    *,
    config: Config,
    control: Control,
) -> tuple[PlayerState, Frame]:
    """Step 2: displays the next frame, and moves the commanded path on."""
    now = jax.tree.map(
        lambda x: jax.lax.dynamic_slice_in_dim(x, state.cursor, 1), state.plan
    )
    past = jax.tree.map(
        lambda old, new: jnp.concatenate([old[1:], new]), state.past, now
    )
    here = now.motion.root_position[0, ::2]
    away = state.anchor + command.velocity / config.fps - here
    away /= jnp.maximum(length(away) / control.leash, 1.0)
    anchor = jnp.where(trajectory.is_still(command.velocity), here, here + away)
    frame = Frame(
        root_position=now.motion.root_position[0],
        joint_rotation=now.motion.joint_rotation[0],
        desired_velocity=command.velocity,
        desired_facing=command.facing,
        planned=state.cursor == 0,
        extra={"ball": now.ball[0], "touch": now.touch[0]},
        fps=now.motion.fps,
    )
    return dataclasses.replace(
        state,
        past=past,
        cursor=state.cursor + 1,
        anchor=anchor,
    ), frame


def shown(state: PlayerState, frame: Frame) -> PlayerState:
    """The state after a frame whose pose was displayed in place of the plan's own."""
    motion = as_displayed(state.past.motion, frame)
    return dataclasses.replace(
        state, past=dataclasses.replace(state.past, motion=motion)
    )


def controller(
    generate: SamplePath,
    sample: SamplePlan,
    *,
    representation: Representation,
    config: Config,
    control: Control | None = None,
    soon: int = 0,
) -> Controller:
    """The run-time of one player, for `rollout.tick` and `rollout.rollout`.

    Paths are `smgdiff_trajectory.sampler`'s, with its `Config.soon`, or `straight`,
    plans `smgdiff_guidance.sampler`'s. `ValueError` if `control.apply` is not in
    1..`config.future`, or nobody can fetch as `control.fetches_as`.
    """
    control = Control() if control is None else control
    if not 1 <= control.apply <= config.future:
        raise ValueError(f"apply is {control.apply}, expected 1..{config.future}")
    if control.fetch > 0 and not 0 <= control.fetches_as < config.num_labels:
        raise ValueError(
            f"fetches_as is {control.fetches_as}, expected 0..{config.num_labels - 1}"
        )
    told = functools.partial(fetching, control=control)
    plan: Callable = lambda key, state, command: replan(  # noqa: E731
        generate,
        sample,
        key,
        state,
        told(state, command),
        representation=representation,
        config=config,
        control=control,
        soon=soon,
    )
    return Controller(
        plan_level=lambda state, command: plan_level(
            state, told(state, command), control=control
        ),
        plans=(plan,),
        advance=lambda state, command: advance(
            state, told(state, command), config=config, control=control
        ),
        shown=shown,
    )


@dataclasses.dataclass(frozen=True, kw_only=True)
class Method:
    """What makes a controller of parameters; hashable.

    Those are of the motion model and of the paths, and the representation.

    Both chains take `step` where they are not guided; `steps` of the motion model's
    schedule are visited, None for all. Guidance is tuned for short trainings.
    """

    config: Config
    paths: smgdiff_trajectory.Config
    guided: smgdiff_guidance.Guidance = smgdiff_guidance.TUNED
    control: Control | None = None
    step: chain.StepFactory = chain.ancestral_step
    steps: tuple[int, ...] | None = None

    def __call__(self, params: tuple[Params, Params, Representation]) -> Controller:
        """The controller."""
        motion, paths, representation = params
        return controller(
            smgdiff_trajectory.sampler(paths, config=self.paths, step=self.step),
            smgdiff_guidance.sampler(
                motion,
                config=self.config,
                representation=representation,
                guided=self.guided,
                step=self.step,
                steps=self.steps,
            ),
            representation=representation,
            config=self.config,
            control=self.control,
            soon=self.paths.soon,
        )


def _tuning(method: Method) -> Tuning:
    total, guided = method.config.num_steps, method.guided
    control = Control() if method.control is None else method.control

    def tuned(num_steps: int, scale: Any) -> Method:
        return dataclasses.replace(
            method,
            guided=dataclasses.replace(guided, rate=scale),
            steps=None if num_steps == total else spread_steps(total, num_steps),
        )

    return Tuning(
        method=tuned,
        num_steps=tuple(range(max(guided.start + guided.end, 1), total + 1)),
        own_steps=total,
        scale=float(guided.rate),
        scales=(0.0, 1.0),
        patience=method.config.future - control.apply,
    )


def start_states(
    data: BallClips, model: Model, labels: np.ndarray, *, seed: int
) -> PlayerState:
    """States of players that start with real frames of their skill, batch axis first.

    Each is moved so that it stands at the origin and faces +z.

    A `ValueError` names a skill without a clip that is long enough.
    """
    check_labels(labels, model.labels)
    arrays = smgdiff_data.scene_arrays(data, model.config.past)
    owner = np.asarray(data.clips.labels[smgdiff_data.FIELD])[arrays.index.clips]
    generator = np.random.default_rng(seed)
    chosen = []
    for label in labels:
        known = np.flatnonzero(owner == label)
        if known.size == 0:
            raise ValueError(f"no clip of skill {model.labels[label]!r} to start from")
        chosen.append(int(generator.choice(known)))
    scenes, _ = smgdiff_data.all_scenes(arrays, jnp.asarray(chosen))
    skeleton = model.representation.skeleton
    return _states_of(skeleton, _at_origin(skeleton, scenes), config=model.config)


def own_states(model: Model, labels: np.ndarray, *, seed: int) -> PlayerState:
    """States of players that start with the model's own frames of their skill."""
    if model.starts is None:
        raise ValueError("the model has no frames to start from")
    chosen = chosen_starts(model.starts, labels, model.labels, seed=seed)
    return _states_of(model.representation.skeleton, chosen, config=model.config)


@functools.partial(jax.jit, static_argnames="config")
def _states_of(skeleton: Skeleton, scenes: Scene, *, config: Config) -> PlayerState:
    return jax.vmap(functools.partial(init_state, skeleton, config=config))(scenes)


@jax.jit
def _at_origin(skeleton: Skeleton, scenes: Scene) -> Scene:
    """Each scene moved so that its player ends at the origin and faces +z."""

    def local(scene: Scene) -> Scene:
        frame = smgdiff_scene.plan_frame(skeleton, scene.motion)
        return smgdiff_scene.to_frame(scene, frame)

    return jax.vmap(local)(scenes)


def load_run(path: Path) -> tuple[smgdiff_training.Run, Model, dict[str, Params]]:
    """A run folder, and its model of 8 steps of motion and the most of paths.

    `CheckpointError` if a stage was not trained.
    """
    run = smgdiff_training.load_run(path)
    return run, *smgdiff_training.load_networks(run)


def own_starts(path: Path, *, number: int, seed: int = 0) -> Scene:
    """Frames in which a run's players stand (`Model.starts`), none of them recorded.

    Players of each skill stand for twelve seconds; of sixteen the calmest `number` are
    taken.
    """
    run, model, _ = load_run(path)
    character, skeleton = load_character(path), model.representation.skeleton
    found = []
    for label in range(len(model.labels)):
        labels = np.full(16, label)
        states = start_states(run.train, model, labels, seed=seed)
        past = model.config.past
        _, frames = calmest(
            character, states, labels, number=number, past=past, seed=seed
        )
        scenes = Scene(motion=frames.motion, **frames.extra)
        found.append(_at_origin(skeleton, scenes))
    return jax.tree.map(lambda *x: jnp.stack(x), *found)


def load_character(
    path: Path, *, step: chain.StepFactory = chain.ancestral_step
) -> Character:
    """The player of a run folder or an exported file; frames show its ball.

    It starts in the model's own frames where it has some, else in frames that the run
    was trained on. `step` makes the step of the unguided parts of the chain; the
    default is the paper's.

    `CheckpointError` if a stage was not trained or the file is damaged, `ValueError`
    for another system.
    """
    if path.is_file():
        model, params = smgdiff_model.import_file(path)
        starts = functools.partial(own_states, model)
    else:
        run, model, params = load_run(path)
        starts = functools.partial(start_states, run.train, model)
    control = None if model.starts is None else OWN_STARTS
    # Nobody who dribbles or sprints is more than .9 m from his ball.
    if control and ALONE in model.labels:
        alone = model.labels.index(ALONE)
        control = dataclasses.replace(control, fetch=1.0, fetches_as=alone)
    method = Method(config=model.config, paths=model.paths, control=control, step=step)
    return Character(
        skeleton=model.representation.skeleton,
        labels=model.labels,
        fps=model.config.fps,
        source=model.source,
        params=(params["motion"], params["paths"], model.representation),
        method=method,
        tuning=_tuning(method),
        starts=lambda labels, seed: starts(labels, seed=seed),
        toe_height=model.toe_height,
        ahead=AHEAD,
    )
