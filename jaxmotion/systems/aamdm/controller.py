"""AAMDM's run-time: a character that takes one generated frame a tick.

One tick (1/60 s) of one character:

1. the path that the user wants, by springs from how the character moves now, at a
   third, two thirds and a whole second ahead;
2. the next frame, each of its denoising steps guided down the gradient of the distance
   between its path features and those wanted (eq. 13), or unguided;
3. the pose that the frame means, and the simulation bone moved on by its velocity.

The controller takes any `Stepper`, so that baselines, which are steered in other ways,
run in it too; `guided` makes one of AAMDM.

Source: Li et al. 2024 (AAMDM), sections 3.5 and 3.6. J is ours: half the squared
distance of the 12 features in units of their deviation over the data.

What frames hold as `extra`: the simulation bone in the world ("bone_origin",
"bone_facing", "bone_velocity" in m/s), the path features that the frame promises
("path") and those that were asked for at this tick ("wanted_path").
"""

import dataclasses
import functools
import inspect
import math
from collections.abc import Callable
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxmotion.control.frame import Frame
from jaxmotion.control.rollout import Controller
from jaxmotion.control.steering import Character, Tuning, calmest
from jaxmotion.diffusion import chain
from jaxmotion.motion import features, ground, path_features, pose, spring
from jaxmotion.motion.features import unpack
from jaxmotion.motion.trajectory import Command, PlanarFrame, Trajectory, is_still
from jaxmotion.systems.aamdm import model as aamdm_model
from jaxmotion.systems.aamdm import space as aamdm_space
from jaxmotion.systems.aamdm import stored as aamdm_stored
from jaxmotion.systems.aamdm import training as aamdm_training
from jaxmotion.systems.aamdm.data import PoseData
from jaxmotion.systems.aamdm.embedding import PATH
from jaxmotion.systems.aamdm.model import Sample
from jaxmotion.systems.aamdm.space import Space
from jaxmotion.typing import Exported, Key, Objective, Params

# Strength of the guidance, epsilon of eq. 13; ours.
SCALE = 3.0
# How many steps at the chain's end are guided; ours. The paper guides all: what earlier
# ones add is denoised away (experiments/results/findings.md), at a gradient each.
GUIDED_STEPS = 1
# `Character.coast`; with .25 s, as others have, it comes later to a place.
COAST = 0.15
# What who stands is asked to go faster than told, m/s (`wanted_path`). Without it, told
# to go at 0.8 m/s, two of 16 stand for two seconds. He stands whose speed is a small
# part of the commanded one, or of this, m/s.
START, _WALK = 0.5, 0.9
# How much slower than told who is too fast is asked to go, in shares of either, and the
# largest such share (`wanted_path`), since guidance pulls at the path that a frame
# promises, not at its pose. Without it, told .8 m/s, he goes at .88, with it at .83.
GAIN, _CUT = 3.0, 0.3


@dataclasses.dataclass(frozen=True, kw_only=True)
class Memory:
    """Noise of the chain's posteriors that is correlated in time; ours.

    The paper draws it anew in every frame, which one sees: the polisher does not take
    all of it away, and joints shake. Remembered, it is r z + sqrt(1 - r^2) e, with e
    drawn anew: normal noise again, so that each frame by itself is what it was.

    Attributes:
      num_steps: T of the chain.
      half_life: Seconds in which r halves, positive; infinite for noise that a rollout
        keeps.
    """

    num_steps: int
    half_life: float

    def __call__(self, key: Key, noise: Array, *, fps: float) -> Array:
        """The noise of the next tick."""
        keep = 0.5 ** (1.0 / (fps * self.half_life))
        fresh = jax.random.normal(key, noise.shape, noise.dtype)
        return keep * noise + math.sqrt(1.0 - keep**2) * fresh


