"""experiments/report.py: claims decided each way, what is missing, what is damaged."""

import dataclasses
import functools
import json
import math
import re

import numpy as np
import pytest
import scipy.stats

from jaxmotion.evaluation import sequential
from jaxmotion.systems import registry
from jaxmotion.systems.camdm import release as camdm_release


@pytest.fixture(scope="module")
def call(invoke):
    """Runs a command line."""
    return functools.partial(invoke, "report")


def cell(value, low=None, high=None, samples=20):
    return dict(value=value, low=low, high=high, samples=samples)


def near(value, spread=0.1):
    return cell(value, value - spread, value + spread)


def put(path, rows, **about):
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(json.dumps(about | {"rows": rows}))
    return path


# --- the papers' data ---------------------------------------------------------------


def all_claims(load):
    tables = load("reports.writing").TABLES
    return [(table, claim) for table in tables for claim in table.claims]


def test_tables_are_complete(load):
    writing = load("reports.writing")
    names = [table.name for table in writing.TABLES]
    assert len(set(names)) == len(names)
    for table in writing.TABLES:
        for part in (table.rows, table.columns):
            assert len({x.name for x in part}) == len(part), table.name
        for row in table.rows:
            assert len(row.paper) == len(table.columns), (table.name, row.name)
            assert (row.here is not None) or row.reason, (table.name, row.name)


def test_claims_speak_of_what_can_be_run(load):
    for table, claim in all_claims(load):
        assert claim.pairs and claim.where
        table.column(claim.column)
        for name in claim.rows:
            assert table.row(name).here, (table.name, claim.words)


def test_every_claim_holds_for_what_the_paper_prints(load):
    verdicts, made = load("reports.verdicts"), 0
    for table, claim in all_claims(load):
        for pair in claim.pairs:
            names = (*pair, claim.toward) if claim.toward else pair
            values = [verdicts.printed(table.stated(x, claim.column)) for x in names]
            if None not in values:
                assert verdicts.holds(claim, values) > 0, (table.name, claim.words)
                made += 1
    assert made > 100


def test_every_command_of_a_source_has_its_folder(load):
    for source in load("reports.writing").SOURCES:
        assert any("{run}" in command for command in source.commands)


def test_a_damaged_paper_is_named(load, tmp_path, monkeypatch):
    claims = load("reports.claims")
    text = (claims.FOLDER / "aamdm.toml").read_text()
    monkeypatch.setattr(claims, "FOLDER", tmp_path)
    for old, new, what in (
        ("[source.aamdm]", "[source.other]", "'aamdm'"),
        ("number = ", "numbr = ", "numbr"),
        ("rising = ", "risen = ", "highest"),
    ):
        (tmp_path / "aamdm.toml").write_text(text.replace(old, new, 1))
        with pytest.raises(ValueError, match=f"aamdm.toml: .*{what}"):
            claims.read_paper(registry.get("aamdm"))


# --- decisions ----------------------------------------------------------------------


def test_what_a_claim_compares(load):
    make = functools.partial(
        load("reports.claims").Claim, words="w", column="c", pairs=(), where="here"
    )
    holds = load("reports.verdicts").holds
    assert holds(make(), (1.0, 3.0)) == 2.0
    assert holds(make(factor=4.0), (1.0, 3.0)) == pytest.approx(math.log(3.0 / 4.0))
    assert not math.isfinite(holds(make(factor=4.0), (0.0, 3.0)))
    assert holds(make(toward="x"), (9.0, 12.0, 10.0)) == 1.0
    assert holds(make(margin=0.5), (3.0, 2.0)) == -0.5


def test_no_claim_is_made_twice_and_none_of_what_needs_no_test(load):
    seen = [(t.paper, c.words, c.where) for t, c in all_claims(load)]
    assert len(set(seen)) == len(seen)
    assert not [words for _, words, _ in seen if "take longer" in words]


@pytest.mark.parametrize(("count", "samples"), [(9, 16), (0, 16), (20, 20)])
def test_counts_have_wilsons_interval(load, count, samples):
    found = load("reports.verdicts").wilson(float(count), samples)
    # The ends are where the observed part is 1.96 deviations away.
    for end in np.asarray(found) / samples:
        deviation = math.sqrt(max(end * (1 - end), 0.0) / samples)
        np.testing.assert_allclose(
            abs(count / samples - end), 1.96 * deviation, atol=1e-9
        )


