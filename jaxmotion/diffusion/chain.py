"""The reverse chain, and the steps it can take.

One loop serves every sampler: it walks t = start, start - 1, ..., stop + 1 and applies
a step x_t -> x_{t-1}. The step's key is `fold_in(key, t)`, so the noise of step t does
not depend on where the chain was entered: a chain cut in two equals the whole chain,
and "guide only the last two steps" is two calls with one key.

What the chain walks is any pytree. For most steps it is the sample; a step that looks
back (`Multistep`) walks the sample together with its history, and `sample_from` and
`sample` hide that: they take a sample and return one, whatever the step carries.

Samplers take a step factory, `(schedule, denoise) -> step`: `ancestral_step`,
`ddim_step`, `dpm_solver_step`, or a `functools.partial` of one.

Functions here take callables and are not jitted; jit the whole program around them.
"""

import dataclasses
import operator
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from jaxmotion.diffusion import schedule as _schedule
from jaxmotion.diffusion.schedule import Schedule
from jaxmotion.typing import Denoiser, Key, Step

StepFactory = Callable[[Schedule, Denoiser], Step]


@dataclasses.dataclass(frozen=True)
class Multistep:
    """A step that looks back: what the chain walks is the sample and its history.

    `step` maps (key, state at t, t) to the state at t - 1; `init` makes a state without
    history of a sample, `finish` a sample of a state.
    """

    step: Step
    init: Callable[[Array], Any]
    finish: Callable[[Any], Array]

    def __call__(self, key: Key, state: Any, t: Int[Array, ""], /) -> Any:
        """Maps the state at t to that at t - 1."""
        return self.step(key, state, t)


def respaced(make: StepFactory, steps: tuple[int, ...] | None) -> StepFactory:
    """A factory of steps that visit only some steps of the schedule it is given.

    The steps to visit are as for `schedule.respace`; None for all. The factory's steps
    count 1..len(steps); the denoiser, trained on the given schedule, is told that
    schedule's own step.
    """
    if steps is None:
        return make

    def make_respaced(schedule: Schedule, denoise: Denoiser) -> Step:
        own = jnp.asarray(steps, jnp.int32)
        return make(
            _schedule.respace(schedule, steps),
            lambda key, x_t, t: denoise(key, x_t, own[t - 1]),
        )

    return make_respaced


def reverse_chain(
    step: Step,
    key: Key,
    x: Any,
    *,
    start: int,
    stop: int = 0,
) -> Any:
    """Takes x from step `start` down to step `stop`.

    With start = stop it returns x. Cutting the chain anywhere, with the same key for
    both parts, gives what the whole chain gives.

    Args:
      key: Consumed; step t gets `fold_in(key, t)`.
      x: What the step walks at step `start`: a sample, or any pytree of arrays.
      start: First t, at most the T of the step's schedule (the chain cannot see the
        schedule: a larger start clamps); static.
      stop: Step at which the result lies, 0 = clean; static.

    Raises:
      ValueError: unless start >= stop >= 0, both integers; for a sample that a
        `Multistep` is to walk.

    Source: Ho et al. 2020, alg. 2.
    """

    def body(x_t: Any, t: Array) -> tuple[Any, None]:
        return step(jax.random.fold_in(key, t), x_t, t), None

    if isinstance(step, Multistep) and isinstance(x, Array | np.ndarray):
        raise ValueError("x is a sample, expected step.init(x): or use sample_from")
    x = jax.tree.map(jnp.asarray, x)
    return jax.lax.scan(body, x, _countdown(start, stop))[0]


def reverse_chain_trace(
    step: Step,
    key: Key,
    x: Any,
    *,
    start: int,
    stop: int = 0,
) -> tuple[Any, Any]:
    """Like `reverse_chain`, and keeps every state on the way.

    Beside x at step `stop` comes x at steps start - 1, start - 2, ..., stop on a new
    leading axis: the last of them is the first result.
    """

    def body(x_t: Any, t: Array) -> tuple[Any, Any]:
        x_prev = step(jax.random.fold_in(key, t), x_t, t)
        return x_prev, x_prev

    x = jax.tree.map(jnp.asarray, x)
    return jax.lax.scan(body, x, _countdown(start, stop))


def sample_from(
    step: Step,
    key: Key,
    x: Float[Array, "*shape"],
    *,
    start: int,
    stop: int = 0,
) -> Float[Array, "*shape"]:
    """`reverse_chain` from a sample to a sample: a `Multistep` begins without history.

    To cut the chain of a `Multistep` in two and keep its history, walk its state by
    `reverse_chain`.
    """
    if not isinstance(step, Multistep):
        return reverse_chain(step, key, x, start=start, stop=stop)
    state = reverse_chain(step, key, step.init(x), start=start, stop=stop)
    return step.finish(state)


def ancestral_step(
    schedule: Schedule,
    denoise: Denoiser,
    *,
    noise: Float[Array, "steps *shape"] | None = None,
) -> Step:
    """Step that samples the posterior given the predicted clean sample.

    At t = 1 the result is the prediction itself, without noise. With a stochastic
    denoiser this is the sampler of denoising-diffusion GANs. The normal noise of steps
    1..T may be given; None draws it from the key.

    Source: Ho et al. 2020, eq. 6-7, with the smaller of its two variances; the released
    code of CAMDM.
    """

    def step(
        key: Key, x_t: Float[Array, "*shape"], t: Int[Array, ""], /
    ) -> Float[Array, "*shape"]:
        key_denoise, key_noise = jax.random.split(key)
        x_0 = denoise(key_denoise, x_t, t).astype(x_t.dtype)
        mean, variance = _schedule.posterior(schedule, x_0, x_t, t)
        if noise is None:
            own = jax.random.normal(key_noise, x_t.shape, x_t.dtype)
        else:
            own = noise[t - 1]
        return mean + _schedule.deviation(variance) * own

    return step


