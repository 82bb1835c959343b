"""What EMDM's motions from actions, or from nothing, are scored with.

Every set that is scored, real or generated, has the same number of motions with actions
drawn uniformly, and goes through one evaluator that was trained on real motions only.

Source: Zhou et al. 2024 (EMDM), section 4.3; the evaluation of Guo et al. 2020
(Action2Motion) with uniform actions.
"""

import functools
from collections.abc import Callable
from pathlib import Path

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from jaxmotion.control import foot_lock
from jaxmotion.evaluation import (
    by_frame,
    contact,
    diversity,
    frechet,
    memorization,
    plausibility,
    smoothness,
)
from jaxmotion.evaluation.table import Row
from jaxmotion.evaluators import action as action_evaluator
from jaxmotion.evaluators import frozen as evaluators
from jaxmotion.evaluators.frozen import Evaluator, clips_fingerprint
from jaxmotion.learning import checkpoint, runs
from jaxmotion.motion.skeleton import Motion, joint_positions
from jaxmotion.systems.emdm import data as emdm_data
from jaxmotion.systems.emdm import features as emdm_features
from jaxmotion.systems.emdm import model as emdm_model
from jaxmotion.systems.emdm import training as emdm_training
from jaxmotion.systems.emdm.data import ActionArrays, ActionRun
from jaxmotion.systems.emdm.scoring import (
    Many,
    RowScorer,
    Scores,
    Settings,
    replicated_row,
)
from jaxmotion.typing import Key, Params

# Motions that the evaluator is trained on: most windows of the clips.
_RECOGNIZED = 12288


def evaluator_config(run: ActionRun) -> action_evaluator.Config:
    """Size of a run's evaluator."""
    return action_evaluator.Config(
        num_classes=len(run.actions), num_joints=run.clips.skeleton.num_joints
    )


def fit_evaluator(
    train: ActionArrays, *, num_steps: int, seed: int
) -> tuple[action_evaluator.Config, Params]:
    """Trains an evaluator on motions with actions drawn uniformly."""
    config = action_evaluator.Config(
        num_classes=train.counts.shape[0], num_joints=train.clips.skeleton.num_joints
    )
    key_data, key_train = jax.random.split(jax.random.key(seed))
    actions = jnp.arange(_RECOGNIZED) % config.num_classes
    x = _flat(real_positions(key_data, actions, train))
    params, _ = action_evaluator.train(
        key_train, x, actions, config=config, num_steps=num_steps
    )
    return config, params


def load_evaluator(
    run: ActionRun,
    *,
    num_steps: int,
    seed: int,
    evaluator: evaluators.Evaluator | None = None,
) -> Params:
    """The run's evaluator, trained on its training clips if it is not there yet.

    A frozen evaluator, if given, takes its place. A `ValueError` names the field if the
    folder's was trained otherwise, or the evaluator does not fit the run.
    """
    frozen = evaluators.params_for(
        evaluator,
        kind="action",
        labels=run.actions,
        joints=run.clips.skeleton.names,
        fps=run.clips.fps,
        frames=run.train.frames,
    )
    if frozen is not None:
        return frozen
    folder = run.record.folder / "evaluator"
    config = evaluator_config(run)
    value = {
        "system": "emdm",
        "stage": "evaluator",
        "steps": num_steps,
        "seed": seed,
        "actions": list(run.actions),
        "source": run.clips.source,
    }
    if checkpoint.latest_step(folder) is None:
        _, params = fit_evaluator(run.train, num_steps=num_steps, seed=seed)
        checkpoint.save(folder, num_steps, {"params": params}, value)
    return runs.restore_evaluator(
        folder,
        value,
        lambda: action_evaluator.init(jax.random.key(0), config),
    )


def _flat(positions: Array) -> Array:
    """What the evaluator sees of motions that start at the origin facing +z."""
    return positions.reshape(*positions.shape[:-2], -1)


@jax.jit
def real_positions(
    key: Key, actions: Int[Array, " batch"], part: ActionArrays
) -> Float[Array, "batch frames joints 3"]:
    """Joint positions, meters, of recorded motions."""
    motions = emdm_data.sample_motions(key, part, actions)
    return joint_positions(part.clips.skeleton, motions)


def moments(params: Params, run: ActionRun) -> Callable[[Key, Array], frechet.Moments]:
    """Moments of the evaluator's features, `(key, positions) -> moments`, jitted."""
    config = evaluator_config(run)

    @jax.jit
    def of(key: Key, positions: Array) -> frechet.Moments:
        features, _ = action_evaluator.classify(
            params, key, _flat(positions), config=config
        )
        return frechet.moments(features)

    return of


