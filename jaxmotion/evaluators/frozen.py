"""Frozen evaluators: each in one file, with all that its use needs.

Fréchet distances and accuracies compare only where the same evaluator looked at the
motions. One that is trained anew for each table is another one on another machine, so
tables print its fingerprint, and whoever wants to compare uses one file.
"""

import dataclasses
from pathlib import Path
from typing import Any, Literal

import jax
import numpy as np

from jaxmotion.data.ball_clips import BallClips
from jaxmotion.data.clips import Clips
from jaxmotion.evaluators import action as action_evaluator
from jaxmotion.evaluators import published
from jaxmotion.evaluators import style as style_evaluator
from jaxmotion.learning import checkpoint
from jaxmotion.learning.fingerprint import fingerprint
from jaxmotion.typing import Params

Kind = Literal["style", "action", "ball", "style_release"]
Config = style_evaluator.Config | action_evaluator.Config

_FORMAT = "jaxmotion-evaluator"
_VERSION = 1
_FIELDS = {
    "kind": str,
    "config": dict,
    "field": str,
    "labels": list,
    "joints": list,
    "fps": float,
    "frames": int,
    "source": str,
    "clips": str,
    "seed": int,
    "updates": int,
    "accuracy": float,
    "fingerprint": str,
}


@dataclasses.dataclass(frozen=True, kw_only=True, eq=False)
class Evaluator:
    """An evaluator, what it looks at, and how it came about.

    Attributes:
      kind: "style" (CAMDM's evaluator, of windows of a label), "action" (EMDM's GRU),
        "ball" (SMGDiff's, of skills with a ball), or "style_release" (the classifier
        released with CAMDM).
      field: Label field of the clips that the classes are from.
      labels: Names of the classes, in their order.
      source: Data that it was trained on, and their license.
      clips: Fingerprint of the training clips.
      accuracy: On clips that it was not trained on, in [0, 1]; NaN if nobody said.
      path: Its file; None for one that was not loaded.
    """

    kind: Kind
    params: Params
    field: str
    labels: tuple[str, ...]
    joints: tuple[str, ...]
    fps: float
    frames: int
    source: str
    clips: str
    seed: int
    updates: int
    accuracy: float
    path: Path | None = None

    @property
    def config(self) -> Config:
        """Size of the evaluator."""
        classes, joints = len(self.labels), len(self.joints)
        if self.kind == "action":
            return action_evaluator.Config(num_classes=classes, num_joints=joints)
        if self.kind == "style_release":
            return style_evaluator.ReleasedConfig(num_classes=classes)
        return style_evaluator.Config(
            num_classes=classes,
            num_joints=joints + (self.kind == "ball"),
            frames=self.frames,
        )


def released_style(path: Path) -> Evaluator:
    """The style classifier released with CAMDM, 100style_position_classifier.pth.

    `ValueError` as `published.load_style_classifier`.
    """
    params, labels = published.load_style_classifier(path)
    return Evaluator(
        kind="style_release",
        params=params,
        field="style",
        labels=labels,
        joints=style_evaluator.RELEASED_JOINTS,
        fps=30.0,
        frames=60,
        source="100STYLE (CC BY 4.0); weights released with CAMDM",
        clips="unknown",
        seed=0,
        updates=0,
        accuracy=float("nan"),
    )


def to_json(evaluator: Evaluator) -> dict[str, Any]:
    """All of an evaluator but its parameters, with their fingerprint."""
    value = {
        name: getattr(evaluator, name) for name in _FIELDS if name != "fingerprint"
    }
    return {"format": _FORMAT, "version": _VERSION} | {
        **value,
        "config": dataclasses.asdict(evaluator.config),
        "fps": float(evaluator.fps),
        "labels": list(evaluator.labels),
        "joints": list(evaluator.joints),
        "fingerprint": fingerprint(evaluator.params),
    }


def save(path: Path, evaluator: Evaluator) -> None:
    """Writes an evaluator as one npz file, whole or not at all."""
    # All digits: what is loaded must score as what was saved.
    checkpoint.export_params(
        path, evaluator.params, to_json(evaluator), dtype=np.float32
    )


