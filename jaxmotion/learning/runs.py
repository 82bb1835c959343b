"""Stages of a system's training and what each leaves behind.

Every stage has a folder of its own with checkpoints and losses. Its JSON says which
system and stage it is, so that one cannot be taken for another.
"""

import dataclasses
import json
import math
import typing
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, Literal

import jax
import jax.numpy as jnp
import numpy as np

from jaxmotion.learning import checkpoint, fingerprint, loop, training
from jaxmotion.motion.skeleton import Skeleton, check_skeleton
from jaxmotion.typing import Key, Params


@dataclasses.dataclass(frozen=True, kw_only=True)
class Budget:
    """How a stage is trained.

    Attributes:
      steps: Updates.
      batch: Samples per update (papers: 64).
      optimizer: "muon" or "adamw" with cosine decay, AAMDM's "radam" or EMDM's "adam".
      learning_rate: Of the optimizer.
      ema: Decay of the parameters' moving average.
      chunk: Updates of one compiled call, at most.
      save_every: Updates between checkpoints.
      seed: Of parameters and batches.
      override: Go on even if the checkpoint was trained with another budget or data.
    """

    steps: int
    batch: int = 64
    optimizer: Literal["muon", "adamw", "radam", "adam"] = "muon"
    learning_rate: float = 2e-3
    ema: float = 0.999
    chunk: int = 100
    save_every: int = 1000
    seed: int = 0
    override: bool = False


# What of a budget does not change what is trained.
_FREE = ("chunk", "save_every", "override")


def differences(
    found: dict[str, Any], given: dict[str, Any], *, prefix: str = ""
) -> str:
    """Fields of a JSON object that another does not agree with, in one line.

    Args:
      found: What was stored; fields that `given` lacks do not count.
      given: What should be the same; fields within fields are compared on their own.
      prefix: Of the fields' names.

    Returns:
      As in "seed is 0, given 7; config.width is 64, given 16"; empty for none.
    """
    lines = []
    found, given = json.loads(json.dumps([found, given]))  # tuples to lists
    for name, value in given.items():
        old = found.get(name, "not recorded")
        if isinstance(value, dict) and isinstance(old, dict):
            lines.append(differences(old, value, prefix=f"{prefix}{name}."))
        elif old != value:
            data = " (other data)" if name in ("data", "clips") else ""
            lines.append(
                f"{prefix}{name} is {_short(old)}, given {_short(value)}{data}"
            )
    return "; ".join(filter(None, lines))


def _short(value: Any) -> str:
    text = value if value == "not recorded" else repr(value)
    return text if len(text) <= 60 else f"{text[:57]}..."


def check_resumed(
    folder: Path,
    found: dict[str, Any],
    given: dict[str, Any],
    *,
    steps: int,
    override: bool,
) -> None:
    """Raises unless a run would go on as it began.

    Args:
      folder: Of the run, with `checkpoints`.
      found: Settings that its newest checkpoint was trained with.
      given: Settings to go on with.
      steps: Updates of the whole run that are asked for.
      override: Whether other settings are meant so.

    Raises:
      ValueError: names the settings that differ, or says that more steps are done.
    """
    done = checkpoint.latest_step(folder / "checkpoints") or 0
    if done > steps:
        raise ValueError(
            f"{folder}: has {done} steps, expected at most the {steps} to train"
        )
    differ = differences(found, given)
    if differ and not override:
        raise ValueError(
            f"{folder}: at step {done}, and trained with other settings: {differ}; "
            "--override goes on with those given"
        )


def made_from(paths: Sequence[Path]) -> dict[str, Any]:
    """JSON of the files that a run folder's data are made from.

    Raises:
      OSError: if one cannot be read.
    """
    return {
        "data": [str(path) for path in paths],
        "fingerprints": [fingerprint.file_fingerprint(path) for path in paths],
    }


def check_made(
    folder: Path, found: dict[str, Any], paths: Sequence[Path], given: dict[str, Any]
) -> None:
    """Raises unless a run folder's data are those that would be made now.

    Files that are gone are taken to be the ones of that name; those that are there may
    have other names.

    Args:
      folder: The run folder.
      found: Its JSON, with what `made_from` gave.
      paths: Files to make data from.
      given: How.

    Raises:
      OSError: if a file is there but cannot be read.
      ValueError: names what differs.
    """
    names, old = [str(path) for path in paths], found.get("data")
    old = [old] if isinstance(old, str) else old
    if all(path.is_file() for path in paths) and "fingerprints" in found:
        now = made_from(paths)["fingerprints"]
        same = found["fingerprints"] == now
    else:
        same, now = old == names, "unknown"
    if not same:
        raise ValueError(
            f"{folder}: made from other data: {old} (fingerprint "
            f"{found.get('fingerprints')}), given {names} ({now}); use another folder"
        )
    differ = differences(found, given)
    if differ:
        raise ValueError(
            f"{folder}: its data were made otherwise: {differ}; use another folder"
        )


