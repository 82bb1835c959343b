"""What the benchmarks run: each system at the sizes of its paper or of its script.

A function named after its system makes its `Workload`; a script asks `of` for one, and
a part that a system has not is refused by name. Parameters are random unless a run is
given: their values do not change the time.
"""

import dataclasses
import functools
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any, Literal

import jax
import jax.numpy as jnp
import numpy as np
from jax.sharding import Mesh, PartitionSpec

from jaxmotion import face
from jaxmotion.control import courses, rollout, steering
from jaxmotion.data import procedural, windows
from jaxmotion.data.builders import smpl
from jaxmotion.data.clips import Clips
from jaxmotion.diffusion import chain, schedule
from jaxmotion.evaluation import timing
from jaxmotion.learning import model_json, training
from jaxmotion.motion import pose, trajectory
from jaxmotion.motion.features import Normalizer, unpack
from jaxmotion.motion.skeleton import Skeleton
from jaxmotion.systems import registry
from jaxmotion.systems.aamdm import controller as aamdm_controller
from jaxmotion.systems.aamdm import data as aamdm_data
from jaxmotion.systems.aamdm import embedding as aamdm_embedding
from jaxmotion.systems.aamdm import loss as aamdm_loss
from jaxmotion.systems.aamdm import model as aamdm_model
from jaxmotion.systems.aamdm import space as aamdm_space
from jaxmotion.systems.aamdm import training as aamdm_training
from jaxmotion.systems.camdm import controller as camdm_controller
from jaxmotion.systems.camdm import loss as camdm_loss
from jaxmotion.systems.camdm import model as camdm_model
from jaxmotion.systems.camdm import training as camdm_training
from jaxmotion.systems.emdm import model as emdm_model
from jaxmotion.systems.smgdiff import guidance as smgdiff_guidance
from jaxmotion.systems.smgdiff import model as smgdiff_model
from jaxmotion.systems.smgdiff import scene as smgdiff_scene
from jaxmotion.typing import Key, Params


@dataclasses.dataclass(frozen=True, kw_only=True)
class Sizes:
    """What a benchmark asks for.

    Attributes:
      steps: Diffusion steps; None for the paper's.
      width: Channels of a token or hidden layer; None for the system's own.
      frames_per_token: Frames of one token; 1 is the paper's network.
      paper: The published network where the system's own is smaller.
      attention: "full", or "prefix" (camdm, smgdiff): what does not change from step to
        step is computed once a plan.
      guided: Plans with contact guidance.
      step: Makes the chain's steps: a value of `STEPS`.
      config: Configuration of a trained model, in place of all sizes but the steps.
    """

    steps: int | None = None
    width: int | None = None
    frames_per_token: int = 1
    paper: bool = False
    attention: Literal["full", "prefix"] = "full"
    guided: bool = False
    step: chain.StepFactory = chain.ancestral_step
    config: Any = None


# A denoising-diffusion GAN is sampled by ancestral steps whose denoiser is stochastic.
STEPS: dict[str, chain.StepFactory] = {
    "ancestral": chain.ancestral_step,
    "ddgan": chain.ancestral_step,
    "ddim": chain.ddim_step,
    "dpm_solver": chain.dpm_solver_step,
}


