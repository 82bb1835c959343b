"""experiments/reports: stored results, and pages that are what these make of them."""

import json
import math
import re
import shutil
import sys
from pathlib import Path

import numpy as np
import pytest
import scipy.stats

ROOT = Path(__file__).parents[2]
SYSTEMS = ("camdm", "aamdm", "emdm", "smgdiff")


@pytest.fixture(scope="module")
def pages(load):
    return load("reports.pages")


@pytest.fixture(scope="module")
def stored(load):
    return load("reports.stored")


@pytest.fixture
def checkout(tmp_path, pages):
    """A copy of what pages are made from, and of the pages."""
    shutil.copytree(ROOT / "experiments/results", tmp_path / "experiments/results")
    for page in pages.pages():
        place = tmp_path / page.relative_to(ROOT)
        place.parent.mkdir(parents=True, exist_ok=True)
        shutil.copyfile(page, place)
    return tmp_path


def metrics(path, rows, **about):
    made = dict(command="python a.py --run /home/me/runs/a", git_commit="abc")
    cells = {
        row: {k: dict(value=v, low=None, high=None, samples=3) for k, v in x.items()}
        for row, x in rows.items()
    }
    path.write_text(json.dumps(made | about | {"rows": cells}))
    return path


# --- what is committed --------------------------------------------------------------


def test_pages_equal_what_their_results_make_of_them(pages):
    """Else: python experiments/report.py --write-docs."""
    assert pages.stale() == []


@pytest.mark.slow
def test_a_changed_digit_is_noticed_wherever_it_is(pages, checkout):
    assert pages.stale(checkout) == []
    path = checkout / "experiments/results/camdm/bandai2_planted.json"
    text = path.read_text()
    changed = text.replace('"value": 0.174', '"value": 0.175', 1)
    assert changed != text
    path.write_text(changed)
    stale = {x.relative_to(checkout).as_posix() for x in pages.stale(checkout)}
    folder = "experiments/results"
    assert stale == {"README.md", f"{folder}/camdm.md", f"{folder}/findings.md"}
    # A plot's, too.
    path.write_text(text)
    path = checkout / "experiments/results/aamdm/shipped.json"
    text = path.read_text()
    path.write_text(text.replace('"value": 17.2599', '"value": 17.1', 1))
    stale = {x.name for x in pages.stale(checkout)}
    assert stale == {"README.md", "aamdm.md", "locomotion_fast.md", "shipped.svg"}


def test_a_picture_of_costs_joins_tables(pages, checkout):
    page = checkout / "experiments/results/steps.md"
    place = {
        options["file"]: (n, options)
        for n, options in pages.plots_of(page, page.read_text())
    }
    store = pages.Store(checkout / "experiments/results")
    shown = pages._series(store, *place["steps.svg"])
    camdm, _, _, emdm, _ = shown["panels"]
    whole = json.loads(
        (checkout / "experiments/results/camdm/sweep_camdm.json").read_text()
    )
    cells = whole["rows"]["T = 16"]
    expected = [
        [cells[k][x] for x in ("value", "low", "high")] for k in ("plan_time", "fid")
    ]
    assert camdm["points"]["ancestral"]["16"] == expected
    # Milliseconds a frame, of 60 frames.
    assert emdm["points"]["DDGAN"]["10"][0] == pytest.approx([5.058, 4.782, 6.12])
    path = checkout / "experiments/results/timings/peers.json"
    compiled = json.loads(path.read_text())["rows"]["CAMDM, a plan of 8 steps, batch 1"]
    assert camdm["peers"]["torch.compile"] == compiled["compile"]["value"]
    value = compiled["compile"]["value"]
    text = path.read_text().replace(f'"value": {value}', f'"value": {2 * value}')
    path.write_text(text)
    assert {x.name for x in pages.stale(checkout)} == {"steps.svg", "README.md"}


@pytest.mark.slow
def test_writing_is_idempotent_and_mends_what_was_edited(pages, checkout):
    page = checkout / "experiments/results/emdm.md"
    text = page.read_text()
    page.write_text(text.replace("0.191", "0.091"))
    (checkout / "experiments/results/emdm/actions_bandai.svg").unlink()
    assert {x.name for x in pages.write(checkout)} == {"emdm.md", "actions_bandai.svg"}
    assert page.read_text() == text
    assert pages.write(checkout) == []


