"""Run folders and the trainer of all systems.

config.json     what the run is: system, model, settings, source, split; written last
data/           clips or frames as the system uses them: the original is not needed
<stage>/        checkpoints and losses.jsonl of one training; a system has one or more

Every checkpoint says which system and stage it is of, which networks it holds, and how
and on what they were trained, so that one cannot be taken for another. This module
knows no system: what a model's JSON means, its systems know.
"""

import dataclasses
import importlib.metadata
import json
import platform
import sys
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
from jax.experimental import multihost_utils

from jaxmotion import files
from jaxmotion.learning import checkpoint, fingerprint, loop, model_json, training
from jaxmotion.learning.training import OptimizerName
from jaxmotion.typing import Key, Params

# Format of config.json: folders of another number are refused.
FORMAT = 1
_CONFIG = "config.json"
_PACKAGES = ("jaxmotion", "jax", "jaxlib", "flax", "optax", "numpy")


def versions() -> dict[str, str | None]:
    """Versions of Python and of the packages that numbers depend on."""
    found: dict[str, str | None] = {"python": platform.python_version()}
    for name in _PACKAGES:
        try:
            found[name] = importlib.metadata.version(name)
        except importlib.metadata.PackageNotFoundError:
            found[name] = None
    return found


# --- the folder --------------------------------------------------------------------


@dataclasses.dataclass(frozen=True, kw_only=True)
class Content:
    """What a system puts into a new run folder.

    Attributes:
      model: JSON of what rebuilds the model.
      source: The data, and their license.
      split: Names of the clips of each part.
      files: Writers of the files in `data`, by file name.
    """

    model: dict[str, Any]
    source: str
    split: dict[str, list[str]]
    files: Mapping[str, Callable[[Path], None]]


@dataclasses.dataclass(frozen=True, kw_only=True)
class Run:
    """A run folder, of a system; model, source and split are those of its `Content`.

    Attributes:
      settings: JSON of how model and data were made.
      files: Fingerprint of each file in `data`, by file name.
    """

    folder: Path
    system: str
    model: dict[str, Any]
    settings: dict[str, Any]
    source: str
    split: dict[str, list[str]]
    files: dict[str, str]

    @property
    def config(self) -> Path:
        """The file that says what the run is."""
        return self.folder / _CONFIG

    def file(self, name: str) -> Path:
        """A file of the data; raises `ValueError` if config.json lists no such one."""
        if name not in self.files:
            raise ValueError(
                f"{self.config}: field 'files' lists {sorted(self.files)}, expected "
                f"{name!r} among them"
            )
        return self.folder / "data" / name

    def checkpoints(self, stage: str) -> Path:
        """Folder of a stage's checkpoints; it need not exist."""
        return self.folder / stage / "checkpoints"


def of_seed(folder: Path, seed: int) -> Path:
    """The run folder of a seed, beside that of seed 0."""
    return folder.with_name(f"{folder.name}_seed{seed}") if seed else folder


def begin(
    folder: Path,
    *,
    system: str,
    data: Sequence[Path],
    settings: dict[str, Any],
    make: Callable[[], Content],
) -> Run:
    """Makes a run folder, or loads the one that is there.

    A start that is killed leaves no config.json, so nothing that looks whole. Of
    several processes the first one writes; all of them must see the folder.

    Args:
      data: Files that its data are made from. Files that are gone are taken to be those
        of that name; those that are there may have moved.
      settings: JSON of how model and data are made.
      make: Reads the files and makes the content; not called for a folder that is
        there.

    Raises:
      OSError: if a file cannot be read or written.
      ValueError: if the folder is of another system, of other data, or was made with
        other settings; names what differs.
    """
    path = folder / _CONFIG
    if path.exists():
        _check_same(path, _read(folder, system), data, settings)
    else:
        _make(folder, system, data, settings, make)
    multihost_utils.sync_global_devices(f"{folder} is there")
    return load(folder, system=system)