@dataclasses.dataclass(frozen=True, kw_only=True)
class Samples:
    """Samples to time.

    Attributes:
      params: Parameters.
      sampler: Makes `sample(key, condition)` of parameters.
      conditions: Conditions of a number of characters, batch axis first.
      frames: Frames of a sample.
      fps: Frames per second of the motion.
      config: The method.
      chunk: Samples at a time that was fastest on two cores; 0 for all.
    """

    params: Params
    sampler: Callable[[Params], Callable[[Key, Any], jax.Array]]
    conditions: Callable[[int], Any]
    frames: int
    fps: float
    config: Any
    chunk: int = 4

    def program(
        self,
        batch: int,
        *,
        chunk: int = 0,
        arguments: bool = False,
        devices: int = 1,
    ) -> tuple[Callable, tuple]:
        """One batch of samples as a jitted function, and its arguments.

        Args:
          batch: Characters; 1 is the program of one character, not a batch of one.
          chunk: Characters at a time in batches of 16 and more; 0 for all at once.
          arguments: Whether the parameters are arguments, not constants.
          devices: Devices that share the batch; must divide it.
        """
        share = batch // devices

        def samples(params: Params, keys: Key, conditions: Any) -> jax.Array:
            sample = self.sampler(params)
            if batch == 1:
                return sample(keys[0], jax.tree.map(lambda x: x[0], conditions))
            if not chunk or share < 16:
                return jax.vmap(sample)(keys, conditions)
            xs = keys, conditions
            return jax.lax.map(lambda x: sample(*x), xs, batch_size=chunk)

        if devices > 1:
            split, copy = PartitionSpec("characters"), PartitionSpec()
            samples = jax.shard_map(
                samples,
                mesh=Mesh(np.array(jax.devices()[:devices]), ("characters",)),
                in_specs=(copy, split, split),
                out_specs=split,
                check_vma=False,
            )
        given = jax.random.split(jax.random.key(1), batch), self.conditions(batch)
        if arguments:
            return jax.jit(samples), (self.params, *given)
        return jax.jit(functools.partial(samples, self.params)), given


@dataclasses.dataclass(frozen=True, kw_only=True)
class Rollouts:
    """Rollouts to time.

    Attributes:
      params: Parameters of the networks.
      controller: Makes the run-time of parameters.
      start: States and commands of a number of characters.
      plans: How often networks made something, in all frames together.
      fps: Ticks per second.
      chunk: Characters at a time that was fastest on two cores; 0 for all.
      loops: Python loops over a number of ticks of one character, by name.
    """

    params: Params
    controller: Callable[[Params], rollout.Controller]
    start: Callable[[int], tuple[Any, trajectory.Command]]
    plans: Callable[[Any], float]
    fps: float
    chunk: int
    loops: Callable[[int], dict[str, Callable[[], Any]]] = lambda _: {}


@dataclasses.dataclass(frozen=True, kw_only=True)
class Training:
    """What trains a model: its update, its batches, and its first state."""

    update: training.Update
    sample: Callable[[Key, Any], Any]
    init: Callable[[Key], training.TrainState]
    data: Any


@dataclasses.dataclass(frozen=True, kw_only=True)
class Workload:
    """What of a system there is to time; None for what there is not.

    Attributes:
      samples: Samples of these sizes.
      samplers: Names in `STEPS` of what it can be sampled by, its own first.
      rollouts: Rollouts of sizes, a run (or None), seconds, and whether characters
        change commands at different ticks.
      training: Training of sizes and a batch.
    """

    samples: Callable[[Sizes], Samples] | None = None
    samplers: tuple[str, ...] = ("ancestral", "ddim", "dpm_solver")
    rollouts: Callable[[Sizes, Path | None, float, bool], Rollouts] | None = None
    training: Callable[[Sizes, int], Training] | None = None


def of(system: str, part: str) -> Any:
    """A part of a system's workload.

    Raises:
      ValueError: if there is no such system, or no such part of it.
    """
    registry.get(system)

    def found(name: str) -> Any:
        make = getattr(sys.modules[__name__], name, None)
        return make and getattr(make(), part)

    if found(system) is None:
        known = ", ".join(name for name in registry.SYSTEMS if found(name))
        raise ValueError(
            f"--system {system}: no {part} to measure, expected one of {known}"
        )
    return found(system)


def sampler_of(system: str, name: str) -> str:
    """Name in `STEPS` of a sampler; "own" is the system's own.

    Raises:
      ValueError: if the system cannot take it.
    """
    known = of(system, "samplers")
    if name == "own":
        return known[0]
    if name not in known:
        raise ValueError(
            f"--sampler {name}: not for {system}, expected one of own, "
            f"{', '.join(known)}"
        )
    return name