@pytest.mark.parametrize("system", SYSTEMS)
def test_a_systems_page_is_short_and_begins_with_data(system):
    text = (ROOT / f"experiments/results/{system}.md").read_text()
    assert len(text.splitlines()) <= 150
    first = re.search(r"\n\|[-|]+\|\n\| (.*?) \|", text)[1]
    assert re.search("takes|clips|data", first), first
    assert "What falls short" in text and ".svg)" in text


def test_the_experiments_page_is_short():
    text = (ROOT / "experiments/README.md").read_text()
    assert len(text.splitlines()) <= 200


def test_every_stored_result_is_whole_and_shown(pages, stored):
    shown = "".join(page.read_text() for page in pages.pages())
    shown += (ROOT / "experiments/results/headline.toml").read_text()
    folder = ROOT / "experiments/results"
    for path in sorted(folder.glob("*/*.json")):
        name = path.relative_to(folder).with_suffix("").as_posix()
        table = stored.read(folder, re.sub(r"_seed\d+$", "", name))
        assert table.measured.rows
        # A path of somebody's machine would be one.
        assert not re.search(r'[" ]/(home|root|srv|tmp|Users)/', path.read_text()), path
        claimed = name.partition("/")[0] in SYSTEMS
        assert re.sub(r"_seed\d+$", "", name) in shown or claimed, name


# --- storing ------------------------------------------------------------------------


def test_what_is_kept_of_an_evaluation(stored, tmp_path):
    source = metrics(
        tmp_path / "metrics.json",
        {"rollouts": {"foot_slide": 0.123456789, "mine": 2}},
        jax="0.10",
        long={"not": "needed"},
        arguments={"run": "/home/me/runs/a", "seed": 3},
        seeds={"training": [3]},
    )
    path = stored.keep(tmp_path, source, "camdm/it", "A title")
    made = json.loads(path.read_text())
    assert path == tmp_path / "camdm/it.json"
    assert made["title"] == "A title" and made["arguments"] == {"seed": 3}
    assert made["measured"] == {
        "command": "python a.py --run runs/a",
        "git_commit": "abc",
        "jax": "0.10",
    }
    assert made["columns"]["foot_slide"] == {
        "title": "foot slide",
        "unit": "m/s",
        "better": "lower",
    }
    assert made["columns"]["mine"] == {"title": "mine", "better": ""}
    cell = made["rows"]["rollouts"]["foot_slide"]
    assert cell == {"value": 0.123457, "samples": 3}
    # Again, with other numbers: the title and what people wrote stay.
    made["columns"]["foot_slide"]["title"] = "slide of feet"
    path.write_text(
        stored.to_text(made | {"names": {"rollouts": "walks"}, "interval": "none"})
    )
    metrics(source, {"rollouts": {"foot_slide": 0.2}})
    again = json.loads(stored.keep(tmp_path, source, "camdm/it", "").read_text())
    assert again["title"] == "A title" and again["names"] == {"rollouts": "walks"}
    assert again["interval"] == "none" and list(again["columns"]) == ["foot_slide"]
    assert again["columns"]["foot_slide"]["title"] == "slide of feet"


