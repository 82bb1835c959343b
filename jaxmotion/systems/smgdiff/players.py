"""Steered players for SMGDiff's second table, and how much paths owe to their noise.

Players start with held-out frames and keep one command: the mean velocity and the skill
of what was then recorded. Several players share a start and a command, so that their
spread is what the method adds.

Source: SMGDiff, section 5.2 and table 2.
"""

import functools
from collections.abc import Callable, Sequence

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxmotion.control import rollout, steering
from jaxmotion.control.frame import Frame
from jaxmotion.evaluation import diversity, table
from jaxmotion.evaluation.table import Rows
from jaxmotion.motion import ground, trajectory
from jaxmotion.motion.ball import Scene
from jaxmotion.motion.skeleton import joint_positions
from jaxmotion.systems.smgdiff import controller as smgdiff_controller
from jaxmotion.systems.smgdiff import evaluation as smgdiff_evaluation
from jaxmotion.systems.smgdiff import guidance as smgdiff_guidance
from jaxmotion.systems.smgdiff import scoring as smgdiff_scoring
from jaxmotion.systems.smgdiff import training as smgdiff_training
from jaxmotion.systems.smgdiff import trajectory as smgdiff_trajectory
from jaxmotion.systems.smgdiff.evaluation import Setting
from jaxmotion.systems.smgdiff.guidance import Guidance, SamplePlan
from jaxmotion.systems.smgdiff.model import Model
from jaxmotion.systems.smgdiff.scoring import EvalWindows
from jaxmotion.systems.smgdiff.training import Run
from jaxmotion.systems.smgdiff.trajectory import SamplePath, Wish
from jaxmotion.typing import Key

# Moments of training clips among which similar inputs are looked for.
_SIMILAR = 4000

Play = Callable[[Key, EvalWindows], Scene]


def wishes(known: EvalWindows, model: Model) -> Wish:
    """What users would have asked for: the recorded mean velocity, in plans' frames."""
    skeleton, config = model.representation.skeleton, model.config

    def one(known: EvalWindows) -> Wish:
        path, soon = known.future.motion.root_position[:, ::2], model.paths.soon
        return Wish(
            past=trajectory.root_trajectory(skeleton, known.past.motion),
            velocity=path[-1] * config.fps / config.future,
            label=known.label,
            soon=path[soon - 1] * config.fps / soon if soon else None,
        )

    return jax.vmap(one)(known)


def player(
    generate: SamplePath,
    plan: SamplePlan,
    model: Model,
    *,
    ticks: int,
    repeats: int,
    chunk: int,
    control: smgdiff_controller.Control | None = None,
) -> Play:
    """Rollouts of players that keep their first command, as one compiled program.

    There are `repeats` players of each start, at most `chunk` at a time (the largest
    number that divides theirs). Given is `play(key, known) -> scenes` [players, ticks,
    ...]; those of one start are neighbors.
    """
    driver = smgdiff_controller.controller(
        generate,
        plan,
        representation=model.representation,
        config=model.config,
        control=control,
        soon=model.paths.soon,
    )
    skeleton = model.representation.skeleton

    @jax.jit
    def play(key: Key, known: EvalWindows) -> Scene:
        known = jax.tree.map(lambda x: jnp.repeat(x, repeats, axis=0), known)
        wish = wishes(known, model)
        states = jax.vmap(
            lambda past: smgdiff_controller.init_state(
                skeleton, past, config=model.config
            )
        )(known.past)
        every = lambda x: jnp.repeat(x[:, None], ticks, axis=1)  # noqa: E731
        commands = trajectory.Command(
            velocity=every(wish.velocity),
            facing=every(ground.unit(wish.velocity)),
            label=every(known.label),
        )
        number = known.label.shape[0]
        size = max(n for n in range(1, chunk + 1) if number % n == 0)
        frames = rollout.rollout(driver, key, states, commands, chunk=size)[1]
        return to_scene(frames)

    return play