@pytest.fixture
def decide(load, tmp_path):
    """Decides FID of A < B < C from cells of a file."""
    claims, results = load("reports.claims"), load("reports.results")
    source = claims.Source(run="a", file="a.json", commands=("make {run}",))
    other = claims.Source(run="b", file="b.json", commands=("make {run}",))
    table = claims.Table(
        paper="P",
        number="1",
        title="t",
        source=source,
        columns=(
            claims.Column(name="FID", here="fid", better="lower", evaluated=True),
        ),
        rows=tuple(
            claims.Row(name=name, here=name.lower(), paper=(1.0,), source=where)
            for name, where in (("A", None), ("B", None), ("C", None), ("D", other))
        ),
    )

    def run(rows, *, pairs=None, evaluators=(None, None), trainings=4):
        pairs = pairs or (("A", "B"), ("B", "C"))
        claim = claims.Claim(words="w", column="FID", pairs=pairs, where="here")
        found = {}
        for key, names, evaluator in (
            (source, "abc", evaluators[0]),
            (other, "d", evaluators[1]),
        ):
            about = {"evaluator": evaluator} if evaluator else {}
            paths = []
            for seed in range(trainings):
                # Trainings differ by hundredths.
                own = {
                    k: {
                        "fid": v | {"value": v["value"] and v["value"] + i * seed / 100}
                    }
                    for i, (k, v) in enumerate(rows.items())
                    if k in names
                }
                path = tmp_path / str(seed) / key.file
                paths.append(put(path, own, seeds={"training": [seed]}, **about))
            found[key] = results.read_trainings(paths)
        return load("reports.verdicts").decide(table, claim, found)

    return run


def test_a_claim_comes_out_each_way(decide):
    made = decide(dict(a=near(1.0), b=near(2.0), c=near(3.0)))
    assert (made.verdict, made.reason, made.trainings) == ("reproduced", "", 3)
    made = decide(dict(a=near(1.0), b=near(3.0), c=near(2.0)))
    assert made.verdict == "not reproduced" and made.reason == "fails: B and C"
    made = decide(dict(a=near(1.0), b=near(2.0), c=near(2.0 - 0.015)))
    assert made.verdict == "not decided" and made.reason.endswith(": B and C")
    made = decide(dict(a=near(1.0), b=near(2.0)))
    assert made.verdict == "not run" and made.reason == "not measured: C"
    # One comparison that fails is enough, whatever the missing row would show.
    assert decide(dict(a=near(2.0), b=near(1.0))).verdict == "not reproduced"


def test_one_training_decides_nothing(decide):
    rows = dict(a=near(1.0), b=near(2.0), c=near(3.0))
    made = decide(rows, trainings=1)
    assert (made.verdict, made.trainings) == ("not decided", 1)
    assert made.reason and decide(rows, trainings=3).reason == ""


def test_what_is_not_finite_decides_nothing(decide):
    rows = dict(a=near(1.0), b=near(2.0))
    assert decide(rows | dict(c=cell(None))).verdict == "not decided"


def test_rows_of_two_evaluators_are_not_compared(decide):
    rows, pairs = dict(a=near(1.0), d=near(2.0)), (("A", "D"),)
    one = {"fingerprint": "aa", "reference_clips": "cc"}
    for evaluators in ((None, None), (one, one | {"fingerprint": "bb"}), (one, None)):
        made = decide(rows, pairs=pairs, evaluators=evaluators)
        assert made.verdict == "not decided" and "evaluators" in made.reason
    assert decide(rows, pairs=pairs, evaluators=(one, one)).verdict == "reproduced"


def test_beside_the_values_of_camdm_stands_what_its_release_computes(load):
    tables = load("reports.claims").read_paper(registry.get("camdm")).tables
    released = {column for column, _ in camdm_release.COLUMNS.values()}
    names = {"FID", "Ft. Slid.", "Accel.", "Traj. Err.", "Orient. Err."}
    found = {x.name: x.here for table in tables for x in table.columns}
    assert {found[name] for name in names} == released
    assert not {found[name] for name in set(found) - names} & released


# --- several trainings --------------------------------------------------------------


def measured(load, path, rows, **about):
    """What was read of a file, of rows that have one column."""
    results = load("reports.results")
    rows = {k: {"fid": cell(v)} for k, v in rows.items()}
    return results.read(put(path, rows, **about))


