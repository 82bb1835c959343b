"""A CAMDM model as a value: configuration, skeleton and styles, to and from JSON.

A checkpoint holds this beside the parameters, so a model can be used without the
experiment or the data that made it.
"""

import dataclasses
from pathlib import Path
from typing import Any

import jax

from jaxmotion.learning import checkpoint
from jaxmotion.motion.skeleton import Skeleton
from jaxmotion.systems import camdm, model_json
from jaxmotion.typing import Params


@dataclasses.dataclass(frozen=True, kw_only=True)
class Model:
    """Everything but the parameters.

    Attributes:
      config: The method.
      bones: The skeleton that it was trained on.
      labels: Names of the styles.
      source: The data, and its licence.
    """

    config: camdm.Config
    bones: Skeleton
    labels: tuple[str, ...]
    source: str

    def label(self, name: str) -> int:
        """Number of a style.

        Args:
          name: Its name.

        Returns:
          The number.

        Raises:
          ValueError: if the model has no such style; names those it has.
        """
        if name not in self.labels:
            raise ValueError(
                f"unknown style {name!r}: the model has {', '.join(self.labels)}"
            )
        return self.labels.index(name)


def to_json(model: Model) -> dict[str, Any]:
    """JSON of a model.

    Args:
      model: The model.

    Returns:
      A JSON object.
    """
    return {
        "system": "camdm",
        "config": dataclasses.asdict(model.config),
        "skeleton": model_json.skeleton_to_json(model.bones),
        "labels": list(model.labels),
        "source": model.source,
    }


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
    if value.get("system") != "camdm":
        raise ValueError(
            f"{where}: field 'system' is {value.get('system')!r}, expected 'camdm'"
        )
    known = {field.name for field in dataclasses.fields(camdm.Config)}
    unknown = set(value.get("config", {})) - known
    if unknown:
        raise ValueError(f"{where}: field 'config' has unknown {sorted(unknown)}")
    try:
        config = {
            name: tuple(x) if isinstance(x, list) else x
            for name, x in value["config"].items()
        }
        model = Model(
            config=camdm.Config(**config),
            bones=model_json.skeleton_from_json(value["skeleton"]),
            labels=tuple(value["labels"]),
            source=value["source"],
        )
    except (KeyError, TypeError) as error:
        raise ValueError(f"{where}: field {error} is missing or wrong") from error
    except ValueError as error:
        raise ValueError(f"{where}: field 'skeleton' is wrong: {error}") from error
    config = model.config
    for name, found, expected in (
        ("skeleton", model.bones.num_joints, config.num_joints),
        ("labels", len(model.labels), config.num_labels),
    ):
        if found != expected:
            raise ValueError(
                f"{where}: field {name!r} has {found} entries, the config {expected}"
            )
    return model


def _shapes(model: Model) -> Params:
    return jax.eval_shape(lambda: camdm.init(jax.random.key(0), model.config))


def load(folder: str | Path) -> tuple[Model, Params, dict[str, Any]]:
    """Model and averaged parameters (EMA) of a run folder or an exported file.

    Args:
      folder: Run folder that `experiments/camdm.py train` made, or an npz file that
        `checkpoint.export_params` wrote.

    Returns:
      The model, its parameters, and the whole JSON that was stored with it.

    Raises:
      CheckpointError: if there is no checkpoint, or it is corrupt or foreign.
      ValueError: if its JSON is not that of a CAMDM model.
    """
    path = Path(folder)
    if path.is_file():
        _, value = checkpoint.import_params(path)
        model = from_json(value, where=str(path))
        params, _ = checkpoint.import_params(path, like=_shapes(model))
        return model, params, value
    steps = path / "checkpoints"
    value = checkpoint.load_config(steps)
    model = from_json(value, where=str(steps))
    shapes = _shapes(model)
    found = checkpoint.restore_part(steps, {"ema_params": shapes})
    return model, found["ema_params"], value
