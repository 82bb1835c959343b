"""Stored results: what pages are made of, one JSON file per table.

A file is what an evaluation left behind (metrics.json, or a sweep's table.json), cut
to what tables and verdicts need. Beside its rows it declares its columns and says where
its numbers come from: `measured` (command, commit, date, hardware, versions) or, for
numbers whose file was not kept, `transcribed` (from which text). Files of further
trainings have the seed at the end of their name: x.json, x_seed1.json, ... Where the
last digits of one's clips differ, since they were rounded, or prepared on another
machine, `rounded` says why: checksums of its clips are then not compared.
"""

import dataclasses
import functools
import json
import re
from pathlib import Path
from typing import Any

from jaxmotion import files
from jaxmotion.evaluation import columns, table
from jaxmotion.evaluation.table import Cell
from reports import results
from reports.claims import Source
from reports.results import Found, Measured

FOLDER = Path(__file__).parents[1] / "results"

# Of an evaluation's file: what made it, and what else is kept.
_MEASURED = (
    *("command", "git_commit", "date", "cpu", "machine", "cores", "devices"),
    *("python", "jax", "jaxlib", "flax", "numpy", "torch", "onnxruntime"),
    "other_load",
)
_KEPT = (
    *("source", "arguments", "seeds", "data", "rounded"),
    *("training", "models", "minutes", "evaluator"),
)
_EITHER = ("measured", "transcribed")
_FIELDS = {*_KEPT, *_EITHER, "title", "interval", "columns", "rows", "names"}
_FIELDS |= {"command", "hardware", "notes"}
# Columns of a benchmark's report, by the last word of its metrics.
_BENCHMARKS = {"frames": "fps"}
_NAME = re.compile(r"[a-z0-9_]+/[a-z0-9_]+")


@dataclasses.dataclass(frozen=True, kw_only=True)
class Stored:
    """A stored table, with those of further trainings.

    Attributes:
      name: Its file below experiments/results, without the suffix.
      columns: By id.
      measured: Rows of all trainings, and what the files say about them.
    """

    name: str
    columns: dict[str, columns.Column]
    measured: Measured

    def title(self, row: str) -> str:
        """What a row is called in pages."""
        return self.measured.about.get("names", {}).get(row, row)

    def cells(self, row: str, column: str) -> list[Cell]:
        """One cell per training that has it.

        Raises:
          ValueError: if no training has the row, or no column is of that name.
        """
        trainings = [x for x in self.measured.trainings if x is not None]
        if column not in self.columns:
            known = ", ".join(self.columns)
            raise ValueError(f"{self.name}: no column {column!r}, expected of {known}")
        if not any(row in x.rows for x in trainings):
            known = "; ".join(self.measured.rows)
            raise ValueError(f"{self.name}: no row {row!r}, expected of {known}")
        cells = [x.rows.get(row, {}).get(column) for x in trainings]
        return [x for x in cells if x is not None]


def _where_from(path: Path, about: dict[str, Any]) -> None:
    found = [name for name in _EITHER if name in about]
    if len(found) != 1:
        raise ValueError(
            f"{path}: has {' and '.join(found) or 'neither'}, expected one of "
            f"{' and '.join(_EITHER)}"
        )
    measured = about.get("measured", {"command": "", "git_commit": ""})
    if lacks := {"command", "git_commit"} - measured.keys():
        raise ValueError(f"{path}: field 'measured' lacks {', '.join(sorted(lacks))}")


def _read_one(path: Path) -> Measured:
    found = results.read(path)
    if found is None:
        raise FileNotFoundError(f"{path}: no such stored result")
    if unknown := found.about.keys() - _FIELDS:
        raise ValueError(f"{path}: unknown fields {', '.join(sorted(unknown))}")
    for name in ("title", "columns"):
        if name not in found.about:
            raise ValueError(f"{path}: field {name!r} is missing")
    _where_from(path, found.about)
    used = {column for row in found.rows.values() for column in row}
    if missing := used - found.about["columns"].keys():
        raise ValueError(f"{path}: columns lack {', '.join(sorted(missing))}")
    if other := found.about.get("names", {}).keys() - found.rows.keys():
        raise ValueError(f"{path}: names of no row: {', '.join(sorted(other))}")
    return found