@pytest.fixture
def over(load, tmp_path):
    """Decides a claim about rows that are arrays of values, one a training."""
    claims, verdicts = load("reports.claims"), load("reports.verdicts")
    source = claims.Source(run="a", file="a.json", commands=("make {run}",))
    column = claims.Column(name="FID", here="fid", better="lower")

    def run(rows, **more):
        names = [name.upper() for name in rows]
        table = claims.Table(
            paper="P",
            number="1",
            title="t",
            source=source,
            columns=(column,),
            rows=tuple(claims.Row(name=x, here=x.lower(), paper=(1.0,)) for x in names),
        )
        first, *again = (
            measured(
                load,
                tmp_path / f"{i}.json",
                {k: None if math.isnan(v[i]) else float(v[i]) for k, v in rows.items()},
            )
            for i in range(len(rows["a"]))
        )
        found = {source: dataclasses.replace(first, again=tuple(again))}
        more = dict(words="w", column="FID", pairs=(("A", "B"),), where="here") | more
        made = verdicts.decide(table, claims.Claim(**more), found)
        return made, verdicts.over_trainings(table, table.rows[0], column, found)

    return run


def test_evidence_decides_as_the_densities_of_t_do(over):
    """SciPy's noncentral t, and the first training at which a bar is passed."""
    generator, seen = np.random.default_rng(0), []

    def density(t, count):
        effects = (1.0, 2.0, 4.0)
        own = [scipy.stats.nct.pdf(t, count - 1, x * count**0.5) for x in effects]
        return np.mean(own) / scipy.stats.t.pdf(t, count - 1)

    for _ in range(40):
        a = generator.normal(10.0, 3.0, 8)
        b = a + generator.normal(generator.uniform(-1, 1), 0.5, 8)
        made, _ = over(dict(a=a, b=b))
        verdict, when = "not decided", 8
        for count in range(2, 9):
            own = (b - a)[:count]
            t = own.mean() / scipy.stats.sem(own)
            if max(like := [density(t, count), density(-t, count)]) >= 20.0:
                verdict = "reproduced" if like[0] >= 20.0 else "not reproduced"
                when = count
                break
        assert (made.verdict, made.trainings) == (verdict, when)
        seen.append(verdict)
    assert len(set(seen)) == 3 and all(seen.count(x) > 3 for x in set(seen))


def test_what_fails_is_named_by_the_bar_of_all_comparisons(over):
    """Evidence of 27, which fails alone, is none of two comparisons."""
    a = np.array([10.0, 10.0, 10.0])
    rows = dict(a=a, b=a - [1.0, 1.2, 0.8], c=a - [1.0, 1.01, 0.99])
    assert over(rows)[0].reason == "fails: A and B"
    made, _ = over(rows, pairs=(("A", "B"), ("A", "C")))
    assert (made.verdict, made.reason) == ("not reproduced", "fails: A and C")


def test_so_many_times_as_much_does_not_depend_on_how_busy_a_machine_is(load, over):
    """A load that both rows share cancels, and the interval is of their ratio."""
    generator = np.random.default_rng(0)
    load_of, ratio = generator.uniform(0.2, 1.0, 4), generator.uniform(70.0, 80.0, 4)
    made, _ = over(dict(a=load_of, b=load_of * ratio), factor=25.0)
    np.testing.assert_allclose(made.differences["A", "B"], np.log(ratio / 25.0))
    assert made.verdict == "reproduced"
    claim = load("reports.claims").Claim(
        words="w", column="c", pairs=(), where="here", factor=25.0
    )
    text = load("reports.markdown").difference(
        claim, ("A", "B"), made.differences["A", "B"]
    )
    name, mean, low, high = re.match(r"(.*): (.+) \[(.+), (.+)\] of 4", text).groups()
    assert name == "B over A"
    expected = scipy.stats.gmean(ratio)
    assert float(low) < float(mean) < float(high)
    assert float(mean) == pytest.approx(expected, rel=1e-2)
    slower, _ = over(dict(a=load_of, b=load_of * ratio), factor=100.0)
    assert slower.verdict == "not reproduced"