@dataclasses.dataclass(frozen=True)
class Stepper:
    """How the next frame is made.

    Attributes:
      step: `(key, previous, goal) -> frame`; the goal is None where nothing is asked
        for. With a memory it takes the noise of the chain as `noise`, too.
      memory: How that noise is remembered; None if it is drawn by the step.
    """

    step: Callable[..., Array]
    memory: Memory | None = None

    def __call__(
        self, key: Key, previous: Array, goal: Array | None = None, **noise: Array
    ) -> Array:
        """The next frame."""
        return self.step(key, previous, goal, **noise)


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True, kw_only=True, eq=False)
class CharacterState:
    """A character between two ticks.

    Attributes:
      frame: Its frame, as the space has it.
      bone: Its simulation bone, world.
      velocity: Velocity of the bone, meters per second, world.
      turn_rate: Turn rate of the bone, radians per second.
      noise: Noise of the chain's posteriors that is remembered; no steps if none is.
    """

    frame: Float[Array, "*batch channels"]
    bone: PlanarFrame
    velocity: Float[Array, "*batch 2"]
    turn_rate: Float[Array, "*batch"]
    noise: Float[Array, "*batch steps channels"]


def init_state(
    space: Space,
    vector: Float[Array, " features"],
    path: Float[Array, " 12"],
    noise: Float[Array, "steps channels"] | None = None,
    *,
    num_joints: int,
) -> CharacterState:
    """A character at the origin that faces +z, in a real pose.

    Its first tick remembers the normal `noise`; None if none is remembered.
    """
    frame = aamdm_space.to_frames(space, vector, path)
    noise = jnp.zeros((0, space.num_features)) if noise is None else noise
    return _state_of(frame, vector, noise, num_joints=num_joints)


def _state_of(
    frame: Array, vector: Array, noise: Array, *, num_joints: int
) -> CharacterState:
    """A character at the origin that faces +z and moves as its pose does."""
    parts = unpack(pose.pose_layout(num_joints), vector)
    return CharacterState(
        frame=frame,
        bone=PlanarFrame(origin=jnp.zeros(2), facing=jnp.array([0.0, 1.0])),
        velocity=parts["root_velocity"][::2],
        turn_rate=parts["root_angular_velocity"][1],
        noise=noise,
    )


def wanted_path(
    state: CharacterState,
    command: Command,
    *,
    fps: float,
    half_life: float,
    start: float = 0.0,
    gain: float = 0.0,
) -> Float[Array, " 12"]:
    """Path features that a command asks for, in the axes of the character's bone.

    They begin with the character's own velocity, but never faster than told: a wish
    that does would ask him who is too fast to go on so. Whoever has less than a quarter
    of the speed that he was told (of 0.9 m/s, if that is more) is asked for `start` m/s
    more than told as he faces that way, and who has half of it for no more (ours; 0 for
    never). Whoever is a share faster than told is asked to go `gain` such shares slower
    than told, at most .3 (ours). The springs' half-life is in seconds.

    Source: Holden et al. 2020, released code (controller), but for this.
    """
    times = jnp.array(path_features.path_offsets(fps)) / fps
    over = lambda x: jnp.broadcast_to(x, (times.shape[0], *x.shape))  # noqa: E731
    told, own = (
        jnp.sqrt(jnp.sum(jnp.square(x), axis=-1, keepdims=True) + 1e-12)
        for x in (command.velocity, state.velocity)
    )
    velocity = state.velocity * jnp.minimum(1.0, told / own)
    asked = command.velocity * (1.0 - jnp.clip(gain * (own / told - 1.0), 0.0, _CUT))
    if start > 0:
        way = ground.unit(asked, jnp.zeros(2))
        ahead = jnp.clip(jnp.sum(way * state.bone.facing), 0.0, 1.0) * ~is_still(asked)
        stands = jnp.clip(2.0 - 4.0 * own / jnp.maximum(told, _WALK), 0.0, 1.0)
        asked = asked + start * ahead * stands * way
    position, _, _ = spring.velocity_spring(
        over(state.bone.origin),
        over(velocity),
        over(jnp.zeros(2)),
        over(asked),
        half_life=half_life,
        dt=times[:, None],
    )
    facing, _ = spring.facing_spring(
        over(state.bone.facing),
        over(state.turn_rate),
        over(command.facing),
        half_life=half_life,
        dt=times,
    )
    path = Trajectory(position=position, facing=facing)
    return path_features.query(path, state.bone)


