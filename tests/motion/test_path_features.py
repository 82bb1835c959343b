import jax.numpy as jnp
import numpy as np
import pytest

from jaxmotion.motion import path_features
from jaxmotion.motion.trajectory import PlanarFrame, Trajectory
from tests import person
from tests.reference import pose as reference


def straight(count, fps, speed=1.2, heading=0.6):
    """A path along its facing."""
    along = np.multiply.outer(
        speed * np.arange(count) / fps, person.directions(heading)
    )
    return person.path(along + np.array([3.0, -2.0]), np.full(count, heading))


def test_offsets_are_thirds_of_a_second():
    assert path_features.path_offsets(60.0) == (20, 40, 60)
    assert path_features.path_offsets(30.0) == (10, 20, 30)
    assert path_features.path_offsets(120.0) == (40, 80, 120)


@pytest.mark.parametrize("fps", [30.0, 60.0])
def test_random_paths_agree_with_products_of_matrices(fps):
    position, yaw = person.wandering_bone(80, fps)
    found = path_features.path_features(person.path(position, yaw), fps=fps)
    offsets = [round(fps * k / 3) for k in (1, 2, 3)]
    expected = reference.path_features(position, person.directions(yaw), offsets)
    assert found.shape == (80, 12)
    np.testing.assert_allclose(found, expected, atol=2e-6)


def test_straight_path_lies_straight_ahead():
    found = path_features.path_features(straight(80, 60.0), fps=60.0)
    expected = [0, 0.4, 0, 0.8, 0, 1.2, 0, 1, 0, 1, 0, 1]
    np.testing.assert_allclose(found[:20], np.tile(expected, (20, 1)), atol=2e-6)


def test_beyond_the_end_the_last_frame_counts():
    found = path_features.path_features(straight(80, 60.0), fps=60.0)
    left = np.arange(79, -1, -1)
    for column, offset in zip((1, 3, 5), (20, 40, 60), strict=True):
        expected = 1.2 / 60.0 * np.minimum(left, offset)
        np.testing.assert_allclose(found[:, column], expected, atol=2e-6)
    np.testing.assert_allclose(found[-1], [0] * 6 + [0, 1] * 3, atol=2e-6)


def test_clip_of_one_frame_stays_where_it_is():
    path = person.path([[1.0, 2.0]], [0.5])
    found = path_features.path_features(path, fps=60.0)
    np.testing.assert_allclose(found, [[0] * 6 + [0, 1] * 3], atol=1e-6)


def test_left_turn_leads_to_the_left():
    # Left is +x of the frame, and yaw turns +z toward +x.
    yaw = 1.0 + np.arange(80) / 60.0
    position = np.stack([-np.cos(yaw), np.sin(yaw)], axis=-1)
    found = path_features.path_features(person.path(position, yaw), fps=60.0)[0]
    for i, angle in enumerate((1 / 3, 2 / 3, 1.0)):
        expected = [1 - np.cos(angle), np.sin(angle)]
        np.testing.assert_allclose(found[2 * i : 2 * i + 2], expected, atol=2e-6)
        np.testing.assert_allclose(
            found[6 + 2 * i : 8 + 2 * i], person.directions(angle), atol=2e-6
        )


def test_moving_and_turning_the_world_changes_nothing():
    position, yaw = person.wandering_bone(80)
    before = path_features.path_features(person.path(position, yaw), fps=60.0)
    c, s = np.cos(1.9), np.sin(1.9)
    moved = position @ np.array([[c, -s], [s, c]]) + np.array([4.0, -1.0])
    after = path_features.path_features(person.path(moved, yaw + 1.9), fps=60.0)
    np.testing.assert_allclose(after, before, atol=5e-6)


def test_query_of_the_points_ahead_is_the_row_of_the_clip():
    position, yaw = person.wandering_bone(80)
    path = person.path(position, yaw)
    rows = path_features.path_features(path, fps=60.0)
    now = np.arange(20)
    ahead = now[:, None] + np.array([20, 40, 60])
    points = Trajectory(position=path.position[ahead], facing=path.facing[ahead])
    frame = PlanarFrame(origin=path.position[now], facing=path.facing[now])
    np.testing.assert_allclose(path_features.query(points, frame), rows[:20], atol=1e-6)
    one = path_features.query(
        Trajectory(position=points.position[3], facing=points.facing[3]),
        PlanarFrame(origin=frame.origin[3], facing=frame.facing[3]),
    )
    assert one.shape == (12,)
    np.testing.assert_allclose(one, rows[3], atol=1e-6)


def test_query_puts_positions_before_facings():
    points = Trajectory(
        position=jnp.array([[1.0, 2.0], [3.0, 4.0], [5.0, 6.0]]),
        facing=jnp.array([[1.0, 0.0], [0.0, 1.0], [-1.0, 0.0]]),
    )
    found = path_features.query(points, person.frames([0.0, 0.0], 0.0))
    np.testing.assert_allclose(found, [1, 2, 3, 4, 5, 6, 1, 0, 0, 1, -1, 0], atol=1e-6)
