"""Metrics on random input against loops in float64, written from their definitions.

Only those whose own test has none.
"""

import cmath

import jax.numpy as jnp
import numpy as np
import pytest

from jaxmotion.evaluation import (
    alignment,
    contact,
    health,
    modes,
    plausibility,
)
from jaxmotion.motion.ground import angle_from_to

FPS = 30.0


def angle(a, b):
    """From one direction (x, z) to another, by complex numbers, toward +x."""
    return cmath.phase(complex(b[1], b[0]) / complex(a[1], a[0]))


def tracks(seed, frames=25):
    """Wanted velocities and walked paths with pauses in both."""
    rng = np.random.default_rng(seed)
    wanted = rng.normal(size=(frames, 2)) * (rng.uniform(size=(frames, 1)) < 0.8)
    steps = rng.normal(size=(frames, 2)) * (rng.uniform(size=(frames, 1)) < 0.8)
    path = np.cumsum(steps / FPS, axis=0)
    return wanted.astype(np.float32), path.astype(np.float32)


@pytest.mark.parametrize("seed", range(4))
def test_trajectory_error(seed):
    wanted, path = tracks(seed)
    errors = []
    for f in range(len(path) - 1):
        step = (path[f + 1].astype(float) - path[f]) * FPS
        if min(np.hypot(*step), np.hypot(*wanted[f].astype(float))) >= 0.1:
            errors.append(abs(angle(wanted[f].astype(float), step)))
    got = alignment.trajectory_error(jnp.asarray(wanted), jnp.asarray(path), FPS)
    np.testing.assert_allclose(got.error, np.mean(errors), atol=1e-4)
    np.testing.assert_allclose(got.used, len(errors) / 24, rtol=1e-6)
    assert 5 < len(errors) < 24


def test_heading_and_orientation_errors():
    a, b = np.random.default_rng(0).normal(size=(2, 30, 2)).astype(np.float32)
    signed = [
        angle(x, y) for x, y in zip(a.astype(float), b.astype(float), strict=True)
    ]
    a, b = jnp.asarray(a), jnp.asarray(b)
    np.testing.assert_allclose(angle_from_to(a, b), signed, atol=1e-5)
    np.testing.assert_allclose(
        alignment.orientation_error(a, b), np.mean(np.abs(signed)), atol=1e-5
    )


def feet(seed, frames=40):
    """Feet that come down and go up, at speeds on both sides of the bound."""
    rng = np.random.default_rng(seed)
    steps = rng.normal(size=(frames, 2, 3)) * 0.02
    path = np.cumsum(steps, axis=0)
    path[..., 1] = rng.normal(size=(frames, 2)) * 0.05
    return path.astype(np.float32)


@pytest.mark.parametrize("seed", range(4))
def test_skate_ratio(seed):
    path = feet(seed)
    skating = 0
    for now, after in zip(path[:-1].astype(float), path[1:].astype(float), strict=True):
        for k in range(2):
            low = now[k, 1] < 0.05 and after[k, 1] < 0.05
            if low and np.hypot(*(after - now)[k, ::2]) * FPS > 0.5:
                skating += 1
                break
    got = contact.skate_ratio(jnp.asarray(path), FPS)
    np.testing.assert_allclose(got, skating / 39, rtol=1e-6)
    assert 0 < skating < 39


@pytest.mark.parametrize("seed", range(4))
def test_plausibility(seed):
    path = feet(seed)
    low = [min(frame[:, 1].astype(float)) - 0.01 for frame in path]
    sunk = 1000 * np.mean([-y if y < -0.005 else 0.0 for y in low])
    high = 1000 * np.mean([y if y > 0.005 else 0.0 for y in low])
    slid = [
        1000 * np.hypot(*(path[f + 1, k, ::2].astype(float) - path[f, k, ::2]))
        for f in range(len(path) - 1)
        for k in range(2)
        if max(path[f, k, 1], path[f + 1, k, 1]) - 0.01 <= 0.005
    ]
    for measure, want in (
        (plausibility.penetration, sunk),
        (plausibility.floating, high),
        (plausibility.skating, np.mean(slid)),
    ):
        got = measure(jnp.asarray(path), ground=0.01)
        np.testing.assert_allclose(got, want, rtol=1e-4)
        assert want > 0


