"""Noise schedules, and the closed-form Gaussian identities they give.

The forward process adds noise in T steps (Ho et al. 2020, eq. 2 and 4):

    x_t = sqrt(1 - beta_t) x_{t-1} + sqrt(beta_t) noise                            (2)
    x_t = sqrt(alpha_bar_t) x_0 + sqrt(1 - alpha_bar_t) noise                      (4)

Given x_0 and x_t, the state between them is Gaussian (eq. 6-7):

    mean = beta_t sqrt(alpha_bar_{t-1}) / (1 - alpha_bar_t) x_0
         + (1 - alpha_bar_{t-1}) sqrt(1 - beta_t) / (1 - alpha_bar_t) x_t          (7)
    variance = beta_t (1 - alpha_bar_{t-1}) / (1 - alpha_bar_t)

Index 0 is clean data, so that "no noise at the last step" needs no special case: with
alpha_bar_0 = 1 the posterior at t = 1 has mean x_0 and variance 0.
"""

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from jaxmotion.diffusion.tables import Schedule as Schedule
from jaxmotion.diffusion.tables import cosine_schedule as cosine_schedule
from jaxmotion.diffusion.tables import linear_schedule as linear_schedule
from jaxmotion.diffusion.tables import respace as respace
from jaxmotion.diffusion.tables import schedule_from_betas as schedule_from_betas
from jaxmotion.diffusion.tables import vp_schedule as vp_schedule
from jaxmotion.typing import Gaussian


@jax.jit
def q_sample(
    schedule: Schedule,
    x_0: Float[Array, "*shape"],
    t: Int[Array, "*batch"],
    noise: Float[Array, "*shape"],
) -> Float[Array, "*shape"]:
    """Noisy sample x_t of a clean one.

    At t = 0 it is x_0 itself.

    Args:
      schedule: Table of T steps.
      x_0: Clean sample, in normalised units.
      t: Step in 0..T, a scalar or one for each index of x_0's leading axes. Steps out
        of range clamp, they do not raise.
      noise: Standard normal noise.

    Returns:
      The sample at step t.

    Raises:
      ValueError: at trace time, if shapes do not fit.

    Source: Ho et al. 2020, eq. 4.
    """
    _check_shapes(x_0, noise, t, "x_0", "noise")
    signal, spread = _marginal(schedule, t, x_0)
    return signal * x_0 + spread * noise


@jax.jit
def q_step(
    schedule: Schedule,
    x_prev: Float[Array, "*shape"],
    t: Int[Array, "*batch"],
    noise: Float[Array, "*shape"],
) -> Float[Array, "*shape"]:
    """One noising step x_{t-1} -> x_t.

    Args:
      schedule: Table of T steps.
      x_prev: Sample at step t - 1.
      t: Step in 1..T, a scalar or one for each index of x_prev's leading axes. Steps
        out of range clamp, they do not raise.
      noise: Standard normal noise.

    Returns:
      The sample at step t.

    Raises:
      ValueError: at trace time, if shapes do not fit.

    Source: Ho et al. 2020, eq. 2.
    """
    _check_shapes(x_prev, noise, t, "x_prev", "noise")
    t = jnp.clip(t, 1, schedule.num_steps)
    alpha = _expand(jnp.sqrt(_alpha(schedule, t)), x_prev)
    return alpha * x_prev + _expand(jnp.sqrt(schedule.beta[t]), x_prev) * noise


@jax.jit
def posterior(
    schedule: Schedule,
    x_0: Float[Array, "*shape"],
    x_t: Float[Array, "*shape"],
    t: Int[Array, "*batch"],
) -> Gaussian:
    """Distribution of x_{t-1} given x_t and x_0.

    At t = 1 the variance is exactly zero and the mean is x_0.

    Args:
      schedule: Table of T steps.
      x_0: Clean sample (or its prediction), in normalised units.
      x_t: Sample at step t.
      t: Step in 1..T, a scalar or one for each index of x_0's leading axes. Steps out
        of range clamp, they do not raise.

    Returns:
      Mean, and variance that broadcasts to it.

    Raises:
      ValueError: at trace time, if shapes do not fit.

    Source: Ho et al. 2020, eq. 6-7; EMDM alg. 2 with its index shifted by one.
    """
    _check_shapes(x_0, x_t, t, "x_0", "x_t")
    t = jnp.clip(t, 1, schedule.num_steps)
    beta, alpha = schedule.beta[t], _alpha(schedule, t)
    before = schedule.one_minus_alpha_bar[t - 1]
    # 1 - alpha_bar_t, written so that it is beta_1 to the last bit at t = 1.
    total = beta + alpha * before
    from_x_0 = beta / total * jnp.exp(0.5 * schedule.log_alpha_bar[t - 1])
    from_x_t = before / total * jnp.sqrt(alpha)
    mean = _expand(from_x_0, x_0) * x_0 + _expand(from_x_t, x_t) * x_t
    return Gaussian(mean, _expand(beta * (before / total), x_0))


