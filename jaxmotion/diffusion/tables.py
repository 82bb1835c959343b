"""The table of a noise schedule, and the schedules there are.

The variances beta_t of Ho et al. 2020, eq. 2, and alpha_bar_t = prod_{s <= t} (1 -
beta_s). Tables have T + 1 entries and index 0 is clean data: beta_0 = 0, alpha_bar_0 =
1. The released code of MDM, CAMDM and EMDM counts from zero; its index i is step i + 1
here.

What is stored is log alpha_bar, because 1 - alpha_bar = -expm1(log alpha_bar) keeps all
digits where 1 - cumprod(1 - beta) in float32 keeps three. For the same reason each
schedule gives the logs in the form that does not cancel.

Users import all of it from `jaxmotion.diffusion.schedule`.
"""

import dataclasses
import functools
import math

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float


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
        return jnp.abs(jnp.expm1(self.log_alpha_bar))  # abs: no -0, whose snr is -inf

    @property
    def snr(self) -> Float[Array, "*batch entries"]:
        """Signal-to-noise ratio alpha_bar / (1 - alpha_bar); infinite at index 0."""
        return self.alpha_bar / self.one_minus_alpha_bar


@functools.partial(jax.jit, static_argnames=("num_steps", "offset", "max_beta"))
def cosine_schedule(
    num_steps: int, *, offset: float = 0.008, max_beta: float = 0.999
) -> Schedule:
    """Cosine schedule; the default of MDM, CAMDM and SMGDiff.

    alpha_bar(u) is proportional to cos^2 of (u + offset) / (1 + offset) * pi / 2 with
    u = t / T. All arguments are static.

    Args:
      num_steps: T, at least 1.
      offset: Keeps the first steps from vanishing; at least 0.
      max_beta: Upper bound of beta, in (0, 1).

    Returns:
      A schedule of T steps.

    Raises:
      ValueError: if an argument is out of range.

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

    The default bounds were chosen for T = 1000. All arguments are static.

    Args:
      num_steps: T, at least 1.
      beta_min: First variance, in (0, 1].
      beta_max: Last variance, in (0, 1].
      scaled: Multiplies both bounds by 1000 / T, so that few steps add as much noise
        as 1000 would; needs T >= 1000 * beta_max.

    Returns:
      A schedule of T steps.

    Raises:
      ValueError: if an argument is out of range, or a scaled bound exceeds 1; names
        the smallest usable number of steps.

    Source: Ho et al. 2020, section 4; `scaled` as in the released code of MDM and
    CAMDM.
    """
    _check_num_steps(num_steps)
    _check_range("beta_min", beta_min, 0.0 < beta_min <= 1.0, "in (0, 1]")
    _check_range("beta_max", beta_max, 0.0 < beta_max <= 1.0, "in (0, 1]")
    largest = max(beta_min, beta_max)
    if scaled and 1000.0 * largest > num_steps:
        raise ValueError(
            f"scaled linear schedule with num_steps={num_steps} has a beta of "
            f"{1000.0 * largest / num_steps:.4g}, expected at most 1: use at least "
            f"{math.ceil(1000.0 * largest)} steps, or the cosine schedule"
        )
    scale = 1000.0 / num_steps if scaled else 1.0
    return _from_betas(jnp.linspace(scale * beta_min, scale * beta_max, num_steps))


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

    The continuous process runs over times t_min..1 and its noise rate grows from
    beta_min to beta_max. The table starts from clean data at t_min, so alpha_bar_T
    is the same for every T. All arguments are static.

    Args:
      num_steps: T, at least 1.
      beta_min: Noise rate at time 0, more than 0.
      beta_max: Noise rate at time 1, at least beta_min.
      t_min: Time of the clean sample, in [0, 1).

    Returns:
      A schedule of T steps.

    Raises:
      ValueError: if an argument is out of range.

    Source: Song et al. 2021, eq. 32-33; discretised as in Xiao et al. 2022 (DDGAN) and
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
    """Schedule with the given variances.

    Under jit the values are not known and therefore not checked.

    Args:
      beta: Variance added at steps 1..T, in (0, 1); the last may be 1.

    Returns:
      A schedule of T steps.

    Raises:
      ValueError: if beta is empty, not one-dimensional, or has a value out of range;
        names the first such step.

    Source: Ho et al. 2020, eq. 2.
    """
    beta = jnp.asarray(beta)
    if beta.ndim != 1 or beta.shape[0] < 1:
        raise ValueError(f"beta has shape {beta.shape}, expected [T] with T >= 1")
    if not isinstance(beta, jax.core.Tracer):
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
    told the old step: `lambda key, x, t: denoise(key, x, jnp.array(steps)[t - 1])`.

    Args:
      schedule: Table of T steps.
      steps: Steps to keep, in 1..T, strictly increasing, at least one; static.

    Returns:
      A schedule of len(steps) steps.

    Raises:
      ValueError: if steps is empty, out of range or not increasing.

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
