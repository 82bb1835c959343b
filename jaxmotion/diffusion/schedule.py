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

import dataclasses
import functools
import math

import jax
import jax.numpy as jnp
from jax.core import Tracer
from jaxtyping import Array, Float, Int

from jaxmotion.typing import Gaussian


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True, kw_only=True, eq=False)
class Schedule:
    """Table of T noising steps; T + 1 entries, index 0 = clean data.

    Attributes:
      beta: Variance added at step t; 0 at index 0, then in (0, 1].
      log_alpha_bar: Log of the share of x_0's variance left at step t; 0 at index 0.
    """

    beta: Float[Array, "*batch entries"]
    log_alpha_bar: Float[Array, "*batch entries"]

    @property
    def num_steps(self) -> int:
        """Number of steps T."""
        return self.beta.shape[-1] - 1

    @property
    def alpha_bar(self) -> Float[Array, "*batch entries"]:
        """Share of x_0's variance left at step t; 1 at index 0."""
        return jnp.exp(self.log_alpha_bar)

    @property
    def one_minus_alpha_bar(self) -> Float[Array, "*batch entries"]:
        """Variance of the noise at step t; 0 at index 0, exact for small steps."""
        return jnp.abs(jnp.expm1(self.log_alpha_bar))  # abs: no -0

    @property
    def log_snr(self) -> Float[Array, "*batch entries"]:
        """Log of alpha_bar / (1 - alpha_bar); infinite at index 0."""
        return self.log_alpha_bar - jnp.log(self.one_minus_alpha_bar)


@functools.partial(jax.jit, static_argnames=("num_steps", "offset", "max_beta"))
def cosine_schedule(
    num_steps: int, *, offset: float = 0.008, max_beta: float = 0.999
) -> Schedule:
    """Cosine schedule; the default of MDM, CAMDM and SMGDiff.

    alpha_bar(u) is proportional to cos^2 of (u + offset) / (1 + offset) * pi / 2 with u
    = t / T; the offset, at least 0, keeps the first steps from vanishing, and beta is
    at most `max_beta`, in (0, 1). All arguments are static; `ValueError` out of these
    ranges.

    Source: Nichol & Dhariwal 2021, eq. 17; clipping as in the released code of CAMDM.
    """
    _check_num_steps(num_steps)
    _check_range("offset", offset, offset >= 0.0, "at least 0")
    _check_range("max_beta", max_beta, 0.0 < max_beta < 1.0, "in (0, 1)")
    unit = math.pi / 2.0 / (num_steps * (1.0 + offset))
    index = jnp.arange(num_steps + 1, dtype=float)
    # The angle and its complement to a right angle, each exact where it is small.
    angle = unit * (index + num_steps * offset)
    complement = unit * (num_steps - index)
    cosine = jnp.sin(complement)
    # 1 - cos^2 a / cos^2 b = sin(a - b) sin(a + b) / cos^2 b: no cancellation. The
    # smaller of a + b and its supplement has the smaller rounding error.
    total = jnp.minimum(angle[1:] + angle[:-1], complement[1:] + complement[:-1])
    beta = math.sin(unit) * jnp.sin(total) / cosine[:-1] ** 2
    log_alpha = jnp.where(
        beta < 0.5, jnp.log1p(-beta), 2.0 * jnp.log(cosine[1:] / cosine[:-1])
    )
    log_alpha = jnp.maximum(log_alpha, math.log1p(-max_beta))
    return _from_steps(jnp.minimum(beta, max_beta), jnp.cumsum(log_alpha))


@functools.partial(
    jax.jit, static_argnames=("num_steps", "beta_min", "beta_max", "scaled")
)
def linear_schedule(
    num_steps: int,
    *,
    beta_min: float = 1e-4,
    beta_max: float = 0.02,
    scaled: bool = False,
) -> Schedule:
    """Variances on a straight line.

    From `beta_min` in (0, 1) to `beta_max` in (0, 1], chosen for T = 1000. Where
    `scaled`, both are multiplied by 1000 / T, so that few steps add as much noise as
    1000 would. All arguments are static. `ValueError` for one out of range, also after
    scaling; names the smallest usable number of steps.

    Source: Ho et al. 2020, section 4; `scaled` as in the released code of MDM and
    CAMDM.
    """
    _check_num_steps(num_steps)
    # A step before the last that leaves no signal would leave none to be told later.
    _check_range("beta_min", beta_min, 0.0 < beta_min < 1.0, "in (0, 1)")
    _check_range("beta_max", beta_max, 0.0 < beta_max <= 1.0, "in (0, 1]")
    least = max(math.floor(1000.0 * beta_min) + 1, math.ceil(1000.0 * beta_max))
    if scaled and num_steps < least:
        largest = 1000.0 * max(beta_min, beta_max) / num_steps
        raise ValueError(
            f"scaled linear schedule with num_steps={num_steps} has a beta of "
            f"{largest:.4g}, expected at most 1: use at least {least} steps, or the "
            "cosine schedule"
        )
    scale = 1000.0 / num_steps if scaled else 1.0
    return schedule_from_betas(
        jnp.linspace(scale * beta_min, scale * beta_max, num_steps)
    )


