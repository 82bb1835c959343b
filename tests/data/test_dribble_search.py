import numpy as np
import pytest

from jaxmotion.data.dribble import Dribble, Touches, next_touches
from jaxmotion.data.rolling import Body, roll

FRAMES, LAST = 31, 15
SETTINGS = Dribble()
ANGLES = np.radians([0.0, 30.0, 55.0, 65.0, 180.0])


def body(leg=None):
    """Somebody who stands at the origin with legs far above, or with one leg there."""
    legs = np.zeros((FRAMES, 1, 2, 3)) + [0.0, 100.0, 0.0]
    if leg is not None:
        legs = leg
    feet = np.zeros((FRAMES, 1))
    return Body(
        ground=0.0,
        root=np.zeros((FRAMES, 2)),
        toes=np.zeros((FRAMES, 1, 3)),
        velocity=np.zeros((FRAMES, 1, 2)),
        standing=feet.astype(bool),
        legs=legs,
        fps=30.0,
    )


def touches(distance=1.0, toe_speed=2.0):
    """A foot that swings along x, and half a second later feet in some directions."""
    away = np.stack([np.cos(ANGLES), np.sin(ANGLES)], -1)
    count = len(ANGLES)
    return Touches(
        frame=np.array([0] + count * [LAST]),
        foot=np.zeros(count + 1, int),
        place=np.concatenate([np.zeros((1, 2)), distance * away]),
        direction=np.concatenate([[[1.0, 0.0]], away]),
        speed=np.array([toe_speed] + count * [9.0]),
    )


def ways(body, touches, arrive=(0.0, 0.0), **changes):
    found, _ = next_touches(body, touches, 0, np.array(arrive), Dribble(**changes))
    return (np.degrees(ANGLES)[found - 1]).round().tolist()


def test_a_foot_pushes_forwards_within_its_cone():
    assert ways(body(), touches()) == [0, 30, 55]
    assert ways(body(), touches(), cone=np.radians(40.0)) == [0, 30]


def test_the_change_of_velocity_is_what_the_foot_makes():
    """1 m in half a second leaves at 2.2 m/s; a ball that came at (0, 2.2) along z."""
    # From (0, 2.2) to 2.2 (cos, sin): 45 degrees back for 0, 30 for 30, 17.5 for 55.
    assert ways(body(), touches(), arrive=(0.0, 2.2)) == [0, 30, 55, 65]
    # What already goes as fast as the foot cannot be pushed by it.
    assert ways(body(), touches(), arrive=(2.1, 0.0)) == []


def test_a_ball_leaves_no_faster_than_the_foot_and_its_bounce():
    # 2.2 m/s from rest needs a foot of 2.2 / (1 + 0.6) = 1.375 m/s.
    assert 0 in ways(body(), touches(toe_speed=1.38))
    assert 0 not in ways(body(), touches(toe_speed=1.37))
    assert ways(body(), touches(), max_speed=2.1) == []


def test_touches_come_in_time():
    assert 0 in ways(body(), touches(), gap=(0.5, 0.5))
    assert ways(body(), touches(), gap=(0.3, 0.49)) == []
    assert ways(body(), touches(), gap=(0.51, 1.2)) == []


def test_the_ball_stays_within_reach():
    assert 0 in ways(body(), touches(distance=1.2), reach=1.21)
    assert ways(body(), touches(distance=1.2), reach=1.19) == []


def test_a_leg_in_the_way_leaves_the_other_ways():
    leg = np.zeros((FRAMES, 1, 2, 3)) + [0.5, 0.0, 0.0]
    leg[:, :, 1, 1] = 0.5
    assert ways(body(leg), touches()) == [30, 55]


@pytest.mark.parametrize("frame", [0, 2, 3, 7, 12, 13, 15, 16])
@pytest.mark.parametrize("nearer", [-0.001, 0.01, 0.021])
def test_legs_come_nearer_about_touches_only(frame, nearer):
    """For one frame a leg is beside the ball that rolls along x."""
    leg = np.zeros((FRAMES, 1, 2, 3)) + [0.0, 100.0, 0.0]
    time = np.array([[min(frame, LAST) / 30.0]])
    way = roll(np.array([[1.0, 0.0]]), np.array([0.5]), SETTINGS.deceleration, time)
    away = SETTINGS.radius + SETTINGS.thickness - nearer
    leg[frame] = [way[0, 0, 0], SETTINGS.radius, -away]
    touching = frame <= 2 or frame >= LAST - 2
    fine = nearer < 0 or frame > LAST or (touching and nearer <= SETTINGS.give)
    assert (0 in ways(body(leg), touches())) == fine