def load(path: Path) -> Evaluator:
    """Reads what `save` wrote; checks every field.

    A `ValueError` names the file and the field if it is missing, damaged, foreign or of
    another version.
    """
    params, value = checkpoint.import_params(path)
    expected = {"format": _FORMAT, "version": _VERSION}
    for name, wanted in expected.items():
        _require(path, name, value.get(name), wanted)
    for name, kind in _FIELDS.items():
        right = isinstance(value.get(name), kind)
        if kind is list:
            right = right and all(isinstance(x, str) for x in value[name])
        if not right or isinstance(value[name], bool):
            raise checkpoint.CheckpointError(
                f"{path}: field {name!r} is {value.get(name)!r}, expected "
                f"{'names' if kind is list else kind.__name__}"
            )
    if value["kind"] not in Kind.__args__:
        raise checkpoint.CheckpointError(
            f"{path}: field 'kind' is {value['kind']!r}, expected one of "
            f"{', '.join(Kind.__args__)}"
        )
    own = {x: value[x] for x in _FIELDS if x not in ("config", "fingerprint")}
    own |= {name: tuple(value[name]) for name in ("labels", "joints")}
    found = Evaluator(params=params, path=Path(path), **own)
    _require(path, "config", value["config"], dataclasses.asdict(found.config))
    checkpoint.check_params(path, params, _like(found))
    _require(path, "fingerprint", value["fingerprint"], fingerprint(params))
    return found


def _require(path: Path, field: str, found: Any, expected: Any) -> None:
    if found != expected:
        raise checkpoint.CheckpointError(
            f"{path}: field {field!r} is {found!r}, expected {expected!r}"
        )


def _like(evaluator: Evaluator) -> Params:
    """Shapes of its parameters."""
    is_action = evaluator.kind == "action"
    init = action_evaluator.init if is_action else style_evaluator.init
    return jax.eval_shape(lambda: init(jax.random.key(0), evaluator.config))


def params_for(
    evaluator: Evaluator | None,
    *,
    kind: Kind,
    labels: tuple[str, ...],
    joints: tuple[str, ...],
    fps: float,
    frames: int,
) -> Params | None:
    """Parameters of a frozen evaluator for a run that it fits; None without one.

    It scores `frames` frames. A `ValueError` names its file and a field that differs.
    """
    if evaluator is None:
        return None
    run = dict(kind=kind, labels=labels, joints=joints, fps=fps, frames=frames)
    for field, expected in run.items():
        found = getattr(evaluator, field)
        if found != expected:
            raise ValueError(
                f"{evaluator.path}: the evaluator does not fit the run: field "
                f"{field!r} is {found!r}, expected {expected!r}"
            )
    return evaluator.params


def clips_fingerprint(data: Clips | BallClips, field: str) -> str:
    """12 hexadecimal digits of clips, their labels of `field`, and perhaps a ball."""
    clips = data.clips if isinstance(data, BallClips) else data
    arrays = {
        "root_position": clips.root_position,
        "joint_rotation": clips.joint_rotation,
        "offsets": clips.offsets,
        "labels": clips.labels[field],
        "skeleton": clips.skeleton.offsets,
    }
    if isinstance(data, BallClips):
        arrays |= {"ball": data.position, "touch": data.touch}
    return fingerprint(arrays)


def describe(
    params: Params, evaluator: Evaluator | None = None, *, reference: str
) -> dict[str, Any]:
    """Who scored a table, for what stands beside it.

    The evaluator is None if it was trained for this table; the reference is the
    fingerprint of the clips that Fréchet distances refer to.
    """
    found = {"fingerprint": fingerprint(params), "reference_clips": reference}
    if evaluator is None:
        return found | {"origin": "trained here"}
    names = ("source", "clips", "seed", "updates", "accuracy")
    return (
        found
        | {"origin": "unsaved" if evaluator.path is None else evaluator.path.name}
        | {f"evaluator_{name}": getattr(evaluator, name) for name in names}
    )


def note(description: dict[str, Any]) -> str:
    """A line below a table that says who scored: at least fingerprint and origin."""
    line = f"Evaluator {description['fingerprint']} ({description['origin']})"
    if "reference_clips" in description:
        line += f"; Fréchet distances to clips {description['reference_clips']}"
    return f"{line}."