def path_objective(goal: Float[Array, " 12"]) -> Objective:
    """Half the squared distance of a frame's path features to those wanted.

    J of eq. 13, a function of frames; each feature, of the first 12 channels, in its
    deviation over the data.
    """

    def objective(frame: Float[Array, " channels"], /) -> Float[Array, ""]:
        return 0.5 * jnp.sum(jnp.square(frame[:PATH] - goal))

    return objective


def guided(
    sample: Sample,
    *,
    scale: float | Float[Array, ""],
    guided_steps: int | None = None,
    memory: Memory | None = None,
) -> Stepper:
    """AAMDM as a stepper steered by the objective's gradient, unless the goal is None.

    The scale is epsilon of eq. 13. So many steps at the chain's end are guided, None
    for all (paper); without a memory, noise is drawn anew in every frame (paper).
    """

    def step(key: Key, previous: Array, goal: Array | None, **noise: Array) -> Array:
        if goal is None:
            return sample(key, previous, **noise)
        objective = path_objective(goal)
        guidance = dict(objective=objective, scale=scale, guided_steps=guided_steps)
        return sample(key, previous, **guidance, **noise)

    return Stepper(step, memory)


def advance(
    space: Space,
    state: CharacterState,
    command: Command,
    *,
    num_joints: int,
    fps: float,
    wanted: Float[Array, " 12"] | None,
) -> tuple[CharacterState, Frame]:
    """Decodes the character's frame, moves its old bone on, and shows it.

    Path features were `wanted`; None for those that the frame has.
    """
    vector = aamdm_space.to_poses(space, state.frame)
    parts = unpack(pose.pose_layout(num_joints), vector)
    moved, turned = parts["root_velocity"], parts["root_angular_velocity"]
    bone = pose.advance_frame(state.bone, moved, turned, fps=fps)
    velocity = ground.out_of_frame(moved[::2], bone.facing)
    root, rot6d = pose.place(vector, bone, num_joints=num_joints)
    path = aamdm_space.to_paths(space, state.frame)
    state = dataclasses.replace(
        state, bone=bone, velocity=velocity, turn_rate=turned[1]
    )
    return state, Frame(
        root_position=root,
        joint_rotation=rot6d,
        desired_velocity=command.velocity,
        desired_facing=command.facing,
        planned=jnp.ones((), bool),
        extra={
            "bone_origin": bone.origin,
            "bone_facing": bone.facing,
            "bone_velocity": velocity,
            "path": path,
            "wanted_path": path if wanted is None else wanted,
        },
        fps=fps,
    )


def controller(
    step: Stepper,
    space: Space,
    *,
    num_joints: int,
    fps: float,
    steered: bool = True,
    bounded: bool = True,
    half_life: float = 0.27,
    start: float = 0.0,
    gain: float = 0.0,
) -> Controller:
    """The run-time as the three functions that `rollout.rollout` composes.

    Unless `steered`, no steering is compiled in; `bounded` (ours) keeps frames within
    the bounds of the data. The half-life, seconds, is that of the springs from command
    to path; `start` and `gain` are as of `wanted_path`.
    """

    def wanted(state: CharacterState, command: Command) -> Array:
        more = dict(half_life=half_life, start=start, gain=gain)
        return wanted_path(state, command, fps=fps, **more)

    def plan(key: Key, state: CharacterState, command: Command) -> CharacterState:
        goal = None
        if steered:
            path = aamdm_space.path_normalizer(space)
            goal = features.normalize(path, wanted(state, command))
        noise, given = state.noise, {}
        if step.memory is not None:
            key, key_noise = jax.random.split(key)
            noise = step.memory(key_noise, noise, fps=fps)
            given = {"noise": noise}
        frame = step(key, state.frame, goal, **given)
        if bounded:
            frame = aamdm_space.keep_within(space, frame)
        return dataclasses.replace(state, frame=frame, noise=noise)

    def show(state: CharacterState, command: Command) -> tuple[CharacterState, Frame]:
        return advance(
            space,
            state,
            command,
            num_joints=num_joints,
            fps=fps,
            wanted=wanted(state, command) if steered else None,
        )

    return Controller(
        plan_level=lambda state, command: jnp.ones((), jnp.int32),
        plans=(plan,),
        advance=show,
    )


