"""EMDM's training: geometric and adversarial losses, lazy R1, and MDM's loss.

    L_D = E softplus(-D(x_{t-1}, x_t, t, c)) + E softplus(D(x'_{t-1}, x_t, t, c))
          [+ gamma / 2 |grad D(x_{t-1})|^2 every k updates]
    L_G = E softplus(-D(x'_{t-1}, x_t, t, c))
          + R |x_0 - x'_0|^2 + l_pos |p - p'|^2 + l_vel |dx_0 - dx'_0|^2 + l_foot foot

Differs from the released code: both terms of L_G come from one forward pass with the
same t, noise and latent; there from two with fresh ones. The expectation of the
gradient is the same, and a pass is saved. `Config.mask_frames` says how motions of
different lengths are averaged.

Ours, off by default: relativistic losses with a penalty at generated pairs, too
(`Config.discriminator_loss`), and a discriminator that judges noisy steps alone
(`Config.discriminator_from`).

Source: Zhou et al. 2024 (EMDM), eq. 5-12; released code; `diffusion.gan`.
"""

import dataclasses
from collections.abc import Callable

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from jaxmotion.diffusion import gan, schedule
from jaxmotion.learning import losses
from jaxmotion.motion import contact
from jaxmotion.networks import blocks
from jaxmotion.systems.emdm import model as emdm_model
from jaxmotion.systems.emdm.model import Config
from jaxmotion.typing import Key, Params

Info = dict[str, Array]


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True, kw_only=True, eq=False)
class Batch:
    """Motions and what they are made from.

    Attributes:
      x_0: Features in the network's units; zero after a motion's end.
      vector: One-hot actions or text vectors.
      mask: Frames that a motion has.
    """

    x_0: Float[Array, "batch frames features"]
    vector: Float[Array, "batch condition"]
    mask: Bool[Array, "batch frames"]


@dataclasses.dataclass(frozen=True, kw_only=True)
class Geometry:
    """How features become joints; only for the geometric losses.

    Attributes:
      positions: Features (network's units) to joint positions, meters, relative to the
        root or in the world.
      feet: Joints that may stand.
      channels: Channels of whose frame differences the velocity loss is made.
      fps: Frames per second.
      contact_speed: A foot slower than this stands, meters per second (released: 0.01
        meters per frame at any rate, which is 0.2 at HumanML3D's 20 frames per second).
    """

    positions: Callable[[Array], Array]
    feet: tuple[int, ...]
    channels: slice
    fps: float
    contact_speed: float = 0.2


def geometric_loss(
    prediction: Float[Array, "batch frames features"],
    batch: Batch,
    t: Int[Array, " batch"],
    *,
    config: Config,
    geometry: Geometry | None,
) -> tuple[Float[Array, ""], Info]:
    """Weighted errors of features, their differences, joint positions and feet, of x_0.

    Without geometry only the first counts; t is the steps that it is predicted from.
    First and second differences of positions are ours (weight 0 as published). Terms
    are unweighted but for `config.fade_geometry` and `config.weigh_levels`.

    Source: EMDM, eq. 11-12; MDM, eq. 3-5.
    """
    mask, features = batch.mask, batch.x_0
    average = "frames" if config.mask_frames else "samples"
    geometric = (prediction, features)
    if config.weigh_levels == "posterior":  # errors are squared
        count = jnp.sqrt(schedule.posterior_weight(config.table(), t))[:, None, None]
        prediction, features = count * prediction, count * features
    error = losses.masked_mse(prediction, features, mask, average=average)
    terms = {"recon": error}
    if geometry is not None:
        found, truth = map(geometry.positions, geometric)
        stands = contact.foot_contacts(
            truth[..., jnp.asarray(geometry.feet), :],
            geometry.fps,
            max_speed=geometry.contact_speed,
        )
        if config.weigh_levels == "posterior":
            found, truth = count[..., None] * found, count[..., None] * truth
        if config.fade_geometry:
            fade = jnp.sqrt(config.table().alpha_bar[t])[:, None, None]
            prediction, features = fade * prediction, fade * features
            found, truth = fade[..., None] * found, fade[..., None] * truth
        terms["velocity"] = losses.velocity_loss(
            prediction[..., geometry.channels],
            features[..., geometry.channels],
            mask,
            average=average,
        )
        terms |= losses.pose_terms(
            found, truth, stands, mask, feet=geometry.feet, average=average
        )
    return losses.weighted(terms, config)


def _visible(x: Array, batch: Batch, config: Config) -> Array:
    """Motion as the discriminator sees it: nothing after its end."""
    return x * batch.mask[..., None] if config.mask_frames else x


