"""A folder of EMDM: the data it was made from, and what was trained on them.

data.npz, config.json     clips or text motions as they are used, and their making
<row>/                    one trained model each: EMDM, its comparators, ablations
recognizer/ or matcher/   the evaluator
"""

import dataclasses
import functools
import json
from collections.abc import Callable
from pathlib import Path
from typing import Any, Literal

import jax
import jax.numpy as jnp
from jaxtyping import Array

from jaxmotion import files
from jaxmotion.diffusion import chain
from jaxmotion.learning import adversarial, checkpoint, runs, training
from jaxmotion.learning.runs import Budget
from jaxmotion.systems.emdm import loss as emdm_loss
from jaxmotion.systems.emdm import model as emdm_model
from jaxmotion.systems.emdm import published as emdm_published
from jaxmotion.systems.emdm.model import Config
from jaxmotion.typing import Key, Params

_FLAT = dict(weight_position=0.0, weight_velocity=0.0, weight_foot=0.0)
_DDPM = dict(latent=0, schedule="cosine", weight_recon=1.0)
# Changes of the base configuration, by row.
ROWS: dict[str, dict[str, Any]] = {
    "emdm": {},
    "emdm_5": dict(num_steps=5),
    "emdm_2": dict(num_steps=2),
    "emdm_1": dict(num_steps=1),
    "naive": dict(discriminator_condition=False, weight_recon=0.0, **_FLAT),
    "ddpm_50": dict(num_steps=50, **_DDPM),
    "ddpm_1000": dict(num_steps=1000, **_DDPM),
    "recon_0": dict(weight_recon=0.0, **_FLAT),
    "recon_1": dict(weight_recon=1.0, **_FLAT),
    "recon_10": dict(weight_recon=10.0, **_FLAT),
    "recon_100": dict(weight_recon=100.0, **_FLAT),
    "no_r1": dict(weight_r1=0.0),
}
# Ways to sample that need no training of their own: row, steps to visit.
SAMPLERS: dict[str, tuple[str, int]] = {"ddim_10": ("ddpm_1000", 10)}


def check_rows(names: tuple[str, ...]) -> None:
    """Raises unless all are rows or samplers.

    Args:
      names: Names.

    Raises:
      ValueError: names the first unknown one and those there are.
    """
    known = (*ROWS, *SAMPLERS)
    for name in names:
        if name not in known:
            raise ValueError(
                f"unknown row {name!r}: expected one of {', '.join(known)}"
            )


def row_config(base: Config, row: str) -> Config:
    """Configuration of a row.

    Args:
      base: Of the row "emdm".
      row: Its name, or a sampler's.

    Returns:
      The configuration.

    Raises:
      ValueError: if there is no such row.
    """
    check_rows((row,))
    trained = SAMPLERS[row][0] if row in SAMPLERS else row
    return dataclasses.replace(base, **ROWS[trained])


