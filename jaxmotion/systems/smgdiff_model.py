"""A SMGDiff model as a value: both stages' configurations, features and skills.

A run folder holds this as config.json beside one folder of checkpoints a stage, so a
model can be used without the experiment or the data that made it.
"""

import dataclasses
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


def _numbers(name: str, value: Any, *, least: float) -> list[int | float]:
    """A list of finite numbers; raises if it is none."""
    if not isinstance(value, list):
        raise ValueError(f"{name} is {value!r:.60}, expected a list of numbers")
    for x in value:
        right = isinstance(x, int | float) and not isinstance(x, bool)
        if not (right and least <= x <= 1e6):
            raise ValueError(f"{name} has {x!r:.60}, expected {least:g} to 1e+06")
    return value


def _representation(value: Any) -> Representation:
    if not isinstance(value, dict):
        raise ValueError(f"a JSON {type(value).__name__}, expected an object")
    bones = model_json.skeleton_from_json(value["skeleton"])
    joints = value["joints"]
    right = isinstance(joints, list) and all(type(x) is int for x in joints)
    if not right or not all(0 <= x < bones.num_joints for x in joints):
        raise ValueError(
            f"joints is {joints!r:.60}, expected numbers below {bones.num_joints}"
        )
    size = feature_layout(bones, tuple(joints)).size
    # A feature that never varies has a tiny deviation, but not none.
    for name, least in (("mean", -1e6), ("std", 1e-12)):
        if len(_numbers(name, value[name], least=least)) != size:
            raise ValueError(f"{name} has {len(value[name])} numbers, expected {size}")
    scalars = ("fps", "radius", "reach", "contact_speed")
    for name in scalars:
        _numbers(name, [value[name]], least=1e-6)
    return Representation(
        bones=bones,
        normalizer=Normalizer(
            mean=jnp.asarray(value["mean"], jnp.float32),
            std=jnp.asarray(value["std"], jnp.float32),
        ),
        joints=tuple(joints),
        **{name: float(value[name]) for name in scalars},
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
    parts = {
        "config": lambda x: model_json.config_from_json(smgdiff.Config, x),
        "paths": lambda x: model_json.config_from_json(smgdiff_trajectory.Config, x),
        "representation": _representation,
        "labels": model_json.names_from_json,
        "speeds": lambda x: tuple(_numbers("speed", x, least=0.0)),
        "source": lambda x: model_json.names_from_json([x])[0],
    }
    made = {}
    for field, make in parts.items():
        if field not in value:
            raise ValueError(f"{where}: field {field!r} is missing")
        try:
            made[field] = make(value[field])
        except KeyError as error:
            raise ValueError(f"{where}: field {field!r}: {error} is missing") from error
        except (TypeError, ValueError, IndexError) as error:
            raise ValueError(f"{where}: field {field!r}: {error}") from error
    model = Model(**made)
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