def ddim_step(
    schedule: Schedule, denoise: Denoiser, *, eta: float | Float[Array, ""] = 0.0
) -> Step:
    """Step of DDIM, from t to t - 1; `respace` the schedule to skip steps.

    eta, in [0, 1], is the share of the posterior's standard deviation that is drawn as
    noise: 0 draws none; 1 is `ancestral_step`. At t = 1 the result is the prediction
    itself. `ValueError` if eta is a Python number out of range.

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
        posterior = _schedule.posterior(schedule, x_0, x_t, t).variance
        variance = jnp.square(eta) * posterior
        rest = schedule.one_minus_alpha_bar[t - 1].astype(x_t.dtype) - variance
        # Rounding may leave the difference just below zero.
        direction = _schedule.deviation(rest) * predicted_noise
        noise = jax.random.normal(key_noise, x_t.shape, x_t.dtype)
        clean = _schedule.q_sample(schedule, x_0, t - 1, jnp.zeros_like(x_0))
        # The posterior's own: at eta = 0 the root of their product has no gradient.
        return clean + direction + eta * _schedule.deviation(posterior) * noise

    return step


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True, kw_only=True, eq=False)
class SolverState:
    """What DPM-Solver++ 2M walks: x at t, and x_0 as predicted from t + 1, if known."""

    x: Float[Array, "*shape"]
    x_0: Float[Array, "*shape"]
    known: Bool[Array, ""]


def dpm_solver_step(schedule: Schedule, denoise: Denoiser) -> Multistep:
    """Step of DPM-Solver++ 2M: DDIM without noise, of second order in the step size.

    With a = sqrt(alpha_bar), s = sqrt(1 - alpha_bar) and l = log(a / s), the ODE whose
    solutions have the marginals of the diffusion is, for a denoiser D(x, l) = x_0,

        d(x / s) / dl = e^l D      so that, over h = l_{t-1} - l_t,

        x_{t-1} = (s_{t-1} / s_t) x_t + s_{t-1} int_{l_t}^{l_{t-1}} e^l D(l) dl.

    A constant D gives the factor a_{t-1} (1 - e^{-h}) of D(x_t), which is DDIM. Here D
    is a line through the predictions of this step and of the one before, a distance h'
    away; the line's value in the middle of the step makes the integral exact to
    O(h^3):

        D = D_t + h / (2 h') (D_t - D_{t+1})
        x_{t-1} = (s_{t-1} / s_t) x_t + a_{t-1} (1 - e^{-h}) D

    The first step, which has no predecessor, and the last, whose h is infinite, take
    D_t alone; at t = 1 the result is the prediction itself. It draws no noise;
    `respace` the schedule to skip steps.

    Source: Lu et al. 2022, "DPM-Solver++", alg. 2, with its first-order last step.
    """
    # Of steps 1..T: that of clean data is infinite, and so is its gradient.
    log_ratio = 0.5 * jax.tree.map(lambda x: x[1:], schedule).log_snr

    def step(key: Key, state: SolverState, t: Int[Array, ""], /) -> SolverState:
        x_t, dtype = state.x, state.x.dtype
        key_denoise, _ = jax.random.split(key)
        x_0 = denoise(key_denoise, x_t, t).astype(dtype)
        is_last = t == 1
        h = log_ratio[jnp.maximum(t - 2, 0)] - log_ratio[t - 1]
        h_before = log_ratio[t - 1] - log_ratio[t]
        second = state.known & ~is_last
        share = jnp.where(second, h / (2.0 * jnp.where(second, h_before, 1.0)), 0.0)
        line = x_0 + share.astype(dtype) * (x_0 - state.x_0)
        alpha_bar, rest = schedule.alpha_bar[t - 1], schedule.one_minus_alpha_bar
        keep = _schedule.deviation(rest[t - 1] / rest[t]).astype(dtype)
        gone = jnp.where(is_last, 1.0, -jnp.expm1(-h))
        take = (jnp.sqrt(alpha_bar) * gone).astype(dtype)
        x = keep * x_t + take * line
        return SolverState(x=x, x_0=x_0, known=jnp.ones_like(state.known))

    def init(x: Float[Array, "*shape"]) -> SolverState:
        x = jnp.asarray(x)
        return SolverState(x=x, x_0=jnp.zeros_like(x), known=jnp.zeros((), bool))

    return Multistep(step, init, lambda state: state.x)


def sample(
    step: Step, key: Key, shape: tuple[int, ...], *, num_steps: int
) -> Float[Array, "..."]:
    """Draws a sample: normal noise, then the whole reverse chain.

    The shape and T (`num_steps`) of the step's schedule are static.

    Source: Ho et al. 2020, alg. 2.
    """
    key_start, key_chain = jax.random.split(key)
    x = jax.random.normal(key_start, shape)
    return sample_from(step, key_chain, x, start=num_steps)


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