def to_scene(frames: Frame) -> Scene:
    """Displayed frames as a scene."""
    return Scene(motion=frames.motion, **frames.extra)


@functools.partial(jax.jit, static_argnames=("future", "fps"))
def _commanded(velocity: Array, *, future: int, fps: float) -> trajectory.Trajectory:
    """The path along which each window was steered."""
    times = (jnp.arange(1, future + 1) / fps)[None, :, None]
    facing = ground.unit(velocity)[:, None]
    shape = (velocity.shape[0], future, 2)
    return trajectory.Trajectory(
        position=jnp.broadcast_to(times, shape)
        * jnp.broadcast_to(velocity[:, None], shape),
        facing=jnp.broadcast_to(facing, shape),
    )


def score_players(
    setting: Setting, model: Model, play: Play, *, repeats: int, starts: int
) -> list[dict[str, Float[Array, ""]]]:
    """Scores of steered players, a dictionary per replication.

    They are scored from their second plan on, in windows of a plan's length;
    "pose_variance" is the variance of joints over players of one start, in the world.

    Players last for two plans' length or more; `starts` are those of a replication.
    """
    key, future = jax.random.key(setting.seed + 3), model.config.future
    spread = jax.jit(lambda scene: _diversity(scene, model, repeats))
    found = []
    for number, half in enumerate(setting.halves):
        chosen = jnp.asarray(half[:starts])
        known = jax.tree.map(lambda x: x[chosen], setting.known)  # noqa: B023
        scenes = play(jax.random.fold_in(key, number), known)
        last = jax.tree.map(lambda x: x[:, -future:], scenes)
        wish = wishes(known, model)
        velocity = jnp.repeat(wish.velocity, repeats, axis=0)
        labels = jnp.repeat(known.label, repeats)
        wanted = _commanded(velocity, future=future, fps=model.config.fps)
        scores = setting.score(last, wanted, labels)
        found.append(scores | {"pose_variance": spread(last)})
    return found


def _diversity(scene: Scene, model: Model, repeats: int) -> Array:
    places = joint_positions(model.representation.skeleton, scene.motion)
    groups = places.reshape(-1, repeats, *places.shape[1:])
    return jnp.mean(jax.vmap(diversity.intra_style_variance)(groups))


def _nearest(own: Wish, seen: Wish, number: int, fps: float) -> tuple[Array, Array]:
    """Inputs of the same skill that are most alike, and how far they are, m/s."""

    def one(wish: Wish) -> tuple[Array, Array]:
        moved = seen.past.position - wish.past.position[None]
        turned = seen.past.facing - wish.past.facing[None]
        seconds = moved.shape[-2] / fps
        away = jnp.linalg.norm(seen.velocity - wish.velocity[None], axis=-1)
        away += jnp.sqrt(jnp.mean(jnp.sum(moved**2, -1), -1)) / seconds
        away += jnp.sqrt(jnp.mean(jnp.sum(turned**2, -1), -1))
        away = jnp.where(seen.label == wish.label, away, jnp.inf)
        found, chosen = jax.lax.top_k(-away, number)
        return chosen, -found

    return jax.lax.map(one, own, batch_size=16)