def test_rows_are_added_to_those_of_the_same_kind(stored, tmp_path):
    """Trained apart, evaluated alike: one table; anything else is named."""
    real = {"real": {"fid": 1.0}}
    about = dict(seeds={"training": [3]}, arguments={"rows": ["a"], "samples": 9})
    source = tmp_path / "metrics.json"

    def made(rows, **changes):
        metrics(source, rows, **about | changes)
        path = stored.keep(tmp_path, source, "emdm/it", "A title", add=True)
        return json.loads(path.read_text())

    with pytest.raises(ValueError, match="is no measured table"):
        made(real)
    metrics(
        source,
        real | {"a": {"fid": 2.0}},
        minutes={"a": 4.0},
        models={"a": {}},
        **about,
    )
    stored.keep(tmp_path, source, "emdm/it", "A title")
    other = dict(minutes={"b": 5.0}, git_commit="0123456789", command="c.py")
    whole = made(
        real | {"b": {"fid": 3.0, "jerk": 9.0}},
        **other,
        arguments={"rows": ["b"], "samples": 9},
    )
    values = {row: cells["fid"]["value"] for row, cells in whole["rows"].items()}
    assert values == {"real": 1.0, "a": 2.0, "b": 3.0}
    assert whole["minutes"] == {"a": 4.0, "b": 5.0} and "jerk" in whole["columns"]
    assert whole["models"] == {"a": {}}
    command = "python a.py --run runs/a; at 01234567 b: c.py"
    assert whole["measured"] == {"command": command, "git_commit": "abc"}
    kept = (tmp_path / "emdm/it.json").read_text()
    for rows, changes, message in (
        ({"c": {"fid": 3.0}}, {"seeds": {"training": [4]}}, "field 'seeds' is"),
        ({"c": {"fid": 3.0}}, {"arguments": {"samples": 8}}, "field 'arguments'"),
        ({"real": {"fid": 1.5}, "c": {"fid": 3.0}}, {}, "has another row 'real'"),
        (real, {}, "has all rows"),
    ):
        with pytest.raises(ValueError, match=message):
            made(rows, **changes)
    assert (tmp_path / "emdm/it.json").read_text() == kept


def test_what_is_kept_of_a_benchmark(stored, tmp_path):
    made = dict(command="python b.py", git_commit="abc", cpu="a processor")
    made |= dict(torch="2.13", other_load=1.5)
    names = {"emdm batch=1 p50": 2.0, "emdm batch=1 frames": 9.0}
    metrics_ = [dict(name=k, value=v, unit="", direction="") for k, v in names.items()]
    report = dict(benchmark="b", environment=made, metrics=metrics_, settings={})
    source = tmp_path / "b.json"
    source.write_text(json.dumps(report))
    stored.keep(tmp_path, source, "timings/b", "A benchmark")
    found = stored.read(tmp_path, "timings/b")
    assert [x.value for x in found.cells("emdm batch=1", "p50")] == [2.0]
    assert found.columns["frames"].title == "frames per second"
    assert found.columns["p50"].kind == "time"
    assert found.measured.about["measured"] == made


@pytest.mark.parametrize(
    ("name", "title", "about", "message"),
    [
        ("camdm", "t", {}, "name: 'camdm', expected system/table"),
        ("a/../b", "t", {}, "expected system/table"),
        ("camdm/it", "", {}, "title: expected one"),
        ("camdm/it", "t", {"git_commit": None}, "git_commit missing"),
    ],
)
def test_what_cannot_be_kept_is_named(stored, tmp_path, name, title, about, message):
    source = metrics(tmp_path / "metrics.json", {"a": {"fid": 1.0}}, **about)
    with pytest.raises(ValueError, match=re.escape(message)):
        stored.keep(tmp_path, source, name, title)
    assert not list(tmp_path.glob("*/*.json"))


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"transcribed": None, "measured": None}, "neither"),
        ({"measured": {"command": "c", "git_commit": "a"}}, "measured and transcribed"),
        ({"columns": {}}, "columns lack fid"),
        ({"title": None}, "'title' is missing"),
        ({"names": {"b": "B"}}, "names of no row: b"),
        ({"surprise": 1}, "unknown fields surprise"),
        ({"columns": {"fid": {"titel": "FID"}}}, "columns"),
    ],
)
def test_a_damaged_file_is_named(stored, tmp_path, change, message):
    whole = {
        "title": "t",
        "transcribed": "a text",
        "columns": {"fid": {"title": "FID"}},
        "rows": {"a": {"fid": {"value": 1.0, "samples": 1}}},
    } | change
    whole = {k: v for k, v in whole.items() if v is not None}
    path = tmp_path / "camdm/it.json"
    path.parent.mkdir()
    path.write_text(json.dumps(whole))
    with pytest.raises(ValueError, match=f"it.json: .*{message}"):
        stored.read(tmp_path, "camdm/it")


# --- pages --------------------------------------------------------------------------


