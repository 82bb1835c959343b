"""The table of tiny clips, with rollouts that are known to be good or frozen."""

import dataclasses
import functools
import json

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxmotion import reporting
from jaxmotion.data import selection, windows
from jaxmotion.evaluation import table
from jaxmotion.evaluators import network
from jaxmotion.evaluators import style as style_evaluator
from jaxmotion.systems.camdm import scoring as camdm_scoring
from tests import samples, tiny

LABELS = np.repeat([0, 1], 2)
TRUTH, FLOOR = "held-out (ground truth)", "training half vs half (noise floor)"


@dataclasses.dataclass(frozen=True, kw_only=True)
class Small(style_evaluator.Config):
    """With 32 features instead of 512: distances of 512 take seconds."""

    @property
    def network(self):
        return network.WindowClassifier(self.num_classes, num_features=32)


@functools.cache
def parts(trained=False):
    """Four training clips a style, so that both halves hold two of each.

    An evaluator that was not trained has features as good for what moves otherwise.
    """
    run = samples.run()
    train, held_out = selection.split_clips(
        samples.clips(minutes=0.8), fraction=0.33, seed=0, field="style"
    )
    config = Small(
        num_classes=2,
        num_joints=train.skeleton.num_joints,
        frames=style_evaluator.EVAL_WINDOW,
    )
    evaluator = style_evaluator.StyleEvaluator(
        params=tiny.random_params(style_evaluator.init, config),
        config=config,
    )
    if trained:
        evaluator = style_evaluator.fit(
            jax.random.key(0), train, field="style", num_steps=40, batch=16
        )
    real = windows.eval_windows(held_out, stride=10, field="style")
    dense = windows.eval_windows(train, stride=10, field="style")
    return run, evaluator, real, dense


@functools.cache
def walked():
    """Two a style."""
    return samples.walking(LABELS, seconds=14.0)


@functools.cache
def evaluated(kind, trained=False):
    """Characters that walk, two a style; or that stand, each as if alone."""
    run, evaluator, real, dense = parts(trained)
    frames = walked()
    frames = samples.standing(frames) if kind == "standing" else frames
    repeats = 1 if kind == "standing" else 2
    made = windows.rollout_windows(frames, jnp.asarray(LABELS), skip=60)
    skeleton = run.model.skeleton
    reference = camdm_scoring.make_reference(skeleton, real, dense, evaluator, seed=0)
    count = reference.count(len(made.label))
    truth, floor = camdm_scoring.real_rows(reference, count=count, seed=0)
    row = camdm_scoring.made_row(reference, made, repeats=repeats, count=count, seed=0)
    report = {
        "contact_height_m": reference.height,
        "windows": {"held_out": len(reference.hits), "rollouts": len(made.label)},
        "fid_windows": count,
        "health": camdm_scoring.rollout_health(
            skeleton, frames, fps=30.0, height=reference.root
        ),
    }
    return {TRUTH: truth, FLOOR: floor, "rollouts": row}, report


@pytest.mark.slow
def test_the_rows_and_columns_are_there():
    rows, report = evaluated("walking")
    assert list(rows) == [TRUTH, FLOOR, "rollouts"]
    assert set(rows[FLOOR]) == {"fid"}
    assert set(rows["rollouts"]) - set(rows[TRUTH]) == {"pose_variance"}
    assert len(rows[TRUTH]) == 8
    for name, row in rows.items():
        for column, cell in row.items():
            assert np.isfinite(cell.value), (name, column)
            assert cell.low is None or cell.low <= cell.value <= cell.high
    assert rows["rollouts"]["style_accuracy"].samples == 4
    assert report["windows"] == {"held_out": 28, "rollouts": 24}
    assert report["fid_windows"] == 24
    assert report["contact_height_m"] == pytest.approx(0.04, abs=1e-3)


@pytest.mark.slow
def test_styles_are_recognized_far_above_chance():
    rows, _ = evaluated("walking", trained=True)
    assert rows[TRUTH]["style_accuracy"].value > 75.0
    assert rows["rollouts"]["style_accuracy"].value > 75.0


@pytest.mark.slow
def test_walking_is_nearer_to_the_data_than_standing_and_noise_is_nearest():
    walking, standing = evaluated("walking")[0], evaluated("standing")[0]
    assert walking[TRUTH] == standing[TRUTH] and walking[FLOOR] == standing[FLOOR]
    floor = walking[FLOOR]["fid"].value
    frozen = standing["rollouts"]["fid"].value
    assert floor < frozen
    assert walking["rollouts"]["fid"].value < frozen
    for column in ("acceleration", "jerk"):
        assert standing["rollouts"][column].value < 1e-2
        assert walking["rollouts"][column].value > 1.0


@pytest.mark.slow
def test_health_counts_who_stands_although_told_to_walk():
    assert evaluated("walking")[1]["health"] == dict(diverged=0, frozen=0, rollouts=4)
    assert evaluated("standing")[1]["health"] == dict(diverged=0, frozen=4, rollouts=4)
    run = parts()[0]
    frames = jax.tree.map(lambda x: x[:1], walked())
    broken = frames.root_position.at[0, 50, 1].set(5.0)
    frames = dataclasses.replace(frames, root_position=broken)
    found = camdm_scoring.rollout_health(
        run.model.skeleton, frames, fps=30.0, height=0.95
    )
    assert found == dict(diverged=1, frozen=0, rollouts=1)


@pytest.mark.slow
def test_planted_feet_score_as_planted_in_both_rows():
    rows, _ = evaluated("walking")
    for name in (TRUTH, "rollouts"):
        assert rows[name]["foot_slide"].value < 0.15
        assert rows[name]["skate_ratio"].value < 0.05
        assert rows[name]["orientation_error"].value < 15.0
        assert rows[name]["trajectory_error"].value < 35.0