def path_spread(
    key: Key,
    generate: SamplePath,
    known: EvalWindows,
    seen: EvalWindows,
    model: Model,
    *,
    repeats: int,
) -> dict[str, Float[Array, "..."]]:
    """How much paths vary at a fixed input, beside how much people's do.

    Known are moments of held-out recordings; among those `seen` similar inputs are
    looked for, `repeats` of each wish, as are its paths.

    Returns:
      By frame, root mean square distances in cm: of generated paths from the mean of
      their wish ("generated"); of what people did after the most similar inputs of that
      skill from its mean ("recorded"), the same once the generator's mean for each
      input is taken off, so that inputs need not be alike ("recorded, own mean"); and
      of the mean from what was recorded ("error"). "energy": the energy score of the
      paths, cm, which is least for those that vary as people do. "input": how far
      similar inputs are, m/s.

    Source: Gneiting and Raftery 2007, eq. 20, for the energy score.
    """
    wish, others = wishes(known, model), wishes(seen, model)

    @jax.jit
    def run(key: Key) -> dict[str, Array]:
        key_own, key_other = jax.random.split(key)

        def draw(key: Key, wish: Wish) -> Array:
            keys = jax.random.split(key, (wish.label.shape[0], repeats))
            many = jax.vmap(jax.vmap(generate, (0, None)), (0, 0))
            return many(keys, wish).position

        rms = lambda x, axis: 100 * jnp.sqrt(jnp.mean(jnp.sum(x**2, -1), axis))  # noqa: E731
        about = lambda x: x - jnp.mean(x, axis=1, keepdims=True)  # noqa: E731
        real, after = (x.future.motion.root_position[..., ::2] for x in (known, seen))
        paths = draw(key_own, wish)
        mean = jnp.mean(paths, axis=1)
        rest = after - jnp.mean(draw(key_other, others), axis=1)
        chosen, away = _nearest(wish, others, repeats, model.config.fps)
        # Of few draws the deviation from their own mean is too small.
        fair = jnp.sqrt(repeats / (repeats - 1))
        away_from = lambda x, axes: 100 * jnp.mean(jnp.linalg.norm(x, axis=-1), axes)  # noqa: E731
        apart = away_from(paths[:, :, None] - paths[:, None], (0, 1, 2)) * fair**2
        return {
            "generated": fair * rms(about(paths), (0, 1)),
            "recorded": fair * rms(about(after[chosen]), (0, 1)),
            "recorded, own mean": fair * rms(about(rest[chosen]), (0, 1)),
            "error": rms(mean - real, 0),
            "energy": away_from(paths - real[:, None], (0, 1)) - 0.5 * apart,
            "input": jnp.mean(away),
        }

    return run(key)


def straight(model: Model) -> SamplePath:
    """The straight path of a model's lengths, for `smgdiff_trajectory.sampler`."""
    config = model.config
    return functools.partial(
        smgdiff_trajectory.straight, future=config.future, fps=config.fps
    )


def _generators(run: Run) -> dict[str, SamplePath]:
    """Straight paths, and the run's trajectory generators, by name."""
    found = {"straight paths": straight(run.model)}
    for stage in smgdiff_training.path_stages(run):
        model, params = smgdiff_training.load_stage(run, stage)
        found[f"generator, T = {model.paths.num_steps}"] = smgdiff_trajectory.sampler(
            params, config=model.paths
        )
    return found


def path_table(
    run: Run,
    setting: Setting,
    *,
    steps: int,
    guided: Guidance,
    starts: int,
    repeats: int,
    chunk: int,
) -> Rows:
    """Table 2: steered players with and without generated paths and guidance.

    The motion model has T = `steps`; `starts` of players are those of a replication,
    with `repeats` players each.
    """
    model, params = smgdiff_training.load_stage(run, f"motion_{steps}")
    rows = smgdiff_evaluation.real_rows(run, setting)
    for name, generate in _generators(run).items():
        for schedule in ("none", "end 2"):
            plan = smgdiff_guidance.sampler(
                params,
                config=model.config,
                representation=model.representation,
                guided=smgdiff_guidance.on_schedule(guided, schedule),
            )
            play = player(
                generate,
                plan,
                model,
                ticks=2 * model.config.future,
                repeats=repeats,
                chunk=chunk,
            )
            scores = score_players(setting, model, play, repeats=repeats, starts=starts)
            part = starts / setting.known.label.shape[0]
            row = table.row(scores, part=min(part, smgdiff_evaluation.HALF))
            rows[f"{name}, guidance {schedule}"] = row
            print(f"{name}, guidance {schedule}: done", flush=True)
    return rows