def scorer(
    params: Params, run: ActionRun, reference: frechet.Moments, *, ground: float
) -> Callable[[Key, Array, Int[Array, " batch"]], dict[str, Array]]:
    """Scores of a set of motions, as one compiled program.

    The reference is moments of the real features; `ground` is the height, meters, of
    the lowest joint of a person who stands. In `score(key, positions, actions) ->
    scores` the actions are in ascending order, each as often as the others.
    "deviation": of joints from where they are in the mean motion of an action, root
    mean square, cm, with the hips above the origin.
    """
    config, skeleton = evaluator_config(run), run.clips.skeleton
    feet = jnp.asarray(skeleton.feet)
    variance = jax.vmap(diversity.intra_style_variance)

    @jax.jit
    def score(
        key: Key, positions: Array, actions: Int[Array, " batch"]
    ) -> dict[str, Array]:
        key_state, key_pairs, key_modes = jax.random.split(key, 3)
        features, logits = action_evaluator.classify(
            params, key_state, _flat(positions), config=config
        )
        by_action = features.reshape(config.num_classes, -1, features.shape[-1])
        fps = run.clips.fps
        toes = positions[..., feet, :]
        poses = positions.at[..., ::2].add(-positions[..., :1, ::2])
        poses = poses.reshape(config.num_classes, -1, *poses.shape[1:])
        return {
            "fid": frechet.frechet_distance(frechet.moments(features), reference),
            "accuracy": jnp.mean(jnp.argmax(logits, -1) == actions),
            "diversity": diversity.diversity(key_pairs, features, num_pairs=200),
            "multimodality": diversity.multimodality(
                key_modes, by_action, num_pairs=20
            ),
            "deviation": 100 * jnp.sqrt(jnp.mean(variance(poses))),
            "penetration": jnp.mean(plausibility.penetration(positions, ground=ground)),
            "floating": jnp.mean(plausibility.floating(positions, ground=ground)),
            "skate": jnp.mean(plausibility.skating(toes, ground=ground)),
            "skate_ratio": jnp.mean(
                contact.skate_ratio(toes, fps, max_height=ground + 0.05)
            ),
            "jerk": jnp.mean(smoothness.jerk(positions, fps)),
        }

    return score


def nearest_clips(part: ActionArrays) -> Callable[[Array], memorization.Nearest]:
    """The part's clips nearest to motions, `positions -> distances`, jitted."""
    start, clip = emdm_data.all_windows(part)

    def window(number: Int[Array, " chunk"]) -> Array:
        motions = emdm_data.motions_at(part, start[number], clip[number])
        return joint_positions(part.clips.skeleton, motions)

    @jax.jit
    def of(positions: Array) -> memorization.Nearest:
        return memorization.nearest(
            positions, window, clip, num_clips=part.clips.num_clips
        )

    return of


def ground_height(run: ActionRun) -> float:
    """Height, meters, of the lowest joint of who stands: the median over frames."""
    motion = Motion(
        root_position=run.clips.root_position,
        joint_rotation=run.clips.joint_rotation,
        fps=run.clips.fps,
    )
    positions = joint_positions(run.clips.skeleton, motion)
    return float(jnp.median(jnp.min(positions[..., 1], axis=-1)))


