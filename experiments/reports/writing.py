"""Writes report.md and report.json."""

import json
import math
from pathlib import Path
from typing import Any

from jaxmotion import files
from jaxmotion.evaluation.statistics import Spread
from jaxmotion.systems import registry
from reports import markdown, verdicts
from reports.claims import FOLDER, Column, Table, read_paper
from reports.results import Found, provenance

PAPERS = tuple(
    read_paper(system)
    for system in registry.SYSTEMS.values()
    if (FOLDER / f"{system.name}.toml").exists()
)
TABLES = tuple(table for paper in PAPERS for table in paper.tables)
ABSENT = tuple(what for paper in PAPERS for what in paper.absent)
# Every file that a table needs, in the tables' order.
SOURCES = tuple(dict.fromkeys(x for table in TABLES for x in table.sources))
# Those with values of an evaluator.
EVALUATED = {
    source
    for table in TABLES
    for source in table.sources
    if any(column.evaluated for column in table.columns)
}


def _spread_json(spread: Spread | None) -> dict[str, Any] | None:
    if spread is None or not math.isfinite(spread.mean):
        return None
    low, high = verdicts.interval(spread)
    mean = float(spread.mean)
    return {"mean": mean, "low": low, "high": high, "trainings": spread.count}


def _table_json(table: Table, found: Found) -> dict[str, Any]:
    def cell(row: Any, column: Column) -> dict[str, Any]:
        stated = table.stated(row.name, column.name)
        here = verdicts.cell_of(table, row, column, found)
        finite = here is not None and math.isfinite(here.value)
        return {
            "paper": verdicts.printed(stated),
            "paper half width": stated[1] if isinstance(stated, tuple) else None,
            "here": None
            if here is None
            else {
                "value": here.value if finite else None,
                "low": here.low,
                "high": here.high,
                "samples": here.samples,
            },
            "over trainings": _spread_json(
                verdicts.over_trainings(table, row, column, found)
            ),
        }

    return {
        "paper": table.paper,
        "table": table.number,
        "title": table.title,
        "note": table.note,
        "rows": {
            row.name: {
                "here": row.here,
                "file": (source := table.source_of(row)).file,
                "run": source.run,
                "why not": markdown.why_not(table, row, found) or None,
                "cells": {x.name: cell(row, x) for x in table.columns},
            }
            for row in table.rows
        },
    }


def _json(
    decided: markdown.Decided, found: Found, commands: markdown.Commands, made: Any
) -> dict[str, Any]:
    return {
        "written with": made,
        "rule": verdicts.RULE,
        "claims": [
            {
                "table": table.name,
                "claim": claim.words,
                "where": claim.where,
                "column": claim.column,
                "pairs": claim.pairs,
                "factor": claim.factor,
                "toward": claim.toward,
                "margin": claim.margin,
                "verdict": decision.verdict,
                "reason": decision.reason,
                "trainings": decision.trainings,
                "differences": [
                    {"pair": pair, "of each training": values.tolist()}
                    for pair, values in decision.differences.items()
                ],
            }
            for table, claim, decision in decided
        ],
        "tables": [_table_json(table, found) for table in TABLES],
        "cannot be run": [vars(what) for what in ABSENT],
        "sources": [
            {"run": source.run, "file": source.file, "command": commands[source]}
            | {"found": None if there is None else str(there.path)}
            | (
                {}
                if there is None
                else provenance(there, evaluated=source in EVALUATED)
            )
            for source, there in found.items()
        ],
    }


def _lines(
    decided: markdown.Decided,
    found: Found,
    commands: markdown.Commands,
    made: Any,
) -> list[str]:
    lines = ["# The papers' tables, and what is measured here", ""]
    lines += [
        "In tables the paper's value stands above in italics, and below it what was "
        "measured here: where there are several trainings their mean, with its 95 % "
        "interval over these; and the first training's value, with its interval over "
        "replications and number of samples. Columns are to be lower ↓, higher ↑, or "
        "near recorded motion →.",
        "",
        "How claims are decided:",
        "",
        *(f"- {sentence}" for sentence in verdicts.RULE),
        "",
        "## Claims",
        "",
        *markdown.summary(decided),
    ]
    for paper in PAPERS:
        lines += [f"## {paper.system.title}", "", f"{paper.system.paper}.", ""]
        for table in paper.tables:
            lines += markdown.section(table, decided, found, commands)
    lines += ["## What cannot be run here", "", *markdown.absent_lines(ABSENT)]
    lines += ["## Where the values come from", ""]
    lines += markdown.source_lines(found, EVALUATED)
    shown = "; ".join(f"{name} {text}" for name, text in made.items())
    return [*lines, f"This report was written with: {shown}."]


def write(
    out: Path, found: Found, commands: markdown.Commands, made: dict[str, Any]
) -> markdown.Decided:
    """Decides all claims and writes the report.

    Args:
      out: Folder; it must exist.
      found: All that was measured.
      commands: What makes each source.
      made: Versions, commit and date of this report.

    Returns:
      Tables, claims and decisions.
    """
    decided = [
        (table, claim, verdicts.decide(table, claim, found))
        for table in TABLES
        for claim in table.claims
    ]
    whole = _json(decided, found, commands, made)
    files.write_text(out / "report.json", json.dumps(whole, indent=1))
    lines = _lines(decided, found, commands, made)
    files.write_text(out / "report.md", "\n".join(lines) + "\n")
    return decided