def test_nearness_over_trainings_is_of_paired_distances(over):
    a, b, real = np.array(
        [[9.0, 9.5, 8.8, 9.1], [12.0, 12.1, 12.5, 12.2], [10.0, 10.3, 9.9, 10.0]]
    )
    made, _ = over(dict(a=a, b=b, c=real), toward="C")
    expected = np.abs(b - real) - np.abs(a - real)
    np.testing.assert_allclose(made.differences["A", "B"], expected, rtol=1e-9)
    assert made.verdict == "reproduced"


def test_what_twelve_trainings_leave_open_has_its_interval(load, over):
    """Of the comparison that is open alone, and of fewer trainings none."""
    markdown, claims = load("reports.markdown"), load("reports.claims")
    a = np.random.default_rng(0).normal(5.0, 0.1, 12)
    wiggle = np.random.default_rng(1).normal(0.0, 0.3, 12)
    pairs = (("A", "B"), ("A", "C"))
    claim = claims.Claim(words="w", column="FID", pairs=pairs, where="here")
    for count, expected in ((11, ""), (12, "B less A: ")):
        rows = dict(a=a, b=a + wiggle, c=a + 1.0 + 0.1 * wiggle)
        made, _ = over({k: v[:count] for k, v in rows.items()}, pairs=pairs)
        assert (made.verdict, made.open) == ("not decided", (("A", "B"),))
        text = markdown.left_open(claim, made)
        assert text.startswith(expected) and bool(text) == bool(expected)
    mean, low, high = sequential.interval(wiggle)
    size = abs(scipy.stats.ttest_1samp(wiggle, 0.0).statistic) / np.sqrt(12)
    numbers = map(markdown.number, (mean, low, high, size))
    words = "B less A: {} [{}, {}] of 12 trainings, {} deviations of one"
    assert text == words.format(*numbers)
    decided = [(None, claim, made)] * 2
    words = "2 not decided (2 of them after 12 trainings)"
    assert markdown.counts(decided)["not decided"] == words


def test_likeness_needs_both_sides(over):
    a = np.array([5.0, 5.2, 4.9, 5.1, 5.05])
    wiggle = np.array([0.02, -0.03, 0.01, 0.0, -0.01])
    alike = functools.partial(over, margin=0.5)
    assert alike(dict(a=a, b=a + wiggle))[0].verdict == "reproduced"
    assert alike(dict(a=a, b=a + 0.9 + wiggle))[0].verdict == "not reproduced"
    assert alike(dict(a=a, b=a - 0.9 + wiggle))[0].verdict == "not reproduced"
    assert alike(dict(a=a, b=a + 0.495 + wiggle))[0].verdict == "not decided"


@pytest.mark.parametrize("pairs", [1, 3, 6])
def test_false_verdicts_and_power_of_the_rule(load, pairs):
    """Both errors without an effect, and what effects of a few deviations give."""
    when, generator = load("reports.verdicts").when_decided, np.random.default_rng(1)
    shares, trainings = {}, {}
    for effect in (0.0, 2.0, 5.0):
        draws = generator.normal(effect, 1.0, (100, pairs, 12))
        ends = np.array([when(list(draw)) for draw in draws])
        shares[effect] = (
            np.mean(ends[:, :1] < ends[:, 1:]),
            np.mean(ends[:, 1] < ends[:, 0]),
        )
        trainings[effect] = np.mean(np.minimum(ends.min(axis=1), 12))
    # 0.05 and two standard errors of 100 draws.
    assert max(shares[0.0]) < 0.094
    assert shares[2.0][0] > 0.95 and shares[5.0][0] == 1.0
    assert trainings[5.0] < 4.2 and trainings[2.0] < 8.0
    assert max(share[1] for share in shares.values()) < 0.094


def test_a_false_verdict_is_rare_where_one_comparison_has_no_effect(load):
    """The worst case: the other comparisons hold for sure."""
    when, generator = load("reports.verdicts").when_decided, np.random.default_rng(2)
    draws = generator.normal(0.0, 1.0, (200, 3, 12)) + np.array([[0.0], [9.0], [9.0]])
    ends = np.array([when(list(draw)) for draw in draws])
    assert np.mean(ends[:, 0] < math.inf) < 0.081


def test_recorded_motion_has_no_interval_over_trainings(over):
    assert over(dict(a=[2.0, 2.0, 2.0], b=[9.0, 10.0, 11.0]))[1] is None
    made, mean = over(dict(a=[2.0, 2.0, 2.1], b=[9.0, 10.0, 11.0]))
    assert (mean.count, made.verdict) == (3, "reproduced")


