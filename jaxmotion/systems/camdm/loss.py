"""CAMDM's training: examples from windows of motion, and the losses.

Source: Chen et al. 2024 (CAMDM), eq. 2-4, and the released code.
"""

import functools

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from jaxmotion.diffusion import schedule
from jaxmotion.learning import losses
from jaxmotion.motion import features, trajectory
from jaxmotion.motion.skeleton import Motion, Skeleton, joint_positions
from jaxmotion.systems.camdm.model import (
    Condition,
    Config,
    network,
    to_features,
    to_motion,
)
from jaxmotion.typing import Key, Params

# pyright: reportCallIssue=false


def mean_rotations(
    skeleton: Skeleton, motion: Motion, *, config: Config
) -> tuple[float, ...]:
    """Mean of the rotations' features over frames (world), each from its own facing.

    It is what `Config.rotation_mean` expects.
    """

    def local(pose: Motion) -> Array:
        path = trajectory.root_trajectory(skeleton, pose)
        frame = trajectory.PlanarFrame(origin=path.position[0], facing=path.facing[0])
        return features.motion_features(
            features.to_frame(pose, frame), rotation_layout=config.rotation_layout
        )[0, :-6]

    single = jax.tree.map(lambda x: x[:, None], motion)
    mean = jnp.mean(jax.jit(jax.vmap(local))(single), axis=0)
    return tuple(round(float(x), 5) for x in mean)


def example(
    key: Key,
    skeleton: Skeleton,
    window: Motion,
    label: Int[Array, ""],
    *,
    config: Config,
) -> tuple[Condition, Float[Array, "future features"]]:
    """The condition and the future's features, of one window of motion (world).

    Source: released code of CAMDM.
    """
    key_turn, key_course, key_keep = jax.random.split(key, 3)
    last = config.past - 1
    course = trajectory.root_trajectory(skeleton, window)
    if config.heading == "facing":
        facing = course.facing[last]
    else:
        yaw = jax.random.uniform(key_turn, (), maxval=2 * jnp.pi)
        facing = jnp.stack([jnp.sin(yaw), jnp.cos(yaw)])
    frame = trajectory.PlanarFrame(origin=course.position[last], facing=facing)

    smoothed = trajectory.smooth_course(
        key_course, course, last=last, cubic=config.cubic_wishes
    )
    wanted = trajectory.to_local(smoothed, frame)
    poses = to_features(features.to_frame(window, frame), config=config)
    keep = jax.random.bernoulli(key_keep, 1.0 - config.drop_past)
    condition = Condition(
        past=poses[: config.past],
        trajectory=jax.tree.map(lambda x: x[config.past :], wanted),
        label=label,
        keep_past=keep,
    )
    return condition, poses[config.past :]


def loss(
    params: Params,
    key: Key,
    batch: tuple[Motion, Int[Array, " batch"]],
    *,
    skeleton: Skeleton,
    config: Config,
) -> tuple[Float[Array, ""], dict[str, Array]]:
    """The weighted sum of a batch's losses, and its terms by name, unweighted.

    The batch has windows of `config.window` frames, and their styles.

    Source: Chen et al. 2024 (CAMDM), eq. 2-4, and the released code's fifth term.
    """
    key_example, key_noise = jax.random.split(key)
    condition, x_0 = examples(key_example, batch, skeleton=skeleton, config=config)
    predictions = losses.predict_clean(
        key_noise,
        x_0,
        condition.arguments(config),
        apply=functools.partial(
            network(config).apply, {"params": params}, train=config.dropout > 0
        ),
        table=schedule.cosine_schedule(config.num_steps),
        levels=config.noise_levels,
        own=config.own_levels,
    )
    each = seam_terms(skeleton, predictions, x_0, condition, config=config)
    return losses.weighted(each, config)


def seam_terms(
    skeleton: Skeleton,
    predictions: Float[Array, "number batch future features"],
    x_0: Float[Array, "*levels batch future features"],
    condition: Condition,
    *,
    config: Config,
) -> dict[str, Float[Array, " number"]]:
    """`loss_terms` of each level, over the seam if predictions go on from the past."""
    seen = losses.OVER_SEAM if config.seam_half_life else 0
    past = condition.past[:, config.past - seen :]
    kept = jnp.broadcast_to(condition.keep_past[:, None], past.shape[:-1])
    future = jnp.ones(predictions.shape[1:-1], bool)
    mask = jnp.concatenate([kept, future], axis=-1)

    def terms(prediction: Array, target: Array) -> dict[str, Array]:
        joined = (jnp.concatenate([past, x], axis=-2) for x in (prediction, target))
        return loss_terms(skeleton, *joined, config=config, mask=mask)

    # Targets that all levels share are posed once.
    own = 0 if x_0.ndim == predictions.ndim else None
    return jax.vmap(terms, (0, own))(predictions, x_0)


def examples(
    key: Key,
    batch: tuple[Motion, Int[Array, " batch"]],
    *,
    skeleton: Skeleton,
    config: Config,
) -> tuple[Condition, Float[Array, "batch future features"]]:
    """`example` of each window of a batch."""
    windows, labels = batch
    return jax.vmap(lambda k, w, c: example(k, skeleton, w, c, config=config))(
        jax.random.split(key, labels.shape[0]), windows, labels
    )


def loss_terms(
    skeleton: Skeleton,
    prediction: Float[Array, "*batch frames features"],
    target: Float[Array, "*batch frames features"],
    *,
    config: Config,
    mask: Bool[Array, "*#batch frames"] | None = None,
) -> dict[str, Float[Array, ""]]:
    """Unweighted: data, velocity, position, position_velocity, acceleration, foot.

    Positions and foot displacements are in the world, with the predicted root. A foot
    stands where the target's is slower than `config.contact_speed`, at any height.
    Without a mask all frames count.
    """
    every = jnp.ones(target.shape[:-1], bool) if mask is None else mask
    predicted, wanted = (
        joint_positions(skeleton, to_motion(x, config=config))
        for x in (prediction, target)
    )
    unit = jnp.full(config.num_features, 1.0 / config.rotation_scale)
    unit = jnp.broadcast_to(unit.at[-6:].set(1.0), target.shape)
    prediction, target = prediction * unit, target * unit
    feet = jnp.array(skeleton.feet)
    velocity = jnp.diff(wanted[..., feet, :], axis=-3) * config.fps
    speed = jnp.linalg.norm(velocity, axis=-1)
    stands = jnp.pad(
        speed <= config.contact_speed, [(0, 0)] * (speed.ndim - 2) + [(0, 1), (0, 0)]
    )
    without_root = slice(0, -6)
    return {
        "data": losses.masked_mse(prediction, target, every),
        "velocity": losses.velocity_loss(
            prediction[..., without_root], target[..., without_root], every
        ),
    } | losses.pose_terms(predicted, wanted, stands, every, feet=skeleton.feet)
