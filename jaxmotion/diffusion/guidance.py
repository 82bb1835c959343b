"""Wrappers that steer a denoiser; the chain does not know of them."""

from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from jaxmotion.diffusion.schedule import Schedule
from jaxmotion.typing import ConditionalDenoiser, Denoiser, Key, Objective


def classifier_free(
    denoise: ConditionalDenoiser,
    cond: Any,
    null_cond: Any,
    scale: float | Float[Array, ""],
) -> Denoiser:
    """Denoiser that extrapolates from the null condition through the given one.

    x_0 = null + scale * (conditional - null): 0 ignores the condition, 1 is the plain
    conditional denoiser, more exaggerates it. Both predictions come from one call of
    the network, vectorised over the two conditions, with one key, so that a stochastic
    denoiser draws the same latent for both.

    Args:
      denoise: Predicts x_0 from (key, x_t, t, cond).
      cond: Condition, any pytree of arrays.
      null_cond: Condition that stands for "none", of the same structure and shapes.
      scale: Guidance scale; may be traced.

    Returns:
      The guided denoiser.

    Raises:
      ValueError: if the two conditions differ in structure, shape or dtype.

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

    Args:
      schedule: Table of T steps.
      denoise: Predicts x_0; differentiable in x_t.
      objective: Scalar of the prediction.
      scale: Step size; 0 leaves the prediction as it is; may be traced.

    Returns:
      The guided denoiser.

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