@pytest.fixture
def store(pages, stored, tmp_path):
    """One table of three trainings, and one of counts."""

    def put(name, rows, **columns):
        path = tmp_path / f"{name}.json"
        path.parent.mkdir(exist_ok=True)
        whole = dict(title="t", transcribed="x", columns=columns, rows=rows)
        path.write_text(stored.to_text(whole))

    fid = {"title": "FID", "better": "lower"}
    for end, value in (("", 1.0), ("_seed1", 2.0), ("_seed10", 4.0)):
        cell = {"value": value, "samples": 5}
        same = {"value": 0.5, "low": 0.25, "high": 0.75, "samples": 5}
        put(f"emdm/three{end}", {"a": {"fid": cell}, "data": {"fid": same}}, fid=fid)
    lost = {"title": "lost", "kind": "count", "better": "lower"}
    put("emdm/count", {"a": {"lost": {"value": 3.0, "samples": 16}}}, lost=lost)
    return pages.Store(tmp_path)


@pytest.mark.parametrize(
    ("reference", "text"),
    [
        ("emdm/three | a | fid", "1 / 2 / 4"),
        ("emdm/three | data | fid", "0.5"),
        ("emdm/three | data | fid | interval", "0.50 [0.25, 0.75]"),
        ("emdm/count | a | lost", "3 of 16"),
    ],
)
def test_a_figure_in_a_sentence(pages, store, tmp_path, reference, text):
    page = tmp_path / "page.md"
    found = pages.written(page, f"It is <!-- = {reference} -->?<!-- / --> here.", store)
    assert found == f"It is <!-- = {reference} -->{text}<!-- / --> here."


@pytest.mark.parametrize(
    ("marker", "message"),
    [
        (
            "<!-- = emdm/three | b | fid -->x<!-- / -->",
            "no row 'b', expected",
        ),
        ("<!-- = emdm/three | a | jerk -->x<!-- / -->", "no column 'jerk'"),
        ("<!-- = emdm/three | a -->x<!-- / -->", "expected table | row | column"),
        ("<!-- table emdm/none -->\n<!-- end -->", "none.json"),
        ("<!-- table emdm/three\nrows = [-->\n<!-- end -->", "table emdm/three"),
    ],
)
def test_a_wrong_marker_is_named_with_its_page(pages, store, tmp_path, marker, message):
    with pytest.raises(ValueError, match=rf"page.md: .*{re.escape(message)}"):
        pages.written(tmp_path / "page.md", marker, store)


@pytest.mark.parametrize(
    ("value", "low", "high", "text"),
    [
        (0.0873, 0.0869, 0.0881, "0.0873 [0.0869, 0.0881]"),
        (0.002, 0.001, 0.003, "0.002 [0.001, 0.003]"),
        (5.0, 4.9, 5.1, "5.0 [4.9, 5.1]"),
        (0.96, 0.9561, 0.9634, "0.960 [0.956, 0.963]"),
        (2.50026, 2.50016, 2.50035, "2.500 [2.500, 2.500]"),
        (0.021, 0.02065, 0.02136, "0.0210 [0.0207, 0.0214]"),
        (1410.0, 1270.0, 1550.0, "1,410 [1,270, 1,550]"),
        (math.nan, None, None, "–"),
    ],
)
def test_digits_follow_the_interval(load, pages, value, low, high, text):
    columns, table = (
        load("jaxmotion.evaluation.columns"),
        load("jaxmotion.evaluation.table"),
    )
    cell = table.Cell(value=value, low=low, high=high)
    assert pages.text_of([cell], columns.COLUMNS["fid"]) == text


def test_of_many_trainings_the_mean_is_shown(pages, stored, tmp_path):
    """With its interval, by SciPy."""
    values = [1.0, 2.0, 4.0, 3.0, 2.5]
    for seed, value in enumerate(values):
        path = tmp_path / f"emdm/many{f'_seed{seed}' if seed else ''}.json"
        path.parent.mkdir(exist_ok=True)
        rows = {"a": {"fid": {"value": value, "samples": 1}}}
        columns = {"fid": {"title": "FID", "better": "lower"}}
        whole = dict(title="t", transcribed="x", columns=columns, rows=rows)
        path.write_text(stored.to_text(whole))
    text = pages.Store(tmp_path).figure("emdm/many | a | fid | interval")
    ends = scipy.stats.t.interval(0.95, 4, np.mean(values), scipy.stats.sem(values))
    found = [float(x) for x in re.findall(r"\d+\.?\d*", text)]
    np.testing.assert_allclose(found, [np.mean(values), *ends], atol=0.05)


