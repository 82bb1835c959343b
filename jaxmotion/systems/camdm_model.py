"""A CAMDM model as a value: configuration, skeleton and styles, to and from JSON.

A checkpoint holds this beside the parameters, so a model can be used without the
experiment or the data that made it.
"""

import dataclasses
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from jaxmotion.learning import checkpoint
from jaxmotion.motion.skeleton import MAX_METRES, Motion, Skeleton
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
      starts: Poses to start from, [labels, number, past, ...], at the origin facing +z;
        None where characters start from clips. A shipped model has its own, which it
        made itself.
    """

    config: camdm.Config
    bones: Skeleton
    labels: tuple[str, ...]
    source: str
    starts: Motion | None = None

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
    value = {
        "system": "camdm",
        "config": dataclasses.asdict(model.config),
        "skeleton": model_json.skeleton_to_json(model.bones),
        "labels": list(model.labels),
        "source": model.source,
    }
    if model.starts is not None:
        value["starts"] = {
            name: np.asarray(getattr(model.starts, name), np.float64).round(5).tolist()
            for name in ("root_position", "joint_rotation")
        }
    return value


def _starts_from_json(value: Any, config: camdm.Config, where: str) -> Motion | None:
    if value is None:
        return None
    try:
        root, joints = (
            np.asarray(value[name], np.float64)
            for name in ("root_position", "joint_rotation")
        )
    except (KeyError, TypeError, ValueError, OverflowError) as error:
        raise ValueError(f"{where}: field 'starts' is wrong: {error}") from None
    number = root.shape[1] if root.ndim > 1 else 0
    lead = (config.num_labels, number, config.past)
    expected = ((*lead, 3), (*lead, config.num_joints, 6))
    if number < 1 or (root.shape, joints.shape) != expected:
        raise ValueError(
            f"{where}: field 'starts' has shapes {root.shape} and {joints.shape}, "
            f"expected {expected[0]} and {expected[1]} of at least one start per label"
        )
    if not all((np.abs(x) <= MAX_METRES).all() for x in (root, joints)):
        raise ValueError(
            f"{where}: field 'starts' has numbers that are not within {MAX_METRES:g}"
        )
    return Motion(
        root_position=jnp.asarray(root, jnp.float32),
        joint_rotation=jnp.asarray(joints, jnp.float32),
        fps=config.fps,
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
    if value.get("system") != "camdm":
        raise ValueError(
            f"{where}: field 'system' is {value.get('system')!r}, expected 'camdm'"
        )
    parts = {
        "config": lambda x: model_json.config_from_json(camdm.Config, x),
        "skeleton": model_json.skeleton_from_json,
        "labels": model_json.names_from_json,
        "source": lambda x: model_json.names_from_json([x])[0],
    }
    made = {}
    for field, make in parts.items():
        if field not in value:
            raise ValueError(f"{where}: field {field!r} is missing")
        try:
            made[field] = make(value[field])
        except (KeyError, TypeError, ValueError) as error:
            raise ValueError(f"{where}: field {field!r}: {error}") from error
    model = Model(bones=made.pop("skeleton"), **made)
    config = model.config
    for name, found, expected in (
        ("skeleton", model.bones.num_joints, config.num_joints),
        ("labels", len(model.labels), config.num_labels),
    ):
        if found != expected:
            raise ValueError(
                f"{where}: field {name!r} has {found} entries, the config {expected}"
            )
    starts = _starts_from_json(value.get("starts"), config, where)
    return dataclasses.replace(model, starts=starts)


def _shapes(model: Model, where: Path) -> Params:
    try:
        return jax.eval_shape(lambda: camdm.init(jax.random.key(0), model.config))
    except Exception as error:  # whatever a network makes of sizes that do not fit
        line = (str(error).splitlines() or [type(error).__name__])[0]
        raise ValueError(f"{where}: field 'config' is of no network: {line}") from error


# Models that come with the package, by name; each has a card beside it.
SHIPPED = {
    path.stem: path
    for path in sorted((Path(__file__).parents[1] / "assets").glob("*.npz"))
}


def load(folder: str | Path) -> tuple[Model, Params, dict[str, Any]]:
    """Model and averaged parameters (EMA) of a run folder or an exported file.

    Args:
      folder: Name of a shipped model ("locomotion"), run folder that
        `experiments/camdm.py train` made, or npz file that `camdm.py export` wrote.

    Returns:
      The model, its parameters, and the whole JSON that was stored with it.

    Raises:
      CheckpointError: if there is no checkpoint, or it is corrupt or foreign.
      ValueError: if its JSON is not that of a CAMDM model.
    """
    path = Path(folder)
    if not path.exists():
        path = SHIPPED.get(str(folder), path)
    if path.is_file():
        _, value = checkpoint.import_params(path)
        model = from_json(value, where=str(path))
        params, _ = checkpoint.import_params(path, like=_shapes(model, path))
        return model, params, value
    steps = path / "checkpoints"
    value = checkpoint.load_config(steps)
    model = from_json(value, where=str(steps))
    shapes = _shapes(model, path)
    found = checkpoint.restore_part(steps, {"ema_params": shapes})
    return model, found["ema_params"], value
