"""Float64 oracles of EMDM: schedule, pairs, networks, losses and guidance, with loops.

Written from the paper (Zhou et al. 2024, alg. 1-2, eq. 8-12) and the released sizes, in
DDGAN's index t = 0..T-1: the pair is (x_t, x_{t+1}), and the generator reads x_{t+1}
and t. Where beta is a list of T numbers, beta[t] noises x_t to x_{t+1}.

Parameters are dicts of arrays. A linear layer is {"weight": [inputs, outputs],
"bias": [outputs]}; a group norm {"scale": [channels], "bias": [channels]}.

  discriminator  {"time": [2 linear layers], "layers": [7 linear layers],
                  "norms": [the norm after layer 2, the norm after layer 4]}
                 (counted from 1; 1024, 1024, 512, 512, 256, 64 and 1 outputs as
                 published). Inputs of the first layer, in this order: all numbers of
                 x_t (frame by frame), of x_{t+1}, the time embedding, the condition.
  latent MLP     [5 linear layers]
"""

import numpy as np

from tests.reference import diffusion

SELU_ALPHA, SELU_SCALE = 1.6732632423543772, 1.0507009873554805


# Diffusion.


def vp_variances(num_steps, beta_min=0.1, beta_max=20.0, epsilon=1e-3):
    """The T noise variances of the variance-preserving process, one by one."""
    betas = []
    for k in range(1, num_steps + 1):
        alpha_bar = []
        for step in (k - 1, k):
            tau = step / num_steps * (1 - epsilon) + epsilon
            log_mean = -0.25 * tau**2 * (beta_max - beta_min) - 0.5 * tau * beta_min
            alpha_bar.append(np.exp(2 * log_mean))
        betas.append(1 - alpha_bar[1] / alpha_bar[0])
    return np.array(betas)


def pair_moments(betas, t, x_0):
    """Means and variances of x_t and x_{t+1}, and their covariance, given x_0.

    Each number of x_0 for itself. The step from x_t to x_{t+1} has its own noise.
    """
    mean, variance = np.asarray(x_0, np.float64), 0.0
    for beta in betas[:t]:
        mean, variance = np.sqrt(1 - beta) * mean, (1 - beta) * variance + beta
    a = np.sqrt(1 - betas[t])
    return {
        "mean": mean,
        "variance": variance,
        "mean_next": a * mean,
        "variance_next": a**2 * variance + betas[t],
        "covariance": a * variance,
    }


def pair(betas, t, x_0, noise, noise_next):
    """The pair (x_t, x_{t+1}) that two draws of noise make."""
    moments = pair_moments(betas, t, x_0)
    x_t = moments["mean"] + np.sqrt(moments["variance"]) * noise
    a = np.sqrt(1 - betas[t])
    return x_t, a * x_t + np.sqrt(betas[t]) * noise_next


def posterior(betas, t, x_0, x_next):
    """Mean and variance of x_t given x_{t+1} and x_0; at t = 0 it is x_0."""
    table = diffusion.coefficients(betas)
    mean = table["c1"][t] * x_0 + table["c2"][t] * x_next
    return mean, table["v"][t]


def sample(predict, betas, x, noises):
    """Algorithm 2; predict(x_{t+1}, t) draws its latent, noises[t] is step t's."""
    for t in reversed(range(len(betas))):
        mean, variance = posterior(betas, t, predict(x, t), x)
        x = mean + np.sqrt(variance) * noises[t] if t > 0 else mean
    return x


def guided(generate, x, t, latent, condition, null, scale):
    """Classifier-free guidance: both predictions from the same latent."""
    without = generate(x, t, latent, null)
    return without + scale * (generate(x, t, latent, condition) - without)


# Layers, one sample at a time.


def linear(x, layer):
    return x @ np.asarray(layer["weight"], np.float64) + np.asarray(layer["bias"])


def leaky_relu(x, slope=0.2):
    return np.where(x > 0, x, slope * x)


def selu(x):
    return SELU_SCALE * np.where(x > 0, x, SELU_ALPHA * (np.exp(np.minimum(x, 0)) - 1))


def group_norm(x, norm, groups, epsilon=1e-5):
    """Neighboring channels in equal groups, each to mean 0 and variance 1."""
    size = len(x) // groups
    out = np.empty(len(x))
    for first in range(0, len(x), size):
        group = x[first : first + size]
        centered = group - np.mean(group)
        spread = np.sqrt(np.mean(centered**2) + epsilon)
        out[first : first + size] = centered / spread
    return out * np.asarray(norm["scale"]) + np.asarray(norm["bias"])


def time_code(t, width):
    """Sines of t in the first half of the channels, cosines in the second."""
    half = width // 2
    code = np.empty(2 * half)
    for i in range(half):
        angle = t * np.exp(-np.log(1e4) * i / (half - 1))
        code[i], code[half + i] = np.sin(angle), np.cos(angle)
    return code


