"""What a table of a paper is, and what an ordering that the paper claims is: data.

The data lie in experiments/papers, a file a system.
"""

import dataclasses
import tomllib
from pathlib import Path
from typing import Any

from jaxmotion.evaluation import columns
from jaxmotion.systems import registry

FOLDER = Path(__file__).parents[1] / "papers"

# As printed: a value, a value with the half width of its interval, or nothing.
Stated = float | tuple[float, float] | None


@dataclasses.dataclass(frozen=True, kw_only=True)
class Source:
    """A file of measured rows, and the commands that leave it behind.

    Attributes:
      run: Name of the run folder, and of the option that moves it.
      file: Path below that folder.
      commands: "{run}" stands for the folder.
      title: What it answers, for a first training that is stored.
      chosen_on: Seeds of trainings that its recipe was chosen on: they decide no claim.
      name: "system/table": its part of experiments/papers, and its file in
        experiments/results.
    """

    run: str
    file: str
    commands: tuple[str, ...]
    title: str = ""
    chosen_on: tuple[int, ...] = ()
    name: str = ""


@dataclasses.dataclass(frozen=True, kw_only=True)
class Column:
    """A metric of a table; what is not said here is as `columns.COLUMNS` declares it.

    Attributes:
      name: As the paper names it.
      here: Id of the column here.
      better: Where good values lie.
      kind: What its intervals are.
      evaluated: It is an evaluator's: values of two evaluators do not compare.
      scale: Factor from the unit here to the paper's.
      note: What differs from the paper's metric.
    """

    name: str
    here: str
    better: columns.Direction
    kind: columns.Kind = "mean"
    evaluated: bool = False
    scale: float = 1.0
    note: str = ""


def _column(value: dict[str, Any]) -> Column:
    declared = columns.COLUMNS[value["here"]]
    names = ("better", "kind", "evaluated")
    return Column(**{name: getattr(declared, name) for name in names} | value)


@dataclasses.dataclass(frozen=True, kw_only=True)
class Row:
    """A line of a table.

    Attributes:
      name: As the paper names it.
      here: As metrics.json names it; None for one that cannot be run here.
      paper: One value a column.
      source: Where it is measured; None for the table's source.
      reason: Why it cannot be run here.
      ours: The same by our recipe, as the metrics.json of the table's source names it;
        None where there is none.
    """

    name: str
    here: str | None
    paper: tuple[Stated, ...]
    source: Source | None = None
    reason: str = ""
    ours: str | None = None


@dataclasses.dataclass(frozen=True, kw_only=True)
class Claim:
    """Orderings within a column, all of which the paper claims or shows.

    Attributes:
      words: The claim.
      column: Name of the column.
      pairs: Rows (smaller, larger); with `toward`, (nearer, farther).
      where: Section or table of the paper.
      factor: The larger is at least so many times the smaller; None to compare
        differences.
      toward: Row that the nearer is nearer to; None to compare values.
      margin: The two rows differ by less, in the column's unit; None for an ordering.
    """

    words: str
    column: str
    pairs: tuple[tuple[str, str], ...]
    where: str
    factor: float | None = None
    toward: str | None = None
    margin: float | None = None

    @property
    def rows(self) -> tuple[str, ...]:
        """All rows that it speaks of, each once."""
        names = [name for pair in self.pairs for name in pair]
        return tuple(dict.fromkeys([*names, *filter(None, [self.toward])]))


