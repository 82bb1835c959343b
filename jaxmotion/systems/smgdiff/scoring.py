"""How SMGDiff's motions are scored: windows of recordings, an evaluator, the ball.

Source: SMGDiff, section 5.
"""

import dataclasses
import functools
from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from jaxmotion.data.ball_clips import BallClips
from jaxmotion.data.clips import toe_height
from jaxmotion.evaluation import ball, frechet, locomotion
from jaxmotion.evaluators import style as style_evaluator
from jaxmotion.motion import ground, rotation, trajectory
from jaxmotion.motion.ball import Scene
from jaxmotion.motion.skeleton import joint_positions
from jaxmotion.systems.smgdiff import data as smgdiff_data
from jaxmotion.systems.smgdiff import loss as smgdiff_loss
from jaxmotion.systems.smgdiff import scene as smgdiff_scene
from jaxmotion.systems.smgdiff.model import Condition, Model
from jaxmotion.systems.smgdiff.scene import Representation
from jaxmotion.typing import Key, Params

_DEGREES = 180.0 / np.pi


@dataclasses.dataclass(frozen=True, kw_only=True)
class Thresholds:
    """Where a touch begins; the same for all rows of a table.

    Attributes:
      acceleration: A ball that accelerates more is being pushed, meters per second
        squared. A thirtieth of the synthetic dribble's pushes is weaker.
      distance: From a joint to the ball's center up to which it pushes, meters: the
        ball's radius, half a foot, and 2 cm.
      foot_height: Below it a foot joint should not move, meters.
    """

    acceleration: float
    distance: float
    foot_height: float


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True, kw_only=True, eq=False)
class SkillEvaluator:
    """A trained evaluator of skills; moments of its features over training clips."""

    params: Params
    reference: frechet.Moments
    representation: Representation
    config: style_evaluator.Config = jax.tree.static()


def evaluator_input(
    scene: Scene, representation: Representation
) -> Float[Array, "*batch frames channels"]:
    """Joints and ball relative to the root, turned to face +z, in each frame.

    Meters; three channels a joint, and three of the ball, no longer than the reach.
    """
    skeleton = representation.skeleton
    joints = style_evaluator.window_input(skeleton, scene.motion)
    facing = trajectory.root_trajectory(skeleton, scene.motion).facing
    away = scene.ball - scene.motion.root_position
    away = away.at[..., ::2].set(ground.into_frame(away[..., ::2], facing))
    length = jnp.linalg.norm(away, axis=-1, keepdims=True)
    away = away * jnp.minimum(1.0, representation.reach / jnp.maximum(length, 1e-6))
    return jnp.concatenate([joints, away], axis=-1)


def make_evaluator(
    key: Key,
    scenes: Scene,
    labels: Int[Array, " windows"],
    *,
    representation: Representation,
    num_labels: int,
    num_steps: int,
    frozen: Params | None = None,
) -> SkillEvaluator:
    """Trains an evaluator of skills on real windows, which are its reference, too."""
    config = style_evaluator.Config(
        num_classes=num_labels,
        num_joints=representation.skeleton.num_joints + 1,
        frames=scenes.ball.shape[-2],
    )
    params = frozen
    if params is None:
        x = jax.jit(evaluator_input)(scenes, representation)
        params, _ = style_evaluator.train(
            key, x, labels, config=config, num_steps=num_steps
        )
    reference = moments(params, scenes, representation, config=config)
    return SkillEvaluator(
        params=params,
        reference=reference,
        representation=representation,
        config=config,
    )


@functools.partial(jax.jit, static_argnames=("config",))
def moments(
    params: Params,
    scenes: Scene,
    representation: Representation,
    *,
    config: style_evaluator.Config,
) -> frechet.Moments:
    """Moments of an evaluator's features of windows."""
    x = evaluator_input(scenes, representation)
    return frechet.moments(style_evaluator.classify(params, x, config=config)[0])


Score = Callable[..., dict[str, Float[Array, ""]]]


def scorer(
    evaluator: SkillEvaluator, limits: Thresholds, happened: frechet.Moments
) -> Score:
    """`score(scenes, wanted, labels) -> scores` of windows, one compiled program.

    Wanted is a path, where the scenes are: world or frame of the plan. `happened` is
    of features of held-out recordings.
    """
    representation = evaluator.representation
    skeleton = representation.skeleton

    @jax.jit
    def score(
        scenes: Scene, wanted: trajectory.Trajectory, labels: Int[Array, " windows"]
    ) -> dict[str, Array]:
        x = evaluator_input(scenes, representation)
        features, logits = style_evaluator.classify(
            evaluator.params, x, config=evaluator.config
        )
        found = frechet.moments(features)
        velocity = (
            jnp.asarray(jnp.gradient(wanted.position, axis=-2)) * representation.fps
        )
        body = locomotion.locomotion_metrics(
            skeleton,
            scenes.motion,
            velocity,
            wanted.facing,
            contact_height=limits.foot_height,
        )
        return {
            "fid": frechet.frechet_distance(found, evaluator.reference),
            "fid_held_out": frechet.frechet_distance(found, happened),
            "foot_slide": _weighted(body["slide_speed"], body["slide_seconds"]),
            "skate_ratio": jnp.mean(body["skate_ratio"]),
            "acceleration": jnp.mean(body["acceleration"]),
            "jerk": jnp.mean(body["jerk"]),
            "trajectory_error": _DEGREES
            * _weighted(body["trajectory_error"], body["trajectory_used"]),
            "orientation_error": _DEGREES * jnp.mean(body["orientation_error"]),
            "skill_accuracy": jnp.mean(jnp.argmax(logits, axis=-1) == labels),
        } | contact_scores(scenes, representation, limits)

    return score


