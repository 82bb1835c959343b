"""How EMDM is trained: a stage a row, which is EMDM, a comparator or an ablation."""

import dataclasses
import functools
from collections.abc import Callable
from pathlib import Path
from typing import Any, Literal

import jax
import jax.numpy as jnp
from jaxtyping import Array

from jaxmotion.diffusion import chain
from jaxmotion.learning import adversarial, runs, training
from jaxmotion.learning.runs import Budget
from jaxmotion.systems.emdm import loss as emdm_loss
from jaxmotion.systems.emdm import model as emdm_model
from jaxmotion.systems.emdm import published as emdm_published
from jaxmotion.systems.emdm.model import Config
from jaxmotion.typing import Key, Params

SYSTEM = "emdm"
_GEOMETRY = ("velocity", "position", "position_velocity", "acceleration", "foot")
_FLAT = {f"weight_{name}": 0.0 for name in _GEOMETRY}
# Few steps whose discriminator learns (ours).
_FEW = dict(
    discriminator_network="temporal",
    discriminator_loss="relativistic",
    discriminator_from=2,
    weight_r1=500.0,
    r1_every=4,
    weigh_levels="posterior",
    fade_geometry=True,
)
# Shares left at last steps of little noise (ours): the published schedule, made for a
# discriminator, goes from .32 deviations to none.
_FINE = (0.999, 0.99, 0.95, 0.86, 0.71, 0.5, 0.3, 0.14)
# Shares left at the published schedule's five noisiest steps.
_NOISY = (0.02607685, 0.007086248, 0.001578794, 0.0002883917, 4.319044e-05)
_DDPM = dict(latent=0, schedule="cosine", weight_recon=1.0)
# Changes of the base configuration, by row.
ROWS: dict[str, dict[str, Any]] = {
    "emdm": {},
    "emdm_5": dict(num_steps=5),
    "emdm_3": dict(num_steps=3),
    "emdm_2": dict(num_steps=2),
    "emdm_1": dict(num_steps=1),
    "naive": dict(discriminator_condition=False, weight_recon=0.0, **_FLAT),
    "ddpm_50": dict(num_steps=50, **_DDPM),
    "ddpm_1000": dict(num_steps=1000, **_DDPM),
    "recon_0": dict(weight_recon=0.0, **_FLAT),
    "recon_1": dict(weight_recon=1.0, **_FLAT),
    "recon_10": dict(weight_recon=10.0, **_FLAT),
    "recon_100": dict(weight_recon=100.0, **_FLAT),
    "recon_1000": dict(weight_recon=1000.0, **_FLAT),
    "no_condition": dict(discriminator_condition=False),
    "few_1": dict(num_steps=1) | _FEW | dict(discriminator_from=1),
    "few_2": dict(num_steps=2, alpha_bar=(0.7, 4e-5), **_FEW),
    "few_3": dict(num_steps=3, alpha_bar=(0.9, 0.5, 4e-5), **_FEW),
    "few_5": dict(num_steps=5, alpha_bar=(0.95, 0.8, 0.6, 0.3, 4e-5), **_FEW),
    "few_10": dict(
        num_steps=10,
        alpha_bar=(0.99, 0.95, 0.89, 0.81, 0.71, 0.59, 0.45, 0.31, 0.16, 4e-5),
        **_FEW,
    ),
    "no_r1": dict(weight_r1=0.0),
    "no_gan": dict(weight_adversarial=0.0),
    "no_gan_fine": dict(weight_adversarial=0.0, alpha_bar=(*_FINE, 0.04, 4e-5)),
    # The same last steps, and the six noisiest published ones.
    "no_gan_14": dict(
        weight_adversarial=0.0, num_steps=14, alpha_bar=(*_FINE, 0.07867597, *_NOISY)
    ),
    # Ten of these: five last ones, and the five noisiest.
    "no_gan_10": dict(
        weight_adversarial=0.0, alpha_bar=(*_FINE[:2], *_FINE[3::2], *_NOISY)
    ),
    "no_gan_5": dict(weight_adversarial=0.0, num_steps=5),
    "no_gan_3": dict(weight_adversarial=0.0, num_steps=3),
    "no_gan_2": dict(weight_adversarial=0.0, num_steps=2),
    "no_gan_1": dict(weight_adversarial=0.0, num_steps=1),
}
# Ways to sample that need no training of their own: row, steps to visit.
SAMPLERS: dict[str, tuple[str, int]] = {"ddim_10": ("ddpm_1000", 10)}