def paths_of(folder: Path, name: str) -> list[Path]:
    """The file of a stored table, and those of further trainings in order."""
    first = folder / f"{name}.json"
    number = re.compile(rf"{re.escape(first.stem)}_seed(\d+)\.json")
    further = {
        int(match[1]): path
        for path in first.parent.glob(f"{first.stem}_seed*.json")
        if (match := number.fullmatch(path.name))
    }
    return [first, *(further[seed] for seed in sorted(further))]


@functools.cache  # of all tables: a page after the other asks for each
def _parsed(paths: tuple[Path, ...], _: tuple[int, ...]) -> Measured:
    first, *again = map(_read_one, paths)
    return dataclasses.replace(first, again=tuple(again))


def read(folder: Path, name: str) -> Stored:
    """Reads a stored table with those of further trainings.

    Args:
      folder: Of all stored results.
      name: "system/table".

    Raises:
      OSError: if there is none, or it cannot be read.
      ValueError: if a file is damaged, or says nothing of where it comes from.
    """
    if not _NAME.fullmatch(name):
        raise ValueError(f"name: {name!r}, expected system/table in lower case")
    paths = tuple(path for path in paths_of(folder, name))
    stamps = tuple(x.stat().st_mtime_ns if x.exists() else 0 for x in paths)
    measured = _parsed(paths, stamps)
    try:
        declared = {
            id: columns.Column(id=id, **value)
            for id, value in measured.about["columns"].items()
        }
    except TypeError as error:
        raise ValueError(f"{paths[0]}: field 'columns': {error}") from None
    return Stored(name=name, columns=declared, measured=measured)


def found_for(folder: Path, sources: tuple[Source, ...]) -> Found:
    """What is stored of the tables that a paper's claims speak of; None for nothing."""
    return {
        source: read(folder, source.name).measured
        if (folder / f"{source.name}.json").exists()
        else None
        for source in sources
    }


def _declared(id: str) -> dict[str, Any]:
    column = columns.COLUMNS.get(_BENCHMARKS.get(id, id))
    if column is None:
        return {"title": id, "better": ""}
    names = ("title", "unit", "better", "kind")
    value = {name: getattr(column, name) for name in names}
    return {k: v for k, v in value.items() if v not in ("", "mean") or k == "better"}


def _nobodys(command: str) -> str:
    """A command without the folders of one machine: two parts of each whole path."""
    words = command.split(" ")
    return " ".join(
        "/".join(word.split("/")[-2:]) if word.startswith("/") else word
        for word in words
    )


def trimmed(measured: Measured, title: str) -> dict[str, Any]:
    """What is kept of an evaluation's file, as JSON."""
    about = measured.about
    used = dict.fromkeys(id for row in measured.rows.values() for id in row)
    made = {k: about[k] for k in _MEASURED if about.get(k) is not None}
    if lacks := {"command", "git_commit"} - made.keys():
        raise ValueError(f"{measured.path}: fields {', '.join(sorted(lacks))} missing")
    made["command"] = _nobodys(made["command"])
    kept = {k: about[k] for k in _KEPT if about.get(k)}
    if isinstance(given := kept.get("arguments"), dict):
        kept["arguments"] = {
            k: _nobodys(v) if isinstance(v, str) else v
            for k, v in given.items()
            if k not in ("run", "out", "data", "evaluator")
        }
    rows = {
        row: {
            column: {k: v for k, v in cell.items() if v is not None}
            for column, cell in cells.items()
            if cell["samples"]
        }
        for row, cells in table.to_json(measured.rows).items()
    }
    return {
        "title": title,
        **kept,
        "measured": made,
        "columns": {id: _declared(id) for id in used},
        "rows": _rounded(rows),
    }


def _rounded(rows: dict[str, Any]) -> dict[str, Any]:
    """Six digits: no table shows more, but of a million and more."""

    def short(value: Any) -> Any:
        return float(f"{value:.6g}") if isinstance(value, float) else value

    return {
        row: {
            column: {"value": None} | {k: short(v) for k, v in cell.items()}
            for column, cell in cells.items()
        }
        for row, cells in rows.items()
    }


def to_text(value: dict[str, Any]) -> str:
    """A stored table as JSON, one row of cells per line."""
    rows = value["rows"]
    text = json.dumps({**value, "rows": None}, indent=1, ensure_ascii=False)
    each = [
        f"  {json.dumps(row, ensure_ascii=False)}: {{\n"
        + ",\n".join(f"   {json.dumps(k)}: {json.dumps(v)}" for k, v in cells.items())
        + "\n  }"
        for row, cells in rows.items()
    ]
    return (
        text.replace('"rows": null', '"rows": {\n' + ",\n".join(each) + "\n }") + "\n"
    )