def exports(controller: Controller) -> dict[str, Exported]:
    """What can leave Python: "step", a whole tick, since every tick makes a frame."""

    # A controller that locks feet has more of a state.
    def step(key: Key, state: Any, command: Command) -> tuple[Any, Frame]:
        state = controller.plans[0](key, state, command)
        return controller.advance(state, command)

    return {"step": Exported(step, ("key", "state", "command"), ("state", "frame"))}


@dataclasses.dataclass(frozen=True, kw_only=True)
class Method:
    """What makes a controller of `(networks' parameters, space)`; hashable."""

    config: aamdm_model.Config
    num_joints: int
    fps: float
    scale: float | Float[Array, ""] = SCALE
    guided_steps: int | None = GUIDED_STEPS
    memory: Memory | None = None
    step: chain.StepFactory = chain.ancestral_step
    start: float = 0.0
    gain: float = 0.0
    held: bool = False

    def __call__(self, params: tuple[Params, Space]) -> Controller:
        """The controller."""
        networks, space = params
        change = aamdm_training.scale_of_changes(space, self.config)
        sample = aamdm_model.sampler(
            networks,
            config=self.config,
            change=change,
            step=self.step,
            held=self.held,
        )
        return controller(
            guided(
                sample,
                scale=self.scale,
                guided_steps=self.guided_steps,
                memory=self.memory,
            ),
            space,
            num_joints=self.num_joints,
            fps=self.fps,
            start=self.start,
            gain=self.gain,
        )


def start_states(
    data: PoseData,
    space: Space,
    number: int,
    *,
    num_joints: int,
    seed: int,
    memory: Memory | None = None,
) -> CharacterState:
    """Characters in poses of the data, each at the origin and facing +z."""
    chosen = np.random.default_rng(seed).integers(0, data.num_frames, number)
    steps = 0 if memory is None else memory.num_steps
    noise = jax.random.normal(jax.random.key(seed), (number, steps, space.num_features))
    poses, paths = data.poses[chosen], data.paths[chosen]
    return _states_of(space, poses, paths, noise, num_joints=num_joints)


@functools.partial(jax.jit, static_argnames="num_joints")
def _states_of(
    space: Space, poses: Array, paths: Array, noise: Array, *, num_joints: int
) -> CharacterState:
    init = functools.partial(init_state, space, num_joints=num_joints)
    return jax.vmap(init)(poses, paths, noise)


def own_states(
    model: aamdm_stored.Model, number: int, *, seed: int, memory: Memory | None = None
) -> CharacterState:
    """Characters in a model's own frames, at the origin and facing +z."""
    space, joints = model.space, model.skeleton.num_joints
    if model.starts is None:
        raise ValueError("the model has no starts")
    chosen = np.random.default_rng(seed).integers(0, len(model.starts), number)
    steps = 0 if memory is None else memory.num_steps
    noise = jax.random.normal(jax.random.key(seed), (number, steps, space.num_features))
    return _own_states_of(space, model.starts[chosen], noise, num_joints=joints)


@functools.partial(jax.jit, static_argnames="num_joints")
def _own_states_of(
    space: Space, frames: Array, noise: Array, *, num_joints: int
) -> CharacterState:
    def state(frame: Array, noise: Array) -> CharacterState:
        vector = aamdm_space.to_poses(space, frame)
        return _state_of(frame, vector, noise, num_joints=num_joints)

    return jax.vmap(state)(frames, noise)