@dataclasses.dataclass(frozen=True, kw_only=True)
class Table:
    """A table of a paper, as far as it can be run here.

    Attributes:
      paper: System.
      number: Number of the table; with a word where it is run in two ways.
      title: What it compares.
      columns: Metrics.
      rows: Methods.
      source: Where rows are measured.
      claims: What the paper says of it.
      note: What is other here: data, sizes, stand-ins.
    """

    paper: str
    number: str
    title: str
    columns: tuple[Column, ...]
    rows: tuple[Row, ...]
    source: Source
    claims: tuple[Claim, ...] = ()
    note: str = ""

    @property
    def name(self) -> str:
        """For headings and messages."""
        return f"{self.paper}, table {self.number}"

    @property
    def ours(self) -> "Table":
        """The table with the rows of our recipes in place of the published ones."""
        rows = [
            dataclasses.replace(x, here=x.ours, source=None) if x.ours else x
            for x in self.rows
        ]
        return dataclasses.replace(self, rows=tuple(rows))

    def column(self, name: str) -> Column:
        """The column of a name."""
        return next(x for x in self.columns if x.name == name)

    def row(self, name: str) -> Row:
        """The row of a name."""
        return next(x for x in self.rows if x.name == name)

    def source_of(self, row: Row) -> Source:
        """Where a row is measured."""
        return row.source or self.source

    @property
    def sources(self) -> tuple[Source, ...]:
        """Files of its rows, and of those by our recipes."""
        rows = [*self.rows, *self.ours.rows]
        return tuple(dict.fromkeys(map(self.source_of, rows)))

    def stated(self, row: str, column: str) -> Stated:
        """What the paper prints."""
        place = [x.name for x in self.columns].index(column)
        return self.row(row).paper[place]


@dataclasses.dataclass(frozen=True, kw_only=True)
class Absent:
    """What a paper reports and nothing here can run.

    Attributes:
      paper: System.
      what: Table, rows or claim.
      reason: Why not.
    """

    paper: str
    what: str
    reason: str


@dataclasses.dataclass(frozen=True, kw_only=True)
class Paper:
    """What a file of experiments/papers says.

    Attributes:
      system: That the paper describes.
      tables: Its tables, as far as they can be run here.
      absent: What it reports and nothing here can run.
    """

    system: registry.System
    tables: tuple[Table, ...]
    absent: tuple[Absent, ...]


def _pairs(claim: dict[str, Any]) -> tuple[tuple[str, str], ...]:
    """Comparisons (smaller, larger) of a claim as the file writes it.

    `rising`: rows whose values rise; `lowest` or `highest`: a row beside those in `of`;
    `alike`: two rows that differ by less than `margin`.
    """
    if "alike" in claim:
        return (tuple(claim.pop("alike")),)
    if "rising" in claim:
        rising = claim.pop("rising")
        return tuple(zip(rising, rising[1:], strict=False))
    if "lowest" in claim:
        own = claim.pop("lowest")
        return tuple((own, other) for other in claim.pop("of"))
    own = claim.pop("highest")
    return tuple((other, own) for other in claim.pop("of"))


def _stated(value: Any) -> Stated:
    return None if value == "–" else tuple(value) if isinstance(value, list) else value


def _row(value: dict[str, Any], sources: dict[str, Source], number: int) -> Row:
    paper = value.pop("paper", ["–"] * number)
    source = value.pop("source", None)
    return Row(
        here=value.pop("here", None),
        paper=tuple(map(_stated, paper)),
        source=None if source is None else sources[source],
        **value,
    )


def read_paper(system: registry.System) -> Paper:
    """Reads experiments/papers/<system>.toml.

    Raises:
      ValueError: if a field is missing, unknown or names what is not there; names the
        file.
    """
    path = FOLDER / f"{system.name}.toml"
    whole = tomllib.loads(path.read_text())
    try:
        sources = {
            name: Source(
                name=f"{system.name}/{name}",
                **value
                | {key: tuple(value.get(key, ())) for key in ("commands", "chosen_on")},
            )
            for name, value in whole.pop("source").items()
        }
        known = {k: _column(value) for k, value in whole.pop("column").items()}
        tables = []
        for value in whole.pop("table"):
            names, claims = value.pop("columns"), value.pop("claims", [])
            rows = [_row(x, sources, len(names)) for x in value.pop("rows")]
            table = Table(
                paper=system.title,
                source=sources[value.pop("source")],
                columns=tuple(known[name] for name in names),
                rows=tuple(rows),
                claims=tuple(Claim(pairs=_pairs(x), **x) for x in claims),
                **value,
            )
            tables.append(table)
        absent = [Absent(paper=system.title, **x) for x in whole.pop("absent", [])]
    except (KeyError, TypeError) as error:
        raise ValueError(f"{path}: {error}") from error
    return Paper(system=system, tables=tuple(tables), absent=tuple(absent))
