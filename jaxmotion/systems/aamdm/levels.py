"""What AAMDM's networks predict at each step, beside what they are given.

A generator that draws each frame anew, or repeats the frame before, may score alike in
samples that are polished. How far its mean is from the frame that follows tells them
apart, and so does what its latent changes.
"""

import functools

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxmotion.diffusion import schedule
from jaxmotion.evaluation.table import Cell, Rows
from jaxmotion.systems.aamdm import model as aamdm_model
from jaxmotion.systems.aamdm.model import Config
from jaxmotion.typing import Key, Params

Frames = Float[Array, "pairs features"]


def level_table(
    params: Params,
    key: Key,
    previous: Frames,
    frame: Frames,
    *,
    config: Config,
    change: Float[Array, " features"] | None = None,
    latents: int = 16,
) -> Rows:
    """A row for each step t, as the chain takes them, and two to compare with.

    Each step is given the frame, noised to it, and the frame before; the generator has
    so many latents, of which the mean is taken. Both columns, its error and the
    deviation over latents, are root mean squares in units of the change from frame to
    frame: each channel is divided by the deviation of its changes (those that never
    change are left out), and the frame before then has error 1. `change` is as in
    `aamdm.model.to_frame`.
    """
    table, unit = config.table(), jnp.std(frame - previous, axis=0)
    rate = jnp.where(unit > 1e-6, 1.0 / unit, 0.0)

    def size(x: Array) -> Array:
        return jnp.sqrt(jnp.mean((x * rate.reshape((1,) * (x.ndim - 1) + (-1,))) ** 2))

    one = size(frame - previous)

    @functools.partial(jax.jit, static_argnames="draft")
    def measure(params: Params, key: Key, t: Array, *, draft: bool):
        make = aamdm_model.draft if draft else aamdm_model.polish
        denoise = make(params, previous, config=config, change=change)
        key_noise, key_latents = jax.random.split(key)
        steps = jnp.full(len(frame), t)
        noise = jax.random.normal(key_noise, frame.shape)
        x_t = schedule.q_sample(table, frame, steps, noise)
        keys = jax.random.split(key_latents, latents if draft else 1)
        found = jax.vmap(lambda key: denoise(key, x_t, steps))(keys)
        mean = jnp.mean(found, axis=0)
        return size(mean - frame) / one, size(found - mean[None]) / one

    rows: Rows = {}
    for t in range(config.num_steps, 0, -1):
        draft = t > config.polishes
        network = "generator" if draft else "polisher"
        if network not in params:  # the frame before is held in its place
            continue
        error, spread = measure(
            params[network], jax.random.fold_in(key, t), jnp.array(t), draft=draft
        )
        rows[f"{network}, t = {t}"] = _cells(error, spread, len(frame))
    mean = jnp.mean(frame, axis=0, keepdims=True)
    for name, guess in (("frame before", previous), ("mean of all frames", mean)):
        rows[f"the {name}"] = _cells(size(guess - frame) / one, 0.0, len(frame))
    return rows


def _cells(error: Array, spread: Array | float, number: int) -> dict[str, Cell]:
    found = {"frame_error": error, "frame_over_latents": spread}
    return {name: Cell(value=float(x), samples=number) for name, x in found.items()}