# When paths are looked at, seconds after the last displayed pose, and for what.
_LOOKS = (0.25, 0.5, 1.0)
_CURVES = {
    "spread": "generated",
    "people's": "recorded, own mean",
    "error of the mean": "error",
    "energy score": "energy",
}


def spread_table(run: Run, *, windows: int, seed: int) -> Rows:
    """How much each generator's paths vary beside people's (`path_spread`)."""
    model = run.model
    known = smgdiff_scoring.eval_windows(run.held_out, model, number=windows, seed=seed)
    seen = smgdiff_scoring.eval_windows(
        run.train, model, number=_SIMILAR, seed=seed + 6
    )
    rows = {}
    for name, generate in _generators(run).items():
        found = path_spread(
            jax.random.key(seed), generate, known, seen, model, repeats=8
        )
        rows[name] = {
            f"{title} after {look:g} s, cm": table.Cell(
                value=float(found[part][round(look * model.config.fps) - 1]),
                samples=int(known.label.shape[0]),
            )
            for title, part in _CURVES.items()
            for look in _LOOKS
        }
    return rows


# The direction of the command turns by so much, every so many seconds.
_TURN, _SECONDS = np.pi / 3, 4.0


def skill_commands(
    model: Model, skills: Sequence[str], *, seconds: float
) -> trajectory.Command:
    """Each skill at its own speed, for an equal time, with turns to either side.

    `ValueError` if the model has no such skill, or there is less than a tick of each.
    """
    ticks = round(seconds * model.config.fps)
    if ticks < len(skills):
        raise ValueError(f"{seconds:g} s are too short for {len(skills)} skills")
    labels = steering.label_indices(model.labels, skills)
    label = labels[np.arange(ticks) * len(skills) // ticks]
    turn = np.floor(np.arange(ticks) / (_SECONDS * model.config.fps)).astype(int)
    yaw = _TURN * np.array([0, 1, 0, -1])[turn % 4]
    facing = np.stack([np.sin(yaw), np.cos(yaw)], axis=-1)
    speed = np.array(model.speeds)[label]
    return trajectory.Command(
        velocity=jnp.asarray(speed[:, None] * facing, jnp.float32),
        facing=jnp.asarray(facing, jnp.float32),
        label=jnp.asarray(label, jnp.int32),
    )


def path_sampler(run: Run, stage: str) -> SamplePath:
    """Paths of a stage such as "paths_1", or "straight" ones."""
    if stage == "straight":
        return straight(run.model)
    model, params = smgdiff_training.load_stage(run, stage)
    return smgdiff_trajectory.sampler(params, config=model.paths)


def play_one(
    run: Run,
    commands: trajectory.Command,
    *,
    steps: int,
    paths: str,
    guided: Guidance,
    seed: int,
) -> Scene:
    """One player that starts with training frames of its first command's skill.

    Commands are one a tick; `steps` is the motion model's T; paths as `path_sampler`'s.
    """
    model, params = smgdiff_training.load_stage(run, f"motion_{steps}")
    driver = smgdiff_controller.controller(
        path_sampler(run, paths),
        smgdiff_guidance.sampler(
            params,
            config=model.config,
            representation=model.representation,
            guided=guided,
        ),
        representation=model.representation,
        config=model.config,
        soon=model.paths.soon,
    )
    known = smgdiff_scoring.eval_windows(run.train, model, number=2000, seed=seed)
    first = int(np.flatnonzero(np.asarray(known.label) == int(commands.label[0]))[0])
    past = jax.tree.map(lambda x: x[first], known.past)
    state = smgdiff_controller.init_state(
        model.representation.skeleton, past, config=model.config
    )
    one = lambda tree: jax.tree.map(lambda x: x[None], tree)  # noqa: E731
    play = jax.jit(lambda *given: rollout.rollout(driver, *given)[1])
    return to_scene(play(jax.random.key(seed), one(state), one(commands))[0])
