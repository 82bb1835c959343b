"""Wrappers that steer a denoiser; the chain does not know of them."""

from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from jaxmotion.diffusion import schedule as _schedule
from jaxmotion.diffusion.schedule import Schedule
from jaxmotion.typing import ConditionalDenoiser, Denoiser, Key, Objective, Step


def classifier_free(
    denoise: ConditionalDenoiser,
    cond: Any,
    null_cond: Any,
    scale: float | Float[Array, ""],
) -> Denoiser:
    """Denoiser that extrapolates from the null condition through the given one.

    x_0 = null + scale * (conditional - null): 0 ignores the condition, 1 is the plain
    conditional denoiser, more exaggerates it. Both predictions come from one call of
    the network, vectorized over the two conditions, with one key, so that a stochastic
    denoiser draws the same latent for both.

    The null condition has the other's structure, shapes and types (else `ValueError`);
    the scale may be traced.

    Source: Chen et al. 2024 (CAMDM), eq. 5; Ho & Salimans 2022.
    """
    both = _stack(cond, null_cond)

    def guided(
        key: Key, x_t: Float[Array, "*shape"], t: Int[Array, ""], /
    ) -> Float[Array, "*shape"]:
        predictions = jax.vmap(lambda c: denoise(key, x_t, t, c))(both)
        conditional, null = predictions[0], predictions[1]
        return null + jnp.asarray(scale, null.dtype) * (conditional - null)

    return guided


def _stack(cond: Any, null_cond: Any) -> Any:
    """Both conditions on a new leading axis of every leaf."""
    expected = jax.tree.structure(cond)
    found = jax.tree.structure(null_cond)
    if expected != found:
        raise ValueError(
            f"null_cond has structure {found}, expected that of cond, {expected}"
        )

    def stack(path: Any, a: Any, b: Any) -> Array:
        a, b = jnp.asarray(a), jnp.asarray(b)
        if (a.shape, a.dtype) != (b.shape, b.dtype):
            where = jax.tree_util.keystr(path) or "leaf"
            raise ValueError(
                f"null_cond{where} is {b.dtype}{list(b.shape)}, expected "
                f"{a.dtype}{list(a.shape)} as in cond"
            )
        return jnp.stack([a, b])

    return jax.tree_util.tree_map_with_path(stack, cond, null_cond)


def gradient_guidance(
    schedule: Schedule,
    denoise: Denoiser,
    objective: Objective,
    *,
    scale: float | Float[Array, ""],
) -> Denoiser:
    """Denoiser whose prediction moves down an objective's gradient.

    x_0 - scale * alpha_t * d objective(denoise(x_t)) / d x_t, alpha_t = 1 - beta_t. The
    gradient goes through the network to its noisy input, so the prediction moves only
    where a change of the input would have moved it.

    The scale may be traced; 0 leaves the prediction as it is.

    Source: Li et al. 2024 (AAMDM), eq. 13; Rempe et al. 2023 (TRACE).
    """

    def guided(
        key: Key, x_t: Float[Array, "*shape"], t: Int[Array, ""], /
    ) -> Float[Array, "*shape"]:
        def value(x: Array) -> tuple[Array, Array]:
            x_0 = denoise(key, x, t)
            return objective(x_0), x_0

        gradient, x_0 = jax.grad(value, has_aux=True)(x_t)
        alpha = (1.0 - schedule.beta[t]).astype(x_0.dtype)
        return x_0 - jnp.asarray(scale, x_0.dtype) * alpha * gradient

    return guided


def dsg_step(
    schedule: Schedule,
    denoise: Denoiser,
    objective: Objective,
    *,
    rate: float | Float[Array, ""] = 0.5,
    last_sigma: float | Float[Array, ""] | None = None,
) -> Step:
    """Ancestral step whose noise is turned down an objective's gradient.

    The step of length r = sqrt(n) sigma_t, where n numbers of Gaussian noise nearly
    always end, is taken in a direction between the drawn noise and the descent
    D* = -r g / |g|, with g the gradient through the network at x_t:

        D = sigma_t noise + rate (D* - sigma_t noise),   x_{t-1} = mean + r D / |D|

    Where g is zero (nothing to guide) it is the ancestral step. Any other g, however
    small, is followed over the whole length: an objective should be flat where it is
    satisfied.

    The last step draws no noise, for its sigma is 0: there the whole step is descent,
    of length sqrt(n) `last_sigma`.

    Args:
      objective: Of the prediction; its gradient is finite.
      last_sigma: sigma of the step from t = 1; None for that of t = 2, as the released
        code's clipped variance has it. It is a fifth of the data's deviation at T = 8,
        all of it along one direction: smaller values disturb less. A chain of one step
        has no t = 2, and is not guided then.

    Source: Yang et al. 2024 (DSG), eq. 13-15 of SMGDiff, and DSG's released code.
    """

    def step(
        key: Key, x_t: Float[Array, "*shape"], t: Int[Array, ""], /
    ) -> Float[Array, "*shape"]:
        key_denoise, key_noise = jax.random.split(key)

        def value(x: Array) -> tuple[Array, Array]:
            x_0 = denoise(key_denoise, x, t)
            return objective(x_0), x_0.astype(x.dtype)

        gradient, x_0 = jax.grad(value, has_aux=True)(x_t)
        mean, variance = _schedule.posterior(schedule, x_0, x_t, t)
        noise = jax.random.normal(key_noise, x_t.shape, x_t.dtype)
        drawn = _schedule.deviation(variance) * noise
        zero = jnp.zeros_like(x_t)
        typical = _schedule.posterior(schedule, zero, zero, jnp.maximum(t, 2)).variance
        sigma = _schedule.deviation(typical)
        if last_sigma is not None:
            sigma = jnp.where(t == 1, jnp.asarray(last_sigma, x_t.dtype), sigma)
        radius = jnp.sqrt(x_t.size).astype(x_t.dtype) * sigma
        descent = -radius * _direction(gradient)
        mixed = drawn + jnp.asarray(rate, x_t.dtype) * (descent - drawn)
        guided = mean + radius * _direction(mixed)
        return jnp.where(jnp.any(gradient != 0), guided, mean + drawn)

    return step


def _direction(x: Float[Array, "*shape"]) -> Float[Array, "*shape"]:
    """The unit vector along x, and 0 for 0; its derivative is finite everywhere."""
    # A gradient's square may leave float32's range, its ratio to its largest does not.
    largest = jax.lax.stop_gradient(jnp.max(jnp.abs(x)))
    scaled = x / jnp.where(largest > 0, largest, 1.0)
    square = jnp.sum(scaled * scaled)
    norm = jnp.sqrt(jnp.where(square > 0, square, 1.0))
    return scaled / norm