def _benchmark(path: Path) -> Measured | None:
    """What a benchmark's report measured: the last word of a metric is its column."""
    if not path.exists():
        return None
    whole = json.loads(path.read_text())
    if not isinstance(whole, dict) or "benchmark" not in whole:
        return None
    rows: dict[str, dict[str, Cell]] = {}
    for metric in whole["metrics"]:
        row, _, column = metric["name"].rpartition(" ")
        interval = {x: metric[x] for x in ("low", "high", "samples") if x in metric}
        rows.setdefault(row, {})[column] = Cell(value=metric["value"], **interval)
    about = whole["environment"] | {"arguments": whole["settings"]}
    return Measured(path=path, rows=rows, about=about)


def is_measured(path: Path) -> bool:
    """Whether a stored file is there that a command made, and not a text."""
    return path.is_file() and "measured" in json.loads(path.read_text())


def _joined(place: Path, before: dict[str, Any], new: dict[str, Any]) -> dict[str, Any]:
    """A stored table with the rows of another evaluation of the same kind.

    Raises:
      ValueError: names in what they differ, or the row that both have otherwise.
    """
    if "measured" not in before:
        raise ValueError(f"{place}: is no measured table, to which rows can be added")
    for field in ("seeds", "data", "evaluator", "arguments"):
        was, given = before.get(field), new.get(field)
        if field == "arguments":
            was, given = ({**(x or {}), "rows": None} for x in (was, given))
        if was != given:
            raise ValueError(
                f"{place}: field {field!r} is {was!r:.200}, but {given!r:.200} in what "
                "should be added"
            )
    rows = new["rows"]
    for row in before["rows"].keys() & rows.keys():
        if before["rows"][row] != rows[row]:
            raise ValueError(f"{place}: has another row {row!r}")
    added = [row for row in rows if row not in before["rows"]]
    if not added:
        raise ValueError(f"{place}: has all rows, expected one to add")
    command = (
        f"{before['measured']['command']}; at {new['measured']['git_commit'][:8]} "
        f"{', '.join(added)}: {new['measured']['command']}"
    )
    whole = {**before, "measured": {**before["measured"], "command": command}}
    for field in ("rows", "columns", "training", "models", "minutes"):
        whole[field] = {**new.get(field, {}), **before.get(field, {})}
    whole["rows"] = before["rows"] | {row: rows[row] for row in added}
    return whole


def keep(
    folder: Path, path: Path, name: str, title: str = "", *, add: bool = False
) -> Path:
    """Trims an evaluation's file and stores it.

    Args:
      folder: Of all stored results.
      path: The metrics.json, a sweep's table.json, or a benchmark's report.
      name: "system/table", or "system/table_seed1" for a further training.
      title: What it answers; "" for that of the file it replaces, or of the first
        training.
      add: Add its rows to those that are stored, instead of replacing them; both
        evaluations must be of the same seeds, data, evaluator and arguments.

    Returns:
      The file that was written.

    Raises:
      OSError: if it cannot be read or written.
      ValueError: if it is damaged or says not what made it.
    """
    if not _NAME.fullmatch(name):
        raise ValueError(f"name: {name!r}, expected system/table in lower case")
    found = _benchmark(path) or results.read(path)
    if found is None:
        raise FileNotFoundError(f"{path}: no such file")
    place = folder / f"{name}.json"
    first = folder / f"{re.sub(r'_seed[0-9]+$', '', name)}.json"
    told = place if place.exists() else first
    before = json.loads(told.read_text()) if told.exists() else {}
    title = title or before.get("title", "")
    if not title:
        raise ValueError("title: expected one for a table that is new")
    whole = trimmed(found, title)
    # What people wrote into the file that it replaces stays.
    for field in ("interval", "names", "notes"):
        if field in before and (field == "names" or "measured" in before):
            whole[field] = before[field]
    said = before.get("columns", {})
    whole["columns"] = {id: said.get(id, x) for id, x in whole["columns"].items()}
    if "names" in whole:
        whole["names"] = {k: v for k, v in whole["names"].items() if k in found.rows}
    if add:
        whole = _joined(place, before if place.exists() else {}, whole)
    files.write_text(place, to_text(whole))
    _read_one(place)
    return place