def load_run(
    path: Path, *, noise_half_life: float = 0.0
) -> tuple[aamdm_training.Run, aamdm_stored.Model, Params]:
    """A run folder, its model, and networks: 3 drafts and 2 polishes, embedded.

    `CheckpointError` if a stage was not trained.
    """
    run = aamdm_training.load_run(path)
    space = aamdm_training.load_space(run, "embedded")
    networks, config = aamdm_training.load_networks(
        run, "embedded", space, drafts=3, polishes=2
    )
    model = aamdm_stored.Model(
        config=config,
        skeleton=run.skeleton,
        space=space,
        source=run.source,
        noise_half_life=noise_half_life,
        toe_height=run.toe_height,
    )
    return run, model, networks


def own_starts(
    path: Path, *, number: int, noise_half_life: float = 0.0, seed: int = 0
) -> Float[Array, "number channels"]:
    """Frames in which a run's characters stand (`Model.starts`), none of them recorded.

    They stand for twelve seconds; of sixteen the calmest `number` are taken. The
    noise's half-life is as in `load_character`.
    """
    character = load_character(path, noise_half_life=noise_half_life)
    labels = np.zeros(16, int)
    states, _ = calmest(
        character,
        character.starts(labels, seed),
        labels,
        number=number,
        past=20,
        seed=seed,
    )
    return states.frame


def load_character(
    path: Path,
    *,
    step: chain.StepFactory = chain.ancestral_step,
    noise_half_life: float | None = None,
    held: bool = False,
) -> Character:
    """The character of a run folder or an exported file.

    It starts in the model's own frames where it has some, else in held-out poses.
    Commands have no labels. Noise of the posteriors is forgotten in `noise_half_life`
    seconds; 0 draws it anew in every frame (paper), None is what the model was exported
    with, 0 for a run folder and for a step that takes no `noise`, as `chain.ddim_step`.
    `held` is as in `model.sampler`. `CheckpointError` if a stage was not trained, or
    the file is damaged, `ValueError` for another system, or a half-life of noise that a
    step draws itself.
    """
    if path.is_file():
        model, networks = aamdm_stored.load(path)
        starts = functools.partial(own_states, model)
    else:
        run, model, networks = load_run(path)
        joints = run.skeleton.num_joints
        starts = functools.partial(
            start_states, run.held_out, model.space, num_joints=joints
        )
    space, fps = model.space, model.autoencoder.config.fps
    half_life = model.noise_half_life if noise_half_life is None else noise_half_life
    memory, takes_noise = None, "noise" in inspect.signature(step).parameters
    if noise_half_life and not takes_noise:
        raise ValueError(
            f"noise_half_life is {noise_half_life}, but the step draws its noise "
            "itself: expected 0 or None, or a step that takes `noise`"
        )
    if half_life and takes_noise:
        memory = Memory(num_steps=model.config.num_steps, half_life=half_life)
    num_joints, steps = model.skeleton.num_joints, model.config.num_steps
    method = Method(
        config=model.config,
        num_joints=num_joints,
        fps=fps,
        memory=memory,
        step=step,
        start=0.0 if model.starts is None else START,
        gain=0.0 if model.starts is None else GAIN,
        held=held,
    )
    return Character(
        skeleton=model.skeleton,
        labels=(),
        fps=fps,
        source=model.source,
        params=(networks, space),
        method=method,
        tuning=Tuning(
            method=lambda num_steps, scale: dataclasses.replace(
                method, scale=scale, held=num_steps < steps
            ),
            num_steps=tuple(sorted({model.config.polishes or steps, steps})),
            own_steps=model.config.polishes if held else steps,
            scale=float(method.scale),
            scales=(0.0, 4 * float(method.scale)),
            patience=0,
        ),
        starts=lambda labels, seed: starts(
            number=len(labels), seed=seed, memory=memory
        ),
        exports=exports,
        toe_height=model.toe_height,
        coast=COAST,
    )
