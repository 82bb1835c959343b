"""Stages of a system's training and what each leaves behind.

Every stage has a folder of its own with checkpoints and losses. Its JSON says which
system and stage it is, so that one cannot be taken for another.
"""

import dataclasses
import json
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any, Literal

import jax

from jaxmotion.learning import checkpoint, fingerprint, loop, training
from jaxmotion.typing import Key, Params


@dataclasses.dataclass(frozen=True, kw_only=True)
class Budget:
    """How a stage is trained.

    Attributes:
      steps: Updates.
      batch: Samples an update (papers: 64).
      optimizer: "muon" or "adamw" with cosine decay, AAMDM's "radam" or EMDM's "adam".
      learning_rate: Of the optimiser.
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
    """The optimiser of a budget.

    Args:
      budget: How a stage is trained.

    Returns:
      The optimiser.
    """
    constant = {"radam": training.radam, "adam": training.gan_adam}
    if budget.optimizer in constant:
        return constant[budget.optimizer](learning_rate=budget.learning_rate)
    make = {"muon": training.muon_cosine, "adamw": training.adamw_cosine}
    return make[budget.optimizer](
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
