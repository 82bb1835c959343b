"""EMDM's motions of actions as a model to be sampled: from a run folder or one file."""

import dataclasses
from collections.abc import Callable
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from jaxmotion.control.sampling import Sampler
from jaxmotion.diffusion import chain
from jaxmotion.learning import checkpoint, model_json
from jaxmotion.motion.skeleton import Motion
from jaxmotion.systems.emdm import data as emdm_data
from jaxmotion.systems.emdm import features as emdm_features
from jaxmotion.systems.emdm import model as emdm_model
from jaxmotion.systems.emdm import training as emdm_training
from jaxmotion.systems.emdm.features import Representation
from jaxmotion.typing import Key, Params


@dataclasses.dataclass(frozen=True, kw_only=True)
class Model:
    """Everything but the generator's parameters."""

    config: emdm_model.Config
    representation: Representation
    labels: tuple[str, ...]
    source: str


def to_json(model: Model) -> dict[str, Any]:
    """JSON of a model."""
    features = model.representation
    return {
        "system": emdm_training.SYSTEM,
        "config": dataclasses.asdict(model.config),
        "representation": {
            "skeleton": model_json.skeleton_to_json(features.skeleton),
            **model_json.normalizer_to_json(features.normalizer),
            "fps": features.fps,
        },
        "labels": list(model.labels),
        "source": model.source,
    }


def _representation(value: Any) -> Representation:
    if not isinstance(value, dict):
        raise ValueError(f"a JSON {type(value).__name__}, expected an object")
    skeleton = model_json.skeleton_from_json(value["skeleton"])
    size = 6 * (skeleton.num_joints + 1)
    model_json.numbers_from_json("fps", [value["fps"]], least=1e-3)
    return Representation(
        skeleton=skeleton,
        normalizer=model_json.normalizer_from_json(value, size=size),
        fps=float(value["fps"]),
    )


def from_json(value: dict[str, Any], *, where: str) -> Model:
    """Inverse of `to_json`; a `ValueError` names the file (`where`) and the field."""
    model_json.check_system(value, emdm_training.SYSTEM, where=where)
    parts = {
        "config": lambda x: model_json.config_from_json(emdm_model.Config, x),
        "representation": _representation,
        "labels": model_json.names_from_json,
        "source": lambda x: model_json.names_from_json([x])[0],
    }
    model = Model(**model_json.decode(value, where, parts))
    _check(model, where)
    return model


def _check(model: Model, where: str) -> None:
    """Raises unless a model's parts fit together, and it makes motions of actions."""
    config = model.config
    for name, found, expected in (
        ("condition", config.condition, "action"),
        ("condition_size", config.condition_size, len(model.labels)),
        ("features", config.features, model.representation.num_features),
    ):
        if found != expected:
            raise ValueError(
                f"{where}: field 'config.{name}' is {found!r}, expected {expected!r}"
            )


# What is loaded of a run folder.
ROW = "emdm"


def load(path: Path, *, row: str = ROW) -> tuple[Model, Params]:
    """Model and averaged parameters of a run folder or an exported file.

    The row says which model of a folder that `experiments/emdm.py train` made; a file
    holds one.

    `CheckpointError` if the row was not trained or the file is damaged, `ValueError`
    for another system, one that makes no motions of actions, a row of a file, or one
    that is another way to sample a row's weights.
    """
    if row in emdm_training.SAMPLERS:
        whose = emdm_training.SAMPLERS[row][0]
        raise ValueError(
            f"row is {row!r}, which samples {whose!r} otherwise: expected {whose!r}"
        )
    if path.is_file():
        if row != ROW:
            raise ValueError(f"{path}: holds one model, expected no row {row!r}")
        params, value = checkpoint.import_params(path)
        model = from_json(value, where=str(path))
        like = jax.eval_shape(lambda: emdm_model.init(jax.random.key(0), model.config))
        checkpoint.check_params(path, params, like["generator"])
        return model, params
    run = emdm_data.load_run(path)
    params, config = emdm_training.load_row(run.record, row)
    model = Model(
        config=config,
        representation=run.representation,
        labels=run.actions,
        source=run.clips.source,
    )
    _check(model, str(run.record.config))
    return model, params


# What of a configuration its parameters do not depend on.
_FREE = (
    "num_steps",
    "schedule",
    "alpha_bar",
    "dropout",
    "drop_condition",
    "geometry",
    "mask_frames",
    "fade_geometry",
    "weigh_levels",
    "r1_every",
)


def start_of(path: Path, model: Model, *, row: str = ROW) -> Params:
    """Averaged parameters of a folder's row or an exported file, to train on from.

    A `ValueError` names sizes, skeleton, labels or units of features that differ.
    """
    first, params = load(path, row=ROW if path.is_file() else row)
    found, wanted = (to_json(dataclasses.replace(x, source="")) for x in (first, model))
    model_json.check_start(path, found, wanted, free=("discriminator_", *_FREE))
    return params


@dataclasses.dataclass(frozen=True, kw_only=True)
class Method:
    """What makes motions of `(generator's parameters, representation)`; hashable."""

    config: emdm_model.Config
    scale: float | None = None
    step: chain.StepFactory = chain.ancestral_step

    def __call__(
        self, params: tuple[Params, Representation]
    ) -> Callable[[Key, Array], Motion]:
        """`(key, label) -> motion`."""
        generator, representation = params
        sample = emdm_model.sampler(generator, config=self.config, step=self.step)

        def make(key: Key, label: Array) -> Motion:
            condition = emdm_model.Condition(
                vector=jax.nn.one_hot(label, self.config.condition_size),
                keep=jnp.ones((), bool),
                mask=jnp.ones(self.config.frames, bool),
            )
            x = sample(key, condition, scale=self.scale)
            return emdm_features.to_motion(x, representation)

        return make


def load_sampler(
    path: Path,
    *,
    step: chain.StepFactory = chain.ancestral_step,
    scale: float | None = None,
    row: str = ROW,
) -> Sampler:
    """The sampler of a run folder or an exported file; see `load`.

    `step` makes the chain's step, and `scale` is that of classifier-free guidance; None
    for none, as the paper has it for actions. A `ValueError` if it is no finite number.
    """
    if scale is not None:
        if isinstance(scale, str) or not np.isfinite(scale):
            raise ValueError(f"scale is {scale!r}, expected a finite number")
        scale = float(scale)
    model, params = load(path, row=row)
    return Sampler(
        skeleton=model.representation.skeleton,
        labels=model.labels,
        fps=model.representation.fps,
        frames=model.config.frames,
        source=model.source,
        params=(params, model.representation),
        method=Method(config=model.config, scale=scale, step=step),
    )