def test_one_training_that_is_not_finite_decides_nothing(over):
    made, mean = over(dict(a=[1.0, 2.0, math.nan], b=[9.0, 10.0, 11.0]))
    assert made.verdict == "not decided" and math.isnan(mean.mean)
    assert made.trainings == 2


def test_what_is_no_further_training_is_named(load, tmp_path):
    read = load("reports.results").read_trainings
    about = dict(seeds={"training": [0]}, data={"train.npz": "a"}, arguments={"n": 3})
    about |= dict(training={"a": {"steps": 9}, "b": {"steps": 1}})
    paths = [tmp_path / f"{i}.json" for i in range(3)]
    measured(load, paths[0], {"a": 1.0}, **about)
    assert read(paths[1:]) is None
    found = read(paths)
    assert [x is None for x in found.trainings] == [False, True, True]
    assert found.seeds == (0,)
    with pytest.raises(FileNotFoundError, match="1.json: no such file, but .*0.json"):
        read(paths[1::-1])
    for more, message in (
        ({}, "1.json: trained with seed 0, as .*0.json was"),
        (dict(data={"train.npz": "b"}), "1.json: differs from .*0.json in data"),
        (dict(arguments={"n": 4}), "in n is 3, given 4: expected the same"),
        (dict(training={"a": {"steps": 8}}), "in a.steps is 9, given 8: expected"),
    ):
        own = about | (dict(seeds={"training": [1]}) if more else {}) | more
        measured(load, paths[1], {"a": 1.0}, **own)
        with pytest.raises(ValueError, match=message) as error:
            read(paths)
        assert "\n" not in str(error.value)
    # A file that is stored does not name the one it was made from, nor folders.
    given = {"n": 3, "data": None, "run": "runs/a", "out": None}
    own = about | dict(seeds={"training": [1]}, arguments=given)
    measured(load, paths[1], {"a": 1.0}, **own)
    assert [x is None for x in read(paths).trainings] == [False, False, True]


def test_a_row_that_the_first_training_lacks_was_run(load, tmp_path):
    claims, markdown = load("reports.claims"), load("reports.markdown")
    source = claims.Source(run="a", file="m.json", commands=("make {run}",))
    row = claims.Row(name="B", here="b", paper=(1.0,))
    table = claims.Table(
        paper="P",
        number="1",
        title="t",
        source=source,
        columns=(claims.Column(name="FID", here="fid", better="lower"),),
        rows=(row,),
    )
    paths = [tmp_path / f"{i}.json" for i in range(2)]
    for seed, (path, rows) in enumerate(zip(paths, ("a", "ab"), strict=True)):
        about = dict(seeds={"training": [seed]})
        measured(load, path, dict.fromkeys(rows, 1.0), **about)
    read = load("reports.results").read_trainings
    assert markdown.why_not(table, row, {source: read(paths)}) == ""
    assert markdown.why_not(table, row, {source: read(paths[:1])}) == "not run"


def test_rounded_clips_are_the_same_clips(load, tmp_path):
    read = load("reports.results").read_trainings
    paths = [tmp_path / f"{i}.json" for i in range(2)]
    for seed, (path, print_) in enumerate(zip(paths, "ab", strict=True)):
        stage = {"steps": 9, "files": {"train.npz": print_}}
        about = dict(seeds={"training": [seed]}, training={"motion": stage})
        about |= dict(data=stage["files"])
        measured(load, path, {"a": 1.0}, **about)
    with pytest.raises(ValueError, match="motion.files.train.npz is 'a', given 'b'"):
        read(paths)
    measured(load, paths[1], {"a": 1.0}, **about, rounded="to 1e-6")
    assert all(x is not None for x in read(paths).trainings)
    about["training"]["motion"]["steps"] = 8
    measured(load, paths[1], {"a": 1.0}, **about, rounded="to 1e-6")
    with pytest.raises(ValueError, match="motion.steps is 9, given 8"):
        read(paths)