def discriminator(params, x_t, x_next, t, condition, *, width=128, groups=(32, 16)):
    """The logit of one pair [frames, features] at step t."""
    first, second = params["time"]
    code = linear(leaky_relu(linear(time_code(t, width), first)), second)
    h = np.concatenate([np.ravel(x_t), np.ravel(x_next), code, condition])
    norms = {1: (params["norms"][0], groups[0]), 3: (params["norms"][1], groups[1])}
    last = len(params["layers"]) - 1
    for i, layer in enumerate(params["layers"]):
        h = linear(h, layer)
        if i in norms:
            h = group_norm(h, *norms[i])
        if i < last:
            h = selu(h)
    return h[0]


def latent_mlp(layers, z):
    """Latent to token: a leaky ReLU after every layer, the last one too."""
    for layer in layers:
        z = leaky_relu(linear(z, layer))
    return z


# Losses.


def softplus(x):
    return np.logaddexp(0.0, x)


def discriminator_loss(real_logits, fake_logits):
    real = np.mean([softplus(-logit) for logit in real_logits])
    return real + np.mean([softplus(logit) for logit in fake_logits])


def generator_loss(fake_logits):
    return np.mean([softplus(-logit) for logit in fake_logits])


def r1(discriminate, batch, gamma=0.02, step=1e-5):
    """gamma / 2 times the mean squared gradient, by central differences.

    discriminate(x_t, i) is the logit of sample i with x_t in place of its own.
    """
    norms = []
    for i, x in enumerate(batch):
        x = np.array(x, np.float64)
        squared = 0.0
        for index in np.ndindex(x.shape):
            up, down = x.copy(), x.copy()
            up[index] += step
            down[index] -= step
            slope = (discriminate(up, i) - discriminate(down, i)) / (2 * step)
            squared += slope**2
        norms.append(squared)
    return gamma / 2 * np.mean(norms)


def masked_l2(a, b, mask):
    """Mean over samples of the mean square over the frames that the mask keeps.

    a, b [batch, frames, ...]; mask [batch, frames] of zeros and ones.
    """
    losses = []
    for x, y, keep in zip(a, b, mask, strict=True):
        total, count = 0.0, 0
        for frame in range(len(x)):
            if keep[frame]:
                total += np.sum((np.asarray(x[frame], np.float64) - y[frame]) ** 2)
                count += np.size(x[frame])
        losses.append(total / max(count, 1))  # too short for a difference: 0
    return np.mean(losses)


def foot_loss(found, wanted, feet, mask, speed=0.01):
    """Masked L2 between the steps of the feet and none, where the data's feet stand.

    found, wanted [batch, frames, joints, 3], meters, relative to the root as in the
    paper's code; a foot stands from a frame to the next if the data's moves `speed`
    meters a frame at most. Steps of feet that move count as zeros.
    """
    steps = np.zeros((len(found), found.shape[1] - 1, len(feet), 3))
    for b, frame, k in np.ndindex(steps.shape[:3]):
        foot = feet[k]
        moved = wanted[b, frame + 1, foot] - wanted[b, frame, foot]
        if np.sqrt(np.sum(np.asarray(moved, np.float64) ** 2)) <= speed:
            steps[b, frame, k] = found[b, frame + 1, foot] - found[b, frame, foot]
    return masked_l2(steps, np.zeros_like(steps), mask[:, 1:])


def geometric_terms(
    prediction, target, found, wanted, mask, feet, *, speed=0.01, translation=None
):
    """The four terms of a batch, unweighted, and differences of positions (ours).

    prediction, target [batch, frames, features]; found, wanted are the joint positions
    of the two. The columns `translation` (a slice) of the features are left out of the
    velocity term. A difference of two frames counts if the mask keeps the later one.
    """
    kept = np.ones(prediction.shape[-1], bool)
    if translation is not None:
        kept[translation] = False
    steps = [np.diff(x[..., kept], axis=1) for x in (prediction, target)]
    return {
        "reconstruction": masked_l2(prediction, target, mask),
        "position": masked_l2(found, wanted, mask),
        "velocity": masked_l2(*steps, mask[:, 1:]),
        "position_velocity": masked_l2(
            np.diff(found, axis=1), np.diff(wanted, axis=1), mask[:, 1:]
        ),
        "acceleration": masked_l2(
            np.diff(found, 2, axis=1), np.diff(wanted, 2, axis=1), mask[:, 2:]
        ),
        "foot": foot_loss(found, wanted, feet, mask, speed),
    }


def geometric_loss(terms, **weights):
    """R times the reconstruction plus the weighted other terms; those not named: 1."""
    return sum(weights.get(name, 1.0) * value for name, value in terms.items())