def _generated(
    params: Params, key: Key, batch: Batch, config: Config, *, least: int = 1
) -> tuple[Array, Array, Array, Array, Array]:
    """Step from `least` on, real x_{t-1}, x_t, predicted x_0, generated x_{t-1}."""
    names = ("t", "pair", "keep", "latent", "dropout", "posterior")
    keys = dict(zip(names, jax.random.split(key, len(names)), strict=True))
    table, size = config.table(), batch.x_0.shape[0]
    t = jax.random.randint(keys["t"], (size,), least, config.num_steps + 1)
    x_prev, x_t = gan.q_pair(table, keys["pair"], batch.x_0, t)
    keep = jax.random.bernoulli(keys["keep"], 1.0 - config.drop_condition, (size,))
    prediction = blocks.apply(
        params,
        emdm_model.generator(config),
        x_t,
        t,
        batch.vector,
        keep,
        batch.mask | (not config.mask_frames),
        jax.random.normal(keys["latent"], (size, config.latent)),
        train=True,
        rngs={"dropout": keys["dropout"]},
    )
    fake = gan.posterior_sample(table, keys["posterior"], prediction, x_t, t)
    visible = lambda x: _visible(x, batch, config)  # noqa: E731
    return t, visible(x_prev), visible(x_t), prediction, visible(fake)


def discriminator_loss(
    params: Params,
    generator: Params,
    key: Key,
    batch: Batch,
    *,
    config: Config,
    penalized: Bool[Array, ""],
) -> tuple[Float[Array, ""], Info]:
    """The discriminator's loss: "adversarial", and "r1" in the updates that have it.

    "r1" is the sum of both penalties where the loss is relativistic.
    """
    least = config.discriminator_from
    t, x_prev, x_t, _, fake = _generated(generator, key, batch, config, least=least)
    net = emdm_model.discriminator(config)
    seen = emdm_model.discriminator_condition(batch.vector, config=config)

    def score(x: Array) -> Array:
        return blocks.apply(params, net, x, x_t, t, seen)

    fake = jax.lax.stop_gradient(fake)
    if config.discriminator_loss == "relativistic":
        adversarial = gan.relativistic_loss(score(x_prev), score(fake))
        places = x_prev, fake
    else:
        adversarial = gan.discriminator_loss(score(x_prev), score(fake))
        places = (x_prev,)
    penalty = jnp.zeros(())
    if config.weight_r1:
        penalty = jax.lax.cond(
            penalized,
            lambda places: sum(gan.r1_penalty(score, x) for x in places),
            lambda places: penalty,
            places,
        )
    loss = adversarial + 0.5 * config.weight_r1 * penalty
    return loss, {"adversarial": adversarial, "r1": penalty}


def generator_loss(
    params: Params,
    discriminator: Params,
    key: Key,
    batch: Batch,
    *,
    config: Config,
    geometry: Geometry | None,
) -> tuple[Float[Array, ""], Info]:
    """The generator's loss, "adversarial" (weighted) and the geometric terms.

    Geometry is None if the weights of positions, velocities and feet are 0.
    """
    t, x_prev, x_t, prediction, fake = _generated(params, key, batch, config)
    seen = emdm_model.discriminator_condition(batch.vector, config=config)

    def score(x: Array) -> Array:
        net = emdm_model.discriminator(config)
        return blocks.apply(discriminator, net, x, x_t, t, seen)

    if config.discriminator_loss == "relativistic":
        judge, logits = gan.relativistic_loss, (score(fake), score(x_prev))
    else:
        judge, logits = gan.generator_loss, (score(fake),)
    if config.discriminator_from == 1:
        verdict = judge(*logits)
    else:
        judged = t >= config.discriminator_from
        verdicts = jnp.where(judged, jax.vmap(judge)(*logits), 0.0)
        verdict = jnp.sum(verdicts) / jnp.maximum(jnp.sum(judged), 1)
    geometric, terms = geometric_loss(
        prediction, batch, t, config=config, geometry=geometry
    )
    adversarial = config.weight_adversarial * verdict
    return adversarial + geometric, {"adversarial": adversarial, **terms}


def diffusion_loss(
    params: Params,
    key: Key,
    batch: Batch,
    *,
    config: Config,
    geometry: Geometry | None,
) -> tuple[Float[Array, ""], Info]:
    """MDM's loss: the geometric one alone, of a denoiser with or without latent.

    Geometry is None if the weights of positions, velocities and feet are 0.

    Source: Tevet et al. 2023 (MDM), eq. 2-6.
    """
    key_t, key_noise, key_keep, key_dropout, key_latent = jax.random.split(key, 5)
    size = batch.x_0.shape[0]
    latent = None
    if config.latent:
        latent = jax.random.normal(key_latent, (size, config.latent))
    t = jax.random.randint(key_t, (size,), 1, config.num_steps + 1)
    noise = jax.random.normal(key_noise, batch.x_0.shape)
    x_t = schedule.q_sample(config.table(), batch.x_0, t, noise)
    keep = jax.random.bernoulli(key_keep, 1.0 - config.drop_condition, (size,))
    prediction = blocks.apply(
        params,
        emdm_model.generator(config),
        x_t,
        t,
        batch.vector,
        keep,
        batch.mask | (not config.mask_frames),
        latent,
        train=True,
        rngs={"dropout": key_dropout},
    )
    return geometric_loss(prediction, batch, t, config=config, geometry=geometry)
