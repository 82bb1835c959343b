"""Float64 oracles of the diffusion maths, in the zero-based index of MDM's code.

Index i = 0..T-1; i = 0 is the least noisy state. Written from the papers and in the
naive forms (products, differences), which float64 can afford.
"""

import numpy as np


def cosine_betas(num_steps, offset=0.008, max_beta=0.999):
    def f(u):
        return np.cos((u + offset) / (1 + offset) * np.pi / 2) ** 2

    i = np.arange(num_steps, dtype=np.float64)
    return np.minimum(1 - f((i + 1) / num_steps) / f(i / num_steps), max_beta)


def linear_betas(num_steps, beta_min=1e-4, beta_max=0.02, scale=1.0):
    return np.linspace(scale * beta_min, scale * beta_max, num_steps)


def vp_betas(num_steps, beta_min=0.1, beta_max=20.0, epsilon=1e-3):
    tau = np.arange(num_steps + 1) / num_steps * (1 - epsilon) + epsilon
    log_mean = -0.25 * tau**2 * (beta_max - beta_min) - 0.5 * tau * beta_min
    variance = 1 - np.exp(2 * log_mean)
    alpha_bar = 1 - variance
    return 1 - alpha_bar[1:] / alpha_bar[:-1]


def coefficients(betas):
    """alpha_bar, c1, c2, v and the two clipped log variances of a list of betas."""
    betas = np.asarray(betas, np.float64)
    alpha = 1 - betas
    alpha_bar = np.cumprod(alpha)
    before = np.append(1.0, alpha_bar[:-1])
    c1 = betas * np.sqrt(before) / (1 - alpha_bar)
    c2 = (1 - before) * np.sqrt(alpha) / (1 - alpha_bar)
    v = betas * (1 - before) / (1 - alpha_bar)
    return {
        "beta": betas,
        "alpha_bar": alpha_bar,
        "c1": c1,
        "c2": c2,
        "v": v,
        # MDM copies v[1] into slot 0; DDGAN floors at 1e-20.
        "log_v_copied": np.log(np.append(v[1], v[1:])) if len(v) > 1 else None,
        "log_v_floored": np.log(np.maximum(v, 1e-20)),
    }


def product_of_gaussians(mean_a, variance_a, mean_b, variance_b):
    """Mean and variance of the normalized product of two densities (Bayes' rule)."""
    precision = 1 / variance_a + 1 / variance_b
    return (mean_a / variance_a + mean_b / variance_b) / precision, 1 / precision


def bayes_posterior(betas, i, x_0, x_i):
    """q(x_{i-1} | x_i, x_0) from the prior q(x_{i-1} | x_0) and one noising step."""
    alpha_bar = np.cumprod(1 - np.asarray(betas, np.float64))
    prior_mean = np.sqrt(alpha_bar[i - 1]) * x_0
    prior_variance = 1 - alpha_bar[i - 1]
    # The step x_i ~ N(sqrt(alpha) x_{i-1}, beta), read as a density of x_{i-1}.
    alpha = 1 - betas[i]
    return product_of_gaussians(
        prior_mean, prior_variance, x_i / np.sqrt(alpha), betas[i] / alpha
    )


def ddim(betas, i, x_0, x_i, noise, eta):
    """One DDIM step from index i to i - 1 (index -1 is clean data)."""
    alpha_bar = np.append(np.cumprod(1 - np.asarray(betas, np.float64)), 1.0)
    at, to = alpha_bar[i], alpha_bar[i - 1]  # i = 0 wraps to the appended 1.
    predicted = (x_i / np.sqrt(at) - x_0) / np.sqrt(1 / at - 1)
    sigma = eta * np.sqrt((1 - to) / (1 - at)) * np.sqrt(1 - at / to)
    direction = np.sqrt(np.maximum(1 - to - sigma**2, 0.0)) * predicted
    return np.sqrt(to) * x_0 + direction + sigma * noise


def exact_denoiser(betas, i, x_i, mean, variance):
    """Mean and variance of x_0 given x_i, for x_0 ~ N(mean, variance)."""
    at = np.cumprod(1 - np.asarray(betas, np.float64))[i]
    return product_of_gaussians(mean, variance, x_i / np.sqrt(at), (1 - at) / at)


def ancestral_moments(betas, mean, variance, stochastic):
    """Mean and variance that the reverse chain ends with, starting from N(0, 1).

    The denoiser is exact for x_0 ~ N(mean, variance): affine in x_i, so the moments
    follow a recursion. A stochastic one samples x_0 given x_i instead of averaging.
    """
    table = coefficients(betas)
    m, s = 0.0, 1.0
    for i in reversed(range(len(betas))):
        at_zero, spread = exact_denoiser(betas, i, 0.0, mean, variance)
        at_one, _ = exact_denoiser(betas, i, 1.0, mean, variance)
        slope = at_one - at_zero
        gain = table["c1"][i] * slope + table["c2"][i]
        m = gain * m + table["c1"][i] * at_zero
        s = gain**2 * s + table["v"][i]
        if stochastic:
            s += table["c1"][i] ** 2 * spread
    return m, s