def test_rows_of_two_runs_pair_by_seed_and_data(load, tmp_path):
    claims, verdicts = load("reports.claims"), load("reports.verdicts")
    results = load("reports.results")
    sources = [
        claims.Source(run=x, file="m.json", commands=("make {run}",)) for x in "ab"
    ]
    table = claims.Table(
        paper="P",
        number="1",
        title="t",
        source=sources[0],
        columns=(claims.Column(name="FID", here="fid", better="lower"),),
        rows=tuple(
            claims.Row(name=x.run.upper(), here="it", paper=(1.0,), source=x)
            for x in sources
        ),
    )
    claim = claims.Claim(words="w", column="FID", pairs=(("A", "B"),), where="here")

    def decided(seeds, data, **more):
        found = {}
        for source, own, print_, value in zip(
            sources, seeds, data, (1.0, 5.0), strict=True
        ):
            paths = [tmp_path / source.run / str(i) / "m.json" for i in range(len(own))]
            for path, seed in zip(paths, own, strict=True):
                about = dict(seeds={"training": [seed]}, data={"train.npz": print_})
                measured(load, path, {"it": value + 0.1 * seed}, **about, **more)
            found[source] = results.read_trainings(paths)
        return verdicts.decide(table, claim, found)

    made = decided(((0, 1, 2, 3), (0, 1, 2)), "xx")
    assert (made.verdict, made.trainings) == ("reproduced", 3)
    assert "different seeds" in decided(((0, 1), (3, 2)), "xx").reason
    # A seed that one file lacks does not shift those after it.
    made = decided(((0, 1, 2, 3, 5), (0, 1, 2, 4, 5)), "xx")
    assert made.differences[("A", "B")].size == 4
    assert decided(((0, 1), (0, 2)), "xx").trainings == 1
    assert "different data" in decided(((0, 1), (0, 1)), "xy").reason
    # Clips that differ in their last digits are the same.
    assert not decided(((0, 1), (0, 1)), "xy", rounded="elsewhere").reason.startswith(
        "rows were"
    )
    # A row by our recipe is one of the table's own file.
    published, other = table.rows[1], dataclasses.replace(table.rows[1], ours="our")
    whole = dataclasses.replace(table, rows=(table.rows[0], other))
    assert [(x.here, whole.source_of(x)) for x in whole.ours.rows] == [
        ("it", sources[0]),
        ("our", sources[0]),
    ]
    assert table.ours.source_of(published) == sources[1]
    # Of one training each, nothing is paired.
    made = decided(((0,), (7,)), "xx")
    assert (made.verdict, made.trainings) == ("not decided", 1)
    # What a recipe was chosen on decides nothing.
    sources[1] = dataclasses.replace(sources[1], chosen_on=(1, 2))
    rows = (table.rows[0], dataclasses.replace(table.rows[1], source=sources[1]))
    table = dataclasses.replace(table, rows=rows)
    made = decided(((0, 1, 2, 3), (0, 1, 2, 3)), "xx")
    assert (made.verdict, made.trainings) == ("not decided", 2)
    assert decided(((1, 2), (1, 2)), "xx").verdict == "not run"


def test_a_comparison_has_the_trainings_of_its_own_two_rows(load, tmp_path):
    claims, verdicts = load("reports.claims"), load("reports.verdicts")
    results = load("reports.results")
    seeds = {"a": range(4), "b": range(4), "c": range(1, 3)}
    rows, found = [], {}
    for run, own in seeds.items():
        source = claims.Source(run=run, file="m.json", commands=("make {run}",))
        paths = [tmp_path / run / str(seed) / "m.json" for seed in own]
        for path, seed in zip(paths, own, strict=True):
            value = {"it": seed + 10.0 * (run != "a")}
            measured(load, path, value, seeds={"training": [seed]})
        rows.append(claims.Row(name=run, here="it", paper=(1.0,), source=source))
        found[source] = results.read_trainings(paths)
    table = claims.Table(
        paper="P",
        number="1",
        title="t",
        source=rows[0].source,
        columns=(claims.Column(name="FID", here="fid", better="lower"),),
        rows=tuple(rows),
    )
    pairs = (("a", "b"), ("a", "c"))
    claim = claims.Claim(words="w", column="FID", pairs=pairs, where="here")
    made = verdicts.decide(table, claim, found)
    assert [x.tolist() for x in made.differences.values()] == [[10.0] * 4, [10.0] * 2]
    assert made.trainings == 2


# --- a report -----------------------------------------------------------------------

