"""A SMGDiff model as a value: both stages' configurations, features and skills.

A run folder holds this as config.json beside one folder of checkpoints a stage, so a
model can be used without the experiment or the data that made it.
"""

import dataclasses
from collections.abc import Mapping
from typing import Any

import jax.numpy as jnp
import numpy as np

from jaxmotion.motion.features import Normalizer
from jaxmotion.systems import model_json, smgdiff, smgdiff_trajectory
from jaxmotion.systems.smgdiff_scene import Representation, feature_layout

SYSTEM = "smgdiff"


@dataclasses.dataclass(frozen=True, kw_only=True)
class Model:
    """Everything but the parameters.

    Attributes:
      config: Of the motion model.
      paths: Of the trajectory generator.
      representation: What features mean.
      labels: Names of the skills.
      speeds: Median speed of the root in each skill, metres a second.
      source: The data, and its licence.
    """

    config: smgdiff.Config
    paths: smgdiff_trajectory.Config
    representation: Representation
    labels: tuple[str, ...]
    speeds: tuple[float, ...]
    source: str

    def label(self, name: str) -> int:
        """Number of a skill.

        Args:
          name: Its name.

        Returns:
          The number.

        Raises:
          ValueError: if the model has no such skill; names those it has.
        """
        if name not in self.labels:
            raise ValueError(
                f"unknown skill {name!r}: the model has {', '.join(self.labels)}"
            )
        return self.labels.index(name)


def to_json(model: Model) -> dict[str, Any]:
    """JSON of a model.

    Args:
      model: The model.

    Returns:
      A JSON object.
    """
    features = model.representation
    numbers = lambda x: np.asarray(x, np.float64).tolist()  # noqa: E731
    return {
        "system": SYSTEM,
        "config": dataclasses.asdict(model.config),
        "paths": dataclasses.asdict(model.paths),
        "representation": {
            "skeleton": model_json.skeleton_to_json(features.bones),
            "mean": numbers(features.normalizer.mean),
            "std": numbers(features.normalizer.std),
            "joints": list(features.joints),
            "fps": features.fps,
            "radius": features.radius,
            "reach": features.reach,
            "contact_speed": features.contact_speed,
        },
        "labels": list(model.labels),
        "speeds": list(model.speeds),
        "source": model.source,
    }


def _representation(value: Mapping[str, Any]) -> Representation:
    bones = model_json.skeleton_from_json(value["skeleton"])
    size = feature_layout(bones, tuple(value["joints"])).size
    for name in ("mean", "std"):
        if len(value[name]) != size:
            raise ValueError(f"{name} has {len(value[name])} numbers, expected {size}")
    return Representation(
        bones=bones,
        normalizer=Normalizer(
            mean=jnp.asarray(value["mean"], jnp.float32),
            std=jnp.asarray(value["std"], jnp.float32),
        ),
        joints=tuple(value["joints"]),
        **{name: value[name] for name in ("fps", "radius", "reach", "contact_speed")},
    )


def from_json(value: dict[str, Any], *, where: str) -> Model:
    """Inverse of `to_json`.

    Args:
      value: The JSON object.
      where: The file, for error messages.

    Returns:
      The model.

    Raises:
      ValueError: names the file and the field that is missing or wrong.
    """
    if value.get("system") != SYSTEM:
        raise ValueError(
            f"{where}: field 'system' is {value.get('system')!r}, expected {SYSTEM!r}"
        )
    try:
        model = Model(
            config=smgdiff.Config(**value["config"]),
            paths=smgdiff_trajectory.Config(**value["paths"]),
            representation=_representation(value["representation"]),
            labels=tuple(value["labels"]),
            speeds=tuple(value["speeds"]),
            source=value["source"],
        )
    except (KeyError, TypeError) as error:
        raise ValueError(f"{where}: field {error} is missing or wrong") from error
    except ValueError as error:
        raise ValueError(f"{where}: field 'representation': {error}") from error
    labels, size = len(model.labels), model.representation.normalizer.mean.size
    for name, found, expected in (
        ("config.num_features", model.config.num_features, size),
        ("config.num_labels", model.config.num_labels, labels),
        ("paths.num_labels", model.paths.num_labels, labels),
        ("speeds", len(model.speeds), labels),
    ):
        if found != expected:
            raise ValueError(f"{where}: field {name!r} is {found}, expected {expected}")
    return model
