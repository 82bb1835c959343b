"""What a table of a paper is, and what an ordering that the paper claims is: data."""

import dataclasses
from typing import Literal

# As printed: a value, a value with the half width of its interval, or nothing.
Stated = float | tuple[float, float] | None


@dataclasses.dataclass(frozen=True, kw_only=True)
class Source:
    """A file of measured rows, and the commands that leave it behind.

    Attributes:
      run: Name of the run folder, and of the option that moves it.
      file: Path below that folder.
      commands: "{run}" stands for the folder.
    """

    run: str
    file: str
    commands: tuple[str, ...]


@dataclasses.dataclass(frozen=True, kw_only=True)
class Column:
    """A metric of a table.

    Attributes:
      name: As the paper names it.
      here: As metrics.json names it.
      better: Where good values lie; "real" is near those of recorded motion.
      kind: "mean" has an interval of 95 %, or none; "time" has the middle half of the
        calls, or none; "count" is a number of the samples.
      judged: A recognizer's: values of two recognizers do not compare.
      scale: Factor from the unit here to the paper's.
      note: What differs from the paper's metric.
    """

    name: str
    here: str
    better: Literal["lower", "higher", "real"]
    kind: Literal["mean", "time", "count"] = "mean"
    judged: bool = False
    scale: float = 1.0
    note: str = ""


@dataclasses.dataclass(frozen=True, kw_only=True)
class Row:
    """A line of a table.

    Attributes:
      name: As the paper names it.
      here: As metrics.json names it; None for one that cannot be run here.
      paper: One value a column.
      source: Where it is measured; None for the table's source.
      reason: Why it cannot be run here.
    """

    name: str
    here: str | None
    paper: tuple[Stated, ...]
    source: Source | None = None
    reason: str = ""


@dataclasses.dataclass(frozen=True, kw_only=True)
class Claim:
    """Orderings within a column, all of which the paper claims or shows.

    Attributes:
      words: The claim.
      column: Name of the column.
      pairs: Rows (smaller, larger); with `toward`, (nearer, farther).
      where: Section or table of the paper.
      factor: The larger is at least so many times the smaller.
      toward: Row that the nearer is nearer to; None to compare values.
    """

    words: str
    column: str
    pairs: tuple[tuple[str, str], ...]
    where: str
    factor: float = 1.0
    toward: str | None = None

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
      number: Of the table; with a word where it is run in two ways.
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

    def column(self, name: str) -> Column:
        """The column of a name."""
        return next(x for x in self.columns if x.name == name)

    def row(self, name: str) -> Row:
        """The row of a name."""
        return next(x for x in self.rows if x.name == name)

    def source_of(self, row: Row) -> Source:
        """Where a row is measured."""
        return row.source or self.source

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


def chain(*names: str) -> tuple[tuple[str, str], ...]:
    """Pairs of neighbors of rows whose values rise.

    Args:
      names: Rows, the smallest first.

    Returns:
      The pairs.
    """
    return tuple(zip(names, names[1:], strict=False))


def below(name: str, others: tuple[str, ...]) -> tuple[tuple[str, str], ...]:
    """Pairs of a row that is smaller (nearer) than each of others.

    Args:
      name: The row.
      others: The others.

    Returns:
      The pairs.
    """
    return tuple((name, other) for other in others)


def above(name: str, others: tuple[str, ...]) -> tuple[tuple[str, str], ...]:
    """Pairs of a row that is larger (farther) than each of others.

    Args:
      name: The row.
      others: The others.

    Returns:
      The pairs.
    """
    return tuple((other, name) for other in others)