SWEEP = {
    f"T = {steps}": {
        "p50": near(float(steps)),
        "fid_camdm_release": near(fid),
        "slide_camdm_release": near(0.5),
    }
    for steps, fid in ((2, 5.0), (4, 4.0), (8, 3.0), (16, 2.0), (32, None))
    if fid
}


@pytest.fixture
def runs(tmp_path):
    """Run folders of which one has results."""
    about = dict(
        source="some clips (CC0)",
        jax="0.10",
        seeds={"training": 3},
        git_commit="abc",
        evaluator={"fingerprint": "f00d", "reference_clips": "c11"},
        arguments={"steps": [2, 4, 8, 16]},
    )
    put(tmp_path / "runs" / "sweep_camdm" / "table.json", SWEEP, **about)
    return tmp_path / "runs"


def test_a_report_has_values_verdicts_and_what_is_missing(call, runs, tmp_path, capsys):
    out = tmp_path / "out"
    call(f"--runs {runs} --out {out}")
    shown, text = capsys.readouterr().out, (out / "report.md").read_text()
    whole = json.loads((out / "report.json").read_text())
    assert " not run\n" in shown and str(out) in shown
    verdicts = {(x["table"], x["claim"]): x["verdict"] for x in whole["claims"]}
    five = {k[1]: v for k, v in verdicts.items() if k[0] == "CAMDM, table 5"}
    assert five == {
        "up to 8 steps FID falls": "not decided",
        "8 steps have a lower FID than 16 and 32": "not run",
        "up to 8 steps feet slide less": "not decided",
        "feet slide least with 16 steps": "not run",
    }
    others = [v for k, v in verdicts.items() if k[0] != "CAMDM, table 5"]
    assert len(others) > 50 and set(others) == {"not run"}
    # The paper's value above the one here; sources; a command for what is missing.
    assert "*0.938*<br>5 [4.9, 5.1] (n=20)" in text
    for told in ("some clips (CC0)", "jax 0.10", "abc", "f00d", "c11", "'training': 3"):
        assert told in text
    assert f"python experiments/aamdm.py evaluate --run {runs}/aamdm" in text
    rows = next(
        x for x in whole["tables"] if x["paper"] == "CAMDM" and x["table"] == "5"
    )
    assert rows["rows"]["2 steps"]["cells"]["FID"]["paper"] == 0.938
    assert rows["rows"]["2 steps"]["cells"]["FID"]["here"]["value"] == 5.0
    assert rows["rows"]["32 steps"]["cells"]["FID"]["here"] is None
    assert "100STYLE" in text and len(whole["cannot be run"]) > 5


def test_a_report_over_trainings_has_both_intervals(call, runs, tmp_path, capsys):
    out = tmp_path / "out"
    for seed, shift in ((1, 0.2), (2, -0.2)):
        rows = {
            row: {k: v | {"value": v["value"] + shift} for k, v in cells.items()}
            for row, cells in SWEEP.items()
        }
        about = dict(seeds={"training": seed}, arguments={"steps": [2, 4, 8, 16]})
        put(runs / f"sweep_camdm_seed{seed}" / "table.json", rows, **about)
    with pytest.raises(ValueError, match="seed1/table.json: trained with seed 1"):
        given = ",".join([f"{runs}/sweep_camdm_seed1"] * 2)
        call(f"--runs {runs} --elsewhere sweep_camdm={given} --out {out}")
    call(f"--runs {runs} --seeds 4 --out {out}")
    shown, text = capsys.readouterr().out, (out / "report.md").read_text()
    assert f"a training is missing: no {runs}/sweep_camdm_seed3/table.json" in shown
    assert "\n1 reproduced\n" in f"\n{shown}"
    assert "of the papers' results cannot be run here" in shown
    low, high = scipy.stats.t.interval(0.95, 2, 5.0, scipy.stats.sem([5, 5.2, 4.8]))
    both = f"5 [{low:.3g}, {high:.3g}] of 3 trainings<br>first: 5 [4.9, 5.1] (n=20)"
    assert f"*0.938*<br>{both}" in text
    assert f"--out {runs}/sweep_camdm_seed2 --seed 2" in text
    whole = json.loads((out / "report.json").read_text())
    claim = next(x for x in whole["claims"] if x["claim"] == "up to 8 steps FID falls")
    assert (claim["verdict"], claim["trainings"]) == ("reproduced", 3)
    made = np.array([x["of each training"] for x in claim["differences"]])
    np.testing.assert_allclose(made, np.ones((2, 3)), atol=1e-9)
    assert re.search(r"<br>4 steps less 8 steps: 1 \[.*\] of 3 trainings<br>", text)