def _make(
    folder: Path,
    system: str,
    data: Sequence[Path],
    settings: dict[str, Any],
    make: Callable[[], Content],
) -> None:
    """Writes a new run folder."""
    for one in data:
        if not one.is_file():
            raise FileNotFoundError(f"no clips file {str(one)!r}: {files.CLIPS_MAKER}")
    prints = [fingerprint.file_fingerprint(one) for one in data]
    # By every process, so that bad input ends all of them, each with its line.
    content = make()
    if jax.process_index():
        return
    for name, write in content.files.items():
        write(folder / "data" / name)
    value = {
        "format": FORMAT,
        "system": system,
        "model": content.model,
        "settings": settings,
        "source": content.source,
        "data": {str(one): found for one, found in zip(data, prints, strict=True)},
        "split": content.split,
        "files": {
            name: fingerprint.file_fingerprint(folder / "data" / name)
            for name in content.files
        },
        "versions": versions(),
        "command": " ".join(["python", *sys.argv]),
    }
    files.write_text(folder / _CONFIG, json.dumps(value, indent=1))


def _check_same(
    path: Path, value: dict[str, Any], data: Sequence[Path], settings: dict[str, Any]
) -> None:
    """Raises unless a run would be made now as it was."""
    found, names = value["data"], [str(one) for one in data]
    if all(one.is_file() for one in data):
        given = [fingerprint.file_fingerprint(one) for one in data]
        same = list(found.values()) == given
    else:
        given, same = ["gone"] * len(names), list(found) == names
    if not same:
        raise ValueError(
            f"{path}: field 'data' is {_listed(found.items())}, given "
            f"{_listed(zip(names, given, strict=True))}: other data; use another folder"
        )
    differ = model_json.differences(value["settings"], settings)
    if differ:
        raise ValueError(f"{path}: made otherwise: {differ}; use another folder")


def _listed(pairs: Any) -> str:
    return ", ".join(f"{name} ({found})" for name, found in pairs)


def _is_names(value: Any) -> bool:
    return isinstance(value, list) and all(isinstance(x, str) for x in value)


# Fields of config.json: what they should be, and whether a value is that.
_FIELDS: dict[str, tuple[str, Callable[[Any], bool]]] = {
    "model": ("an object", lambda x: isinstance(x, dict)),
    "settings": ("an object", lambda x: isinstance(x, dict)),
    "source": ("a text", lambda x: isinstance(x, str)),
    "data": (
        "fingerprints of files",
        lambda x: isinstance(x, dict) and _is_names(list(x.values())),
    ),
    "split": (
        "lists of names",
        lambda x: isinstance(x, dict) and all(map(_is_names, x.values())),
    ),
    "files": (
        "fingerprints of file names",
        lambda x: (
            isinstance(x, dict)
            and all(Path(name).name == name and isinstance(x[name], str) for name in x)
        ),
    ),
}


def _read(folder: Path, system: str | None) -> dict[str, Any]:
    """config.json of a run folder, each field of its kind."""
    path, whose = folder / _CONFIG, system or "<system>"
    what = f"expected a run folder of `experiments/{whose}.py train`"
    value = files.read_object(path, what=what)
    found = value.get("format")
    if found != FORMAT or isinstance(found, bool):
        newer = isinstance(found, int) and found > FORMAT
        why = "a newer version of jaxmotion wrote it" if newer else what
        raise ValueError(
            f"{path}: field 'format' is {found!r:.80}, expected {FORMAT}: {why}"
        )
    found = value.get("system")
    if not isinstance(found, str) or (system and found != system):
        raise ValueError(
            f"{path}: field 'system' is {found!r:.80}, expected {system or 'a name'!r}"
        )
    for name, (kind, right) in _FIELDS.items():
        if name not in value:
            raise ValueError(f"{path}: field {name!r} is missing, expected {kind}")
        if not right(value[name]):
            raise ValueError(
                f"{path}: field {name!r} is {value[name]!r:.80}, expected {kind}"
            )
    return value