def point_of(system: str, steps: int) -> str:
    """Name of a number of steps in a sweep of `experiments/step_sweep.py`."""
    if system != "aamdm":
        return str(steps)
    config = _aamdm_config(Sizes(steps=steps))
    return f"{config.polishes}+{config.drafts}"


def config_of(system: str, value: Any) -> Any:
    """A system's configuration, from the JSON of a sweep.

    Raises:
      ValueError: names the field that is wrong.
    """
    kinds = {
        "camdm": camdm_model.Config,
        "aamdm": aamdm_model.Config,
        "emdm": emdm_model.Config,
        "smgdiff": smgdiff_model.Config,
    }
    return model_json.config_from_json(kinds[system], value)


@functools.cache
def make_clips() -> Clips:
    """Two minutes of the procedural walker, with labels "style"."""
    return procedural.make_clips(minutes=2)


def _normal(rng: np.random.Generator, *shape: int) -> jax.Array:
    return jnp.asarray(rng.normal(size=shape), jnp.float32)


def _forward(*shape: int) -> jax.Array:
    return jnp.broadcast_to(jnp.array([0.0, 1.0]), (*shape, 2))


def camdm() -> Workload:
    """Plans and steered rollouts of the transformer, and its training."""
    return Workload(
        samples=_camdm_samples, rollouts=_camdm_rollouts, training=_camdm_training
    )


def camdm_config(sizes: Sizes, **more: Any) -> camdm_model.Config:
    """The paper's network: 25 joints and 100 styles, 3.44 million parameters."""
    if sizes.config is not None:
        return dataclasses.replace(sizes.config, num_steps=sizes.steps)
    width = sizes.width or 256
    return camdm_model.Config(
        **({"num_joints": 25, "num_labels": 100} | more),
        num_steps=sizes.steps or 8,
        width=width,
        hidden=4 * width,
        frames_per_token=sizes.frames_per_token,
        attention=sizes.attention,
    )


def _plan_chunk(attention: str) -> int:
    """Plans at a time: steps of a third of the tokens take four times as many."""
    return 16 if attention == "prefix" else 4


def camdm_conditions(config: camdm_model.Config, batch: int) -> camdm_model.Condition:
    """Conditions of plausible size."""
    rng = np.random.default_rng(0)
    angle = rng.uniform(0, 2 * np.pi, (batch, config.future))
    facing = np.stack([np.sin(angle), np.cos(angle)], axis=-1)
    return camdm_model.Condition(
        past=_normal(rng, batch, config.past, config.num_features),
        trajectory=trajectory.Trajectory(
            position=_normal(rng, batch, config.future, 2),
            facing=jnp.asarray(facing, jnp.float32),
        ),
        label=jnp.asarray(np.arange(batch) % config.num_labels, jnp.int32),
        keep_past=jnp.ones(batch, bool),
    )


def _camdm_samples(sizes: Sizes) -> Samples:
    config = camdm_config(sizes)
    return Samples(
        params=camdm_model.init(jax.random.key(0), config),
        sampler=lambda params: camdm_model.sampler(
            params, config=config, step=sizes.step
        ),
        conditions=lambda batch: camdm_conditions(config, batch),
        frames=config.future,
        fps=config.fps,
        config=config,
        chunk=_plan_chunk(config.attention),
    )


def walker_model(
    run: Path | None, sizes: Sizes = Sizes()
) -> tuple[camdm_model.Model, Params]:
    """A CAMDM model of the procedural walker, and its parameters.

    Args:
      run: Run folder or exported file; None for random parameters.
      sizes: Without a run.

    Raises:
      ValueError: if the run's model is of another skeleton or other styles.
    """
    clips = make_clips()
    labels, skeleton = clips.names("style"), clips.skeleton
    if run is None:
        config = camdm_config(
            sizes, num_joints=skeleton.num_joints, num_labels=len(labels)
        )
        model = camdm_model.Model(
            config=config, skeleton=skeleton, labels=labels, source=clips.source
        )
        return model, camdm_model.init(jax.random.key(0), config)
    model, params = camdm_model.load(run)
    if (model.labels, model.skeleton.names) != (labels, skeleton.names):
        raise ValueError(
            f"{run}: a model of {model.skeleton.num_joints} joints and the styles "
            f"{', '.join(model.labels)}: expected one of the procedural walker"
        )
    return model, params


