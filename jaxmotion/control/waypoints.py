"""Waypoints that somebody sets: the path along them, and what it asks for now.

A path grows while it is walked: who sets one more waypoint lengthens it, and who sets
others begins a new one where the character is. `viz/web/waypoints.js` is the same for
pages without a server.
"""

import dataclasses
import itertools
import math

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array

from jaxmotion.control import goals
from jaxmotion.control.steering import AHEAD, NEAR, Wish
from jaxmotion.motion.spring import Scalar

MOST = 32

Point = tuple[float, float]


@dataclasses.dataclass(frozen=True, kw_only=True)
class Route:
    """Where a character goes along waypoints.

    Attributes:
      points: Where it began and the waypoints, (x, z) meters; none for no route.
      way: How far along them the character has come, meters.
    """

    points: tuple[Point, ...] = ()
    way: float = 0.0


def routed(route: Route, waypoints: tuple[Point, ...], position: Point) -> Route:
    """The route along waypoints, for a character at a position.

    `ValueError` for more than `MOST`.
    """
    if len(waypoints) > MOST:
        raise ValueError(f"{len(waypoints)} waypoints, expected at most {MOST}")
    old = route.points[1:]
    if not waypoints:
        return Route()
    if old and waypoints[: len(old)] == old:
        return dataclasses.replace(route, points=(route.points[0], *waypoints))
    return Route(points=(position, *waypoints))


def along(
    route: Route,
    last: Wish,
    *,
    position: Point,
    velocity: Point,
    speed: float,
    ahead: float = AHEAD,
) -> tuple[Wish, Route]:
    """What a route asks for, and the route from there.

    Who has stopped near its end stays, until it is lengthened.

    The velocity is the character's own, m/s (see `goals.averaged`), `speed` that on the
    way, of which he looks `ahead` seconds ahead. Places are (x, z), meters.
    """
    # Of one length, so that waypoints compile nothing.
    points = route.points + route.points[-1:] * (MOST + 1 - len(route.points))
    given = (points, speed, position, velocity, last.facing, route.way, ahead)
    arrays = [np.asarray(x, np.float32) for x in given]
    found, way = map(np.asarray, _pursue(*arrays))
    route = dataclasses.replace(route, way=float(way))
    length = sum(itertools.starmap(math.dist, itertools.pairwise(route.points)))
    ends = length - route.way < NEAR and math.dist(position, route.points[-1]) < NEAR
    far = math.hypot(*found)
    if far == 0.0 or (ends and not last.speed):
        return Wish(facing=last.facing), route
    x, z = map(float, found)
    return Wish(velocity=(x, z), facing=(x / far, z / far)), route


@jax.jit
def _pursue(
    points: Array,
    speed: Array,
    position: Array,
    velocity: Array,
    facing: Array,
    way: Array,
    ahead: Scalar,
) -> tuple[Array, Array]:
    path = goals.Path(points=points, speed=jnp.full(len(points), speed))
    walker = goals.Walker(position=position, velocity=velocity, facing=facing)
    return goals.pursue(path, walker, way, ahead=ahead)
