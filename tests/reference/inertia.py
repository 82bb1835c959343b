"""NumPy oracle of Bollo's quintic, from its published coefficients."""

import numpy as np


def quintic(x0, v0, t, duration):
    """Offset of one number at time t, all in float64."""
    if duration <= 0:
        return 0.0
    t1 = duration
    if v0 != 0 and -5 * x0 / v0 > 0:
        t1 = min(duration, -5 * x0 / v0)
    if t >= t1:
        return 0.0
    a0 = (-8 * v0 * t1 - 20 * x0) / t1**2
    a = -(a0 * t1**2 + 6 * v0 * t1 + 12 * x0) / (2 * t1**5)
    b = (3 * a0 * t1**2 + 16 * v0 * t1 + 30 * x0) / (2 * t1**4)
    c = -(3 * a0 * t1**2 + 12 * v0 * t1 + 20 * x0) / (2 * t1**3)
    return np.polyval([a, b, c, a0 / 2, v0, x0], t)
