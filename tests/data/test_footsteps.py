import numpy as np
import pytest

from jaxmotion.data import footsteps

FPS = 30.0


def plan(path, yaw, **changes):
    options = dict(
        fps=FPS,
        cadence=1.2,
        cadence_slope=0.6,
        double_support=0.2,
        width=0.2,
        toe_ahead=0.1,
        toe_height=0.03,
        lift=0.08,
        toe_out=0.0,
        generator=np.random.default_rng(0),
        jitter=0.0,
    )
    return footsteps.plan_footsteps(path, yaw, **(options | changes))


def straight(speed, frames=300, heading=0.0):
    time = np.arange(frames)[:, None] / FPS
    path = speed * time * np.array([np.sin(heading), np.cos(heading)])
    return path, np.full(frames, heading)


def lift_offs(contact):
    """Frames in which a foot leaves the ground, one array a foot."""
    up = contact[:-1] & ~contact[1:]
    return [np.flatnonzero(up[:, foot]) for foot in (0, 1)]


def test_nobody_steps_while_the_body_stands():
    found = plan(np.zeros((200, 2)), np.full(200, 0.3))
    assert found.contact.all()
    np.testing.assert_array_equal(found.toe, np.broadcast_to(found.toe[0], (200, 2, 3)))
    # Half the width to each side, 0.1 m ahead, in the frame of the body.
    lateral = np.array([np.cos(0.3), -np.sin(0.3)])
    ahead = np.array([np.sin(0.3), np.cos(0.3)])
    expected = 0.1 * ahead + np.array([[0.1], [-0.1]]) * lateral
    np.testing.assert_allclose(found.toe[0, :, ::2], expected, atol=1e-12)
    np.testing.assert_array_equal(found.phase, 0.0)


@pytest.mark.parametrize("speed", [0.3, 0.8, 1.5])
def test_feet_alternate_at_the_cadence(speed):
    found = plan(*straight(speed))
    left, right = lift_offs(found.contact)
    order = np.argsort(np.concatenate([left, right]))
    side = np.repeat([0, 1], [left.size, right.size])[order]
    assert np.all(side[1:] != side[:-1])
    # Steps per second as commanded, to half a frame of rounding a step.
    between = np.diff(np.sort(np.concatenate([left, right])))
    assert abs(between.mean() - FPS / (1.2 + 0.6 * speed)) <= 0.5
    assert found.contact.any(axis=1).all(), "somebody always stands"


def test_the_stance_is_centered_under_the_body():
    speed = 1.0
    path, yaw = straight(speed)
    found = plan(path, yaw)
    step = speed / (1.2 + 0.6 * speed)
    # Averaged over the stance, a foot is where it would stand at rest, but for half of
    # the time in which both stand (a fifth of a step).
    gap = (found.toe[..., 2] - path[:, 1:] - 0.1)[60:240]
    gap = gap[found.contact[60:240]]
    assert abs(gap.mean()) < 0.1 * step + 0.01
    # From landing to lift-off the body covers 1.2 steps.
    assert np.ptp(gap) == pytest.approx(1.2 * step, rel=0.1)


@pytest.mark.parametrize("double_support", [0.1, 0.4])
def test_both_feet_stand_for_the_part_asked_for(double_support):
    found = plan(*straight(0.6, 900), double_support=double_support)
    both = found.contact.all(axis=1)[60:-60].mean()
    assert abs(both - double_support) < 0.05


def test_a_standing_toe_is_at_one_point_and_a_swinging_one_above_the_ground():
    rng = np.random.default_rng(3)
    velocity = np.repeat(rng.normal(0, 0.8, (10, 2)), 60, axis=0)
    path = np.cumsum(velocity, axis=0) / FPS
    yaw = np.cumsum(np.repeat(rng.normal(0, 1.0, 10), 60)) / FPS
    found = plan(path, yaw, jitter=0.02, generator=rng)
    both = found.contact[1:] & found.contact[:-1]
    np.testing.assert_array_equal(np.diff(found.toe, axis=0)[both], 0.0)
    np.testing.assert_array_equal(np.diff(found.yaw, axis=0)[both], 0.0)
    np.testing.assert_array_equal(found.toe[found.contact][:, 1], 0.03)
    assert np.all(found.toe[~found.contact][:, 1] > 0.03)
    assert np.all((found.swing > 0) == ~found.contact)
    assert both.any() and (~found.contact).any()


def test_turning_on_the_spot_steps_until_the_feet_face_ahead():
    yaw = np.concatenate([np.zeros(30), np.linspace(0, 2.0, 60), np.full(120, 2.0)])
    found = plan(np.zeros((210, 2)), yaw)
    assert not found.contact.all()
    np.testing.assert_allclose(found.yaw[-1], 2.0, atol=0.36)
    assert found.contact[-30:].all()


def test_the_highest_point_of_a_swing_is_the_lift():
    found = plan(*straight(0.8), lift=0.2)
    # A fresh random factor of 8 % a step; the top lies between two frames.
    assert 0.15 < found.toe[..., 1].max() - 0.03 < 0.26


def test_phase_grows_by_pi_each_step():
    found = plan(*straight(1.0))
    assert np.all(np.diff(found.phase) >= 0)
    steps = sum(off.size for off in lift_offs(found.contact))
    assert abs(found.phase[-1] / np.pi - steps) <= 1.0


def test_smoothstep_and_wrap_in_closed_form():
    np.testing.assert_allclose(
        footsteps.smoothstep(np.array([0.0, 0.5, 1.0])), [0, 0.5, 1]
    )
    h = 1e-4
    ends = footsteps.smoothstep(np.array([h, 1 - h]))
    np.testing.assert_allclose(ends, [0, 1], atol=20 * h**3)
    angle = np.linspace(-10, 10, 101)
    found = footsteps.wrap(angle)
    assert np.all((found >= -np.pi) & (found < np.pi))
    np.testing.assert_allclose(np.exp(1j * found), np.exp(1j * angle), atol=1e-12)