def _straight_on(
    labels: np.ndarray, seconds: float, fps: float, staggered: bool
) -> trajectory.Command:
    """The course "forward" at 1 m/s; staggered: from another place of it for each."""
    ticks, extra = round(seconds * fps), 30.0 if staggered else 0.0
    commands = courses.course_batch(
        "forward", labels, np.ones(len(labels)), seconds=seconds + extra, fps=fps
    )
    last = round(extra * fps)
    places = np.random.default_rng(0).integers(0, last + 1, len(labels))
    rows = jnp.asarray(places[:, None] + np.arange(ticks))
    return jax.tree.map(lambda x: jax.vmap(lambda y, i: y[i])(x, rows), commands)


def shipped_rollouts(name: str, seconds: float, staggered: bool) -> Rollouts:
    """A shipped model, steered straight on, without the foot lock.

    Raises:
      ValueError: if it makes whole motions.
    """
    model = steering.steered(face.load(name, foot_lock=False), what=name)

    def start(characters: int) -> tuple[Any, trajectory.Command]:
        labels = np.zeros(characters, np.int32)
        return model.start(characters), _straight_on(
            labels, seconds, model.fps, staggered
        )

    return Rollouts(
        params=model.params,
        controller=model.method,
        start=start,
        plans=lambda frames: float(frames.planned.sum()),
        fps=model.fps,
        chunk=4,
    )


def _camdm_rollouts(
    sizes: Sizes, run: Path | None, seconds: float, staggered: bool
) -> Rollouts:
    """Walkers on the course "forward" at 1 m/s."""
    model, params = walker_model(run, sizes)
    fps = model.config.fps

    def start(characters: int) -> tuple[Any, trajectory.Command]:
        labels = np.arange(characters) % len(model.labels)
        states = camdm_controller.start_states(
            make_clips(), model, labels, field="style", seed=0
        )
        return states, _straight_on(labels, seconds, fps, staggered)

    return Rollouts(
        params=params,
        controller=lambda params: camdm_controller.controller(
            params, model.skeleton, config=model.config
        ),
        start=start,
        plans=lambda frames: float(frames.planned.sum()),
        fps=fps,
        chunk=4,
    )


def _camdm_training(sizes: Sizes, batch: int) -> Training:
    """The preset "small" on windows of the walker."""
    clips, width = make_clips(), sizes.width or 128
    preset = camdm_training.PRESETS["small"] | {"width": width, "hidden": 4 * width}
    model = camdm_training.make_model(clips, field="style", **preset)
    optimizer = training.make_optimizer("muon", learning_rate=1e-3, num_steps=1000)
    loss = functools.partial(
        camdm_loss.loss, skeleton=model.skeleton, config=model.config
    )
    return Training(
        update=training.make_update(loss, optimizer),
        sample=camdm_training.window_sampler(field="style", batch=batch),
        init=lambda key: training.init_train_state(
            camdm_model.init(key, model.config), optimizer
        ),
        data=(clips, windows.window_index(clips, model.config.window)),
    )


FPS = 60.0  # of AAMDM
# DPM-Solver++ 2M draws a line through two predictions: with a latent drawn for each, it
# would extrapolate noise.
_GAN_SAMPLERS = ("ddgan", "ddim")


def aamdm() -> Workload:
    """Single frames, free rollouts, and the training of the polisher."""
    return Workload(
        samples=_aamdm_samples,
        samplers=_GAN_SAMPLERS,
        rollouts=_aamdm_rollouts,
        training=_aamdm_training,
    )


