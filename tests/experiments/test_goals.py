"""experiments/goals.py: paths, places, and how far from them somebody is."""

import dataclasses

import jax.numpy as jnp
import numpy as np
import pytest

import jaxmotion as jm
from jaxmotion.control.frame import Frame


def test_the_s_is_fourteen_meters_long_and_closes_no_corner(load):
    goal = load("goals").s_shapes(5, seed=0)
    steps = np.diff(np.asarray(goal.points), axis=1)
    lengths = np.linalg.norm(steps, axis=-1)
    np.testing.assert_allclose(lengths.sum(axis=1), 14.0, rtol=1e-3)
    cosines = np.sum(steps[:, 1:] * steps[:, :-1], axis=-1)
    assert (cosines / (lengths[:, 1:] * lengths[:, :-1])).min() > 0.99
    np.testing.assert_array_equal(goal.points[:, 0], 0.0)


def test_distances_are_to_the_nearest_point_of_the_line(load):
    generator = np.random.default_rng(0)
    points, places = generator.normal(size=(6, 2)), generator.normal(size=(50, 2))
    part = np.linspace(0.0, 1.0, 2001)[:, None]
    dense = np.concatenate(
        [a + part * (b - a) for a, b in zip(points[:-1], points[1:], strict=True)]
    )
    expected = np.linalg.norm(places[:, None] - dense[None], axis=-1).min(axis=1)
    found = load("goals").distances_to_path(places, points)
    np.testing.assert_allclose(found, expected, atol=2e-3)


def test_places_are_reached_at_a_walk(load):
    goal = load("goals").some_places(200, seed=0)
    away = np.linalg.norm(np.asarray(goal.position), axis=1)
    assert away.min() >= 1.0 and away.max() <= 5.0
    assert (away / (np.asarray(goal.seconds) - 2.0)).max() < 1.25
    np.testing.assert_allclose(np.linalg.norm(goal.facing, axis=1), 1.0, rtol=1e-5)


def test_who_comes_near_and_who_arrives_is_counted(load):
    """Two pass at 30 cm and arrive; the third stays where he is."""
    ticks = np.linspace(-2.0, 2.0, 41)
    still = np.full(41, 9.0)
    x = np.stack([np.full(41, 0.0), np.full(41, 0.3), still])
    z = np.stack([ticks, -ticks, still])
    root = jnp.asarray(np.stack([x, np.ones_like(x), z], axis=-1), jnp.float32)
    frames = Frame(
        root_position=root,
        joint_rotation=jnp.zeros((3, 41, 1, 6)),
        desired_velocity=jnp.zeros((3, 41, 2)),
        desired_facing=jnp.zeros((3, 41, 2)),
        planned=jnp.zeros((3, 41), bool),
        extra={},
        fps=30.0,
    )
    wanted = np.array([[0.0, 2.0], [0.3, -2.1], [0.0, 0.0]])
    row = load("goals").crossing_row(None, frames, wanted)
    assert row["gap"].value == pytest.approx(30.0, abs=0.01)
    assert row["touching"].value == pytest.approx(2 / 3)
    assert row["arrived"].value == pytest.approx(2 / 3)


@pytest.mark.slow
@pytest.mark.parametrize("fetches", [True, False])
def test_shipped_players_fetch_their_ball(load, fetches):
    """All of eight within six seconds, wherever it went; without the rule not all."""
    model = jm.load("dribble")
    if not fetches:
        inner = model.method.method
        control = dataclasses.replace(inner.control, fetch=0.0)
        method = dataclasses.replace(inner, control=control)
        locked = dataclasses.replace(model.method, method=method)
        model = dataclasses.replace(model, method=locked)
    found = load("goals").fetch_errors(model, 8, 0)
    back = (found["fetch"] < 6.0) & (found["ball_end"] < 80.0)
    assert back.all() == fetches, found


@pytest.mark.slow
def test_who_does_not_rest_at_his_place_is_counted(load, monkeypatch):
    """One stands, one creeps, one walks on, and one walks for half of that time."""
    script, model = load("goals"), jm.load("walker")
    ticks = np.arange(round(9.0 * model.fps)) / model.fps
    due = np.asarray(script.some_places(4, seed=0).seconds)
    half = due[3] + script.REST + (9.0 - due[3] - script.REST) / 2
    x = np.stack([0 * ticks, 0.1 * ticks, 0.3 * ticks, 0.3 * np.minimum(ticks, half)])
    root = jnp.asarray(np.stack([x, np.ones_like(x), 0 * x], axis=-1), jnp.float32)
    still = jnp.zeros((*x.shape, 2))
    upright = jnp.eye(3)[:2].reshape(6)
    frames = Frame(
        root_position=root,
        joint_rotation=jnp.broadcast_to(
            upright, (*x.shape, model.skeleton.num_joints, 6)
        ),
        desired_velocity=still,
        desired_facing=still,
        planned=jnp.zeros(x.shape, bool),
        extra={},
        fps=model.fps,
    )
    monkeypatch.setattr(script.goals, "goal_rollouts", lambda *_, **__: frames)
    found = script.place_errors(model, 4, seed=0)["place_moves"]
    np.testing.assert_allclose(found, [0.0, 0.0, 1.0, 0.5], atol=0.1)