@pytest.mark.slow
def test_without_repeats_there_is_no_diversity():
    assert "pose_variance" not in evaluated("standing")[0]["rollouts"]


@pytest.mark.slow
def test_diversity_is_zero_for_characters_that_do_the_same():
    run = parts()[0]
    same = jax.tree.map(lambda x: jnp.repeat(x[::2], 2, axis=0), walked())
    found = windows.rollout_windows(same, jnp.asarray(LABELS), skip=60)
    found = camdm_scoring.repeat_diversity(run.model.skeleton, found, repeats=2)
    assert found.value == pytest.approx(0.0, abs=1e-9) and found.samples == 2
    assert evaluated("walking")[0]["rollouts"]["pose_variance"].value > 1e-4


def test_a_row_without_evaluator_lacks_style_accuracy_only():
    run, _, real, _ = parts()
    row = camdm_scoring.metric_row(run.model.skeleton, real, None, height=0.04)
    expected = dict(evaluated("walking")[0][TRUTH])
    for column in ("style_accuracy", "fid"):
        del expected[column]
    assert list(row) == list(expected)
    for column, cell in expected.items():
        assert row[column].value == pytest.approx(cell.value, rel=1e-3, abs=1e-3)


def test_frechet_distance_of_a_shift_is_its_square():
    rng = np.random.default_rng(0)
    reference = rng.normal(size=(400, 3)).astype(np.float32)
    shifted = reference + np.array([2.0, 0.0, 0.0], np.float32)
    cell = camdm_scoring.frechet_cell(shifted, reference, count=400, seed=0)
    assert cell.value == pytest.approx(4.0, rel=1e-3)
    # All windows are one subset: five times the same have no interval.
    assert cell.samples == 1 and cell.low is None
    half = camdm_scoring.frechet_cell(shifted, reference, count=200, seed=0)
    assert half.samples == 5 and half.low < half.value < half.high


def test_intervals_of_frechet_distances_hold_what_they_estimate():
    """In 19 of 20 sets, though subsets share most of a set's windows."""
    rng = np.random.default_rng(0)
    reference = rng.normal(size=(4000, 4)).astype(np.float32)
    cells = [
        camdm_scoring.frechet_cell(
            rng.normal(size=(100, 4)).astype(np.float32), reference, count=80, seed=i
        )
        for i in range(60)
    ]
    mean = np.mean([cell.value for cell in cells])
    held = np.mean([cell.low < mean < cell.high for cell in cells])
    assert 0.85 < held <= 1.0


def test_halves_of_the_clips_share_no_clip_and_hold_each_style_alike():
    clips, styles = np.repeat(np.arange(14), 5), np.repeat([0, 1, 0], [20, 30, 20])
    halves = set()
    for seed in range(5):
        own = camdm_scoring.random_half(clips, styles, seed=seed)
        assert not set(clips[own]) & set(clips[~own])
        for style in (0, 1):
            number = len(set(clips[own & (styles == style)]))
            assert abs(number - len(set(clips[styles == style])) / 2) <= 0.5
        halves.add(tuple(own))
    assert len(halves) > 1
    with pytest.raises(ValueError, match="expected at least two"):
        camdm_scoring.random_half(np.zeros(5, int), np.zeros(5, int), seed=0)


def test_batches_put_together_are_the_whole():
    x = (np.arange(10.0), np.arange(20.0).reshape(10, 2))
    sizes = []

    def double(part):
        sizes.append(len(part[0]))
        return jax.tree.map(lambda a: 2 * a, part)

    found = style_evaluator.in_batches(double, x, size=4)
    assert sizes == [4, 4, 2]
    np.testing.assert_array_equal(found[0], 2 * x[0])
    np.testing.assert_array_equal(found[1], 2 * x[1])


def test_the_table_is_written_as_strict_json_and_markdown(tmp_path, capsys):
    rows, report = evaluated("standing")
    reporting.write_table(tmp_path, rows, report)

    def refuse(name):
        raise AssertionError(f"{name} is no JSON")

    text = (tmp_path / "metrics.json").read_text()
    found = json.loads(text, parse_constant=refuse)
    assert found["rows"] == json.loads(json.dumps(table.to_json(rows)))
    assert found["health"]["frozen"] == 4
    markdown = (tmp_path / "table.md").read_text()
    assert markdown.count("\n") == 5 and TRUTH in markdown
    assert markdown.strip() in capsys.readouterr().out


def test_an_unbiased_distance_is_nearer_to_the_true_one():
    """Gaussians a unit apart, few windows."""
    draw = np.random.default_rng(0).normal
    reference = draw(size=(20_000, 16)).astype(np.float32)
    apart = np.eye(16)[0].astype(np.float32)
    biased, unbiased = [], []
    for seed in range(8):
        features = draw(size=(120, 16)).astype(np.float32) + apart
        whole = camdm_scoring.unbiased_cells(features, reference, seed=seed)
        cell = whole["fid_unbiased"]
        assert cell.samples == 120 and cell.low is None
        unbiased.append(cell.value)
        whole = dict(count=120, seed=seed, repeats=1)
        biased.append(camdm_scoring.frechet_cell(features, reference, **whole).value)
    assert np.mean(biased) > 1.4
    error = np.std(unbiased, ddof=1) / np.sqrt(8)
    assert abs(np.mean(unbiased) - 1.0) < max(4 * error, 0.1) < 0.4
    assert camdm_scoring.unbiased_cells(features[:19], reference, seed=0) == {}
