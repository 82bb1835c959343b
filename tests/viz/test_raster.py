import numpy as np
import pytest

from jaxmotion.viz import raster


def draw(ends, radii, colors=(0,)):
    ends, radii = np.array(ends, float), np.array(radii, float)
    colors = np.array(colors)
    return raster.capsules(ends, radii, colors, width=80, height=60, soft={})


@pytest.mark.parametrize("depth", [0.0, 15.0, 400.0])
@pytest.mark.parametrize("radii", [(8.0, 8.0), (5.0, 9.0), (3.0, 14.0)])
@pytest.mark.parametrize("length", [0.0, 4.0, 30.0])
def test_a_capsule_covers_the_discs_along_its_axis(depth, radii, length):
    a, b = np.array([20.0, 25.0, 0.0]), np.array([20 + length, 30.0, depth])
    found = draw([[a, b]], [radii]) > 0
    x, y = np.meshgrid(np.arange(80), np.arange(60))
    nearest = np.full(x.shape, np.inf)
    for part in np.linspace(0, 1, 201):
        center, r = a + part * (b - a), radii[0] + part * (radii[1] - radii[0])
        nearest = np.minimum(nearest, np.hypot(x - center[0], y - center[1]) - r)
    # No holes, nothing beside it; a cone's side is a little inside its discs' hull.
    assert not np.any(found & (nearest > 0.01))
    assert not np.any(~found & (nearest < -1.2))


def test_what_is_nearer_hides_what_is_farther():
    ball = [[30.0, 30.0, 0.0]] * 2
    bar = lambda z: [[5.0, 30.0, z], [55.0, 30.0, z]]  # noqa: E731
    color = lambda seen: (int(seen[30, 30]) - 1) // raster.LEVELS  # noqa: E731
    for order in ((0, 1), (1, 0)):
        for z, front in ((20.0, 1), (-20.0, 0)):
            shapes = np.array([ball, bar(z)])[list(order)]
            radii = np.array([[6.0, 6.0], [4.0, 4.0]])[list(order)]
            assert color(draw(shapes, radii, order)) == front


def test_the_side_toward_the_light_is_lighter():
    seen = draw([[[40.0, 30.0, 0.0]] * 2], [[20.0, 20.0]])
    assert seen[18, 33] > seen[44, 48] > 0
    table = raster.shades((40, 120, 200)).sum(axis=1)
    assert np.all(np.diff(table) > 0)
