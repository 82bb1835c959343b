"""The reverse chain, and the steps it can take.

One loop serves every sampler: it walks t = start, start - 1, ..., stop + 1 and applies
a step x_t -> x_{t-1}. The step's key is `fold_in(key, t)`, so the noise of step t does
not depend on where the chain was entered: a chain cut in two equals the whole chain,
and "guide only the last two steps" is two calls with one key.

Functions here take callables and are not jitted; jit the whole program around them.
"""

import operator

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

from jaxmotion.diffusion import schedule as _schedule
from jaxmotion.diffusion.schedule import Schedule
from jaxmotion.typing import Denoiser, Key, Step


def reverse_chain(
    step: Step,
    key: Key,
    x: Float[Array, "*shape"],
    *,
    start: int,
    stop: int = 0,
) -> Float[Array, "*shape"]:
    """Takes x from step `start` down to step `stop`.

    With start = stop it returns x. Cutting the chain anywhere, with the same key for
    both parts, gives what the whole chain gives.

    Args:
      step: Maps (key, x_t, t) to x_{t-1}.
      key: Consumed; step t gets `fold_in(key, t)`.
      x: Sample at step `start`.
      start: First t, at most the T of the step's schedule (the chain cannot see the
        schedule: a larger start clamps); static.
      stop: Step at which the result lies, 0 = clean; static.

    Returns:
      Sample at step `stop`.

    Raises:
      ValueError: unless start >= stop >= 0, both integers.

    Source: Ho et al. 2020, alg. 2.
    """

    def body(x_t: Array, t: Array) -> tuple[Array, None]:
        return step(jax.random.fold_in(key, t), x_t, t), None

    return jax.lax.scan(body, jnp.asarray(x), _countdown(start, stop))[0]


def reverse_chain_trace(
    step: Step,
    key: Key,
    x: Float[Array, "*shape"],
    *,
    start: int,
    stop: int = 0,
) -> tuple[Float[Array, "*shape"], Float[Array, "steps *shape"]]:
    """Like `reverse_chain`, and keeps every state on the way.

    Args:
      step: Maps (key, x_t, t) to x_{t-1}.
      key: Consumed; step t gets `fold_in(key, t)`.
      x: Sample at step `start`.
      start: First t; static.
      stop: Step at which the result lies, 0 = clean; static.

    Returns:
      Sample at step `stop`, and the samples at steps start - 1, start - 2, ..., stop:
      the last of them is the first result.

    Raises:
      ValueError: unless start >= stop >= 0, both integers.

    Source: Ho et al. 2020, alg. 2.
    """

    def body(x_t: Array, t: Array) -> tuple[Array, Array]:
        x_prev = step(jax.random.fold_in(key, t), x_t, t)
        return x_prev, x_prev

    return jax.lax.scan(body, jnp.asarray(x), _countdown(start, stop))


def ancestral_step(schedule: Schedule, denoise: Denoiser) -> Step:
    """Step that samples the posterior given the predicted clean sample.

    At t = 1 the result is the prediction itself, without noise. With a stochastic
    denoiser this is the sampler of denoising-diffusion GANs.

    Args:
      schedule: Table of T steps.
      denoise: Predicts x_0 from x_t.

    Returns:
      The step.

    Source: Ho et al. 2020, eq. 6-7, with the smaller of its two variances; the released
    code of CAMDM.
    """

    def step(
        key: Key, x_t: Float[Array, "*shape"], t: Int[Array, ""], /
    ) -> Float[Array, "*shape"]:
        key_denoise, key_noise = jax.random.split(key)
        x_0 = denoise(key_denoise, x_t, t).astype(x_t.dtype)
        mean, variance = _schedule.posterior(schedule, x_0, x_t, t)
        noise = jax.random.normal(key_noise, x_t.shape, x_t.dtype)
        return mean + jnp.sqrt(variance) * noise

    return step


def ddim_step(
    schedule: Schedule, denoise: Denoiser, *, eta: float | Float[Array, ""] = 0.0
) -> Step:
    """Step of DDIM, from t to t - 1; `respace` the schedule to skip steps.

    eta = 0 draws no noise; eta = 1 is `ancestral_step`. At t = 1 the result is the
    prediction itself.

    Args:
      schedule: Table of T steps.
      denoise: Predicts x_0 from x_t.
      eta: Share of the posterior's standard deviation that is drawn as noise, in
        [0, 1].

    Returns:
      The step.

    Raises:
      ValueError: if eta is a Python number out of range.

    Source: Song et al. 2020 (DDIM), eq. 12 and 16, written with x_0.
    """
    if isinstance(eta, int | float) and not 0.0 <= eta <= 1.0:
        raise ValueError(f"eta is {eta}, expected 0 to 1")

    def step(
        key: Key, x_t: Float[Array, "*shape"], t: Int[Array, ""], /
    ) -> Float[Array, "*shape"]:
        key_denoise, key_noise = jax.random.split(key)
        x_0 = denoise(key_denoise, x_t, t).astype(x_t.dtype)
        predicted_noise = _schedule.noise_from_x0(schedule, x_0, x_t, t)
        variance = jnp.square(eta) * _schedule.posterior(schedule, x_0, x_t, t).variance
        rest = schedule.one_minus_alpha_bar[t - 1].astype(x_t.dtype) - variance
        # Rounding may leave the difference just below zero.
        direction = jnp.sqrt(jnp.maximum(rest, 0.0)) * predicted_noise
        noise = jax.random.normal(key_noise, x_t.shape, x_t.dtype)
        clean = _schedule.q_sample(schedule, x_0, t - 1, jnp.zeros_like(x_0))
        return clean + direction + jnp.sqrt(variance) * noise

    return step


def sample(
    step: Step, key: Key, shape: tuple[int, ...], *, num_steps: int
) -> Float[Array, "..."]:
    """Draws a sample: normal noise, then the whole reverse chain.

    Args:
      step: Maps (key, x_t, t) to x_{t-1}.
      key: Consumed.
      shape: Shape of the sample; static.
      num_steps: T of the step's schedule; static.

    Returns:
      Clean sample.

    Raises:
      ValueError: if num_steps is negative or no integer.

    Source: Ho et al. 2020, alg. 2.
    """
    key_start, key_chain = jax.random.split(key)
    x = jax.random.normal(key_start, shape)
    return reverse_chain(step, key_chain, x, start=num_steps)


def _countdown(start: int, stop: int) -> Int[Array, " steps"]:
    """The steps t of a chain: start, start - 1, ..., stop + 1."""
    try:
        start, stop = operator.index(start), operator.index(stop)
    except TypeError as error:
        raise ValueError(
            f"start={start!r} and stop={stop!r}: expected Python integers"
        ) from error
    if not start >= stop >= 0:
        raise ValueError(f"start={start}, stop={stop}: expected start >= stop >= 0")
    return jnp.arange(start, stop, -1, dtype=jnp.int32)