def load(folder: Path, *, system: str | None = None) -> Run:
    """Loads a run folder and checks that its data are those it was made with.

    Raises:
      OSError: if a file is missing or cannot be read.
      ValueError: if it is no run folder, one of another system (None: any may be) or of
        a newer format, or its data are other than they were; names file and field.
    """
    value = _read(folder, system)
    run = Run(
        folder=folder,
        **{
            field.name: value[field.name]
            for field in dataclasses.fields(Run)
            if field.name != "folder"
        },
    )
    for name, expected in run.files.items():
        path = run.file(name)
        if not path.is_file():
            raise FileNotFoundError(f"{path}: no such file: {run.config} lists it")
        if (found := fingerprint.file_fingerprint(path)) != expected:
            raise ValueError(
                f"{path}: fingerprint is {found}, expected {expected} of {run.config}: "
                "damaged, or of other data"
            )
    return run


# --- stages ------------------------------------------------------------------------


@dataclasses.dataclass(frozen=True, kw_only=True)
class Budget:
    """How a stage is trained.

    Attributes:
      steps: Updates.
      batch: Samples per update (papers: 64).
      optimizer: "muon" or "adamw" with warm-up and cosine decay, or AAMDM's "radam" or
        EMDM's "adam", which by default have a constant rate.
      learning_rate: Rate of the optimizer; where it varies, its peak.
      constant: Whether the rate stays as it is; None: of radam and adam alone.
      warmup: Updates of linear rise; None for a tenth of them, 100 at most.
      final: Rate at the end of the decay, as a fraction of the peak.
      max_norm: Gradients are clipped to this global norm; 0 for no clipping.
      ema: Decay per update of the parameters' moving average; 0 for no average.
      initial_scale: Factor on the first weights of a system's denoisers' linear layers,
        which are Flax's; .58 for about PyTorch's.
      devices: Split each batch over so many; a run of several processes takes all.
      chunk: Updates of one compiled call, at most.
      save_every: Updates between checkpoints.
      seed: Seeds parameters and batches.
      override: Go on even if the checkpoint was trained with another budget or data.
    """

    steps: int
    batch: int = 64
    optimizer: OptimizerName = "muon"
    learning_rate: float = 2e-3
    constant: bool | None = None
    warmup: int | None = None
    final: float = 0.05
    max_norm: float = 0.0
    ema: float = 0.999
    initial_scale: float = 1.0
    devices: int = 1
    chunk: int = 100
    save_every: int = 1000
    seed: int = 0
    override: bool = False

    def __post_init__(self):
        """Raises if there are fewer devices, before any work."""
        if self.devices > 1 and self.devices > jax.device_count():
            raise ValueError(
                f"devices is {self.devices}, {jax.device_count()} are there"
            )
        if jax.process_count() > 1 and self.batch % jax.device_count():
            raise ValueError(
                f"batch is {self.batch}, expected a multiple of the "
                f"{jax.device_count()} devices of {jax.process_count()} processes"
            )


# What of a budget does not change what is trained.
_FREE = ("devices", "chunk", "save_every", "override")


def initial(params: Params, budget: Budget) -> Params:
    """Random parameters as a training begins with them: scaled by the budget."""

    def scaled(path: tuple, x: jax.Array) -> jax.Array:
        return budget.initial_scale * x if path[-1].key == "kernel" else x

    if budget.initial_scale == 1.0:
        return params
    return jax.tree_util.tree_map_with_path(scaled, params)


