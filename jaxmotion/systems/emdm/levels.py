"""What a generator predicts at each step of its chain: errors, and what latents change.

Where a whole chain falls short is not seen in its samples: a step whose prediction is
a mean, or whose latent changes nothing, is. Each step is given training motions at its
own level of noise.
"""

import dataclasses
import functools

import jax
import jax.numpy as jnp
from jaxtyping import Array

from jaxmotion.diffusion import gan, schedule
from jaxmotion.evaluation.table import Cell, Rows
from jaxmotion.networks import blocks
from jaxmotion.systems.emdm import data as emdm_data
from jaxmotion.systems.emdm import features as emdm_features
from jaxmotion.systems.emdm import loss as emdm_loss
from jaxmotion.systems.emdm import model as emdm_model
from jaxmotion.systems.emdm.sampler import Model
from jaxmotion.typing import Key, Params

_ROWS = 10


def level_table(
    params: Params,
    run: emdm_data.ActionRun,
    model: Model,
    *,
    number: int,
    seed: int,
) -> Rows:
    """A row for each step t, over `number` training motions of actions drawn alike.

    Chains of more than ten steps have ten rows.

    Columns: error of features and deviation over latents, in deviations of features;
    deviation of poses over motions, of the data's; and how far feet move in a frame,
    mm, where the recorded ones are slower than `Geometry.contact_speed`, with theirs.

    `ValueError` if the model was made for other actions or another skeleton.
    """
    skeleton = run.representation.skeleton
    for name, found, expected in (
        ("actions", model.labels, run.actions),
        ("joints", model.representation.skeleton.names, skeleton.names),
    ):
        if found != expected:
            raise ValueError(
                f"{run.record.folder}: {name} are {', '.join(expected)}, the model's "
                f"{', '.join(found)}"
            )
    run = dataclasses.replace(run, representation=model.representation)
    key_data, key_noise = jax.random.split(jax.random.key(seed))
    task = emdm_data.make_task(run, model.config, conditional=True)
    batch = task.batch(key_data, task.data, number)
    geometry = emdm_features.geometry(model.representation, relative=False)
    measure = jax.jit(
        functools.partial(_level, params, config=model.config, geometry=geometry)
    )
    rows = {}
    steps = model.config.num_steps
    for t in schedule.spread_steps(steps, min(steps, _ROWS)):
        found = measure(jax.random.fold_in(key_noise, t), batch, jnp.full(number, t))
        rows[f"t = {t}"] = {
            name: Cell(value=float(x), samples=number) for name, x in found.items()
        }
    return rows


def _level(
    params: Params,
    key: Key,
    batch: emdm_loss.Batch,
    t: Array,
    *,
    config: emdm_model.Config,
    geometry: emdm_loss.Geometry,
) -> dict[str, Array]:
    key_pair, *keys = jax.random.split(key, 3)
    _, x_t = gan.q_pair(config.table(), key_pair, batch.x_0, t)
    net, size = emdm_model.generator(config), len(t)
    keep = jnp.ones(size, bool)

    def predict(key: Key) -> Array:
        latent = None
        if config.latent:
            latent = jax.random.normal(key, (size, config.latent))
        arguments = x_t, t, batch.vector, keep, batch.mask, latent
        return blocks.apply(params, net, *arguments)

    one, other = map(predict, keys)
    joints, real = map(geometry.positions, (one, batch.x_0))

    def deviation(joints: Array) -> Array:
        return jnp.mean(jnp.std(joints - joints[..., :1, :], axis=0))

    def steps(joints: Array) -> Array:
        feet = joints[..., jnp.asarray(geometry.feet), ::2]
        return jnp.linalg.norm(jnp.diff(feet, axis=1), axis=-1)

    still = steps(real) < geometry.contact_speed / geometry.fps
    slide = lambda x: 1000.0 * jnp.sum(steps(x) * still) / jnp.sum(still)  # noqa: E731
    return {
        "prediction_error": jnp.sqrt(jnp.mean((one - batch.x_0) ** 2)),
        "over_latents": jnp.sqrt(jnp.mean((one - other) ** 2) / 2.0),
        "spread": deviation(joints) / deviation(real),
        "skate": slide(joints),
        "skate_recorded": slide(real),
    }