def test_a_run_folder_can_be_elsewhere(load, runs, tmp_path):
    report = load("report")
    (tmp_path / "mine").mkdir()
    args = report.Config(runs=runs, elsewhere=(f"aamdm={tmp_path / 'mine'}",))
    folders = {source.run: path for source, path in report.folders_of(args).items()}
    assert folders["aamdm"] == (tmp_path / "mine",)
    assert folders["camdm_small"] == (runs / "camdm_small",)


def test_trainings_have_folders_of_their_own(load, runs):
    report = load("report")
    (runs / "b").mkdir()
    given = (f"aamdm={runs},{runs / 'b'}",)
    args = report.Config(runs=runs, seeds=3, elsewhere=given)
    folders = {source.run: path for source, path in report.folders_of(args).items()}
    assert folders["aamdm"] == (runs, runs / "b")
    assert [path.name for path in folders["sweep_camdm"]] == [
        "sweep_camdm",
        "sweep_camdm_seed1",
        "sweep_camdm_seed2",
    ]
    source = next(x for x in folders if x == "sweep_camdm")
    source = next(x for x in load("reports.writing").SOURCES if x.run == source)
    own = folders["sweep_camdm"]
    (shown,) = zip(
        *(report.commands_of(source, x, i) for i, x in enumerate(own)), strict=True
    )
    assert [line.partition("--out ")[2] for line in shown] == [
        f"{runs}/sweep_camdm",
        f"{runs}/sweep_camdm_seed1 --seed 1",
        f"{runs}/sweep_camdm_seed2 --seed 2",
    ]


def test_a_missing_folder_is_named(call, runs, tmp_path):
    with pytest.raises(OSError, match="runs: no folder .*gone"):
        call(f"--runs {tmp_path}/gone --out {tmp_path}/out")
    with pytest.raises(OSError, match="no folder .*gone for emdm_text"):
        call(
            f"--runs {runs} --elsewhere emdm_text={tmp_path}/gone --out {tmp_path}/out"
        )
    with pytest.raises(
        ValueError, match="'emd=a', expected name=folder with a name of"
    ):
        call(f"--runs {runs} --elsewhere emd=a --out {tmp_path}/out")
    (tmp_path / "plain").write_text("")
    with pytest.raises(OSError, match="plain"):
        call(f"--runs {runs} --out {tmp_path}/plain/below")


DAMAGED = {
    '{"rows": {': "not JSON, line 1 column 11",
    "[]": "field '.whole file.' is \\[\\], expected an object",
    "{}": "field 'rows' is missing",
    '{"rows": 3}': "field 'rows' is 3, expected an object",
    '{"rows": {"a": 3}}': "field 'rows.a' is 3",
    '{"rows": {}, "training": [1]}': "field 'training' is \\[1\\], expected an object",
    '{"rows": {}, "seeds": {"training": [[1]]}}': "field 'seeds.training' is \\[1\\]",
    '{"rows": {"a": {"b": 3}}}': "field 'rows.a.b' is 3",
    '{"rows": {"a": {"b": {"samples": 1}}}}': "field 'rows.a.b.value' is missing",
    '{"rows": {"a": {"b": {"value": 1}}}}': "field 'rows.a.b.samples' is missing",
    '{"rows": {"a": {"b": {"value": "1", "samples": 1}}}}': "a.b.value' is '1'",
    '{"rows": {"a": {"b": {"value": 1, "low": [], "samples": 1}}}}': "b.low' is",
    '{"rows": {"a": {"b": {"value": 1, "samples": 1.5}}}}': "b.samples' is 1.5",
}


@pytest.mark.parametrize("text", DAMAGED)
def test_a_damaged_file_is_named_with_its_field(call, runs, tmp_path, text):
    path = runs / "sweep_camdm" / "table.json"
    path.write_text(text)
    with pytest.raises(ValueError, match=DAMAGED[text]) as error:
        call(f"--runs {runs} --out {tmp_path}/out")
    assert str(path) in str(error.value) and "\n" not in str(error.value)
    assert not (tmp_path / "out").exists()