def row_scorer(folder: Path, settings: Settings) -> RowScorer:
    """The evaluator of a run folder, and real motions' scores.

    Motions made from nothing are compared with real ones of all actions; they have no
    accuracy and no multimodality.

    `ValueError` if there are too few samples, or data or a frozen evaluator do not fit.
    """
    for name in ("matcher", "glove"):
        if (found := getattr(settings, name)) is not None:
            raise ValueError(
                f"{name} is {found}, but {folder} does not make motions from texts: "
                "expected none"
            )
    if settings.padding != "zeros":
        raise ValueError(
            f"padding is {settings.padding!r}, but {folder} does not make motions from "
            "texts: expected 'zeros'"
        )
    run = emdm_data.load_run(folder)
    number = len(run.actions)
    each = settings.samples // number
    if each < 2:
        raise ValueError(
            f"samples is {settings.samples}, expected at least 2 for each of {number} "
            "actions"
        )
    frozen = settings.evaluator
    steps = 1500 if settings.evaluator_steps is None else settings.evaluator_steps
    evaluator = load_evaluator(run, num_steps=steps, seed=0, evaluator=frozen)
    trained = (run.clips.source, steps, 0)
    if frozen is not None:
        trained = (frozen.source, frozen.updates, frozen.seed)
    wanted = jnp.repeat(jnp.arange(number), each)
    key_motion, key_state, *keys_real = jax.random.split(
        jax.random.key(settings.seed), 4
    )
    truth = real_positions(key_motion, wanted, run.train)
    reference = moments(evaluator, run)(key_state, truth)
    ground = ground_height(run)
    scores = scorer(evaluator, run, reference, ground=ground)
    nearest = nearest_clips(run.train)

    def score(key: Key, positions: Array, *, trained: bool = False) -> Scores:
        near = nearest(positions)
        found = {"nearest": 100 * jnp.mean(near.other if trained else near.clip)}
        if not trained:
            found["copied"] = memorization.copied(near)
        return scores(key, positions, wanted) | found

    def score_real(key: Key, part: ActionArrays) -> Row:
        def once(key: Key) -> Scores:
            key_motion, key_score = jax.random.split(key)
            positions = real_positions(key_motion, wanted, part)
            return score(key_score, positions, trained=part is run.train)

        return replicated_row(key, once, number=settings.replications)

    conditional = run.record.settings["task"] == "action"
    conditions = emdm_model.Condition(
        vector=emdm_model.action_vectors(wanted, number if conditional else 0),
        keep=jnp.ones(wanted.shape, bool),
        mask=jnp.ones((*wanted.shape, run.train.frames), bool),
    )

    def cleaned(motion: Motion) -> Motion:
        return foot_lock.clean_motion(
            run.clips.skeleton, motion, lock=foot_lock.FootLock()
        )

    @jax.jit
    def positions_of(x: Array) -> Array:
        motion = emdm_features.to_motion(x, run.representation)
        if settings.foot_lock:
            motion = jax.vmap(cleaned)(motion)
        return joint_positions(run.clips.skeleton, motion)

    def score_row(key: Key, many: Many) -> Scores:
        key_sample, key_score = jax.random.split(key)
        x = many(key_sample, conditions, scale)
        found = score(key_score, positions_of(x))
        if not conditional:
            found = {
                k: found[k]
                for k in found
                if k not in ("accuracy", "multimodality", "deviation")
            }
        return found

    def places(key: Key, many: Many, frames_per_token: int) -> by_frame.ByFrame:
        positions = positions_of(many(key, conditions, scale))
        at = jnp.arange(positions.shape[1]) % frames_per_token
        return by_frame.by_frame(
            positions,
            run.clips.skeleton.feet,
            jnp.broadcast_to(at, positions.shape[:2]),
            run.clips.fps,
            num_places=frames_per_token,
            contact_height=ground + 0.05,
        )

    scale = emdm_training.guidance_scale(settings.scale, task="action")
    return RowScorer(
        by_frame=places,
        real={
            "real (training clips)": score_real(keys_real[0], run.train),
            "real (held-out clips)": score_real(keys_real[1], run.held_out),
        },
        score=score_row,
        scale=scale,
        one=jax.tree.map(lambda x: x[0], conditions),
        samples=each * number,
        describe={
            "network": "GRU 2 x 128, tanh 30, joint positions; trained on "
            "{}, {} updates, seed {}".format(*trained),
            "reference": f"{each * number} real motions of training clips, actions "
            "uniform",
            "ground height m": ground,
        }
        | evaluators.describe(
            evaluator,
            frozen,
            reference=evaluators.clips_fingerprint(run.train.clips, run.field),
        ),
    )


# Motions of each action for the accuracy.
_HELD_OUT = 40


def train_action(
    train: ActionArrays,
    held_out: ActionArrays,
    *,
    field: str,
    num_steps: int,
    seed: int,
) -> Evaluator:
    """EMDM's evaluator, of motions with actions (`field`) drawn uniformly.

    The held-out clips give its accuracy.
    """
    clips = train.clips
    config, params = fit_evaluator(train, num_steps=num_steps, seed=seed)
    wanted = jnp.repeat(jnp.arange(config.num_classes), _HELD_OUT)
    key_motion, key_state = jax.random.split(jax.random.key(seed + 1))
    positions = real_positions(key_motion, wanted, held_out)
    x = positions.reshape(*positions.shape[:2], -1)
    recognize = functools.partial(action_evaluator.classify, config=config)
    _, logits = jax.jit(recognize)(params, key_state, x)
    return Evaluator(
        kind="action",
        params=params,
        field=field,
        labels=clips.names(field),
        joints=clips.skeleton.names,
        fps=clips.fps,
        frames=train.frames,
        source=clips.source,
        clips=clips_fingerprint(clips, field),
        seed=seed,
        updates=num_steps,
        accuracy=float(jnp.mean(jnp.argmax(logits, axis=-1) == wanted)),
    )