def _aamdm_config(sizes: Sizes, features: int = 64) -> aamdm_model.Config:
    steps = sizes.steps or 5
    polishes = min(2, steps - 1)
    if sizes.config is not None:
        return dataclasses.replace(
            sizes.config, drafts=steps - polishes, polishes=polishes
        )
    return aamdm_model.Config(
        features=features,
        width=sizes.width or 256,
        drafts=steps - polishes,
        polishes=polishes,
    )


def _aamdm_samples(sizes: Sizes) -> Samples:
    config = _aamdm_config(sizes)
    # Of some size: it does not matter to the time.
    change = jnp.ones(config.features) if config.predict == "change" else None
    return Samples(
        params=aamdm_model.init(jax.random.key(0), config),
        sampler=lambda params: aamdm_model.sampler(
            params, config=config, change=change, step=sizes.step
        ),
        conditions=lambda batch: _normal(
            np.random.default_rng(0), batch, config.features
        ),
        frames=1,
        fps=FPS,
        config=config,
        chunk=0,
    )


def _aamdm_random(sizes: Sizes) -> tuple:
    """A character of the procedural walker with untrained networks."""
    clips = procedural.make_clips(minutes=1.0)
    joints = clips.skeleton.num_joints
    data, _ = aamdm_data.pose_data(clips, fps=FPS)
    own = aamdm_embedding.Config(num_joints=joints, fps=FPS)
    autoencoder = aamdm_space.Autoencoder(
        params=aamdm_embedding.init(jax.random.key(0), own),
        statistics=aamdm_embedding.fit_statistics(data.poses, data.paths, config=own),
        config=own,
    )
    starts = aamdm_data.starts(data, 2)
    space = aamdm_space.fit_space(
        data.poses, data.paths, starts, autoencoder=autoencoder
    )
    config = _aamdm_config(sizes, space.num_features)
    return config, aamdm_model.init(jax.random.key(1), config), space, data, joints


def _aamdm_trained(folder: Path) -> tuple:
    run = aamdm_training.load_run(folder)
    space = aamdm_training.load_space(run, "embedded")
    params, config = aamdm_training.load_networks(
        run, "embedded", space, drafts=3, polishes=2
    )
    return config, params, space, run.held_out, run.skeleton.num_joints


def _aamdm_rollouts(
    sizes: Sizes, run: Path | None, seconds: float, staggered: bool
) -> Rollouts:
    """Free characters, each frame generated in 3 + 2 steps."""
    del staggered  # commands change nothing
    config, params, space, data, joints = (
        _aamdm_trained(run) if run else _aamdm_random(sizes)
    )

    def controller(params: Params) -> rollout.Controller:
        change = aamdm_training.scale_of_changes(params["space"], config)
        sample = aamdm_model.sampler(params["networks"], config=config, change=change)
        return aamdm_controller.controller(
            aamdm_controller.guided(sample, scale=0.0),
            params["space"],
            num_joints=joints,
            fps=FPS,
            steered=False,
        )

    def start(number: int) -> tuple[Any, trajectory.Command]:
        rows = jnp.arange(number) * 7 % data.num_frames
        states = jax.vmap(
            lambda pose, path: aamdm_controller.init_state(
                space, pose, path, num_joints=joints
            )
        )(data.poses[rows], data.paths[rows])
        facing = _forward(number, round(seconds * FPS))
        label = jnp.zeros(facing.shape[:-1], jnp.int32)
        return states, trajectory.Command(velocity=facing, facing=facing, label=label)

    def loops(ticks: int) -> dict[str, Callable[[], Any]]:
        state, command = jax.tree.map(lambda x: x[0], start(1))
        command = jax.tree.map(lambda x: x[0], command)
        driver = controller({"networks": params, "space": space})
        parts = functools.partial(
            _aamdm_frame, config, params, space, driver, joints, command
        )

        def tick(key: Key, state: Any) -> Any:
            return rollout.tick(driver, key, state, command)[0]

        whole = jax.jit(tick, compiler_options=timing.compiler_options())
        frames = {
            "networks jitted": parts(glue=False),
            "whole steps jitted": parts(glue=True),
            "whole frames jitted": whole,
        }
        return {
            name: _python_loop(frame, state, ticks) for name, frame in frames.items()
        }

    return Rollouts(
        params={"networks": params, "space": space},
        controller=controller,
        start=start,
        plans=lambda frames: float(frames.extra["path"][..., 0].size),
        fps=FPS,
        chunk=0,
        loops=loops,
    )


