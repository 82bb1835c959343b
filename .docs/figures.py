"""One figure per concept, drawn from the library: what is shown is what it computes."""

import io
import re

import jax
import jax.numpy as jnp
import matplotlib
import numpy as np
from matplotlib.figure import Figure
from matplotlib.patches import Rectangle

from jaxmotion.diffusion import chain, schedule

BLUE, RED, GREEN, ORANGE = "#2878c8", "#d63a3a", "#2ca02c", "#ff7f0e"
MEAN, VARIANCE = 1.5, 0.3


def _svg(canvas: Figure) -> str:
    text = io.StringIO()
    with matplotlib.rc_context({"svg.hashsalt": "jaxmotion"}):
        canvas.savefig(text, format="svg", metadata={"Date": None, "Creator": None})
    return re.sub(r"[ \t]+\n", "\n", text.getvalue())


def _canvas(height: float = 3.0):
    canvas = Figure(figsize=(7.4, height), layout="constrained")
    axes = canvas.subplots()
    axes.grid(alpha=0.3)
    axes.spines[["top", "right"]].set_visible(False)
    return canvas, axes


def _exact(table):
    """The mean of x_0 given x_t where x_0 is a Gaussian."""

    def denoise(key, x_t, t):
        signal = table.alpha_bar[t]
        gain = jnp.sqrt(signal) * VARIANCE / (signal * VARIANCE + 1 - signal)
        return MEAN + gain * (x_t - jnp.sqrt(signal) * MEAN)

    return denoise


def draw_schedule() -> str:
    """Part of the signal that each table leaves, step by step."""
    canvas, axes = _canvas()
    tables = {
        "cosine, 8 steps (CAMDM, SMGDiff)": schedule.cosine_schedule(8),
        "cosine, 5 steps (AAMDM)": schedule.cosine_schedule(5),
        "variance preserving, 10 steps (EMDM)": schedule.vp_schedule(10),
    }
    for (name, table), color in zip(tables.items(), (BLUE, GREEN, RED), strict=True):
        steps = np.arange(table.num_steps + 1)
        axes.plot(steps, np.asarray(table.alpha_bar), "o-", color=color, label=name)
    axes.set_xlabel("step t: 0 is clean data")
    axes.set_ylabel("part of the signal's variance")
    axes.legend(fontsize=8, frameon=False)
    return _svg(canvas)


def draw_chain() -> str:
    """Samples on their way from noise to data, with the exact denoiser."""
    canvas, axes = _canvas()
    table = schedule.cosine_schedule(8)
    step = chain.ancestral_step(table, _exact(table))
    key_start, key = jax.random.split(jax.random.key(1))
    x = jax.random.normal(key_start, (60,))
    walked = [x]
    for t in range(8, 0, -1):
        x = step(jax.random.fold_in(key, t), x, jnp.array(t))
        walked.append(x)
    walked = np.asarray(jnp.stack(walked))
    axes.plot(np.arange(8, -1, -1), walked, color=BLUE, alpha=0.35, lw=1)
    axes.axhspan(MEAN - VARIANCE**0.5, MEAN + VARIANCE**0.5, color=GREEN, alpha=0.15)
    axes.axhline(MEAN, color=GREEN, lw=1)
    axes.text(2.4, 2.9, "data: mean and deviation", color=GREEN, fontsize=9)
    axes.set_xlim(8, 0)
    axes.set_xlabel("step t: from noise (8) to a sample (0)")
    axes.set_ylabel("x at t")
    return _svg(canvas)


def draw_denoiser() -> str:
    """What the best prediction of x_0 is where data are two values."""
    canvas, axes = _canvas()
    table = schedule.cosine_schedule(8)
    x = np.linspace(-2.5, 2.5, 401)
    for t, color in ((1, BLUE), (4, ORANGE), (7, RED)):
        signal = float(table.alpha_bar[t])
        values = np.tanh(np.sqrt(signal) * x / (1 - signal))
        axes.plot(x, values, color=color, label=f"t = {t}")
    axes.set_xlabel("noisy sample x at t")
    axes.set_ylabel("predicted clean sample")
    axes.legend(fontsize=8, frameon=False, title="data are -1 or 1")
    return _svg(canvas)


def draw_controller() -> str:
    """Plans of 45 frames, of which 15 are shown before the next is made."""
    canvas, axes = _canvas(2.4)
    axes.grid(visible=False)
    for i in range(4):
        start = 15 * i
        for length, color, alpha in ((45, BLUE, 0.25), (15, BLUE, 0.9)):
            axes.add_patch(
                Rectangle((start, 3 - i), length, 0.6, color=color, alpha=alpha, lw=0)
            )
        axes.add_patch(
            Rectangle((start - 10, 3 - i), 10, 0.6, color=ORANGE, alpha=0.6, lw=0)
        )
        axes.text(start + 30, 3.3 - i, f"plan {i + 1}", fontsize=8, va="center")
    axes.set_xlim(-12, 92)
    axes.set_ylim(-0.2, 4)
    axes.set_yticks([])
    axes.spines["left"].set_visible(False)
    axes.set_xlabel("frame (30 per second): past, shown, planned but replaced")
    return _svg(canvas)


FIGURES = {
    "schedule": draw_schedule,
    "chain": draw_chain,
    "denoiser": draw_denoiser,
    "controller": draw_controller,
}