def _weighted(values: Array, weights: Array) -> Array:
    # A window without weight has no value (0 of 0).
    used = jnp.where(weights > 0, values, 0.0)
    return jnp.sum(used * weights) / jnp.maximum(jnp.sum(weights), 1e-9)


def contact_scores(
    scenes: Scene, representation: Representation, limits: Thresholds
) -> dict[str, Float[Array, ""]]:
    """How well foot and ball go together.

    Touches and missed ones per minute, missed part of the touches, distance at touches,
    penetration of the ground and of the ball, acceleration without a touch. Part and
    distance are NaN where there is no touch.
    """
    skeleton, fps = representation.skeleton, representation.fps
    joints = jnp.array(representation.joints)
    places = joint_positions(skeleton, scenes.motion)[..., joints, :]
    at = dict(threshold=limits.acceleration)
    count = ball.touch_count(
        scenes.ball, places, fps, max_distance=limits.distance, **at
    )
    near = ball.foot_ball_distance(scenes.ball, places, fps, **at)
    free = ball.untouched_acceleration(
        scenes.ball, places, fps, max_distance=limits.distance
    )
    minutes, touches = jnp.sum(count.minutes), jnp.sum(count.touches)
    sunk = ball.ground_penetration(scenes.ball, radius=representation.radius)
    inside = ball.joint_penetration(scenes.ball, places, radius=representation.radius)
    ratio = lambda a, b: jnp.sum(a) / jnp.sum(b)  # noqa: E731
    return {
        "touches": touches / minutes,
        "missed": jnp.sum(count.missed) / minutes,
        "missed_part": ratio(count.missed, count.touches),
        "touch_distance": 100.0 * ratio(near.total, near.count),
        "ball_in_ground": jnp.mean(sunk.mean),
        "foot_in_ball": jnp.mean(inside.mean),
        "free_acceleration": ratio(free.total, free.count),
    }


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True, kw_only=True, eq=False)
class EvalWindows:
    """Moments of recordings: what is known, and what then happened.

    Frames before and after are in the frame of the plan.

    Attributes:
      piece: Number of the piece of a recording (`smgdiff_data.pieces`).
    """

    condition: Condition
    future: Scene
    past: Scene
    label: Int[Array, "*batch"]
    piece: Int[Array, "*batch"]


def eval_windows(
    data: BallClips, model: Model, *, number: int, seed: int
) -> EvalWindows:
    """At most `number` moments spread at random over clips, of the model's lengths.

    `ValueError` if no clip is long enough, or there are fewer than 4 moments.
    """
    config = model.config
    arrays = smgdiff_data.scene_arrays(data, config.window, stride=config.past)
    total = arrays.index.starts.shape[0]
    if min(total, number) < 4:
        raise ValueError(f"{total} windows of {config.window} frames, expected 4")
    order = np.random.default_rng(seed).permutation(total)[:number]
    scenes, labels = smgdiff_data.all_scenes(arrays, jnp.asarray(order))
    clips, starts = (
        np.asarray(x)[order] for x in (arrays.index.clips, arrays.index.starts)
    )
    pieces = jnp.asarray(smgdiff_data.pieces(data, clips, starts))
    return _eval_windows(scenes, labels, pieces, model.representation, config)


@functools.partial(jax.jit, static_argnames=("config",))
def _eval_windows(
    scenes: Scene, labels: Array, pieces: Array, representation, config
) -> EvalWindows:
    matrix = trajectory.smoothing_matrices(config.window, (10.0,))[0]
    last, skeleton = config.past - 1, representation.skeleton

    @jax.vmap
    def one(scene: Scene, label: Array, piece: Array) -> EvalWindows:
        course = trajectory.root_trajectory(skeleton, scene.motion)
        path = trajectory.smooth(course.position, matrix)
        path = path + (course.position[last] - path[last])[None]
        facing = trajectory.smooth(course.facing, matrix)
        facing = rotation.safe_normalize(facing, jnp.array([0.0, 1.0]))
        wanted = trajectory.Trajectory(position=path, facing=facing)
        condition, _ = smgdiff_loss.situation(
            scene, wanted, label, representation=representation, config=config
        )
        past = jax.tree.map(lambda x: x[: config.past], scene.motion)
        frame = smgdiff_scene.plan_frame(skeleton, past)
        local = smgdiff_scene.to_frame(scene, frame)
        return EvalWindows(
            condition=condition,
            future=jax.tree.map(lambda x: x[config.past :], local),
            past=jax.tree.map(lambda x: x[: config.past], local),
            label=label,
            piece=piece,
        )

    return one(scenes, labels, pieces)


def limits(data: BallClips) -> Thresholds:
    """Thresholds of the figures, from real clips.

    Feet: where toes rest (their first percentile) and one centimeter more. Touches: the
    ball's radius and 7 cm (half a foot, and 2 cm); and an acceleration of 12 meters per
    second squared, a change of 0.4 m/s within a frame of 1/30 s.
    """
    return Thresholds(
        acceleration=12.0,
        distance=data.radius + 0.07,
        foot_height=toe_height(data.clips, every=10) + 0.01,
    )
