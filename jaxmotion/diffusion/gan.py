"""Denoising-diffusion GANs: pairs of neighboring noise levels, and their losses.

A generator predicts x_0 from x_t and a latent; its x_{t-1} is drawn from the posterior.
A discriminator tells pairs (x_{t-1}, x_t) of the data from such pairs. Because the
latent makes the prediction a distribution, few and large steps keep the data's
variance. Sampling needs nothing new: `chain.ancestral_step` with a denoiser that draws
its latent from its key.

    L_D = E softplus(-D(x_{t-1}, x_t)) + E softplus(D(x'_{t-1}, x_t))
    L_G = E softplus(-D(x'_{t-1}, x_t))

Relativistic players judge a pair of the data beside a generated one instead:

    L_D = E softplus(D(x'_{t-1}, x_t) - D(x_{t-1}, x_t)),  L_G with the two exchanged

Source: Xiao et al. 2022, "Tackling the Generative Learning Trilemma with Denoising
Diffusion GANs"; Li et al. 2024 (AAMDM), eq. 10-12; Zhou et al. 2024 (EMDM), alg. 1;
Huang et al. 2024, "The GAN is dead; long live the GAN!", eq. 2 (relativistic).
"""

from collections.abc import Callable

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from jaxmotion.diffusion import schedule as _schedule
from jaxmotion.diffusion.schedule import Schedule
from jaxmotion.typing import Key


@jax.jit
def q_pair(
    schedule: Schedule,
    key: Key,
    x_0: Float[Array, "*shape"],
    t: Int[Array, "*#batch"],
) -> tuple[Float[Array, "*shape"], Float[Array, "*shape"]]:
    """A pair x_{t-1}, x_t of neighboring noise levels of the same clean sample.

    The noise of the second step is independent of that of the first. t is in 1..T; at t
    = 1 the first is x_0 itself.
    """
    key_prev, key_t = jax.random.split(key)
    noise = lambda k: jax.random.normal(k, x_0.shape, x_0.dtype)  # noqa: E731
    x_prev = _schedule.q_sample(schedule, x_0, t - 1, noise(key_prev))
    return x_prev, _schedule.q_step(schedule, x_prev, t, noise(key_t))


@jax.jit
def posterior_sample(
    schedule: Schedule,
    key: Key,
    x_0: Float[Array, "*shape"],
    x_t: Float[Array, "*shape"],
    t: Int[Array, "*#batch"],
) -> Float[Array, "*shape"]:
    """Draws x_{t-1} given x_t and (a prediction of) x_0, t in 1..T; x_0 at t = 1."""
    mean, variance = _schedule.posterior(schedule, x_0, x_t, t)
    noise = jax.random.normal(key, x_t.shape, x_t.dtype)
    return mean + _schedule.deviation(variance) * noise


@jax.jit
def discriminator_loss(
    real_logits: Float[Array, "*reals"], fake_logits: Float[Array, "*fakes"]
) -> Float[Array, ""]:
    """Non-saturating: mean softplus(-real) plus mean softplus(fake).

    2 ln 2 where it is undecided.
    """
    real = jnp.mean(jax.nn.softplus(-real_logits))
    return real + jnp.mean(jax.nn.softplus(fake_logits))


@jax.jit
def generator_loss(fake_logits: Float[Array, "*batch"]) -> Float[Array, ""]:
    """Non-saturating: mean softplus(-fake)."""
    return jnp.mean(jax.nn.softplus(-fake_logits))


@jax.jit
def relativistic_loss(
    won: Float[Array, "*batch"], lost: Float[Array, "*batch"]
) -> Float[Array, ""]:
    """Mean softplus(lost - won); ln 2 where the discriminator is undecided.

    The discriminator's loss where real logits are to win over generated ones of the
    same place, the generator's where they are to lose.
    """
    return jnp.mean(jax.nn.softplus(lost - won))


def r1_penalty(
    discriminate: Callable[[Float[Array, "batch *shape"]], Float[Array, " batch"]],
    x: Float[Array, "batch *shape"],
) -> Float[Array, ""]:
    """Squared gradient of the logits at real samples, averaged over the batch.

    The customary loss is gamma / 2 times it. `discriminate` maps samples to their
    logits, each from its own sample only. At generated samples it is R2.

    Source: Mescheder et al. 2018, eq. 9.
    """
    gradient = jax.grad(lambda y: jnp.sum(discriminate(y)))(x)
    return jnp.sum(jnp.square(gradient)) / x.shape[0]
