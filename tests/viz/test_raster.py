import numpy as np
import pytest
from matplotlib.path import Path

from jaxmotion.viz import raster

SIZE = dict(width=80, height=60)


def draw(points, faces, colors=None, normals=None):
    points, faces = np.array(points, float), np.array(faces)
    seen = raster.triangles(points, faces, **SIZE)
    colors = np.zeros(len(points), int) if colors is None else np.array(colors)
    normals = np.tile([0.0, 0, 1], (len(points), 1)) if normals is None else normals
    return seen, raster.codes(seen, normals, colors, faces, **SIZE)


def triangles(number, seed):
    """Random ones, as the viewer sees their front, and some beyond the edges."""
    draw = np.random.default_rng(seed)
    points = draw.uniform([-20, -20, 0], [100, 80, 50], (number, 3, 3))
    one, two = points[:, 1] - points[:, 0], points[:, 2] - points[:, 0]
    back = two[:, 0] * one[:, 1] - one[:, 0] * two[:, 1] < 0
    points[back] = points[back, ::-1]
    return points


@pytest.mark.parametrize("seed", range(5))
def test_a_triangle_covers_the_pixels_that_matplotlib_finds_inside(seed):
    x, y = np.meshgrid(np.arange(80), np.arange(60))
    pixels = np.stack([x.ravel(), y.ravel()], axis=-1)
    for corner in triangles(4, seed):
        _, codes = draw(corner, [[0, 1, 2]])
        found = codes.ravel() > 0
        flat = Path(corner[:, :2])
        inner, outer = (
            flat.contains_points(pixels, radius=r)
            | flat.contains_points(pixels, radius=-r)
            for r in (0.0, 1e-3)
        )
        assert not np.any(found & ~outer)
        both = [flat.contains_points(pixels, radius=r) for r in (1e-3, -1e-3)]
        assert not np.any(~found & both[0] & both[1])
        covered = raster.covered(corner[::-1], np.array([[0, 1, 2]]), **SIZE)
        np.testing.assert_array_equal(covered.ravel(), found)
        assert not draw(corner[::-1], [[0, 1, 2]])[1].any(), "seen from behind"
        assert inner.sum() <= outer.sum()


def test_each_pixel_shows_the_nearest_triangle_and_its_own_mixture():
    corner = triangles(12, 7)
    seen, codes = draw(
        corner.reshape(-1, 3), np.arange(36).reshape(-1, 3), np.repeat(np.arange(12), 3)
    )
    planes = []
    for a, b, c in corner:
        solved = np.linalg.solve(
            np.stack([a, b, c])[:, [0, 1]] @ np.eye(2, 3) + [0, 0, 1.0],
            [a[2], b[2], c[2]],
        )
        planes.append(solved)
    y, x = np.divmod(seen.pixels, 80)
    mixed = np.einsum("nk,nkd->nd", seen.parts, corner[seen.faces])
    np.testing.assert_allclose(mixed[:, 0], x, atol=1e-2)
    np.testing.assert_allclose(mixed[:, 1], y, atol=1e-2)
    np.testing.assert_allclose(seen.parts.sum(axis=1), 1.0)
    for i, (a, b, c) in enumerate(planes):
        flat = Path(corner[i][:, :2])
        safe = [
            flat.contains_points(np.stack([x, y], -1), radius=r) for r in (0.1, -0.1)
        ]
        here = safe[0] & safe[1]
        depth = a * x + b * y + c
        assert np.all(mixed[here, 2] >= depth[here] - 1e-3), "nothing hides it"
    color = (codes.ravel()[seen.pixels].astype(int) - 1) // raster.LEVELS
    np.testing.assert_array_equal(color, seen.faces)


def test_a_closed_surface_has_no_holes_and_is_lit_from_the_left_above():
    vertices, faces = raster.sphere()
    pixels = 20 * vertices * [1, -1, 1] + [40.3, 30.1, 0]
    _, codes = draw(pixels, faces, normals=vertices)
    x, y = np.meshgrid(np.arange(80), np.arange(60))
    away = np.hypot(x - 40.3, y - 30.1)
    assert (codes[away < 19.5] > 0).all() and not codes[away > 20.01].any()
    assert codes[18, 33] > codes[44, 48] > 0
    table = raster.shades((40, 120, 200)).sum(axis=1)
    assert np.all(np.diff(table) > 0)
