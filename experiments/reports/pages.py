"""Pages of Markdown whose tables, plots and figures come from stored results.

A page says between markers, which no reader sees, what stands there:

    <!-- table camdm/steering
    rows = ["a row", "another"]
    columns = ["foot_slide", "jerk"]
    -->
    ... written here ...
    <!-- end -->

`table` shows rows and columns of a stored table ("system/table | row" is another's),
and as `less` the mean difference of two rows within each training, with its 95 %
interval; `grid` cells, one by one, where a page needs other rows and columns than the
file has ("{}" stands for each of `across`);
`plot` draws a column of chosen rows beside the page, or, with `panels`, quality over
time beside peers' times; `claims` the papers' claims with verdicts; `absent` what
nobody here can measure; `headline` the rows of headline.toml. A
figure within a sentence is <!-- = camdm/steering | row | column -->0.1<!-- / -->.
"""

import dataclasses
import hashlib
import json
import math
import os
import re
import tomllib
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any

import numpy as np

from jaxmotion import files
from jaxmotion.evaluation import columns, statistics
from jaxmotion.evaluation.table import Cell
from reports import markdown, stored, verdicts, writing
from reports.claims import Claim, Table
from reports.stored import Stored

ROOT = Path(__file__).parents[2]
_BLOCK = re.compile(
    r"(<!-- (table|grid|plot|claims|absent|headline)\b(.*?)-->\n).*?(<!-- end -->)",
    re.DOTALL,
)
_FIGURE = re.compile(r"(<!--\s=\s(.*?)\s-->).*?(<!--\s/\s-->)", re.DOTALL)
_PATTERNS = (
    "README.md",
    "experiments/README.md",
    "experiments/results/*.md",
    "experiments/guides/*.md",
    "benchmarks/README.md",
    "jaxmotion/assets/*.md",
)
_NOTHING = "–"
SHOWN = 3  # trainings of which each value is shown


def pages(root: Path = ROOT) -> list[Path]:
    """All pages that may have markers."""
    return [path for pattern in _PATTERNS for path in sorted(root.glob(pattern))]


# --- figures ------------------------------------------------------------------------


def _mean(spread: statistics.Spread) -> Cell:
    """A mean over trainings with its 95 % interval."""
    low, high = verdicts.interval(spread)
    return Cell(value=float(spread.mean), low=low, high=high)


def _decimals(value: float) -> int:
    text = f"{value:.3g}"
    return 0 if "e" in text else len(text.partition(".")[2])


def text_of(cells: list[Cell], column: columns.Column, *, interval: bool = True) -> str:
    """A cell as pages show it.

    One training: its value with the interval. Up to three: the value of each, by seed.
    More: the mean over trainings with its 95 % interval.
    """
    if not cells:
        return _NOTHING
    if column.kind == "count" and cells[0].samples:
        total, samples = (
            sum(x) for x in zip(*((x.value, x.samples) for x in cells), strict=True)
        )
        return f"{markdown.number(total)} of {samples}"
    if len(cells) > SHOWN and all(math.isfinite(x.value) for x in cells):
        values = np.array([x.value for x in cells])
        if np.ptp(values):
            return text_of(
                [_mean(statistics.spread(values))], column, interval=interval
            )
    if len(cells) > 1 and len({x.value for x in cells}) > 1:
        return " / ".join(
            markdown.number(x.value) if math.isfinite(x.value) else _NOTHING
            for x in cells
        )
    cell = cells[0]
    if not math.isfinite(cell.value):
        return _NOTHING
    if not interval or cell.low is None or cell.high is None:
        return markdown.number(cell.value)
    # As many decimals as show the ends to a tenth of the interval's width, but of the
    # value at most four digits.
    near = (cell.high - cell.low) / 10
    ends = (cell.low, cell.high)
    enough = (d for d in range(7) if all(abs(round(x, d) - x) <= near for x in ends))
    digits = max(_decimals(cell.value), next(enough, 6))
    if cell.value:
        digits = max(0, min(digits, 3 - math.floor(math.log10(abs(cell.value)))))
    text, low, high = (f"{x:,.{digits}f}" for x in (cell.value, *ends))
    return f"{text} [{low}, {high}]"