def _aamdm_frame(
    config: aamdm_model.Config,
    params: Params,
    space: aamdm_space.Space,
    driver: rollout.Controller,
    joints: int,
    command: trajectory.Command,
    glue: bool,
) -> Callable[[Key, Any], Any]:
    """The next frame by a Python loop over its steps and its jitted networks.

    The library jits the posterior of a step and the placing of a pose itself. With
    `glue`, what lies between the networks is jitted too: a whole step, and all that
    follows the last one; without it that is called operation by operation.
    """
    net, table = aamdm_model.network(config), config.table()
    whole = functools.partial(jax.jit, compiler_options=timing.compiler_options())
    jit = jax.jit if glue else whole  # within another one it has that one's options
    apply = lambda name: jit(  # noqa: E731
        lambda *given: net.apply({"params": params[name]}, *given)
    )
    draft, polish = apply("generator"), apply("polisher")
    decode = jit(lambda x: aamdm_space.to_poses(space, x))

    def step(key: Key, x: jax.Array, t: int, previous: jax.Array) -> jax.Array:
        key_net, key_noise = jax.random.split(jax.random.fold_in(key, t))
        if t > config.polishes:
            latent = jax.random.normal(key_net, (config.latent,))
            x_0 = draft(x, t, previous, latent)
        else:
            x_0 = polish(x, t, previous)
        mean, variance = schedule.posterior(table, x_0, x, t)
        return mean + jnp.sqrt(variance) * jax.random.normal(key_noise, x.shape)

    def unjitted(state: Any) -> tuple[Any, Any]:
        vector = decode(state.frame)
        parts = unpack(pose.pose_layout(joints), vector)
        moved, turned = parts["root_velocity"], parts["root_angular_velocity"]
        bone = pose.advance_frame(state.bone, moved, turned, fps=FPS)
        shown = pose.place(vector, bone, num_joints=joints)
        return dataclasses.replace(state, bone=bone), shown

    show = unjitted
    if glue:
        step, advance = whole(step, static_argnums=2), whole(driver.advance)
        show = lambda state: advance(state, command)  # noqa: E731

    def frame(key: Key, state: Any) -> Any:
        key_start, key_chain = jax.random.split(key)
        x = jax.random.normal(key_start, state.frame.shape)
        for t in range(config.num_steps, 0, -1):
            x = step(key_chain, x, t, state.frame)
        return show(dataclasses.replace(state, frame=x))[0]

    return frame


def _python_loop(frame: Callable, state: Any, ticks: int) -> Callable[[], Any]:
    """Makes so many frames, one after the other; their keys are made beforehand."""
    keys = [*jax.random.split(jax.random.key(0), ticks)]

    def run() -> Any:
        now = state
        for key in keys:
            now = jax.block_until_ready(frame(key, now))
        return now

    return run


def _aamdm_training(sizes: Sizes, batch: int) -> Training:
    """The polisher on windows of random frames."""
    config = _aamdm_config(sizes)
    optimizer = training.make_optimizer("radam", learning_rate=1e-4)
    shape = (4096, config.window + 1, config.features)

    def init(key: Key) -> training.TrainState:
        params = aamdm_model.init(key, config)["polisher"]
        return training.init_train_state(params, optimizer)

    def sample(key: Key, data: jax.Array) -> jax.Array:
        return data[jax.random.randint(key, (batch,), 0, data.shape[0])]

    loss = functools.partial(aamdm_loss.polisher_loss, config=config)
    return Training(
        update=training.make_update(loss, optimizer),
        sample=sample,
        init=init,
        data=_normal(np.random.default_rng(0), *shape),
    )