@pytest.mark.parametrize("seed", range(6))
def test_frozen_and_diverged(seed):
    """Limbs that stand in a random part of the windows, with a slow or fast wish."""
    rng = np.random.default_rng(seed)
    frames, length = 65, 15  # windows of half a second
    moves = np.repeat(rng.uniform(size=5) < 0.5, length)[:frames, None, None]
    steps = rng.normal(size=(frames, 3, 3)) * np.where(moves, 0.05, 0.0)
    x = (np.cumsum(steps, axis=0) + np.array([0.0, 1.0, 0.0])).astype(np.float32)
    speed = np.repeat(rng.uniform(0.1, 0.8, 5), length)[:frames]
    wanted = np.stack([speed, 0 * speed], -1).astype(np.float32)
    frozen = np.zeros(frames, bool)
    for start in range(0, frames - length, length):
        limbs = [x[f, 1:].astype(float) - x[f, 0] for f in range(frames)]
        gaps = [
            np.linalg.norm(limbs[f + 1] - limbs[f], axis=-1).mean() * FPS
            for f in range(start, start + length)
        ]
        asked = np.hypot(*wanted[start : start + length].T.astype(float))
        if np.mean(gaps) < 0.05 and asked.min() > 0.3:
            frozen[start : start + length] = True
    x, wanted = jnp.asarray(x), jnp.asarray(wanted)
    options = dict(fps=FPS, seconds=0.5)
    np.testing.assert_array_equal(health.frozen_frames(x, wanted, **options), frozen)
    assert bool(health.is_frozen(x, wanted, **options)) == frozen.any()
    bounds = dict(min_root=0.9, max_root=1.1, max_speed=4.0)
    diverged = np.zeros(frames, bool)
    for f in range(frames):
        diverged[f] = not 0.9 <= x[f, 0, 1] <= 1.1
        if f:
            gap = np.float64(x[f]) - np.float64(x[f - 1])
            diverged[f] |= np.linalg.norm(gap, axis=-1).max() * FPS > 4.0
    found = health.diverged_frames(x, fps=FPS, **bounds)
    np.testing.assert_array_equal(found, diverged)
    assert bool(health.has_diverged(x, fps=FPS, **bounds)) == diverged.any()


def test_mode_scores():
    rng = np.random.default_rng(0)
    centers = np.array([[-1.0, 0.0], [1.0, 0.0], [0.0, 2.0]])
    mode = rng.choice(3, size=(200, 4), p=[0.5, 0.3, 0.2])
    points = centers[mode] + 0.2 * rng.standard_t(3, size=(200, 4, 2))
    near = np.zeros((200, 4), int)
    inside = np.zeros((200, 4), bool)
    off = []
    for i, t in np.ndindex(200, 4):
        gaps = [np.hypot(*(points[i, t] - c)) for c in centers]
        near[i, t], inside[i, t] = int(np.argmin(gaps)), min(gaps) <= 0.6
        if inside[i, t]:
            off += list(points[i, t] - centers[near[i, t]])
    shares = np.array([np.mean(near == k) for k in range(3)])
    pairs = np.zeros((3, 3))
    for i, t in np.ndindex(200, 3):
        pairs[near[i, t], near[i, t + 1]] += 1 / 600
    found = modes.mode_scores(points, centers, sigma=0.2)
    for name, want in {
        "least_modes_covered": 3,
        "within_3_sigma": inside.mean(),
        "least_within_3_sigma": min(inside[:, t].mean() for t in range(4)),
        "spread": np.sqrt(np.mean(np.square(off))) / 0.2,
        "kl_to_uniform": sum(p * np.log(3 * p) for p in shares),
        "transition_distance": 0.5 * np.abs(pairs - 1 / 9).sum(),
    }.items():
        assert found[name] == pytest.approx(want, rel=1e-6), name
