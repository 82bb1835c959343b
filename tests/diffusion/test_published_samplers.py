"""DDIM and DPM-Solver++ against diffusers, and what its other solvers would bring."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxmotion.diffusion import chain, schedule

torch = pytest.importorskip("torch")
diffusers = pytest.importorskip("diffusers")
pytestmark = pytest.mark.slow
TABLES = {
    "vp": schedule.vp_schedule(40),
    "cosine": schedule.cosine_schedule(40),
}


def denoise(key, x_t, t):
    """A nonlinear prediction of x_0 that depends on the step."""
    return jnp.tanh(0.7 * x_t + 0.02 * t)


def published(kind, table, **options):
    """A scheduler of the same table: its index i is our t - 1."""
    scheduler = getattr(diffusers, kind)(
        num_train_timesteps=table.num_steps,
        trained_betas=np.asarray(table.beta[1:], np.float64),
        prediction_type="sample",
        **options,
    )
    # The same products of alphas: its own lose digits in float32.
    scheduler.alphas_cumprod = torch.tensor(np.array(table.alpha_bar[1:]))
    return scheduler


def walk(scheduler, x):
    x = torch.tensor(np.array(x))
    for i in scheduler.timesteps:
        x_0 = torch.tanh(0.7 * x + 0.02 * (int(i) + 1))
        x = scheduler.step(x_0, i, x).prev_sample
    return x.numpy()


def ours(factory, table, x, every):
    """Samples in steps every, 2 every, ..., T."""
    steps = tuple(range(every, table.num_steps + 1, every))
    step = chain.respaced(factory, steps)(table, denoise)
    return chain.sample_from(step, jax.random.key(0), x, start=len(steps))


def start():
    return 2.0 * jax.random.normal(jax.random.key(1), (64,))


@pytest.mark.parametrize("every", [1, 5])
@pytest.mark.parametrize("name", TABLES)
def test_ddim_is_the_published_one(name, every):
    table = TABLES[name]
    options = dict(clip_sample=False, steps_offset=every - 1)
    scheduler = published("DDIMScheduler", table, **options)
    scheduler.set_timesteps(table.num_steps // every)
    found = ours(chain.ddim_step, table, start(), every)
    np.testing.assert_allclose(found, walk(scheduler, start()), atol=5e-6)


@pytest.mark.parametrize("t", [1, 2, 20, 40])
def test_ddim_with_noise_is_the_published_one(t):
    table, x, key = TABLES["vp"], start(), jax.random.key(2)
    step = chain.ddim_step(table, denoise, eta=0.6)
    scheduler = published("DDIMScheduler", table, clip_sample=False)
    scheduler.set_timesteps(table.num_steps)
    noise = jax.random.normal(jax.random.split(key)[1], x.shape)
    tensors = [torch.tensor(np.array(z)) for z in (denoise(None, x, t), x, noise)]
    x_0, x_t, noise = tensors
    expected = scheduler.step(x_0, t - 1, x_t, eta=0.6, variance_noise=noise)
    found = step(jax.random.clone(key), x, jnp.int32(t))
    np.testing.assert_allclose(found, expected.prev_sample.numpy(), atol=1e-5)


@pytest.mark.parametrize("every", [1, 5])
@pytest.mark.parametrize("name", TABLES)
def test_dpm_solver_is_the_published_one(name, every):
    table = TABLES[name]
    scheduler = published("DPMSolverMultistepScheduler", table, solver_order=2)
    indices = range(table.num_steps - 1, -1, -every)
    scheduler.set_timesteps(timesteps=list(indices))
    found = ours(chain.dpm_solver_step, table, start(), every)
    np.testing.assert_allclose(found, walk(scheduler, start()), atol=5e-6)


# --- solvers that the library does not have ---------------------------------------

# Data of which the denoiser is exact: means, deviations and shares of Gaussians.
GAUSSIAN = np.array([[1.5, 0.3**0.5, 1.0]]).T
MIXTURE = np.array([[-1.0, 0.15, 0.3], [0.3, 0.3, 0.5], [1.2, 0.1, 0.2]]).T


def error(kind, table, data, last):
    """Distance (RMS) of a whole chain to where the exact flow ends, in float64.

    In one dimension the flow keeps the order of samples, so it maps quantiles of the
    noise to those of the data.
    """
    stats = pytest.importorskip("scipy.stats")
    mean, deviation, share = data
    grid, part = np.linspace(-3, 4, 100_001), (np.arange(2000) + 0.5) / 2000
    below = (share * stats.norm.cdf((grid[:, None] - mean) / deviation)).sum(-1)
    kept = np.exp(np.float64(table.log_alpha_bar))[:, None]
    scheduler = published(kind, table, solver_order=2, timestep_spacing="trailing")
    scheduler.set_timesteps(table.num_steps)
    levels = np.sqrt((1 - kept) / kept)[:0:-1, 0]
    scheduler.sigmas = torch.tensor(np.append(levels, last))
    x = torch.tensor(stats.norm.ppf(part))[:, None]
    for i in scheduler.timesteps:
        a_bar = kept[int(i) + 1]
        total = a_bar * deviation**2 + 1 - a_bar
        off = x.numpy() - np.sqrt(a_bar) * mean
        shares = share / np.sqrt(total) * np.exp(-0.5 * off**2 / total)
        x_0 = mean + np.sqrt(a_bar) * deviation**2 / total * off
        x_0 = (shares * x_0).sum(-1) / shares.sum(-1)
        x = scheduler.step(torch.tensor(x_0)[:, None], i, x).prev_sample
    flow = np.interp(part, below, grid)
    return np.sqrt(np.mean((x.numpy()[:, 0] - flow) ** 2))


@pytest.mark.parametrize(
    ("kind", "last", "gaussian", "mixture"),
    [
        ("UniPCMultistepScheduler", 0.0, (1.0, 0.88, 0.75), (1.0, 0.80, 0.98)),
        # Without a last noise it has none of its integrals.
        ("DEISMultistepScheduler", 1e-3, (1.0, 1.03, 1.31), (1.0, 1.05, 1.26)),
    ],
)
def test_why_other_solvers_are_left_out(kind, last, gaussian, mixture):
    """Errors at 2, 4 and 8 steps, of DPM-Solver++ 2M's; see benchmarks/README.md."""
    for data, expected in ((GAUSSIAN, gaussian), (MIXTURE, mixture)):
        tables = [schedule.cosine_schedule(steps) for steps in (2, 4, 8)]
        ratios = [
            error(kind, table, data, last)
            / error("DPMSolverMultistepScheduler", table, data, 0.0)
            for table in tables
        ]
        np.testing.assert_allclose(ratios, expected, atol=0.01)