@jax.jit
def noise_from_x0(
    schedule: Schedule,
    x_0: Float[Array, "*shape"],
    x_t: Float[Array, "*shape"],
    t: Int[Array, "*batch"],
) -> Float[Array, "*shape"]:
    """Noise that takes x_0 to x_t.

    Args:
      schedule: Table of T steps.
      x_0: Clean sample, in normalised units.
      x_t: Sample at step t.
      t: Step in 1..T (at 0 there is no noise to find), a scalar or one for each index
        of x_0's leading axes. Steps out of range clamp, they do not raise.

    Returns:
      The noise.

    Raises:
      ValueError: at trace time, if shapes do not fit.

    Source: Ho et al. 2020, eq. 4, solved for the noise.
    """
    _check_shapes(x_0, x_t, t, "x_0", "x_t")
    signal, spread = _marginal(schedule, jnp.maximum(t, 1), x_0)
    return (x_t - signal * x_0) / spread


@jax.jit
def x0_from_noise(
    schedule: Schedule,
    noise: Float[Array, "*shape"],
    x_t: Float[Array, "*shape"],
    t: Int[Array, "*batch"],
) -> Float[Array, "*shape"]:
    """Clean sample from which that noise leads to x_t.

    Errors of the noise grow by 1 / sqrt(alpha_bar_t): some 160 at the last step of 8
    cosine steps.

    Args:
      schedule: Table of T steps; alpha_bar_t must not be 0.
      noise: The noise (or its prediction).
      x_t: Sample at step t.
      t: Step in 0..T, a scalar or one for each index of x_t's leading axes. Steps out
        of range clamp, they do not raise.

    Returns:
      The clean sample.

    Raises:
      ValueError: at trace time, if shapes do not fit.

    Source: Ho et al. 2020, eq. 4, solved for x_0.
    """
    _check_shapes(noise, x_t, t, "noise", "x_t")
    signal, spread = _marginal(schedule, t, x_t)
    return (x_t - spread * noise) / signal


def _alpha(schedule: Schedule, t: Int[Array, "*batch"]) -> Float[Array, "*batch"]:
    """1 - beta_t, from logs: beta near 1 has lost the digits of the difference."""
    return jnp.exp(schedule.log_alpha_bar[t] - schedule.log_alpha_bar[t - 1])


def _marginal(
    schedule: Schedule, t: Int[Array, "*batch"], x: Float[Array, "*shape"]
) -> tuple[Float[Array, "..."], Float[Array, "..."]]:
    """Factors of x_0 and of the noise in x_t, shaped to broadcast against x."""
    t = jnp.clip(t, 0, schedule.num_steps)
    log = schedule.log_alpha_bar[t]
    return _expand(jnp.exp(0.5 * log), x), _expand(jnp.sqrt(jnp.abs(jnp.expm1(log))), x)


def _expand(
    values: Float[Array, "*batch"], x: Float[Array, "*shape"]
) -> Float[Array, "..."]:
    """Values of leading axes with x's dtype, and with its trailing axes of size 1."""
    return values.astype(x.dtype).reshape(values.shape + (1,) * (x.ndim - values.ndim))


def _check_shapes(x: Array, y: Array, t: Array, x_name: str, y_name: str) -> None:
    """Raises unless x and y have one shape and t's axes lead it (or are of size 1)."""
    if x.shape != y.shape:
        raise ValueError(
            f"{x_name} has shape {x.shape} and {y_name} {y.shape}, expected the same"
        )
    lead = x.shape[: t.ndim]
    if len(lead) < t.ndim or any(
        a not in (1, b) for a, b in zip(t.shape, lead, strict=True)
    ):
        raise ValueError(
            f"t has shape {t.shape}, expected () or the leading axes of {x.shape}"
        )
