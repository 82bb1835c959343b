"""NumPy oracles for springs, extension and blending; angles, loops and integrators.

Written from the differential equations and the paper's words, not from the code.
"""

import numpy as np
from scipy.integrate import solve_ivp

LN2 = np.log(2.0)


def integrate_spring(x, v, goal, half_life, t):
    """Integrates x'' = -2 y x' - y^2 (x - goal) numerically."""
    y = 2 * LN2 / half_life

    def rhs(_, state):
        return [state[1], -2 * y * state[1] - y * y * (state[0] - goal)]

    return solve_ivp(rhs, (0, t), [x, v], rtol=1e-11, atol=1e-12).y[:, -1]


def integrate_velocity_spring(x, v, a, goal, half_life, t):
    """Integrates v'' = -2 y v' - y^2 (v - goal), x' = v numerically."""
    y = 2 * LN2 / half_life

    def rhs(_, s):
        return [s[1], s[2], -2 * y * s[2] - y * y * (s[1] - goal)]

    return solve_ivp(rhs, (0, t), [x, v, a], rtol=1e-11, atol=1e-12).y[:, -1]


def extend(points, num_frames, reuse):
    """Turns the last points by half a turn about each new end, point by point."""
    path = [np.array(p, np.float64) for p in points]
    frames = len(path)
    half_turn = np.array([[-1.0, 0.0], [0.0, -1.0]])
    while len(path) < frames + num_frames:
        end, end_index = path[-1], len(path) - 1
        for j in range(1, reuse + 1):
            path.append(end + half_turn @ (path[end_index - j] - end))
    return np.array(path[: frames + num_frames])


def yaw(facing):
    """Angle of (x, z) from +z toward +x."""
    return np.arctan2(facing[..., 0], facing[..., 1])


def wrap(angle):
    """Angle in [-pi, pi)."""
    return (angle + np.pi) % (2 * np.pi) - np.pi