def test_differences_are_taken_within_trainings(pages, store, tmp_path):
    """By SciPy: 1, 2 and 4 less .5; a row beside itself differs by nothing."""
    marker = (
        "<!-- table emdm/three\nrows = []\nsource = false\n"
        'less = {"more" = ["a", "data"], "none" = ["a", "a"]}\n-->\n<!-- end -->'
    )
    own = np.array([0.5, 1.5, 3.5])
    ends = scipy.stats.t.interval(0.95, 2, own.mean(), scipy.stats.sem(own))
    lines = pages.written(tmp_path / "page.md", marker, store).splitlines()
    text = next(x for x in lines if x.startswith("| more"))
    mean, low, high = map(float, re.findall(r"-?\d+\.\d+", text))
    np.testing.assert_allclose([mean, low, high], [own.mean(), *ends], atol=0.05)
    assert any(x.startswith("| none | 0 ") for x in lines)


def test_a_table_shows_rows_of_another_file(pages, stored, store, tmp_path):
    """With the file that they come from, and what that calls them."""
    rows = {"a": {"fid": {"value": 7.0, "samples": 5}}}
    fid = {"title": "FID", "better": "lower"}
    whole = dict(transcribed="elsewhere", columns={"fid": fid}, rows=rows)
    text = stored.to_text(dict(title="t", **whole, names={"a": "theirs"}))
    (tmp_path / "emdm/other.json").write_text(text)
    marker = (
        '<!-- table emdm/three\nrows = ["data", "emdm/other | a"]\n'
        'bold = ["emdm/other | a"]\n-->\n<!-- end -->'
    )
    found = pages.written(tmp_path / "page.md", marker, store).splitlines()
    assert "| data | 0.50 [0.25, 0.75] |" in found and "| **theirs** | 7 |" in found
    files = [x for x in found if x.startswith("<sub>")]
    assert len(files) == 2 and "emdm/other.json" in files[1]
    with pytest.raises(ValueError, match="emdm/other: no row 'b', expected of a"):
        pages.written(tmp_path / "page.md", marker.replace("| a", "| b"), store)


def test_claims_are_decided_from_stored_trainings(pages, checkout):
    """The mean over trainings and its interval, by SciPy, and the verdict's word."""
    folder = checkout / "experiments/results"
    values = [
        json.loads(path.read_text())["rows"]["emdm"]["fid"]["value"]
        for path in folder.glob("emdm/emdm_action*.json")
    ]
    values, free = np.array(values), len(values) - 1
    assert free >= 2
    error = scipy.stats.sem(values)
    low, high = scipy.stats.t.interval(0.95, free, values.mean(), error)
    text = (folder / "claims.md").read_text()
    assert f"EMDM (Ours) {values.mean():.3g} [{low:.2f}, {high:.2f}]" in text
    count = int(re.search(r"(\d+) claims: ", text)[1])
    rows = re.findall(
        r"\| (reproduced|not reproduced|not decided|not run)[^|]*\|[^|]*\|\n", text
    )
    assert len(rows) == count > 60


def test_the_command_stores_and_writes(load, checkout, monkeypatch, capsys):
    report, pages_ = load("report"), load("reports.pages")
    folder = checkout / "experiments/results"
    monkeypatch.setattr(report.stored, "FOLDER", folder)
    monkeypatch.setattr(pages_.write, "__defaults__", (checkout,))
    source = metrics(checkout / "metrics.json", {"walker": {"foot_slide": 0.5}})
    words = f"--keep {source} --name camdm/new --title New --write-docs"
    monkeypatch.setattr(sys, "argv", ["report.py", *words.split()])
    report.main()
    assert capsys.readouterr().out == f"wrote {folder / 'camdm/new.json'}\n"