@dataclasses.dataclass(frozen=True)
class Store:
    """Looks up stored figures.

    Attributes:
      folder: Of all stored results.
    """

    folder: Path

    def table(self, name: str) -> Stored:
        """A stored table."""
        return stored.read(self.folder, name)

    def figure(self, reference: str, *, interval: bool = False) -> str:
        """Text of "table | row | column", or with "| interval" at the end."""
        name, *place = (part.strip() for part in reference.split("|"))
        if len(place) == 3 and place[2] == "interval":
            interval, place = True, place[:2]
        if len(place) != 2:
            raise ValueError(f"{reference!r}, expected table | row | column")
        one = self.table(name)
        return text_of(one.cells(*place), one.columns[place[1]], interval=interval)


def header(column: columns.Column) -> str:
    """Words above a column: title, unit, and where good values lie."""
    arrow = columns.ARROWS[column.better]
    return f"{column.header} {arrow}".strip()


def _chosen(given: Any, all_: Iterable[str]) -> dict[str, str]:
    """Names, and what they are called where that is said."""
    if given is None:
        return dict.fromkeys(all_, "")
    return dict.fromkeys(given, "") if isinstance(given, list) else dict(given)


# --- blocks -------------------------------------------------------------------------


def _where_from(one: Stored, page: Path, folder: Path) -> list[str]:
    """A line below a table: its file, and what made it."""
    about = one.measured.about
    place = _relative(folder / f"{one.name}.json", page.parent)
    told = [f"[{one.name}.json]({place})"]
    if "measured" in about:
        made = about["measured"]
        told += [f"commit {made['git_commit'][:8]}", f"`{made['command']}`"]
        if (load := made.get("other_load") or 0.0) > 0.1:
            told += [f"other processes kept {load:g} cores busy meanwhile"]
    else:
        told += [f"transcribed from {about['transcribed']}"]
        told += [f"`{about['command']}`"] if "command" in about else []
    count = sum(x is not None for x in one.measured.trainings)
    shown = "values by seed" if count <= SHOWN else "means over them"
    told += [f"{count} trainings, {shown}"] if count > 1 else []
    told += [about["interval"]] if "interval" in about else []
    trainings = [x.about.get("minutes", {}) for x in one.measured.trainings if x]
    if "measured" in about and trainings[0]:  # a card's are not kept
        taken = {k: [x[k] for x in trainings if k in x] for k in trainings[0]}
        each = (f"{k} {np.mean(x):.3g}" for k, x in taken.items())
        told += [f"minutes of training: {', '.join(each)}"]
    return ["", f"<sub>{'; '.join(told)}</sub>"]


def _relative(path: Path, base: Path) -> str:
    return Path(os.path.relpath(path, base)).as_posix()


def _table(store: Store, name: str, options: dict[str, Any], page: Path) -> list[str]:
    one = store.table(name)
    rows = _chosen(options.get("rows"), one.measured.rows)
    shown = _chosen(options.get("columns"), one.columns)
    interval = options.get("interval", True)
    titles = [title or header(one.columns[id]) for id, title in shown.items()]
    bold = options.get("bold", [])
    lines, tables = [], {name: one}
    for key, title in rows.items():
        where, _, row = key.rpartition(" | ")
        own = tables.setdefault(where or name, store.table(where or name))
        title = title or own.title(row)
        cells = [
            text_of(own.cells(row, id), one.columns[id], interval=interval)
            for id in shown
        ]
        lines.append([f"**{title}**" if key in bold else title, *cells])
    for title, pair in options.get("less", {}).items():
        cells = [_difference(one, *pair, one.columns[id]) for id in shown]
        lines.append([title, *cells])
    made = markdown.table_lines(["", *titles], lines)
    if options.get("source", True):
        for own in tables.values():
            made += _where_from(own, page, store.folder)
    return made


