"""SMGDiff's training: examples from windows of a person and a ball, and the losses.

Source: SMGDiff, section 3.2, eq. 4-9; what it leaves open is as in CAMDM.
"""

import functools

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from jaxmotion.diffusion import schedule
from jaxmotion.learning import losses
from jaxmotion.motion import ball, features, trajectory
from jaxmotion.motion.ball import Scene
from jaxmotion.motion.skeleton import joint_positions
from jaxmotion.motion.trajectory import smooth_course
from jaxmotion.systems.smgdiff import scene as smgdiff_scene
from jaxmotion.systems.smgdiff.model import Condition, Config, network
from jaxmotion.systems.smgdiff.scene import Representation
from jaxmotion.typing import Key, Params

# Control weight from which on the ball is near: 1.6 m away at a reach of 2 m.
NEAR = 0.2


def situation(
    window: Scene,
    course: trajectory.Trajectory,
    label: Int[Array, ""],
    *,
    representation: Representation,
    config: Config,
) -> tuple[Condition, Float[Array, "window features"]]:
    """What a plan is made for at a moment of a recording, and the window's features.

    Window (past and future frames) and the wanted path are in the world. The
    condition's contacts come from its past alone, as in use.
    """
    last = config.past - 1
    past = jax.tree.map(lambda x: x[: config.past], window)
    frame = smgdiff_scene.plan_frame(representation.skeleton, past.motion)
    wanted = trajectory.to_local(course, frame)
    local = smgdiff_scene.to_frame(window, frame)
    past = jax.tree.map(lambda x: x[: config.past], local)
    condition = Condition(
        past=smgdiff_scene.to_features(past, representation),
        trajectory=jax.tree.map(lambda x: x[config.past :], wanted),
        label=label,
        ball=local.ball[last],
    )
    return condition, smgdiff_scene.to_features(local, representation)


def example(
    key: Key,
    window: Scene,
    label: Int[Array, ""],
    *,
    representation: Representation,
    config: Config,
) -> tuple[Condition, Float[Array, "window features"]]:
    """One training example from one window (world), as a user might have asked."""
    course = trajectory.root_trajectory(representation.skeleton, window.motion)
    wanted = smooth_course(key, course, last=config.past - 1, cubic=config.cubic_wishes)
    return situation(
        window, wanted, label, representation=representation, config=config
    )


def loss(
    params: Params,
    key: Key,
    batch: tuple[Scene, Int[Array, " batch"]],
    *,
    representation: Representation,
    config: Config,
) -> tuple[Float[Array, ""], dict[str, Array]]:
    """The weighted sum of a batch's losses, and its terms by name, unweighted.

    The batch has windows of `config.window` frames, and their skills.

    Source: SMGDiff, eq. 4-9.
    """
    windows, labels = batch
    size = labels.shape[0]
    key_example, key_noise = jax.random.split(key)
    keys = jax.random.split(key_example, size)
    condition, recorded = jax.vmap(
        lambda k, w, c: example(k, w, c, representation=representation, config=config)
    )(keys, windows, labels)
    predictions = losses.predict_clean(
        key_noise,
        recorded[:, config.past :],
        condition.arguments(),
        apply=functools.partial(
            network(config).apply, {"params": params}, train=config.dropout > 0
        ),
        table=schedule.cosine_schedule(config.num_steps),
        levels=config.noise_levels,
        own=config.own_levels,
    )
    seen = losses.OVER_SEAM if config.seam_half_life else 0
    recorded = recorded[:, config.past - seen :]

    def joined(x: Array) -> Array:
        return jnp.concatenate([recorded[:, :seen], x], axis=-2)

    terms = functools.partial(
        loss_terms, representation=representation, rotation=config.weight_rotation
    )
    each = jax.vmap(lambda x: terms(joined(x), recorded))(predictions)
    return losses.weighted(each, config)


def loss_terms(
    prediction: Float[Array, "*batch frames features"],
    target: Float[Array, "*batch frames features"],
    *,
    representation: Representation,
    rotation: float = 1.0,
) -> dict[str, Float[Array, ""]]:
    """Unweighted means: data, velocity, those of `losses.pose_terms`, of the ball.

    In data and velocity, squared errors of rotations count `rotation` times. A foot
    stands where the data say so. The ball's place is a quotient whose error grows
    without bound at the reach: it counts while the ball is nearer than that.

    Source: SMGDiff, eq. 6-9; position_velocity from CAMDM; acceleration and those of
    the ball are ours.
    """
    every = jnp.ones(target.shape[:-1], bool)
    skeleton = representation.skeleton

    predicted, wanted = (
        joint_positions(skeleton, smgdiff_scene.to_motion(x, representation))
        for x in (prediction, target)
    )
    names = smgdiff_scene.feature_layout(skeleton, representation.joints)
    guess, truth = (
        features.unpack(names, features.denormalize(representation.normalizer, x))
        for x in (prediction, target)
    )
    stands = truth["ground"] > 0.5
    is_near = truth["ball"][..., -1] >= NEAR
    ball_error = _ball_place(guess) - _ball_place(truth)
    none = jnp.zeros_like(ball_error)
    units = {name: 1.0 for name, _, _ in names.fields} | {"rotations": rotation**0.5}
    unit = jnp.concatenate(
        [jnp.full(stop - start, units[name]) for name, start, stop in names.fields]
    )
    unit = jnp.broadcast_to(unit, target.shape)
    prediction, target = prediction * unit, target * unit
    return {
        "data": losses.masked_mse(prediction, target, every),
        "velocity": losses.velocity_loss(prediction, target, every),
        "ball": losses.masked_mse(ball_error, none, is_near),
        "ball_acceleration": losses.velocity_loss(
            losses.displacement(ball_error),
            none[..., 1:, :],
            is_near[..., 1:] & is_near[..., :-1],
        ),
    } | losses.pose_terms(predicted, wanted, stands, every, feet=skeleton.feet)


def _ball_place(parts: dict[str, Array]) -> Float[Array, "*batch frames 3"]:
    return ball.place_ball(parts["ball"], parts["root"], least_weight=NEAR)