def emdm() -> Workload:
    """Motions from actions, of HumanAct12's sizes."""
    return Workload(samples=_emdm_samples, samplers=_GAN_SAMPLERS)


def _emdm_samples(sizes: Sizes) -> Samples:
    """The network that experiments/emdm.py trains, or the published one."""
    width = sizes.width or 128
    own = dict(
        width=width, depth=4, heads=4, hidden=3 * width, frames_per_token=4, norm="pre"
    )
    config = emdm_model.Config(
        features=150,  # 25 rows of 6 numbers
        frames=60,
        condition_size=12,
        num_steps=sizes.steps or 10,
        **({} if sizes.paper else own),
    )
    if sizes.config is not None:
        config = dataclasses.replace(sizes.config, num_steps=sizes.steps)

    def conditions(batch: int) -> emdm_model.Condition:
        actions = config.condition_size
        vectors = emdm_model.action_vectors(jnp.arange(batch) % actions, actions)
        return emdm_model.make_condition(vectors, config=config)

    return Samples(
        params=emdm_model.init(jax.random.key(0), config)["generator"],
        sampler=lambda params: emdm_model.sampler(
            params, config=config, step=sizes.step
        ),
        conditions=conditions,
        frames=config.frames,
        fps=15.0,
        config=config,
        chunk=16,
    )


def smgdiff() -> Workload:
    """Plans of a person and a ball."""
    return Workload(samples=_smgdiff_samples)


def _smgdiff_samples(sizes: Sizes) -> Samples:
    """CAMDM's network for SMPL's 24 joints with a ball: 162 channels.

    A threshold of zero keeps the gradient of guided plans at work in every frame.
    """
    offsets = np.random.default_rng(0).normal(0.0, 0.15, (24, 3))
    skeleton = Skeleton(
        offsets=jnp.asarray(offsets, jnp.float32),
        parents=smpl.PARENTS,
        names=smpl.JOINTS,
        feet=(7, 8, 10, 11),
    )
    size = smgdiff_scene.feature_layout(skeleton, skeleton.feet).size
    representation = smgdiff_scene.Representation(
        skeleton=skeleton,
        normalizer=Normalizer(mean=jnp.zeros(size), std=jnp.ones(size)),
        joints=skeleton.feet,
        fps=30.0,
    )
    width = sizes.width or 256
    config = smgdiff_model.Config(
        num_features=size,
        num_labels=6,
        num_steps=sizes.steps or 8,
        width=width,
        hidden=4 * width,
        frames_per_token=sizes.frames_per_token,
        attention=sizes.attention,
    )
    if sizes.config is not None:
        config = dataclasses.replace(sizes.config, num_steps=sizes.steps)
    guided = (
        smgdiff_guidance.Guidance(min_acceleration=0.0)
        if sizes.guided
        else smgdiff_guidance.UNGUIDED
    )

    def conditions(batch: int) -> smgdiff_model.Condition:
        rng = np.random.default_rng(0)
        return smgdiff_model.Condition(
            past=0.3 * _normal(rng, batch, config.past, config.num_features),
            trajectory=trajectory.Trajectory(
                position=_normal(rng, batch, config.future, 2),
                facing=_forward(batch, config.future),
            ),
            label=jnp.arange(batch) % config.num_labels,
            ball=jnp.broadcast_to(jnp.array([0.0, 0.11, 0.5]), (batch, 3)),
        )

    return Samples(
        params=smgdiff_model.init(jax.random.key(0), config),
        sampler=lambda params: smgdiff_guidance.sampler(
            params,
            config=config,
            representation=representation,
            guided=guided,
            step=sizes.step,
        ),
        conditions=conditions,
        frames=config.future,
        fps=representation.fps,
        config=config,
        chunk=_plan_chunk(config.attention),
    )