def _difference(one: Stored, row: str, other: str, column: columns.Column) -> str:
    """The mean difference of two rows over trainings that have both."""
    trainings = [x.rows for x in one.measured.trainings if x is not None]
    pairs = [
        [rows.get(name, {}).get(column.id) for name in (row, other)]
        for rows in trainings
    ]
    own = np.array([a.value - b.value for a, b in pairs if a and b])
    if own.size < 2 or not np.isfinite(own).all():
        return _NOTHING
    return text_of(
        [_mean(statistics.spread(own))], dataclasses.replace(column, kind="mean")
    )


def _grid(store: Store, name: str, options: dict[str, Any], page: Path) -> list[str]:
    one, across = store.table(name), options["across"]
    across = dict.fromkeys(across, "") if isinstance(across, list) else dict(across)
    lines = []
    for title, template in options["rows"].items():
        row, _, column = (part.strip() for part in template.rpartition("|"))
        cells = []
        for key in across:
            place = row.replace("{}", key)
            known = any(place in x.rows for x in one.measured.trainings if x)
            cells.append(
                text_of(
                    one.cells(place, column) if known else [],
                    one.columns[column],
                    interval=options.get("interval", True),
                )
            )
        lines.append([title, *cells])
    titles = [title or key for key, title in across.items()]
    made = markdown.table_lines([options.get("corner", ""), *titles], lines)
    if options.get("source", True):
        made += _where_from(one, page, store.folder)
    return made


def _plot(store: Store, name: str, options: dict[str, Any], page: Path) -> list[str]:
    path = page.parent / options["file"]
    return [f"![{options['title']}]({_relative(path, page.parent)})"]


def _claims(store: Store, name: str, options: dict[str, Any], page: Path) -> list[str]:
    """The claims of one system, each with the paper's values, ours and the verdict."""
    paper = next(x for x in writing.PAPERS if x.system.name == name)
    found = found_of(store, paper.system.name)
    lines = []
    for one in paper.tables:
        for claim in one.claims:
            own = "–"
            if any(one.row(name).ours for name in claim.rows):
                own = _verdict(one.ours, claim, found)
            lines.append([*_claim(one, claim, found), own])
    titles = ("table", "claim", "paper", "here", "verdict", "our variant")
    return markdown.table_lines(titles, lines)


def found_of(store: Store, system: str) -> stored.Found:
    """Stored trainings of a paper's tables."""
    paper = next(x for x in writing.PAPERS if x.system.name == system)
    sources = dict.fromkeys(x for table in paper.tables for x in table.sources)
    return stored.found_for(store.folder, tuple(sources))


def _verdict(one: Table, claim: Claim, found: stored.Found) -> str:
    """A verdict, and of how many trainings it is."""
    decision = verdicts.decide(one, claim, found)
    if not decision.trainings or decision.verdict == "not run":
        return decision.verdict
    sources = {one.source_of(one.row(name)) for name in claim.rows}
    files_ = [x for source in sources if (x := found.get(source))]
    if any(len(x.seeds) > 1 for x in files_):
        return f"{decision.verdict}: single trainings were not kept"
    several = "s" * (decision.trainings > 1)
    if text := markdown.left_open(claim, decision):
        return f"{decision.verdict}: {text}"
    return f"{decision.verdict}, {decision.trainings} training{several}"


def _claim(one: Table, claim: Claim, found: stored.Found) -> list[str]:
    column, paper, here = one.column(claim.column), [], []
    for name in claim.rows:
        row = one.row(name)
        short = name.removesuffix(" (not in the paper)")
        paper.append(f"{short} {markdown.stated(one.stated(name, claim.column))}")
        cells = [x for x in verdicts.cells_of(one, row, column, found) if x]
        spread = verdicts.over_trainings(one, row, column, found)
        if spread is not None and math.isfinite(spread.mean):
            here.append(f"{short} {text_of([_mean(spread)], _plain(column))}")
        elif cells:
            here.append(f"{short} {text_of(cells[:1], _plain(column))}")
    return [
        f"{one.number}, {claim.column}",
        claim.words,
        "; ".join(paper),
        "; ".join(here) or _NOTHING,
        _verdict(one, claim, found),
    ]


