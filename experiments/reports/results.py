"""Reads what evaluations left behind, and says what is damaged."""

import dataclasses
import itertools
import json
import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from jaxmotion.evaluation.table import Cell
from jaxmotion.learning import model_json
from reports.claims import Source

NOT_RECORDED = "not recorded"
# Arguments that trainings of one run may differ in: what they name is compared itself,
# and files that are stored do not have paths.
_FREE = ("run", "out", "data", "models", "evaluator", "rows", "tables", "seed")


def _seeds(about: dict[str, Any]) -> tuple[Any, ...]:
    found = (about.get("seeds") or {}).get("training", ())
    return tuple(found) if isinstance(found, list | tuple) else (found,)


@dataclasses.dataclass(frozen=True, kw_only=True)
class Measured:
    """The rows of a file, and what the file says about them.

    Attributes:
      path: The file.
      rows: Row names to column names to cells.
      about: Everything else in the file.
      again: The same of further trainings; None for one that is not there.
    """

    path: Path
    rows: dict[str, dict[str, Cell]]
    about: dict[str, Any]
    again: tuple["Measured | None", ...] = ()

    @property
    def trainings(self) -> tuple["Measured | None", ...]:
        """This one, followed by the further ones."""
        return (self, *self.again)

    @property
    def seeds(self) -> tuple[int, ...]:
        """Seeds of the training; none where the file does not say."""
        return _seeds(self.about)

    @property
    def settings(self) -> dict[str, Any]:
        """How it was evaluated: arguments that change the value of a cell."""
        given = self.about.get("arguments")
        given = given if isinstance(given, dict) else {}
        return {name: value for name, value in given.items() if name not in _FREE}

    @property
    def evaluator(self) -> tuple[str, str] | None:
        """Fingerprints of the evaluator and of the clips that distances refer to."""
        found = self.about.get("evaluator")
        names = ("fingerprint", "reference_clips")
        if not isinstance(found, dict) or not all(name in found for name in names):
            return None
        return tuple(str(found[name]) for name in names)


def is_whole(path: Path) -> bool:
    """Whether a file is there, and all that it measured was trained to its end."""
    if not path.is_file():
        return False
    stages = json.loads(path.read_text()).get("training") or {}
    return not any("of" in x for x in stages.values())


# What each source's file holds; None where there is no file.
Found = dict[Source, Measured | None]


def _fail(path: Path, field: str, found: Any, expected: str) -> None:
    shown = repr(found)
    shown = shown if len(shown) <= 60 else f"{shown[:57]}..."
    raise ValueError(f"{path}: field {field!r} is {shown}, expected {expected}")


def _object(path: Path, field: str, value: Any) -> dict[str, Any]:
    if not isinstance(value, dict):
        _fail(path, field, value, "an object")
    return value


def _number(path: Path, field: str, value: Any) -> float | None:
    """A number; None for null, as which tables write what is not finite."""
    if value is None:
        return None
    if isinstance(value, bool) or not isinstance(value, int | float):
        _fail(path, field, value, "a number or null")
    return float(value)


def _cell(path: Path, field: str, value: Any) -> Cell:
    value = _object(path, field, value)
    for name in ("value", "samples"):
        if name not in value:
            raise ValueError(f"{path}: field '{field}.{name}' is missing")
    numbers = {
        name: _number(path, f"{field}.{name}", value.get(name))
        for name in ("value", "low", "high")
    }
    samples = value["samples"]
    if isinstance(samples, bool) or not isinstance(samples, int) or samples < 0:
        _fail(path, f"{field}.samples", samples, "a number of samples")
    if numbers["value"] is None:
        return Cell(value=math.nan, samples=samples)
    return Cell(**numbers, samples=samples)


def read(path: Path) -> Measured | None:
    """Reads the metrics.json of an evaluation, or the table.json of a sweep.

    Args:
      path: The file.

    Returns:
      What was measured; None if there is no such file.

    Raises:
      OSError: if the file cannot be read.
      ValueError: if it is damaged; names the file and the field.
    """
    try:
        text = path.read_text()
    except FileNotFoundError:
        return None
    except UnicodeDecodeError as error:
        raise ValueError(f"{path}: not a text file: {error.reason}") from error
    try:
        whole = json.loads(text)
    except json.JSONDecodeError as error:
        raise ValueError(
            f"{path}: not JSON, line {error.lineno} column {error.colno}: {error.msg}"
        ) from error
    about = dict(_object(path, "(whole file)", whole))
    if "rows" not in about:
        raise ValueError(f"{path}: field 'rows' is missing")
    for name in ("training", "seeds"):
        _object(path, name, about.get(name) or {})
    if wrong := [x for x in _seeds(about) if type(x) is not int]:
        _fail(path, "seeds.training", wrong[0], "a whole number")
    rows = {
        row: {
            column: _cell(path, f"rows.{row}.{column}", cell)
            for column, cell in _object(path, f"rows.{row}", cells).items()
        }
        for row, cells in _object(path, "rows", about.pop("rows")).items()
    }
    return Measured(path=path, rows=rows, about=about)