def make_optimizer(budget: Budget) -> training.Optimizer:
    """The optimizer of a budget."""
    clip = budget.max_norm or None
    constant = budget.constant
    if constant is None:
        constant = budget.optimizer in ("radam", "adam")
    if constant:
        return training.make_optimizer(
            budget.optimizer, learning_rate=budget.learning_rate, max_norm=clip
        )
    warmup = budget.warmup
    return training.make_optimizer(
        budget.optimizer,
        learning_rate=budget.learning_rate,
        num_steps=budget.steps,
        warmup_steps=min(100, budget.steps // 10) if warmup is None else warmup,
        final_fraction=budget.final,
        max_norm=clip,
    )


def check_stage(run: Run, stage: str) -> dict[str, Any]:
    """JSON of a stage's newest checkpoint.

    A `CheckpointError` names the folder if there is none, or it is of another stage or
    system.
    """
    value = checkpoint.load_config(run.checkpoints(stage))
    for field, expected in (("system", run.system), ("stage", stage)):
        if value.get(field) != expected:
            raise checkpoint.CheckpointError(
                f"{run.folder / stage}: field {field!r} is {value.get(field)!r}, "
                f"expected {expected!r}: the checkpoint is of another stage"
            )
    return value


def check_model(run: Run, stage: str, model: dict[str, Any]) -> None:
    """Raises unless a stage's newest checkpoint is of this model.

    `CheckpointError` as `check_stage`; a `ValueError` names the fields that differ.
    """
    differ = model_json.differences(check_stage(run, stage).get("model", {}), model)
    if differ:
        raise ValueError(f"{run.folder / stage}: of another model: {differ}")


def stage_config(run: Run, stage: str, kind: type, **more: Any) -> Any:
    """The configuration that a stage was trained with.

    `more` gives fields that stages of that kind do not decide. `CheckpointError` as
    `check_stage`; a `ValueError` names the first field that is not the dataclass's.
    """
    value = check_stage(run, stage).get("model")
    try:
        return model_json.config_from_json(
            kind, value | more if isinstance(value, dict) else None
        )
    except ValueError as error:
        raise ValueError(f"{run.folder / stage}: field 'model': {error}") from error


def _stage_json(run: Run, stage: str, model: dict[str, Any]) -> dict[str, Any]:
    return {"system": run.system, "stage": stage, "model": model}


def store(run: Run, stage: str, state: Any, *, model: dict[str, Any]) -> None:
    """Writes what is made without training as a stage: its checkpoint of step 0.

    The model is the JSON of its structure. Raises `OSError` if it cannot be written,
    `ValueError` if the stage has a checkpoint.
    """
    place = run.checkpoints(stage)
    if checkpoint.latest_step(place) is not None:
        raise ValueError(f"{run.folder}: {stage!r} exists; use another folder")
    # On the host: of several processes' arrays Orbax would take none for common.
    checkpoint.save(place, 0, jax.device_get(state), _stage_json(run, stage, model))


def _check_resumed(
    run: Run, stage: str, model: dict[str, Any], how: dict[str, Any], budget: Budget
) -> None:
    """Raises unless a stage would go on as it began."""
    check_model(run, stage, model)
    folder, found = run.folder / stage, check_stage(run, stage)
    done = checkpoint.latest_step(run.checkpoints(stage)) or 0
    if done > budget.steps:
        raise ValueError(
            f"{folder}: has {done} steps, expected at most the {budget.steps} to train"
        )
    differ = model_json.differences(found.get("training", {}), how)
    if differ and not budget.override:
        raise ValueError(
            f"{folder}: at step {done}, and trained with other settings: {differ}; "
            "--override goes on with those given"
        )


def fit(
    run: Run,
    stage: str,
    state: Any,
    update: training.Update,
    sample_batch: Callable[[Key, Any], Any],
    data: Any,
    *,
    budget: Budget,
    model: dict[str, Any],
    settings: dict[str, Any] | None = None,
    key: Key | None = None,
    show: tuple[str, ...] = ("loss",),
) -> Any:
    """Trains a stage, from its newest checkpoint if there is one.

    Args:
      sample_batch: `(key, data) -> batch`.
      model: JSON of what rebuilds the stage's networks.
      settings: JSON of how the stage is trained besides the budget.
      key: Key of batches and noise; None for one of the budget's seed.

    Raises:
      CheckpointError: if the folder holds another stage.
      ValueError: if the checkpoint has other sizes, or other settings or data and the
        budget does not override them, or more steps; names the fields.
      TrainingDiverged: if a loss is not finite.
    """
    several = jax.process_count() > 1
    devices = jax.device_count() if several else budget.devices
    mesh = jax.make_mesh((devices,), ("data",)) if devices > 1 else None
    state = training.replicate(state, mesh)
    own = {k: v for k, v in dataclasses.asdict(budget).items() if k not in _FREE}
    if budget.constant is None:  # as checkpoints of before have it
        del own["constant"]
    if budget.initial_scale == 1.0:
        del own["initial_scale"]
    how = own | {"files": run.files} | (settings or {})
    if checkpoint.latest_step(run.checkpoints(stage)) is not None:
        _check_resumed(run, stage, model, how, budget)
        state = checkpoint.restore(run.checkpoints(stage), state)
    chunk = min(budget.steps, budget.chunk)
    lengths = loop.Loop(
        num_steps=budget.steps,
        chunk=chunk,
        save_every=budget.save_every,
        folder=run.folder / stage,
        config=_stage_json(run, stage, model) | {"training": how},
        show=show,
    )
    if key is None:
        key = jax.random.fold_in(jax.random.key(budget.seed), 1)
    state = loop.train(
        training.train_chunk(update, sample_batch, num_steps=chunk, mesh=mesh),
        state,
        key,
        training.replicate(data, mesh),
        loop=lengths,
    )
    # What follows is each process's own work, on arrays that are bound to no device.
    return jax.tree.map(jnp.asarray, jax.device_get(state)) if several else state


def minimize(
    params: Params,
    run: Run,
    stage: str,
    loss: training.Loss,
    sample_batch: Callable[[Key, Any], Any],
    data: Any,
    *,
    budget: Budget,
    **more: Any,
) -> training.TrainState:
    """Trains a stage of one network by a loss, with the budget's optimizer.

    The loss is `(params, key, batch) -> (loss, info)`; `more` is as `fit` takes it.
    """
    optimizer = make_optimizer(budget)
    return fit(
        run,
        stage,
        training.init_train_state(params, optimizer),
        training.make_update(loss, optimizer, ema_decay=budget.ema),
        sample_batch,
        data,
        budget=budget,
        **more,
    )


def load_params(
    run: Run,
    stage: str,
    init: Callable[[], Params],
    *,
    adversarial: bool = False,
) -> Params:
    """Averaged parameters of a stage, or of the generator of an adversarial one.

    `init` makes parameters of the same shapes; it is never run. Raises
    `CheckpointError` if there is no checkpoint, or it is of another stage or size.
    """
    check_stage(run, stage)
    found = checkpoint.restore_part(
        run.checkpoints(stage),
        {"ema_params": jax.eval_shape(init)},
        within="generator" if adversarial else None,
    )
    return found["ema_params"]


def restore_evaluator(
    folder: Path, value: dict[str, Any], init: Callable[[], Params]
) -> Params:
    """Parameters of an evaluator that must have been trained as the JSON `value` says.

    `init` makes parameters of the same shapes; it is never run. Raises
    `CheckpointError` if there are none, a `ValueError` with the field if it was trained
    otherwise.
    """
    found = checkpoint.load_config(folder)
    for field, expected in value.items():
        if found.get(field) != expected:
            raise ValueError(
                f"{folder}: field {field!r} is {found.get(field)!r}, expected "
                f"{expected!r}; delete the folder to train another evaluator"
            )
    return checkpoint.restore(folder, {"params": jax.eval_shape(init)})["params"]
