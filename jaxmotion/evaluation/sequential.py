"""A t-test that may be looked at after every sample, and stopped when it decides.

For normal samples of unknown variance the ratio of the densities of Student's t with
and without an effect,

    e_n = p(t_n | mean = effect * deviation) / p(t_n | mean = 0),

is a nonnegative martingale with mean 1 if there is no effect (its mean is less if the
effect has the other sign): it ever exceeds 1 / alpha with probability alpha at most
(Ville), however often one looks and whenever one stops. Evidence here is the mean of
e_n over `EFFECTS`, in deviations of a sample.

Source: Rushton 1950; Lai 1976; Pérez-Ortiz, Lardy, de Heide and Grünwald 2024, "E-
statistics, group invariance and anytime-valid testing".
"""

import functools

import numpy as np
import scipy.optimize
from scipy.special import logsumexp

from jaxmotion.evaluation.statistics import Interval

# Sizes of effects that are looked for: one, two and four deviations of a sample.
EFFECTS = (1.0, 2.0, 4.0)


@functools.cache
def _table(count: int) -> tuple[np.ndarray, np.ndarray]:
    """Log e_n for values of sum / sqrt(sum of squares), which is all that it needs.

    Up to a factor that cancels, p(t_n | effect) is the integral over u > 0 of
    u^(n-1) exp(-u^2 / 2 + u effect ratio - n effect^2 / 2).
    """
    ratio = np.linspace(-np.sqrt(count), np.sqrt(count), 801)
    u = np.linspace(1e-4, np.sqrt(count) * (max(EFFECTS) + 1.0) + 9.0, 2000)
    null = (count - 1) * np.log(u) - 0.5 * np.square(u)
    terms = [
        logsumexp(null + u * effect * ratio[:, None], axis=1)
        - logsumexp(null)
        - 0.5 * count * effect**2
        for effect in EFFECTS
    ]
    return ratio, logsumexp(terms, axis=0) - np.log(len(EFFECTS))


def log_evidence(samples: np.ndarray) -> np.ndarray:
    """Evidence that the mean of normal samples is above zero, after each of them.

    Natural logarithms of e_1, ..., e_n for samples in the order in which they were
    drawn; the first is 0: one sample says nothing of a deviation. Not a number from the
    first sample on that is none. Samples that are all zero are no evidence either way.
    """
    values = np.asarray(samples, np.float64)
    # Scaled first: squares of tiny or huge numbers would vanish or overflow.
    size = np.max(
        np.abs(values), axis=-1, keepdims=True, initial=0.0, where=np.isfinite(values)
    )
    values = values / np.where(size > 0.0, size, 1.0)
    norm = np.sqrt(np.cumsum(np.square(values), axis=-1))
    with np.errstate(invalid="ignore"):  # infinite ones
        ratio = np.cumsum(values, axis=-1) / np.where(norm > 0.0, norm, 1.0)
    found = np.zeros(values.shape)
    for count in range(2, values.shape[-1] + 1):
        found[..., count - 1] = np.interp(ratio[..., count - 1], *_table(count))
    # Before the first that is not zero there is nothing to be found in a ratio.
    found = np.where(norm > 0.0, found, 0.0)
    return np.where(np.isnan(ratio), np.nan, found)


def interval(samples: np.ndarray, *, level: float = 0.95) -> Interval:
    """Values that the mean may have: it holds the true one at all counts at once.

    The level is the probability that the intervals after 2, 3, ... normal samples all
    hold the mean. The interval after the last one is wider than Student's, which holds
    the mean at one count that is chosen beforehand. Its ends are infinite where no mean
    could be excluded by so few samples.
    """
    values = np.asarray(samples, np.float64)
    mean, size = float(values.mean()), float(np.std(values))
    bound = -np.log(0.5 * (1.0 - level))

    def excess(shift: float, sign: float) -> float:
        """How much more evidence against mean + sign * shift there is than allowed."""
        return float(log_evidence(sign * (mean - values) + shift)[-1] - bound)

    if len(values) < 2 or not np.isfinite(size):
        return Interval(mean, -np.inf, np.inf)
    if size == 0.0:
        size = max(abs(mean), 1.0) * 1e-12
    found = []
    for sign in (-1.0, 1.0):
        far = 1e6 * size
        if excess(far, sign) <= 0.0:
            found.append(sign * np.inf)
            continue
        shift = scipy.optimize.brentq(excess, 0.0, far, args=(sign,), full_output=False)
        found.append(mean + sign * float(shift))  # pyright: ignore[reportArgumentType]
    return Interval(mean, float(found[0]), float(found[1]))