def check_rows(names: tuple[str, ...]) -> None:
    """Raises a `ValueError`, with those there are, unless all are rows or samplers."""
    known = (*ROWS, *SAMPLERS)
    for name in names:
        if name not in known:
            raise ValueError(
                f"unknown row {name!r}: expected one of {', '.join(known)}"
            )


def row_config(base: Config, row: str) -> Config:
    """Configuration of a row (or a sampler's), from that of the row "emdm"."""
    check_rows((row,))
    trained = SAMPLERS[row][0] if row in SAMPLERS else row
    return dataclasses.replace(base, **ROWS[trained])


def ddim_steps(num_steps: int, count: int) -> tuple[int, ...]:
    """Steps that "ddimN" of guided-diffusion visits: 1, 1 + T/N, ..., never T itself.

    Source: released code of MDM (there counted from 0).
    """
    if count < 1 or num_steps % count:
        raise ValueError(f"{count} steps do not divide the {num_steps} of the model")
    return tuple(range(1, num_steps + 1, num_steps // count))


TaskName = Literal["action", "text", "none"]


def check_task(run: runs.Run, expected: tuple[TaskName, ...]) -> None:
    """Raises unless a run is of one of these tasks, and has what its data need."""
    settings, own = run.settings, ("field",)
    if "text" in expected:
        own = ("encoder", "text_form")
    wrong = {}
    if settings.get("task") not in expected:
        wrong["task"] = " or ".join(map(repr, expected))
    wrong |= {x: "a text" for x in own if type(settings.get(x)) is not str}
    frames = settings.get("frames")
    if type(frames) is not int or not 2 <= frames <= 10**5:
        wrong["frames"] = "a whole number from 2 to 100000"
    for name, what in wrong.items():
        raise ValueError(
            f"{run.config}: field 'settings.{name}' is {settings.get(name)!r:.80}, "
            f"expected {what}"
        )


@dataclasses.dataclass(frozen=True, kw_only=True)
class Task:
    """What models are trained on, the same for all rows.

    Attributes:
      base: Configuration of the row "emdm".
      batch: `(key, data, size) -> Batch`.
      geometry: For the losses of joints; None if there are none.
    """

    run: runs.Run
    base: Config
    data: Any
    batch: Callable[[Key, Any, int], emdm_loss.Batch]
    geometry: emdm_loss.Geometry | None


def gan_update(
    optimizers: tuple[training.Optimizer, training.Optimizer],
    *,
    config: Config,
    geometry: emdm_loss.Geometry | None,
    ema: float,
    alone: int = 0,
) -> training.Update:
    """One update of the discriminator, then of the generator; R1 every k-th time.

    `update(state, key, batch) -> (state, info)` is of a `GanState`. Optimizers are the
    generator's and the discriminator's; `ema` decays the generator's average; the first
    `alone` updates are the generator's without a discriminator (ours).
    """

    def update(state: Any, key: Key, batch: emdm_loss.Batch) -> tuple[Any, dict]:
        penalized = state.step % config.r1_every == 0
        discriminate = functools.partial(
            emdm_loss.discriminator_loss, config=config, penalized=penalized
        )
        make = functools.partial(
            emdm_loss.generator_loss, config=config, geometry=geometry
        )
        both = adversarial.make_gan_update(
            discriminate, make, optimizers, ema_decay=ema
        )
        return both(state, key, batch)

    def regress(state: Any, key: Key, batch: emdm_loss.Batch) -> tuple[Any, dict]:
        loss = functools.partial(
            emdm_loss.diffusion_loss, config=config, geometry=geometry
        )
        one = training.make_update(loss, optimizers[0], ema_decay=ema)
        generator, info = one(state.generator, key, batch)
        shapes = jax.eval_shape(update, state, key, batch)[1]
        unused = {name: jnp.zeros(x.shape, x.dtype) for name, x in shapes.items()}
        found = {f"generator/{name}": value for name, value in info.items()}
        state = dataclasses.replace(state, generator=generator)
        return state, {**unused, **found, "loss": info["loss"]}

    def either(state: Any, key: Key, batch: emdm_loss.Batch) -> tuple[Any, dict]:
        return jax.lax.cond(state.step < alone, regress, update, state, key, batch)

    return either if alone else update


def _stage(row: str) -> str:
    """Name of a row's stage; a sampler's is that of the row it samples."""
    check_rows((row,))
    return SAMPLERS[row][0] if row in SAMPLERS else row


def train_row(
    task: Task,
    row: str,
    *,
    generator: Budget,
    discriminator: Budget,
    alone: float = 0.0,
    start: Params | None = None,
) -> None:
    """Trains a row, from its newest checkpoint if there is one.

    Of the discriminator's budget only the optimizer counts: its steps are the
    generator's, but for the part of them, `alone`, that the generator learns without
    it. The generator starts from `start`, if given.

    `ValueError` if its checkpoint has other sizes or data; `TrainingDiverged` if a loss
    is not finite.
    """
    config = row_config(task.base, row)
    is_flat = not any(getattr(config, name) for name in _FLAT)
    geometry = None if is_flat else task.geometry
    params = emdm_model.init(jax.random.key(generator.seed), config)
    if start is None:
        start = runs.initial(params["generator"], generator)
    params |= {"generator": start}
    common: dict[str, Any] = dict(budget=generator, model=dataclasses.asdict(config))
    stage = _stage(row)

    def sample(key: Key, data: Any) -> emdm_loss.Batch:
        return task.batch(key, data, generator.batch)

    if not config.adversarial:
        loss = functools.partial(
            emdm_loss.diffusion_loss, config=config, geometry=geometry
        )
        runs.minimize(
            params["generator"], task.run, stage, loss, sample, task.data, **common
        )
        return
    first = round(alone * generator.steps)
    # The discriminator's rate falls over the updates that it makes.
    with_it = dataclasses.replace(discriminator, steps=generator.steps - first)
    optimizers = runs.make_optimizer(generator), runs.make_optimizer(with_it)
    names = ("generator", "discriminator")
    players = {
        name: training.init_train_state(params[name], optimizer)
        for name, optimizer in zip(names, optimizers, strict=True)
    }
    runs.fit(
        task.run,
        stage,
        adversarial.GanState(**players),
        gan_update(
            optimizers,
            config=config,
            geometry=geometry,
            ema=generator.ema,
            alone=first,
        ),
        sample,
        task.data,
        settings={
            "discriminator_rate": discriminator.learning_rate,
            "discriminator_constant": discriminator.constant,
            **({"alone": first} if first else {}),
        },
        show=("loss", "discriminator/loss"),
        **common,
    )


def import_row(task: Task, weights: Path, *, heads: int, num_steps: int) -> Config:
    """Puts the authors' weights into a run folder, as its row "emdm".

    Of the task's data only what it is conditioned on and how it looks counts; for the
    other arguments see `emdm_published.load`.

    A `ValueError` names what differs if the row exists, or the file does not fit.
    """
    base = task.base
    config, params = emdm_published.load(
        weights, frames=base.frames, num_steps=num_steps, heads=heads
    )
    for field in ("condition", "condition_size", "features"):
        expected, found = getattr(base, field), getattr(config, field)
        if expected != found:
            raise ValueError(
                f"{weights} does not fit {task.run.folder}: field {field!r} is "
                f"{found!r}, the run's {expected!r}"
            )
    state = {"generator": {"ema_params": params["generator"]}}
    runs.store(task.run, "emdm", state, model=dataclasses.asdict(config))
    return config


def load_row(run: runs.Run, row: str) -> tuple[Params, Config]:
    """Averaged parameters of a row's (or sampler's) generator, and its configuration.

    `CheckpointError` if the row was not trained here.
    """
    stage = _stage(row)
    config = runs.stage_config(run, stage, Config)
    params = runs.load_params(
        run,
        stage,
        lambda: emdm_model.init(jax.random.key(0), config)["generator"],
        adversarial=config.adversarial,
    )
    return params, config


def row_sampler(params: Params, config: Config, row: str) -> emdm_model.Sample:
    """The way a row samples, `sample(key, condition, *, scale=None)`."""
    if row not in SAMPLERS:
        return emdm_model.sampler(params, config=config)
    steps = ddim_steps(config.num_steps, SAMPLERS[row][1])
    return emdm_model.sampler(params, config=config, step=chain.ddim_step, steps=steps)


# The paper's scales of guidance, by what motions are made from.
GUIDANCE = {"action": 1.0, "text": 2.5, "none": 1.0}


def guidance_scale(scale: float | None, *, task: TaskName) -> Array | None:
    """Scale of classifier-free guidance as samplers take it, by default the paper's.

    None for 1, which needs no second call of the network.
    """
    scale = GUIDANCE[task] if scale is None else scale
    return None if scale == 1.0 else jnp.float32(scale)


def sample_many(
    sample: emdm_model.Sample, *, chunk: int
) -> Callable[[Key, emdm_model.Condition, Array | None], Array]:
    """Samples of many conditions, in chunks that fit the cache, as one program.

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