@functools.partial(
    jax.jit, static_argnames=("num_steps", "beta_min", "beta_max", "t_min")
)
def vp_schedule(
    num_steps: int,
    *,
    beta_min: float = 0.1,
    beta_max: float = 20.0,
    t_min: float = 1e-3,
) -> Schedule:
    """Variance-preserving diffusion cut into T steps; the default of EMDM.

    The continuous process runs over times t_min..1 (t_min in [0, 1)) and its noise rate
    grows from beta_min > 0 to beta_max. The table starts from clean data at t_min, so
    alpha_bar_T is the same for every T. All arguments are static; `ValueError` out of
    range.

    Source: Song et al. 2021, eq. 32-33; discretized as in Xiao et al. 2022 (DDGAN) and
    the released code of EMDM. Differs: those give the clean sample a variance of 1e-8.
    """
    _check_num_steps(num_steps)
    _check_range("beta_min", beta_min, beta_min > 0.0, "more than 0")
    _check_range("beta_max", beta_max, beta_max >= beta_min, f"at least {beta_min}")
    _check_range("t_min", t_min, 0.0 <= t_min < 1.0, "in [0, 1)")
    width = (1.0 - t_min) / num_steps
    index = jnp.arange(num_steps + 1, dtype=float)
    time = width * index + t_min
    slope = 0.5 * (beta_max - beta_min)

    # log alpha_bar(b) - log alpha_bar(a) = -(b - a) (slope (a + b) + beta_min).
    log_alpha = -width * (slope * (time[1:] + time[:-1]) + beta_min)
    log_alpha_bar = -width * index * (slope * (time + t_min) + beta_min)
    return _from_steps(-jnp.expm1(log_alpha), log_alpha_bar[1:])


def schedule_from_betas(beta: Float[Array, " steps"]) -> Schedule:
    """Schedule with the given variances of steps 1..T, in (0, 1); the last may be 1.

    A `ValueError` names the first step out of range. Under jit the values are not known
    and therefore not checked.

    Source: Ho et al. 2020, eq. 2.
    """
    beta = jnp.asarray(beta)
    if beta.ndim != 1 or beta.shape[0] < 1:
        raise ValueError(f"beta has shape {beta.shape}, expected [T] with T >= 1")
    if not isinstance(beta, Tracer):
        valid = (beta > 0.0) & (beta < 1.0)
        valid = valid.at[-1].set((beta[-1] > 0.0) & (beta[-1] <= 1.0))
        if not bool(valid.all()):
            step = int(jnp.argmin(valid))
            raise ValueError(
                f"beta at step {step + 1} is {float(beta[step])}, expected in (0, 1)"
            )
    return _from_betas(beta)


@functools.partial(jax.jit, static_argnames=("steps",))
def respace(schedule: Schedule, steps: tuple[int, ...]) -> Schedule:
    """Schedule that visits only some steps of another.

    Step k of the result is step `steps[k - 1]` of the given schedule: alpha_bar is
    kept there and beta spans the gap. A network trained on the given schedule must be
    told the old step, as `chain.respaced` does.

    `steps` are in 1..T, strictly increasing, one at least, and static (else
    `ValueError`).

    Source: Nichol & Dhariwal 2021, section 4 (fast sampling).
    """
    if not steps:
        raise ValueError("steps is empty, expected at least one step")
    for before, step in zip((0, *steps), steps, strict=False):
        if not before < step <= schedule.num_steps:
            raise ValueError(
                f"step {step} after {before}: expected increasing steps in "
                f"1..{schedule.num_steps}, got {steps}"
            )
    kept = schedule.log_alpha_bar[jnp.array((0, *steps))]
    return _from_steps(-jnp.expm1(kept[1:] - kept[:-1]), kept[1:])