def _plain(column: Any) -> columns.Column:
    return columns.Column(id=column.here, title=column.name, kind=column.kind)


def _absent(store: Store, name: str, options: dict[str, Any], page: Path) -> list[str]:
    return markdown.absent_lines(writing.ABSENT)[:-1]


def _counts(store: Store) -> list[str]:
    """How many claims have each verdict: in all, then by system."""
    decided = {}
    for paper in writing.PAPERS:
        found = found_of(store, paper.system.name)
        decided[paper.system] = [
            (table, claim, verdicts.decide(table, claim, found))
            for table in paper.tables
            for claim in table.claims
        ]

    def counted(some: markdown.Decided) -> str:
        return f"{len(some)} claims: {', '.join(markdown.counts(some).values())}."

    return [counted(sum(decided.values(), [])), ""] + [
        f"* [{system.title}](#{system.name}): {counted(some)}"
        for system, some in decided.items()
    ]


def _headline(
    store: Store, name: str, options: dict[str, Any], page: Path
) -> list[str]:
    path = store.folder / "headline.toml"
    whole = tomllib.loads(path.read_text(encoding="utf-8"))

    def figure(match: re.Match[str]) -> str:
        return _counts(store)[0] if match[1] == "claims" else store.figure(match[1])

    def filled(text: str) -> str:
        return re.sub(r"\{(.*?)\}", figure, text)

    lines = [
        [filled(row[k]) for k in ("what", "here", "beside")] for row in whole["row"]
    ]
    return markdown.table_lines(("What", "Here", "Beside it"), lines)


_BLOCKS: dict[str, Callable[..., list[str]]] = {
    "table": _table,
    "grid": _grid,
    "plot": _plot,
    "claims": _claims,
    "absent": _absent,
    "headline": _headline,
}


# --- pages --------------------------------------------------------------------------


def _options(text: str) -> tuple[str, dict[str, Any]]:
    """Name and options after the word of a marker."""
    name, _, rest = text.strip().partition("\n")
    return name.strip(), tomllib.loads(rest)


def written(page: Path, text: str, store: Store) -> str:
    """The text of a page with everything between its markers written anew.

    Raises:
      ValueError: if a marker names what is not stored; names the page and the marker.
    """

    def block(match: re.Match[str]) -> str:
        begin, kind, more, end = match.groups()
        try:
            name, options = _options(more)
            if kind == "claims" and not name:
                lines = _counts(store)
            else:
                lines = _BLOCKS[kind](store, name, options, page)
        except (ValueError, KeyError, OSError, StopIteration) as error:
            raise ValueError(
                f"{page}: <!-- {kind}{more.splitlines()[0]}: {error}"
            ) from error
        # A comment right below a table would be one of its rows.
        below = [""] if lines[-1].startswith("|") else []
        return begin + "\n".join(["", *lines, *below, end])

    def figure(match: re.Match[str]) -> str:
        begin, reference, end = match.groups()
        try:
            return begin + store.figure(reference) + end
        except (ValueError, OSError) as error:
            raise ValueError(f"{page}: <!-- = {reference}: {error}") from error

    return _FIGURE.sub(figure, _BLOCK.sub(block, text))


def plots_of(page: Path, text: str) -> list[tuple[str, dict[str, Any]]]:
    """Stored table and options of each plot of a page."""
    return [_options(match[3]) for match in _BLOCK.finditer(text) if match[2] == "plot"]


def _ends(one: Stored, row: str, column: str, times: float = 1.0) -> list[list[float]]:
    """Value, lower and upper end of each training whose value is finite."""
    return [
        [float(f"{times * (cell.value if x is None else x):.6g}") for x in ends]
        for cell in one.cells(row, column)
        if math.isfinite(cell.value)
        for ends in [(cell.value, cell.low, cell.high)]
    ]


