"""Waypoints: what they ask of somebody who obeys late."""

import numpy as np
import pytest

from jaxmotion.control import goals, waypoints
from jaxmotion.control.steering import Wish

FPS = 30.0


def walk(clicks, seconds, *, speed=1.4):
    """Places [ticks, 2] and wishes of who gets waypoints at their times, seconds."""
    place = velocity = own = np.zeros(2)
    last, route, places, wishes = Wish(), waypoints.Route(), [], []
    for tick in range(round(seconds * FPS)):
        points = tuple(point for at, point in clicks if at * FPS <= tick)
        here = (float(place[0]), float(place[1]))
        route = waypoints.routed(route, points, here)
        last, route = waypoints.along(
            route, last, position=here, velocity=tuple(velocity), speed=speed
        )
        own = 0.85 * own + 0.15 * np.array(last.velocity)
        place = place + own / FPS
        velocity = goals.averaged(velocity, own, FPS)
        places.append(place)
        wishes.append(last)
    return np.array(places), wishes


@pytest.mark.parametrize("late", [1.0, 6.0])
def test_a_route_is_lengthened_on_the_way_and_after_its_end(late):
    places, wishes = walk([(0.0, (0.0, 3.0)), (late, (3.0, 3.0))], late + 8.0)
    away = lambda x: np.linalg.norm(places - np.array(x), axis=1)  # noqa: E731
    # He looks half a meter ahead, and so cuts corners a little.
    assert away((0.0, 3.0)).min() < 0.45 and away((3.0, 3.0))[-1] < 0.15
    off = np.minimum(np.abs(places[:, 0]), np.abs(places[:, 1] - 3.0))
    assert off.max() < 0.35
    speeds = np.array([wish.speed for wish in wishes])
    assert speeds.max() == pytest.approx(1.4, abs=1e-5)
    # He stands at last, and faces as he came.
    assert not speeds[-30:].any()
    np.testing.assert_allclose(wishes[-1].facing, (1.0, 0.0), atol=0.2)


def test_who_ends_where_he_begins_goes_all_the_way():
    corners = [(0.0, 2.0), (2.0, 2.0), (2.0, 0.0), (0.0, 0.0)]
    places, wishes = walk([(0.0, x) for x in corners], 12.0, speed=1.2)
    for corner in corners:
        assert np.linalg.norm(places - np.array(corner), axis=1).min() < 0.45
    assert np.linalg.norm(places[-1]) < 0.15 and wishes[-1].speed == 0


def test_more_waypoints_than_a_route_holds_are_told():
    with pytest.raises(ValueError, match="33 waypoints, expected at most 32"):
        waypoints.routed(waypoints.Route(), ((0.0, 1.0),) * 33, (0.0, 0.0))