def differ(one: Measured, other: Measured) -> str:
    """In what two files differ that should be of equal data and settings; or ""."""
    stages = [x.about.get("training") or {} for x in (one, other)]
    common = stages[0].keys() & stages[1].keys()
    found = [{name: x[name] for name in sorted(common)} for x in stages]
    data = [x.about.get("data") for x in (one, other)]
    if any("rounded" in x.about for x in (one, other)):
        # The same clips but for their last digits: checksums cannot tell.
        data = [None, None]
        found = [{k: v | {"files": None} for k, v in x.items()} for x in found]
    if trained := model_json.differences(*found):
        return trained
    if None not in data and data[0] != data[1]:
        return "data"
    both = one.settings and other.settings
    return model_json.differences(one.settings, other.settings) if both else ""


def read_trainings(paths: Sequence[Path]) -> Measured | None:
    """Reads one file of each training of a run.

    Args:
      paths: The file in the run folder of each training.

    Returns:
      The first, with the further ones; None if none is there.

    Raises:
      OSError: if a file cannot be read, or only the first is not there.
      ValueError: if one is damaged, or two are of the same seed, of other data, or
        evaluated otherwise; names the file.
    """
    first, *again = map(read, paths)
    there = [x for x in (first, *again) if x is not None]
    if first is None:
        if there:
            raise FileNotFoundError(f"{paths[0]}: no such file, but {there[0].path} is")
        return None
    for one, other in itertools.combinations(there, 2):
        if both := set(one.seeds) & set(other.seeds):
            raise ValueError(
                f"{other.path}: trained with seed {min(both)}, as {one.path} was: "
                "expected another training"
            )
        if found := differ(one, other):
            raise ValueError(
                f"{other.path}: differs from {one.path} in {found}: expected the same "
                "but for the seed of training"
            )
    return dataclasses.replace(first, again=tuple(again))


def _joined(about: dict[str, Any], names: tuple[str, ...]) -> str:
    found = []
    for name in names:
        value = about.get(name)
        if value is not None:
            shown = ", ".join(value) if isinstance(value, list) else str(value)
            found.append(f"{name} {shown}")
    return "; ".join(found) or NOT_RECORDED


def _data(about: dict[str, Any], evaluator: Any) -> str:
    if "source" in about:
        return str(about["source"])
    run = about.get("run")
    files = run.get("data", []) if isinstance(run, dict) else []
    # Data and license of what the evaluator was trained on, where nothing else says.
    told = evaluator.get("network") if isinstance(evaluator, dict) else None
    parts = [", ".join(str(x) for x in files), f"evaluator: {told}" if told else ""]
    return "; ".join(filter(None, parts)) or NOT_RECORDED


def _training(stages: Any) -> str:
    if not isinstance(stages, dict):
        return NOT_RECORDED
    lengths = {
        k: f"{x.get('steps')}" + (f" of {x['of']}" if "of" in x else "")
        for k, x in stages.items()
        if isinstance(x, dict) and x.get("steps")
    }
    parts = [f"{name} {steps} updates" for name, steps in lengths.items()]
    return ", ".join(parts) or NOT_RECORDED


def _evaluator(evaluator: Any) -> str:
    if not isinstance(evaluator, dict) or "fingerprint" not in evaluator:
        return NOT_RECORDED
    names = ("fingerprint", "origin", "reference_clips")
    return _joined(evaluator, names).removeprefix("fingerprint ")


def provenance(measured: Measured, *, evaluated: bool) -> dict[str, str]:
    """What a file says about how its rows came about.

    Args:
      measured: What was read of the file.
      evaluated: Whether an evaluator had a part in it.

    Returns:
      Texts by heading; "not recorded" for what it does not say.
    """
    about, evaluator = measured.about, measured.about.get("evaluator")
    arguments = about.get("arguments")
    seed = arguments.get("seed") if isinstance(arguments, dict) else None
    seeds = about.get("seeds", seed)
    return {
        "data": _data(about, evaluator),
        "seed": NOT_RECORDED if seeds is None else str(seeds),
        "training": _training(about.get("training")),
        "versions": _joined(about, ("python", "jax", "jaxlib", "flax", "numpy")),
        "hardware": _joined(about, ("cpu", "machine", "cores", "devices")),
        "git commit": str(about.get("git_commit") or NOT_RECORDED),
        "evaluator": _evaluator(evaluator) if evaluated else "none needed",
        "arguments": json.dumps(arguments) if arguments else NOT_RECORDED,
    }
