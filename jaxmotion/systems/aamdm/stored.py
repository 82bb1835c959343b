"""AAMDM's character as one file: all that its run-time needs, and poses of its own.

The encoder, with which one starts in other poses or trains on, may be left out: a
character starts in frames of the space.
"""

import dataclasses
import functools
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from jaxmotion.learning import checkpoint, model_json
from jaxmotion.motion import pose
from jaxmotion.motion.skeleton import Skeleton
from jaxmotion.systems.aamdm import embedding as aamdm_embedding
from jaxmotion.systems.aamdm import model as aamdm_model
from jaxmotion.systems.aamdm.model import SYSTEM
from jaxmotion.systems.aamdm.space import Autoencoder, Space
from jaxmotion.typing import Params

# Networks that take part in a tick.
_NETWORKS = ("generator", "polisher")
_AUTOENCODER = ("encoder", "decoder")


@dataclasses.dataclass(frozen=True, kw_only=True)
class Model:
    """Everything but the parameters of the chain's networks.

    Attributes:
      noise_half_life: Seconds in which the noise of the posteriors is forgotten; 0
        where it is drawn anew in every frame.
      starts: Frames of the space that characters start in; None in a run folder.
      toe_height: Where toes rest in its data, meters; None where nobody measured it.
    """

    config: aamdm_model.Config
    skeleton: Skeleton
    space: Space
    source: str
    noise_half_life: float = 0.0
    starts: Float[Array, "number channels"] | None = None
    toe_height: float | None = None

    @property
    def autoencoder(self) -> Autoencoder:
        """The space's; raises `ValueError` for one of full poses."""
        if self.space.autoencoder is None:
            raise ValueError("the space has no autoencoder: expected an embedded one")
        return self.space.autoencoder


_BOUNDS = ("change", "low", "high")


def export(path: Path, model: Model, networks: Params, *, encoder: bool = True) -> None:
    """Writes a model with starts as one file, with or without its encoder."""
    own, space = model.autoencoder, model.space
    statistics = {
        field.name: model_json.normalizer_to_json(getattr(own.statistics, field.name))
        for field in dataclasses.fields(own.statistics)
    }
    value = {
        "system": SYSTEM,
        "config": dataclasses.asdict(model.config),
        "embedding": dataclasses.asdict(own.config),
        "skeleton": model_json.skeleton_to_json(model.skeleton),
        "statistics": statistics,
        "space": model_json.normalizer_to_json(space.normalizer)
        | {
            name: np.asarray(getattr(space, name), np.float64).tolist()
            for name in _BOUNDS
        },
        "source": model.source,
        # JSON has no infinity: this many seconds are as good.
        "noise_half_life": min(model.noise_half_life, 1e6),
        "starts": model_json.arrays_to_json({"frames": model.starts}),
        "toe_height": model.toe_height,
    }
    params = {name: networks[name] for name in _NETWORKS}
    kept = _AUTOENCODER if encoder else _AUTOENCODER[1:]
    params |= {name: own.params[name] for name in kept if name in own.params}
    checkpoint.export_params(path, params, value)


def load(path: Path) -> tuple[Model, Params]:
    """Reads what `export` wrote: the model, and the chain's networks.

    `CheckpointError` if the file is damaged or none; a `ValueError` names the field
    that is wrong, or another system.
    """
    params, value = checkpoint.import_params(path)
    where = str(path)
    model_json.check_system(value, SYSTEM, where=where)
    parts = {
        "config": lambda x: model_json.config_from_json(aamdm_model.Config, x),
        "embedding": lambda x: model_json.config_from_json(aamdm_embedding.Config, x),
        "skeleton": model_json.skeleton_from_json,
        "source": lambda x: model_json.names_from_json([x])[0],
        "noise_half_life": lambda x: float(
            model_json.numbers_from_json("noise_half_life", [x], least=0.0)[0]
        ),
    }
    made = model_json.decode(value, where, parts)
    config, embedding = made["config"], made.pop("embedding")
    for name, found, expected in (
        ("skeleton", made["skeleton"].num_joints, embedding.num_joints),
        ("config.features", config.features, embedding.num_embedded),
    ):
        if found != expected:
            raise ValueError(
                f"{where}: field {name!r} has {found}, expected {expected}"
            )
    like = jax.eval_shape(lambda: _init(config, embedding))
    if "encoder" not in params:
        del like["encoder"]
    checkpoint.check_params(path, params, like)
    own = Autoencoder(
        params={name: params.pop(name) for name in _AUTOENCODER if name in params},
        statistics=_statistics(value, where, embedding),
        config=embedding,
    )
    size = config.features
    more = model_json.decode(
        value,
        where,
        {
            "space": lambda x: _space(x, own, size),
            "starts": lambda x: model_json.arrays_from_json(
                x, lead=(), shapes={"frames": (size,)}
            ),
        },
    )
    model = Model(
        **made,
        space=more["space"],
        starts=more["starts"]["frames"],
        toe_height=model_json.toe_height_from_json(
            value.get("toe_height"), where=where
        ),
    )
    return model, params


def _init(config: aamdm_model.Config, embedding: aamdm_embedding.Config) -> Params:
    """Parameters of a file's shapes."""
    found = aamdm_model.init(jax.random.key(0), config)
    autoencoder = aamdm_embedding.init(jax.random.key(1), embedding)
    return {name: found[name] for name in _NETWORKS} | autoencoder


def _statistics(
    value: dict[str, Any], where: str, embedding: aamdm_embedding.Config
) -> aamdm_embedding.Statistics:
    whole = pose.pose_layout(embedding.num_joints).size
    parts = {
        field.name: functools.partial(
            model_json.normalizer_from_json,
            size=aamdm_embedding.PATH if field.name == "path" else whole,
        )
        for field in dataclasses.fields(aamdm_embedding.Statistics)
    }
    found = model_json.decode(value, where, {"statistics": lambda x: dict(x)})
    return aamdm_embedding.Statistics(
        **model_json.decode(found["statistics"], f"{where}: statistics", parts)
    )


def _space(value: Any, autoencoder: Autoencoder, size: int) -> Space:
    bounds = {
        name: jnp.asarray(
            model_json.numbers_from_json(name, value[name], least=-1e6, size=size),
            jnp.float32,
        )
        for name in _BOUNDS
    }
    normalizer = model_json.normalizer_from_json(value, size=size)
    return Space(normalizer=normalizer, autoencoder=autoencoder, **bounds)
