"""The report as Markdown."""

import math
from collections.abc import Iterable

import numpy as np

from jaxmotion.evaluation import columns, sequential
from jaxmotion.evaluation.statistics import Spread
from jaxmotion.evaluation.table import Cell
from reports import verdicts
from reports.claims import Absent, Claim, Column, Row, Source, Stated, Table
from reports.results import Found, provenance

# Command lines that leave a source behind.
Commands = dict[Source, tuple[str, ...]]
Decided = list[tuple[Table, Claim, verdicts.Decision]]


def number(value: float) -> str:
    """Three digits, or whole thousands.

    Args:
      value: Finite.

    Returns:
      The text.
    """
    # What three digits would round up to a thousand, too.
    return f"{value:,.0f}" if abs(value) >= 999.5 else f"{value:.3g}"


def stated(value: Stated) -> str:
    """What the paper prints.

    Args:
      value: With or without the half width of its interval.

    Returns:
      The text.
    """
    if value is None:
        return "–"
    return f"{value[0]:g} ± {value[1]:g}" if isinstance(value, tuple) else f"{value:g}"


def measured(cell: Cell, column: Column) -> str:
    """A value with its interval and number of samples.

    Args:
      cell: The value.
      column: Its column.

    Returns:
      The text.
    """
    if not math.isfinite(cell.value):
        return f"not finite (n={cell.samples})"
    if column.kind == "count":
        return f"{number(cell.value)} of {cell.samples}"
    text = number(cell.value)
    if cell.low is not None and cell.high is not None:
        text += f" [{number(cell.low)}, {number(cell.high)}]"
    return f"{text} (n={cell.samples})"


def over_trainings(spread: Spread | None) -> str:
    """Mean over trainings with its interval; "" for one training."""
    if spread is None:
        return ""
    if not math.isfinite(spread.mean):
        return f"not finite in some of {spread.count} trainings"
    low, high = map(number, verdicts.interval(spread))
    return f"{number(spread.mean)} [{low}, {high}] of {spread.count} trainings"


def both(table: Table, row: Row, column: Column, found: Found) -> str:
    """A value over trainings, and that of the first; "" if it was not measured."""
    cell = verdicts.cell_of(table, row, column, found)
    spread = verdicts.over_trainings(table, row, column, found)
    one = "" if cell is None else measured(cell, column)
    if spread is None:
        return one
    return "<br>".join(filter(None, [over_trainings(spread), one and f"first: {one}"]))


def difference(claim: Claim, pair: tuple[str, str], values: np.ndarray) -> str:
    """By how much a comparison holds over trainings; "" of fewer than two."""
    if len(values) < 2:
        return ""
    first, second = pair
    where = f"distances to {claim.toward}, " if claim.toward else ""
    ends, less = sequential.interval(values), "less"
    if claim.factor is not None:
        ends, less = claim.factor * np.exp(ends), "over"
    mean, low, high = map(number, ends)
    return (
        f"{where}{second} {less} {first}: {mean} [{low}, {high}] of {len(values)} "
        "trainings"
    )


def left_open(claim: Claim, decision: verdicts.Decision) -> str:
    """How far apart rows may be that all trainings there are to be left open; or "".

    Their mean difference is told in deviations of a training, too.
    """
    if decision.trainings < verdicts.MAX_TRAININGS:
        return ""
    texts = []
    for pair in decision.open:
        values = decision.differences[pair]
        size = abs(values.mean()) / values.std(ddof=1) if values.std() else 0.0
        text = difference(claim, pair, values)
        texts.append(f"{text}, {number(size)} deviations of one")
    return "; ".join(texts)


def table_lines(header: Iterable[str], rows: Iterable[Iterable[str]]) -> list[str]:
    """Lines of a Markdown table.

    Args:
      header: Titles of the columns.
      rows: Texts of each row.

    Returns:
      The lines.
    """

    def line(cells: Iterable[str]) -> str:
        safe = (cell.replace("|", "\\|").replace("\n", " ") for cell in cells)
        return f"| {' | '.join(safe)} |"

    header = list(header)
    return [line(header), "|---" * len(header) + "|", *map(line, rows)]


def why_not(table: Table, row: Row, found: Found) -> str:
    """Why a row has no values.

    Args:
      table: The table.
      row: One of its rows.
      found: All that was measured.

    Returns:
      The reason; "" if the row was measured.
    """
    if row.here is None:
        return f"not run: {row.reason}"
    there = found.get(table.source_of(row))
    if there is None or not any(x and row.here in x.rows for x in there.trainings):
        return "not run"
    return ""


def _row(table: Table, row: Row, found: Found) -> list[str]:
    missing, cells = why_not(table, row, found), []
    for column, paper in zip(table.columns, row.paper, strict=True):
        here = both(table, row, column, found) or ("" if missing else "–")
        cells.append("<br>".join(filter(None, [f"*{stated(paper)}*", here])))
    name = f"**{row.name}**" + (f"<br>`{row.here}`" if row.here else "")
    return [name + (f"<br>{missing}" if missing else ""), *cells]


