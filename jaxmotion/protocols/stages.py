"""Stages of a system's training and what each leaves behind.

Every stage has a folder of its own with checkpoints and losses. Its JSON says which
system and stage it is, so that one cannot be taken for another.
"""

import dataclasses
import math
from collections.abc import Callable
from pathlib import Path
from typing import Any, Literal

import jax

from jaxmotion.learning import checkpoint, loop, training
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
      chunk: Updates of one compiled call; fewer, if these do not divide the steps.
      save_every: Updates between checkpoints.
      seed: Of parameters and batches.
    """

    steps: int
    batch: int = 64
    optimizer: Literal["muon", "adamw", "radam", "adam"] = "muon"
    learning_rate: float = 2e-3
    ema: float = 0.999
    chunk: int = 100
    save_every: int = 1000
    seed: int = 0


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
      show: Names on the progress bar.

    Returns:
      The last state.

    Raises:
      CheckpointError: if the folder holds another stage, or other sizes.
      ValueError: if the checkpoint has other settings; names the field.
      TrainingDiverged: if a loss is not finite.
    """
    value = {"system": system, "stage": stage} | config
    if checkpoint.latest_step(folder / "checkpoints") is not None:
        found = check_stage(folder, stage, system=system)
        differ = sorted(k for k in value if found.get(k) != value[k])
        if differ:
            raise ValueError(
                f"{folder}: trained with other {', '.join(differ)}: expected "
                f"{[value[k] for k in differ]}, found {[found.get(k) for k in differ]}"
            )
        state = checkpoint.restore(folder / "checkpoints", state)
    chunk = math.gcd(budget.steps, int(state.step), budget.chunk)
    run = training.train_chunk(update, sample_batch, num_steps=chunk)
    settings = loop.Loop(
        num_steps=budget.steps,
        chunk=chunk,
        save_every=budget.save_every,
        folder=folder,
        config=value,
        show=show,
    )
    key = jax.random.fold_in(jax.random.key(budget.seed), 1)
    return loop.train(run, state, key, data, loop=settings)


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