def _costs(store: Store, name: str, options: dict[str, Any]) -> dict[str, Any]:
    """What a plot of quality over time shows, as JSON; `name` is of the peers' times.

    Each panel has its own table and columns, and points by sampler.
    """
    peers, panels = store.table(name), []
    for panel in options["panels"]:
        one, times = store.table(panel["table"]), panel.get("times", 1.0)
        time, quality = (one.columns[panel[x]] for x in ("time", "quality"))
        points = {
            sampler: {
                label: [
                    _ends(one, row, time.id, times)[0],
                    _ends(one, row, quality.id)[0],
                ]
                for row, label in rows.items()
            }
            for sampler, rows in panel["points"].items()
        }
        panels.append(
            {
                "title": panel["title"],
                "xlabel": panel["label"],
                "ylabel": header(quality),
                "points": points,
                "data": _ends(one, panel["data"], quality.id)[0],
                "call": f"beside: {panel['peers']}, timed in turn",
                "peers": {
                    column.title: found[0][0]
                    for column in peers.columns.values()
                    if (found := _ends(peers, panel["peers"], column.id))
                },
            }
        )
    return {"title": options["title"], "panels": panels}


def _series(store: Store, name: str, options: dict[str, Any]) -> dict[str, Any]:
    """What a plot shows, as JSON: titles and (value, low, high) of each row."""
    if "panels" in options:
        return _costs(store, name, options)
    one, id = store.table(name), options["column"]
    rows = _chosen(options.get("rows"), one.measured.rows)
    shown = {
        title or one.title(row): _ends(one, row, id) for row, title in rows.items()
    }
    return {
        "label": header(one.columns[id]),
        "title": options["title"],
        "data": options.get("data", []),
        "log": options.get("log", False),
        "rows": shown,
    }


def _stamp(series: dict[str, Any]) -> str:
    return hashlib.sha256(json.dumps(series).encode()).hexdigest()[:16]


def _panel(plots: Any, panel: dict[str, Any]) -> Any:
    points = {
        sampler: {label: np.array(ends) for label, ends in rows.items()}
        for sampler, rows in panel["points"].items()
    }
    return plots.Costs(**panel | {"points": points, "data": np.array(panel["data"])})


def drawn(series: dict[str, Any]) -> str:
    """A plot as SVG; its description is the stamp of what it shows."""
    # matplotlib is slow to import, and only those who draw need it.
    from jaxmotion.viz import plots

    if "panels" in series:
        return plots.costs_svg(
            tuple(_panel(plots, panel) for panel in series["panels"]),
            title=series["title"],
            description=_stamp(series),
        )
    return plots.dots_svg(
        {k: np.reshape(v, (-1, 3)) for k, v in series["rows"].items()},
        references=tuple(series["data"]),
        title=series["title"],
        xlabel=series["label"],
        logarithmic=series["log"],
        description=_stamp(series),
    )


def stale(root: Path = ROOT) -> list[Path]:
    """Pages and plots that differ from what their stored results make of them."""
    store, found = Store(root / "experiments/results"), []
    for page in pages(root):
        text = page.read_text(encoding="utf-8")
        if written(page, text, store) != text:
            found.append(page)
        for name, options in plots_of(page, text):
            path = page.parent / options["file"]
            stamp = _stamp(_series(store, name, options))
            if not path.exists() or stamp not in path.read_text(encoding="utf-8"):
                found.append(path)
    return found


def write(root: Path = ROOT) -> list[Path]:
    """Writes all pages and plots that are stale; returns them."""
    store, made = Store(root / "experiments/results"), stale(root)
    for page in pages(root):
        text = page.read_text(encoding="utf-8")
        for name, options in plots_of(page, text):
            if (path := page.parent / options["file"]) in made:
                files.write_text(path, drawn(_series(store, name, options)))
        if page in made:
            files.write_text(page, written(page, text, store))
    return made
