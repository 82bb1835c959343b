"""Critically damped springs in closed form.

A critically damped spring toward g obeys x'' = -2 y x' - y^2 (x - g). With
d = x - g and s = v + y d its solution is

    x(t) = g + e^{-yt} (d + s t)        v(t) = e^{-yt} (v - y s t)            (1)

and y = 2 ln 2 / half_life. The half-life is nominal: it is exact for the first-order
damper of that rate, while from rest (1) keeps (1 + 2 ln 2) / 4 = 0.597 of the distance
at t = half_life. The goal-velocity spring is (1) one derivative higher, for a velocity
that tends to a goal velocity, integrated once more for the position.

No step size enters: two steps of dt equal one of 2 dt. Differs from the source: it adds
1e-5 s to the half-life, here the half-life is at least 1e-5 s.
"""

import math

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Num

from jaxmotion.motion import ground

Scalar = float | Num[Array, ""]


def _rate(half_life: Scalar) -> Float[Array, ""]:
    return 2.0 * math.log(2.0) / jnp.maximum(half_life, 1e-5)


@jax.jit
def spring(
    x: Float[Array, "*#shape"],
    v: Float[Array, "*#shape"],
    goal: Float[Array, "*#shape"],
    *,
    half_life: Scalar,
    dt: Scalar | Float[Array, "*#shape"],
) -> tuple[Float[Array, "*shape"], Float[Array, "*shape"]]:
    """Moves a value toward a goal as a critically damped spring does.

    Value and velocity (units per second) after `dt` seconds, not negative; an array
    gives many times at once. A half-life, seconds, below 1e-5 counts as that (at once).

    Source: Büttner and Clavet 2015; orangeduck's Motion-Matching, spring.h.
    """
    y = _rate(half_life)
    distance = x - goal
    slope = v + distance * y
    decay = jnp.exp(-y * dt)
    return goal + decay * (distance + slope * dt), decay * (v - slope * y * dt)


@jax.jit
def velocity_spring(
    x: Float[Array, "*#shape"],
    v: Float[Array, "*#shape"],
    a: Float[Array, "*#shape"],
    goal_velocity: Float[Array, "*#shape"],
    *,
    half_life: Scalar,
    dt: Scalar | Float[Array, "*#shape"],
) -> tuple[Float[Array, "*shape"], Float[Array, "*shape"], Float[Array, "*shape"]]:
    """Moves a position whose velocity is a spring toward a goal velocity.

    Position, velocity and acceleration (meters, seconds) at that time; `half_life` and
    `dt` are as of `spring`.

    Source: orangeduck's Motion-Matching, controller.cpp
      (simulation_positions_update).
    """
    y = _rate(half_life)
    distance = v - goal_velocity
    slope = a + distance * y
    decay = jnp.exp(-y * dt)
    # expm1, because 1 - decay loses all digits for short times and long half-lives.
    moved = -jnp.expm1(-y * dt) * (slope / y + distance) - decay * slope * dt
    return (
        x + goal_velocity * dt + moved / y,
        goal_velocity + decay * (distance + slope * dt),
        decay * (a - slope * y * dt),
    )


@jax.jit
def facing_spring(
    facing: Float[Array, "*batch 2"],
    turn_rate: Float[Array, "*batch"],
    goal: Float[Array, "*batch 2"],
    *,
    half_life: Scalar,
    dt: Scalar | Float[Array, "*batch"],
) -> tuple[Float[Array, "*batch 2"], Float[Array, "*batch"]]:
    """Turns a facing direction toward a goal along the shorter arc.

    Directions are unit vectors (x, z); a zero vector counts as +z. The turn rate is in
    radians per second, positive from +z toward +x; `half_life` and `dt` are as of
    `spring`.

    Source: orangeduck's Motion-Matching, spring.h, for rotations about one axis.
    """
    angle = ground.angle_from_to(goal, facing)
    zero = jnp.zeros_like(angle)
    angle, turn_rate = spring(angle, turn_rate, zero, half_life=half_life, dt=dt)
    return ground.turn(ground.unit(goal), angle), turn_rate