def _block(commands: tuple[str, ...]) -> list[str]:
    return ["```bash", *commands, "```", ""]


def _sources(table: Table, found: Found, commands: Commands) -> list[str]:
    lines = []
    sources = dict.fromkeys(
        table.source_of(row) for row in table.rows if row.here is not None
    )
    for source in sources:
        there = found.get(source)
        rows = [r for r in table.rows if r.here and table.source_of(r) == source]
        names = ", ".join(row.name for row in rows)
        lacks = [r.name for r in rows if why_not(table, r, found)]
        if there is None:
            lines += [
                f"{names}: **not run**. To be made by",
                "",
                *_block(commands[source]),
            ]
            continue
        lacking = f" **Not run** in it: {', '.join(lacks)}." if lacks else ""
        paths = ", ".join(f"`{x.path}`" for x in filter(None, there.trainings))
        data = provenance(there, evaluated=False)["data"]
        lines += [f"{names}: {paths}. Data: {data}.{lacking} With the defaults:", ""]
        lines += _block(commands[source])
    return lines


def _values(table: Table, claim: Claim, found: Found) -> tuple[str, str]:
    """What the paper prints of a claim's rows, and what was measured."""
    column, paper, here = table.column(claim.column), [], []
    for name in claim.rows:
        paper.append(f"{name} {stated(table.stated(name, claim.column))}")
        if text := both(table, table.row(name), column, found):
            here.append(f"{name} {text}")
    return "<br>".join(paper), "<br>".join(here) or "–"


def _claims(table: Table, decided: Decided, found: Found) -> list[str]:
    rows = []
    for where, claim, decision in decided:
        if where is table:
            texts = [f"**{decision.verdict}**", decision.reason]
            texts += [
                difference(claim, pair, values)
                for pair, values in decision.differences.items()
            ]
            rows.append(
                [f"{claim.words} ({claim.where})", *_values(table, claim, found)]
                + ["<br>".join(filter(None, texts))]
            )
    return table_lines(("claim", "paper", "here", "verdict"), rows) if rows else []


def section(
    table: Table,
    decided: Decided,
    found: Found,
    commands: Commands,
) -> list[str]:
    """Lines of one table: values, sources and claims.

    Args:
      table: The table.
      decided: All claims.
      found: All that was measured.
      commands: What makes each source.

    Returns:
      The lines.
    """
    header = [f"{x.name} {columns.ARROWS[x.better]}" for x in table.columns]
    notes = [f"{x.name}: {x.note}" for x in table.columns if x.note]
    lines = [f"### {table.name}: {table.title}", "", table.note, ""]
    lines += table_lines(
        ("paper's row", *header), [_row(table, row, found) for row in table.rows]
    )
    lines += ["", "Here: " + "; ".join(notes) + ".", ""]
    lines += _sources(table, found, commands)
    return lines + [*_claims(table, decided, found), ""]


def counts(decided: Decided) -> dict[str, str]:
    """Number of claims of each verdict, in words, such as "3 reproduced".

    Those that the last training left open are counted again, in brackets.
    """
    found = {
        name: f"{sum(x.verdict == name for _, _, x in decided)} {name}"
        for name in verdicts.Verdict.__args__
    }
    last = verdicts.MAX_TRAININGS
    ended = sum(x.verdict == "not decided" and x.trainings >= last for *_, x in decided)
    if ended:
        found["not decided"] += f" ({ended} of them after {last} trainings)"
    return found


def summary(decided: Decided) -> list[str]:
    """Lines of all claims with their verdicts, counted.

    Args:
      decided: All claims.

    Returns:
      The lines.
    """
    rows = [
        [table.name, claim.words, f"**{x.verdict}**"]
        + ["–" if x.verdict == "not run" else str(x.trainings)]
        for table, claim, x in decided
    ]
    head = f"{len(decided)} claims: {', '.join(counts(decided).values())}."
    titles = ("table", "claim", "verdict", "trainings")
    return [head, "", *table_lines(titles, rows), ""]


def absent_lines(absent: Iterable[Absent]) -> list[str]:
    """Lines of what cannot be run.

    Args:
      absent: All of it.

    Returns:
      The lines.
    """
    rows = [(x.paper, x.what, x.reason) for x in absent]
    return [*table_lines(("paper", "what", "why not"), rows), ""]


def source_lines(found: Found, evaluated: set[Source]) -> list[str]:
    """Lines of where every file came from.

    Args:
      found: All that was measured.
      evaluated: Sources with values of an evaluator.

    Returns:
      The lines.
    """
    lines = []
    for source, there in found.items():
        if there is None:
            lines += [f"- {source.run}, {source.file}: not run"]
            continue
        for one in filter(None, there.trainings):
            lines += [f"- `{one.path}`"]
            told = provenance(one, evaluated=source in evaluated)
            lines += [f"  - {name}: {text}" for name, text in told.items()]
    return [*lines, ""]
