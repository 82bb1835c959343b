"""What a set of scenes of a person with a ball scores: the columns of SMGDiff's tables.

A recogniser of skills sees joints and ball relative to the root, turned to face +z; its
features give the Fréchet distance, its decisions the skill accuracy. The paper's own
classifier and windows are not published; here a window is a plan of 45 frames.

Source: SMGDiff, section 5; the contact figures are ours.
"""

import dataclasses
import functools
from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from jaxmotion.evaluation import ball, frechet, locomotion
from jaxmotion.learning import recognition
from jaxmotion.motion import ground, skeleton, trajectory
from jaxmotion.motion.ball import Scene
from jaxmotion.systems.smgdiff_scene import Representation
from jaxmotion.typing import Key, Params

_DEGREES = 180.0 / np.pi


@dataclasses.dataclass(frozen=True, kw_only=True)
class Thresholds:
    """Where a touch begins; the same for all rows of a table.

    Attributes:
      acceleration: A ball that accelerates more is being pushed, metres a second
        squared. Half of the weakest push of the synthetic dribble.
      distance: From a joint to the ball's centre up to which it pushes, metres: the
        ball's radius, half a foot, and 2 cm.
      foot_height: Below it a foot joint should not move, metres.
    """

    acceleration: float
    distance: float
    foot_height: float


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True, kw_only=True, eq=False)
class Judge:
    """A trained recogniser, and what real windows look like to it.

    Attributes:
      params: Of the recogniser.
      reference: Moments of its features over windows of training clips.
      representation: Says what the skeleton and the ball are.
      config: Size of the recogniser.
    """

    params: Params
    reference: frechet.Moments
    representation: Representation
    config: recognition.RecognizerConfig = jax.tree.static()


def recognizer_input(
    scene: Scene, representation: Representation
) -> Float[Array, "*batch frames channels"]:
    """Joints and ball relative to the root, turned to face +z, in each frame.

    Args:
      scene: Frames.
      representation: Of their skeleton.

    Returns:
      Metres; three channels a joint, and three of the ball, no longer than the reach.
    """
    bones = representation.bones
    joints = recognition.recognizer_input(bones, scene.motion)
    facing = trajectory.root_trajectory(bones, scene.motion).facing
    away = scene.ball - scene.motion.root_position
    away = away.at[..., ::2].set(ground.into_frame(away[..., ::2], facing))
    length = jnp.linalg.norm(away, axis=-1, keepdims=True)
    away = away * jnp.minimum(1.0, representation.reach / jnp.maximum(length, 1e-6))
    return jnp.concatenate([joints, away], axis=-1)


def make_judge(
    key: Key,
    scenes: Scene,
    labels: Int[Array, " windows"],
    *,
    representation: Representation,
    num_labels: int,
    num_steps: int,
    frozen: Params | None = None,
) -> Judge:
    """Trains the recogniser of skills on real windows.

    Args:
      key: Consumed.
      scenes: Windows of training clips, as long as those that are to be judged.
      labels: Their skills.
      representation: Of their skeleton.
      num_labels: Skills.
      num_steps: Updates.
      frozen: Parameters of a recogniser that was trained before; None to train one.

    Returns:
      The judge; the same windows are its reference.
    """
    config = recognition.RecognizerConfig(
        num_classes=num_labels,
        num_joints=representation.bones.num_joints + 1,
        frames=scenes.ball.shape[-2],
    )
    x = jax.jit(recognizer_input)(scenes, representation)
    params = frozen
    if params is None:
        params, _ = recognition.train_recognizer(
            key, x, labels, config=config, num_steps=num_steps
        )
    features, _ = jax.jit(functools.partial(recognition.recognize, config=config))(
        params, x
    )
    return Judge(
        params=params,
        reference=frechet.moments(features),
        representation=representation,
        config=config,
    )


Score = Callable[..., dict[str, Float[Array, ""]]]


def scorer(judge: Judge, limits: Thresholds) -> Score:
    """Scores of a set of windows, as one compiled program.

    Args:
      judge: From `make_judge`.
      limits: Where a touch begins.

    Returns:
      `score(scenes, wanted, labels) -> scores`: wanted is a path (world or frame of the
      plan, as the scenes), labels the skills.
    """
    representation = judge.representation
    bones = representation.bones

    @jax.jit
    def score(
        scenes: Scene, wanted: trajectory.Trajectory, labels: Int[Array, " windows"]
    ) -> dict[str, Array]:
        x = recognizer_input(scenes, representation)
        features, logits = recognition.recognize(judge.params, x, config=judge.config)
        moments = frechet.moments(features)
        velocity = jnp.gradient(wanted.position, axis=-2) * representation.fps
        body = locomotion.locomotion_metrics(
            bones,
            scenes.motion,
            velocity,
            wanted.facing,
            contact_height=limits.foot_height,
        )
        return {
            "FID": frechet.frechet_distance(moments, judge.reference),
            "foot slide m/s": _weighted(body["slide_speed"], body["slide_seconds"]),
            "skate ratio": jnp.mean(body["skate_ratio"]),
            "acceleration m/s2": jnp.mean(body["acceleration"]),
            "jerk m/s3": jnp.mean(body["jerk"]),
            "trajectory error deg": _DEGREES
            * _weighted(body["trajectory_error"], body["trajectory_used"]),
            "orientation error deg": _DEGREES * jnp.mean(body["orientation_error"]),
            "skill accuracy": jnp.mean(jnp.argmax(logits, axis=-1) == labels),
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

    Args:
      scenes: Windows.
      representation: Of their skeleton.
      limits: Where a touch begins.

    Returns:
      Touches and missed ones a minute, missed part of the touches, distance at touches,
      penetration of the ground and of the ball, acceleration without a touch.
    """
    bones, fps = representation.bones, representation.fps
    joints = jnp.array(representation.joints)
    places = skeleton.joint_positions(bones, scenes.motion)[..., joints, :]
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
    ratio = lambda a, b: jnp.sum(a) / jnp.maximum(jnp.sum(b), 1.0)  # noqa: E731
    return {
        "touches /min": touches / minutes,
        "missed /min": jnp.sum(count.missed) / minutes,
        "missed part": ratio(count.missed, count.touches),
        "touch distance cm": 100.0 * ratio(near.total, near.count),
        "ball in ground mm": jnp.mean(sunk.mean),
        "foot in ball mm": jnp.mean(inside.mean),
        "free acceleration m/s2": ratio(free.total, free.count),
    }