def ddim_steps(num_steps: int, count: int) -> tuple[int, ...]:
    """Steps that "ddimN" of guided-diffusion visits: 1, 1 + T/N, ..., never T itself.

    Args:
      num_steps: T.
      count: N, which divides T.

    Returns:
      The steps, increasing.

    Raises:
      ValueError: if N does not divide T.

    Source: released code of MDM (there counted from 0).
    """
    if count < 1 or num_steps % count:
        raise ValueError(f"{count} steps do not divide the {num_steps} of the model")
    return tuple(range(1, num_steps + 1, num_steps // count))


TaskName = Literal["action", "text", "none"]


@dataclasses.dataclass(frozen=True, kw_only=True)
class Task:
    """What models are trained on, the same for all rows.

    Attributes:
      base: Configuration of the row "emdm".
      data: Arrays on the device.
      batch: `(key, data, size) -> Batch`.
      geometry: For the losses of joints; None if there are none.
      describe: JSON that says what the data are; stored with each checkpoint.
      source: File of the data.
    """

    base: Config
    data: Any
    batch: Callable[[Key, Any, int], emdm_loss.Batch]
    geometry: emdm_loss.Geometry | None
    describe: dict[str, Any]
    source: Path


def _config_json(config: Config) -> dict[str, Any]:
    return {"config": dataclasses.asdict(config)}


def gan_update(
    optimizers: tuple[training.Optimizer, training.Optimizer],
    *,
    config: Config,
    geometry: emdm_loss.Geometry | None,
    ema: float,
) -> training.Update:
    """One update of the discriminator, then of the generator; R1 every k-th time.

    Args:
      optimizers: The generator's and the discriminator's.
      config: The method.
      geometry: As of `emdm_loss.generator_loss`.
      ema: Decay of the generator's average.

    Returns:
      `update(state, key, batch) -> (state, info)` of a `GanState`.
    """

    def update(state: Any, key: Key, batch: emdm_loss.Batch) -> tuple[Any, dict]:
        penalized = state.step % config.r1_every == 0
        judge = functools.partial(
            emdm_loss.discriminator_loss, config=config, penalized=penalized
        )
        make = functools.partial(
            emdm_loss.generator_loss, config=config, geometry=geometry
        )
        both = adversarial.make_gan_update(judge, make, optimizers, ema_decay=ema)
        return both(state, key, batch)

    return update


def train_row(
    folder: Path,
    task: Task,
    row: str,
    *,
    generator: Budget,
    discriminator: Budget,
) -> None:
    """Trains a row, from its newest checkpoint if there is one.

    Args:
      folder: The run folder.
      task: Data and configuration.
      row: Its name.
      generator: How long, and the generator's optimizer.
      discriminator: The discriminator's optimizer; its steps are the generator's.

    Raises:
      ValueError: if the row has a checkpoint of other sizes or data.
      TrainingDiverged: if a loss is not finite.
    """
    config = row_config(task.base, row)
    flat = not (config.weight_position or config.weight_velocity or config.weight_foot)
    geometry = None if flat else task.geometry
    params = emdm_model.init(jax.random.key(generator.seed), config)
    optimizer = runs.make_optimizer(generator)
    if config.latent:
        judge = runs.make_optimizer(discriminator)
        state = adversarial.GanState(
            generator=training.init_train_state(params["generator"], optimizer),
            discriminator=training.init_train_state(params["discriminator"], judge),
        )
        update = gan_update(
            (optimizer, judge), config=config, geometry=geometry, ema=generator.ema
        )
        show = ("loss", "discriminator/loss")
    else:
        state = training.init_train_state(params["generator"], optimizer)
        loss = functools.partial(
            emdm_loss.diffusion_loss, config=config, geometry=geometry
        )
        update = training.make_update(loss, optimizer, ema_decay=generator.ema)
        show = ("loss",)
    runs.fit(
        folder / row,
        state,
        update,
        lambda key, data: task.batch(key, data, generator.batch),
        task.data,
        system="emdm",
        stage=row,
        budget=generator,
        config=_config_json(config) | task.describe,
        source=task.source,
        settings={"discriminator_rate": discriminator.learning_rate}
        if config.latent
        else None,
        show=show,
    )


def import_row(
    folder: Path, task: Task, weights: Path, *, heads: int, num_steps: int
) -> Config:
    """Puts the authors' weights into a run folder, as its row "emdm".

    Args:
      folder: The run folder.
      task: Its data; only what it is conditioned on and how it looks counts.
      weights: As of `emdm_published.load`; so are heads and steps.

    Returns:
      The configuration.

    Raises:
      FileNotFoundError: if there is no such file.
      ValueError: if the row exists, or the file is damaged or does not fit the run;
        names what differs.
    """
    row, base = "emdm", task.base
    place = folder / row / "checkpoints"
    if checkpoint.latest_step(place) is not None:
        raise ValueError(f"{folder}: row {row!r} exists; use another folder")
    config, params = emdm_published.load(
        weights, frames=base.frames, num_steps=num_steps, heads=heads
    )
    for field in ("condition", "condition_size", "features"):
        expected, found = getattr(base, field), getattr(config, field)
        if expected != found:
            raise ValueError(
                f"{weights} does not fit {folder}: field {field!r} is {found!r}, the "
                f"run's {expected!r}"
            )
    checkpoint.save(
        place,
        0,
        {"generator": {"ema_params": params["generator"]}},
        {"system": "emdm", "stage": row, "weights": weights.name}
        | _config_json(config)
        | task.describe,
    )
    return config


def load_row(folder: Path, row: str) -> tuple[Params, Config]:
    """Averaged parameters of a row's generator, and its configuration.

    Args:
      folder: The run folder.
      row: Its name, or a sampler's.

    Returns:
      Both.

    Raises:
      CheckpointError: if the row was not trained here.
      ValueError: if its configuration has other fields than this version's.
    """
    check_rows((row,))
    trained = SAMPLERS[row][0] if row in SAMPLERS else row
    value = runs.check_stage(folder / trained, trained, system="emdm")
    try:
        config = runs.config_from_json(Config, value.get("config"))
    except ValueError as error:
        raise ValueError(f"{folder / trained}: field 'config': {error}") from error
    params = runs.load_params(
        folder / trained,
        trained,
        lambda: emdm_model.init(jax.random.key(0), config)["generator"],
        system="emdm",
        adversarial=bool(config.latent),
    )
    return params, config


def row_sampler(params: Params, config: Config, row: str) -> emdm_model.Sample:
    """The way a row samples.

    Args:
      params: Its generator's.
      config: Its configuration.
      row: Its name, or a sampler's.

    Returns:
      `sample(key, condition, *, scale=None)`.
    """
    if row not in SAMPLERS:
        return emdm_model.sampler(params, config=config)
    steps = ddim_steps(config.num_steps, SAMPLERS[row][1])
    return emdm_model.sampler(params, config=config, step=chain.ddim_step, steps=steps)


def guidance_scale(scale: float | None, *, default: float) -> Array | None:
    """Scale of classifier-free guidance as samplers take it.

    Args:
      scale: What was asked for; None for the default.
      default: The paper's of the task.

    Returns:
      The scale; None for 1, which needs no second call of the network.
    """
    scale = default if scale is None else scale
    return None if scale == 1.0 else jnp.float32(scale)


def sample_many(
    sample: emdm_model.Sample, *, chunk: int
) -> Callable[[Key, emdm_model.Condition, Array | None], Array]:
    """Samples of many conditions, in chunks that fit the cache, as one program.

    Args:
      sample: Of one condition.
      chunk: Conditions at a time.

    Returns:
      `run(key, conditions, scale) -> [conditions, frames, features]`, jitted; the
      motion of condition i depends on the key and i, not on the number of conditions.
      With scale None there is no guidance.
    """

    def run(key: Key, conditions: emdm_model.Condition, scale: Array | None) -> Array:
        number = conditions.keep.shape[0]
        keys = jax.vmap(jax.random.fold_in, (None, 0))(key, jnp.arange(number))
        one = lambda given: sample(given[0], given[1], scale=scale)  # noqa: E731
        return jax.lax.map(one, (keys, conditions), batch_size=min(chunk, number))

    return jax.jit(run)


def write_config(folder: Path, value: dict[str, Any]) -> None:
    """Writes how a run folder's data were made.

    Args:
      folder: The run folder.
      value: A JSON object.
    """
    whole = {"system": "emdm"} | value
    files.write_text(folder / "config.json", json.dumps(whole, indent=1))


def read_config(folder: Path) -> dict[str, Any]:
    """Reads what `write_config` wrote.

    Args:
      folder: The run folder.

    Returns:
      The JSON object.

    Raises:
      OSError: if it cannot be read.
      ValueError: if it is no run folder of EMDM; names the file and the field.
    """
    path = folder / "config.json"
    what = "expected a run folder of `experiments/emdm.py train`"
    found = (value := files.read_object(path, what=what)).get("system")
    if found != "emdm":
        raise ValueError(f"{path}: field 'system' is {found!r}, expected 'emdm'")
    if value.get("task") == "text":
        # Folders from before there was a choice.
        value.setdefault("text_form", "unit")
    return value