def make_optimizer(budget: Budget) -> training.Optimizer:
    """The optimizer of a budget.

    Args:
      budget: How a stage is trained.

    Returns:
      The optimizer.
    """
    if budget.optimizer in ("radam", "adam"):
        return training.make_optimizer(
            budget.optimizer, learning_rate=budget.learning_rate
        )
    return training.make_optimizer(
        budget.optimizer,
        learning_rate=budget.learning_rate,
        num_steps=budget.steps,
        warmup_steps=min(100, budget.steps // 10),
        final_fraction=0.05,
    )


def check_stage(folder: Path, stage: str, *, system: str) -> dict[str, Any]:
    """JSON of a stage's newest checkpoint.

    Args:
      folder: The stage's folder.
      stage: Which stage it must be.
      system: Which system it must be of.

    Returns:
      The JSON object.

    Raises:
      CheckpointError: if there is no checkpoint, or it is of another stage or system;
        names the folder.
    """
    value = checkpoint.load_config(folder / "checkpoints")
    for field, expected in (("system", system), ("stage", stage)):
        if value.get(field) != expected:
            raise checkpoint.CheckpointError(
                f"{folder}: field {field!r} is {value.get(field)!r}, expected "
                f"{expected!r}: the checkpoint is of another stage"
            )
    return value


def restore_evaluator(
    folder: Path, value: dict[str, Any], init: Callable[[], Params]
) -> Params:
    """Parameters of an evaluator that must have been trained as told.

    Args:
      folder: Of its checkpoint.
      value: JSON of how it must have been trained.
      init: Makes parameters of the same shapes; never run.

    Returns:
      The parameters.

    Raises:
      CheckpointError: if there is none.
      ValueError: if it was trained otherwise; names the field.
    """
    found = checkpoint.load_config(folder)
    for field, expected in value.items():
        if found.get(field) != expected:
            raise ValueError(
                f"{folder}: field {field!r} is {found.get(field)!r}, expected "
                f"{expected!r}"
            )
    return checkpoint.restore(folder, {"params": jax.eval_shape(init)})["params"]


def fit(
    folder: Path,
    state: Any,
    update: Callable,
    sample_batch: Callable[[Key, Any], Any],
    data: Any,
    *,
    system: str,
    stage: str,
    budget: Budget,
    config: dict[str, Any],
    source: Path,
    settings: dict[str, Any] | None = None,
    show: tuple[str, ...] = ("loss",),
) -> Any:
    """Trains a stage, from its newest checkpoint if there is one.

    Args:
      folder: The stage's folder.
      state: Of a new run.
      update: Of the state by a batch.
      sample_batch: `(key, data) -> batch`.
      data: Arrays.
      system: Name of the system.
      stage: Name of the stage.
      budget: How long.
      config: JSON of what rebuilds the stage's networks.
      source: File of the data, by which other data are told.
      settings: JSON of how the stage is trained besides the budget.
      show: Names on the progress bar.

    Returns:
      The last state.

    Raises:
      CheckpointError: if the folder holds another stage.
      ValueError: if the checkpoint has other sizes, or other settings or data and the
        budget does not override them, or more steps; names the fields.
      TrainingDiverged: if a loss is not finite.
    """
    value = {"system": system, "stage": stage} | config
    own = {k: v for k, v in dataclasses.asdict(budget).items() if k not in _FREE}
    how = own | {"data": fingerprint.file_fingerprint(source)} | (settings or {})
    if checkpoint.latest_step(folder / "checkpoints") is not None:
        found = check_stage(folder, stage, system=system)
        differ = differences(found, value)
        if differ:
            raise ValueError(f"{folder}: of another model: {differ}")
        check_resumed(
            folder,
            found.get("training", {}),
            how,
            steps=budget.steps,
            override=budget.override,
        )
        state = checkpoint.restore(folder / "checkpoints", state)
    chunk = min(budget.steps, budget.chunk)
    run = training.train_chunk(update, sample_batch, num_steps=chunk)
    lengths = loop.Loop(
        num_steps=budget.steps,
        chunk=chunk,
        save_every=budget.save_every,
        folder=folder,
        config=value | {"training": how},
        show=show,
    )
    key = jax.random.fold_in(jax.random.key(budget.seed), 1)
    return loop.train(run, state, key, data, loop=lengths)


def load_params(
    folder: Path,
    stage: str,
    init: Callable[[], Params],
    *,
    system: str,
    adversarial: bool = False,
) -> Params:
    """Averaged parameters of a stage.

    Args:
      folder: The stage's folder.
      stage: Which stage it must be.
      init: Makes parameters of the same shapes; never run.
      system: Which system it must be of.
      adversarial: Whether the stage trained a generator against a discriminator.

    Returns:
      The parameters.

    Raises:
      CheckpointError: if there is none, or it is of another stage or size.
    """
    check_stage(folder, stage, system=system)
    found = checkpoint.restore_part(
        folder / "checkpoints",
        {"ema_params": jax.eval_shape(init)},
        within="generator" if adversarial else None,
    )
    return found["ema_params"]


def skeleton_to_json(skeleton: Skeleton) -> dict[str, Any]:
    """JSON of a skeleton.

    Args:
      skeleton: The skeleton.

    Returns:
      A JSON object.
    """
    return {
        "offsets": np.asarray(skeleton.offsets, np.float64).tolist(),
        "parents": list(skeleton.parents),
        "names": list(skeleton.names),
        "feet": list(skeleton.feet),
    }


def skeleton_from_json(value: Any) -> Skeleton:
    """Inverse of `skeleton_to_json`.

    Args:
      value: The JSON object.

    Returns:
      The skeleton.

    Raises:
      KeyError: if a field is missing.
      ValueError: if the fields are not those of a skeleton; says what is wrong.
    """
    if not isinstance(value, dict):
        raise ValueError(f"a JSON {type(value).__name__}, expected an object")
    fields = {name: value[name] for name in ("offsets", "parents", "names", "feet")}
    for name, found in fields.items():
        if not isinstance(found, list):
            raise ValueError(f"{name} should be a list, found {found!r:.100}")
    check_skeleton(**fields)
    return Skeleton(
        offsets=jnp.asarray(np.asarray(fields["offsets"], np.float32)),
        parents=tuple(fields["parents"]),
        names=tuple(fields["names"]),
        feet=tuple(fields["feet"]),
    )


# Least and largest of numbers in configurations, by name, which keep a damaged file
# from asking for networks that no machine holds. Others: whole ones 1 to 65,536, the
# rest 0 to 1e6.
_LIMITS: dict[str, tuple[float | int, float | int]] = {
    "features": (1, 10**6),
    "num_features": (1, 10**6),
    "num_labels": (1, 10**5),
    "num_steps": (1, 10**4),
    "depth": (1, 256),
    **dict.fromkeys(("latent", "condition_size", "token_margin"), (0, 2**16)),
    **dict.fromkeys(("drafts", "polishes"), (0, 1000)),
    **dict.fromkeys(("drop_past", "drop_condition", "own_previous"), (0, 1)),
    "dropout": (0, math.nextafter(1, 0)),
    "fps": (1e-3, 1000),
    **dict.fromkeys(("rotation_scale", "meters", "contact_speed"), (1e-6, 1e6)),
    # In features of any scale.
    "rotation_mean": (-1e6, 1e6),
}


def _check_field(name: str, kind: Any, value: Any) -> Any:
    """The value as a configuration has it; raises unless it is of its kind."""
    choices = typing.get_args(kind)
    if typing.get_origin(kind) is typing.Literal:
        right = isinstance(value, str) and value in choices
        expected = f"one of {', '.join(map(repr, choices))}"
    elif kind is bool:
        right, expected = isinstance(value, bool), "true or false"
    elif typing.get_origin(kind) is tuple:
        if not isinstance(value, list | tuple):
            raise ValueError(f"{name} is {value!r:.60}, expected a list")
        return tuple(_check_field(name, choices[0], x) for x in value)
    elif kind in (int, float):
        low, high = _LIMITS.get(name, (1, 2**16) if kind is int else (0, 1e6))
        number = (int,) if kind is int else (int, float)
        right = isinstance(value, number) and not isinstance(value, bool)
        right = right and low <= value <= high
        what = "a whole number" if kind is int else "a number"
        expected = f"{what} from {low:g} to {high:g}"
    else:
        raise TypeError(f"{name}: no rule for {kind}")
    if not right:
        raise ValueError(f"{name} is {value!r:.60}, expected {expected}")
    return float(value) if kind is float else value


def config_from_json(kind: type, value: Any) -> Any:
    """A configuration from its JSON, of which every field is checked.

    Args:
      kind: Its dataclass, of whole numbers, numbers, truth values, choices and lists.
      value: What `dataclasses.asdict` gave, read back.

    Returns:
      The configuration.

    Raises:
      ValueError: names the field that is missing, unknown, of another kind or out of
        range.
    """
    if not isinstance(value, dict):
        raise ValueError(f"a JSON {type(value).__name__}, expected an object")
    kinds = typing.get_type_hints(kind)
    unknown = sorted(set(value) - set(kinds))
    if unknown:
        raise ValueError(f"has unknown {unknown}")
    needed = {
        field.name
        for field in dataclasses.fields(kind)
        if field.default is dataclasses.MISSING
    }
    if needed - set(value):
        raise ValueError(f"{', '.join(sorted(needed - set(value)))} is missing")
    config = kind(**{k: _check_field(k, kinds[k], x) for k, x in value.items()})
    width, heads = (getattr(config, name, 0) for name in ("width", "heads"))
    if heads and width % heads:
        raise ValueError(f"width is {width}, expected a multiple of heads ({heads})")
    return config


def names_from_json(value: Any) -> tuple[str, ...]:
    """A list of different names.

    Raises:
      ValueError: if it is none.
    """
    right = isinstance(value, list) and all(isinstance(x, str) for x in value)
    if not right or len(set(value)) < len(value):
        raise ValueError(f"{value!r:.60}, expected a list of different names")
    return tuple(value)