def spread_steps(total: int, number: int) -> tuple[int, ...]:
    """Steps for `respace`: evenly spread over 1..total, the last of them total."""
    if not 1 <= number <= total:
        raise ValueError(f"{number} steps of {total}, expected 1 to {total}")
    return tuple(-(-total * k // number) for k in range(1, number + 1))


def _from_steps(
    beta: Float[Array, " steps"], log_alpha_bar: Float[Array, " steps"]
) -> Schedule:
    """Schedule from tables of steps 1..T: puts clean data before them."""
    clean = jnp.zeros((1,), beta.dtype)
    return Schedule(
        beta=jnp.concatenate([clean, beta]),
        log_alpha_bar=jnp.concatenate([clean, log_alpha_bar]),
    )


@jax.jit
def _from_betas(beta: Float[Array, " steps"]) -> Schedule:
    """Schedule from the variances of steps 1..T."""
    return _from_steps(beta, jnp.cumsum(jnp.log1p(-beta)))


def _check_num_steps(num_steps: int) -> None:
    if isinstance(num_steps, bool) or not isinstance(num_steps, int) or num_steps < 1:
        raise ValueError(f"num_steps is {num_steps!r}, expected an int of at least 1")


def _check_range(name: str, value: float, valid: bool, expected: str) -> None:
    if not valid:
        raise ValueError(f"{name} is {value!r}, expected {expected}")


@jax.jit
def q_sample(
    schedule: Schedule,
    x_0: Float[Array, "*shape"],
    t: Int[Array, "*batch"],
    noise: Float[Array, "*shape"],
) -> Float[Array, "*shape"]:
    """Noisy sample x_t of a clean one.

    At t = 0 it is x_0 itself, in normalized units. t is in 0..T, a scalar or one for
    each index of x_0's leading axes. Steps out of range clamp, they do not raise;
    shapes that do not fit raise `ValueError`, at trace time.

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

    t is in 1..T, the noise standard normal; shapes and clamping as in `q_sample`.

    Source: Ho et al. 2020, eq. 2.
    """
    _check_shapes(x_prev, noise, t, "x_prev", "noise")
    t = jnp.clip(t, 1, schedule.num_steps)
    alpha = _expand(jnp.sqrt(_alpha(schedule, t)), x_prev)
    return alpha * x_prev + _expand(jnp.sqrt(schedule.beta[t]), x_prev) * noise


@jax.jit
def posterior_weight(
    schedule: Schedule, t: Int[Array, "*batch"]
) -> Float[Array, "*batch"]:
    """How much the mean of x_{t-1} moves with x_0: 1 at t = 1, little at noisy steps.

    Source: Ho et al. 2020, eq. 7: the factor of x_0.
    """
    t = jnp.clip(t, 1, schedule.num_steps)
    beta = schedule.beta[t]
    total = beta + _alpha(schedule, t) * schedule.one_minus_alpha_bar[t - 1]
    return beta / total * jnp.exp(0.5 * schedule.log_alpha_bar[t - 1])


@jax.jit
def posterior(
    schedule: Schedule,
    x_0: Float[Array, "*shape"],
    x_t: Float[Array, "*shape"],
    t: Int[Array, "*batch"],
) -> Gaussian:
    """Distribution of x_{t-1} given x_t and x_0.

    At t = 1 the variance is exactly zero and the mean is x_0.

    t is in 1..T, x_0 in normalized units, maybe predicted; the variance broadcasts to
    the mean. Shapes and clamping as in `q_sample`.

    Source: Ho et al. 2020, eq. 6-7; EMDM alg. 2 with its index shifted by one.
    """
    _check_shapes(x_0, x_t, t, "x_0", "x_t")
    t = jnp.clip(t, 1, schedule.num_steps)
    beta, alpha = schedule.beta[t], _alpha(schedule, t)
    before = schedule.one_minus_alpha_bar[t - 1]
    # 1 - alpha_bar_t, written so that it is beta_1 to the last bit at t = 1.
    total = beta + alpha * before
    from_x_0 = posterior_weight(schedule, t)
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

    t is in 1..T (at 0 there is no noise to find); shapes and clamping as in `q_sample`.

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

    There alpha_bar_t must not be 0. Shapes and clamping as in `q_sample`.

    Source: Ho et al. 2020, eq. 4, solved for x_0.
    """
    _check_shapes(noise, x_t, t, "noise", "x_t")
    signal, spread = _marginal(schedule, t, x_t)
    return (x_t - spread * noise) / signal


def deviation(variance: Float[Array, "*shape"]) -> Float[Array, "*shape"]:
    """Square root, 0 of what is below; its gradient is 0, not infinite, at 0."""
    some = variance > 0.0
    return jnp.where(some, jnp.sqrt(jnp.where(some, variance, 1.0)), 0.0)


def _alpha(schedule: Schedule, t: Int[Array, "*batch"]) -> Float[Array, "*batch"]:
    """1 - beta_t, from logs: beta near 1 has lost the digits of the difference."""
    return jnp.exp(schedule.log_alpha_bar[t] - schedule.log_alpha_bar[t - 1])


def _marginal(
    schedule: Schedule, t: Int[Array, "*batch"], x: Float[Array, "*shape"]
) -> tuple[Float[Array, "..."], Float[Array, "..."]]:
    """Factors of x_0 and of the noise in x_t, shaped to broadcast against x."""
    t = jnp.clip(t, 0, schedule.num_steps)
    log = schedule.log_alpha_bar[t]
    spread = deviation(jnp.abs(jnp.expm1(log)))
    return _expand(jnp.exp(0.5 * log), x), _expand(spread, x)


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
