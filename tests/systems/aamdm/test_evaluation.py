"""Columns of AAMDM's tables on planted rollouts."""

import dataclasses
import functools
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxmotion.control.frame import Frame
from jaxmotion.evaluation import table
from jaxmotion.systems.aamdm import data as aamdm_data
from jaxmotion.systems.aamdm import embedding as aamdm_embedding
from jaxmotion.systems.aamdm import evaluation as aamdm_evaluation
from jaxmotion.systems.aamdm import training as aamdm_training
from tests import person, tiny
from tests.reference import pose as reference

FPS = 60.0


@functools.cache
def run():
    """One clip of four hundred frames in which everything moves."""
    data, _ = aamdm_data.pose_data(person.clips((400,)), fps=FPS)
    return aamdm_training.Run(
        record=tiny.run_folder(Path("none"), "aamdm"),
        skeleton=person.skeleton(),
        embedding=aamdm_embedding.Config(num_joints=6, fps=FPS),
        train=data,
        held_out=data,
    )


@functools.cache
def yardstick():
    return aamdm_evaluation.make_reference(run().skeleton, run().train)


@functools.cache
def character_positions():
    """Joints [frames, J, 3] of every fifth frame in the character's axes."""
    rows = np.float64(run().train.poses[::5])
    found = [
        reference.character_matrices(
            person.PARENTS, row[:18].reshape(6, 3), row[18:54].reshape(6, 6)
        )
        for row in rows
    ]
    return np.array(found)[..., :3, 3]


def real(number, ticks):
    return aamdm_evaluation.data_frames(run(), run().train, number, ticks, seed=0)


def row_of(frames, groups=1, against=None):
    return aamdm_evaluation.free_row(
        jax.random.key(0),
        run().skeleton,
        against or yardstick(),
        frames,
        fps=FPS,
        groups=groups,
    )


# --- the reference, and rows of real frames ----------------------------------------


@pytest.mark.slow
def test_the_reference_is_that_of_the_poses():
    positions, own = character_positions(), yardstick()
    flat = positions.reshape(len(positions), -1)
    np.testing.assert_allclose(own.normalizer.mean, flat.mean(0), atol=1e-4)
    deviation = np.maximum(flat.std(0), 0.01)
    np.testing.assert_allclose(own.normalizer.std, deviation, rtol=1e-3)
    np.testing.assert_allclose(
        own.root_height, np.median(positions[:, 0, 1]), rtol=1e-4
    )
    toes = positions[:, list(person.FEET), 1]
    np.testing.assert_allclose(own.toe_height, np.percentile(toes, 5), atol=1e-4)


def test_windows_of_the_data_are_its_frames():
    frames = real(3, 100)
    assert frames.root_position.shape == (3, 100, 3)
    np.testing.assert_array_equal(frames.extra["bone_origin"][:, 0], 0.0)
    np.testing.assert_array_equal(frames.extra["path"], frames.extra["wanted_path"])
    paths = np.asarray(run().train.paths)
    for window in np.asarray(frames.extra["path"]):
        start = np.flatnonzero(np.all(paths == window[0], axis=-1))[0]
        np.testing.assert_array_equal(window, paths[start : start + 100])
        height = run().train.poses[start : start + 100, 1]
        found = frames.root_position[:, :, 1]
        assert np.any(np.all(np.abs(found - height[None]) < 1e-6, axis=1))
    with pytest.raises(ValueError, match="401 frames.*longest has 400"):
        real(1, 401)


@pytest.mark.slow
def test_the_data_are_at_no_distance_from_themselves():
    row = row_of(real(1, 400))
    assert row["diverged"] == table.Cell(value=0.0, samples=1)
    assert abs(row["fid"].value) < 0.02
    assert row["div"].value > 1.0


@pytest.mark.parametrize("height", [0.05, 0.2])
def test_a_planted_offset_is_the_distance(height):
    frames = real(1, 400)
    root = frames.root_position.at[..., 1].add(height)
    row = row_of(dataclasses.replace(frames, root_position=root))
    deviation = np.maximum(character_positions().std(0)[:, 1], 0.01)
    expected = np.sum((height / deviation) ** 2)
    np.testing.assert_allclose(row["fid"].value, expected, rtol=0.02, atol=0.02)
    np.testing.assert_allclose(row["div"].value, row_of(frames)["div"].value, rtol=1e-3)


def test_place_and_direction_in_the_world_do_not_count():
    frames, yaw, shift = real(1, 400), 1.2, np.array([5.0, 0.0, -3.0])
    matrix = person.float32(person.about_y(yaw))
    ground = matrix[::2, ::2]
    columns = frames.joint_rotation[..., 0, :].reshape(1, 400, 2, 3) @ matrix.T
    six = frames.joint_rotation.at[..., 0, :].set(columns.reshape(1, 400, 6))
    moved = dataclasses.replace(
        frames,
        root_position=frames.root_position @ matrix.T
        + person.float32(shift).reshape(1, 1, 3),
        joint_rotation=six,
        extra=frames.extra
        | {
            "bone_origin": frames.extra["bone_origin"] @ ground.T
            + person.float32(shift[::2]).reshape(1, 1, 2),
            "bone_facing": frames.extra["bone_facing"] @ ground.T,
        },
    )
    assert abs(row_of(moved)["fid"].value) < 0.02


@pytest.mark.slow
def test_groups_must_divide_the_rollouts():
    with pytest.raises(ValueError, match="3 rollouts in 2 groups"):
        row_of(stiff(1.0, number=3), groups=2)
    row = row_of(real(4, 40), groups=2)
    assert row["fid"].samples == row["div"].samples == 2
    assert row["ffr_mann"].samples == row["speed"].samples == 4


# --- planted rollouts --------------------------------------------------------------


@pytest.mark.parametrize("what", [np.nan, 30.0, -1.0])
def test_a_planted_diverged_rollout_is_counted(what):
    frames = real(4, 40)
    root = frames.root_position.at[2, 20, 1].set(what)
    row = row_of(dataclasses.replace(frames, root_position=root), groups=4)
    assert row["diverged"] == table.Cell(value=1.0, samples=4)
    for name, cell in row.items():
        assert np.isfinite(cell.value), name


def stiff(speed, ticks=60, number=2):
    """Rollouts of a stiff person with toes 5 cm high who glides along +z."""
    along = speed * np.arange(ticks) / FPS
    root = np.stack([0 * along, 0 * along + 0.9, along], axis=-1)
    motion = person.motion(root, person.upright(root, np.zeros(ticks)))
    ahead = np.tile([0.0, 1.0], (ticks, 1))

    def many(x):
        return jnp.broadcast_to(person.float32(x), (number, *np.shape(x)))

    return Frame(
        root_position=many(motion.root_position),
        joint_rotation=many(motion.joint_rotation),
        desired_velocity=many(ahead),
        desired_facing=many(ahead),
        planned=jnp.ones((number, ticks), bool),
        extra={
            "bone_origin": many(root[:, ::2]),
            "bone_facing": many(ahead),
            "bone_velocity": many(speed * ahead),
            "path": many(np.zeros((ticks, 12))),
            "wanted_path": many(np.zeros((ticks, 12))),
        },
        fps=FPS,
    )


@pytest.mark.parametrize(("speed", "skates"), [(1.0, 1.0), (0.1, 0.0)])
def test_a_glider_skates_at_every_frame(speed, skates):
    low = dataclasses.replace(yardstick(), toe_height=0.05, root_height=0.9)
    row = row_of(stiff(speed), against=low)
    assert row["ffr_mann"].value == row["ffr_gmd"].value == skates
    np.testing.assert_allclose(row["speed"].value, speed, rtol=1e-5)
    np.testing.assert_allclose(row["div"].value, 0.0, atol=1e-3)
    np.testing.assert_allclose(row["acceleration"].value, 0.0, atol=0.05)
    floating = dataclasses.replace(low, toe_height=0.0)
    assert row_of(stiff(speed), against=floating)["ffr_mann"].value == 0.0


# --- control -----------------------------------------------------------------------


def with_extra(frames, **changes):
    return dataclasses.replace(frames, extra=frames.extra | changes)


def speeding(ticks=100, number=2):
    """Rollouts along +z that get faster, with features that came true."""
    frames = stiff(1.0, ticks, number)
    along = 0.5 * (np.arange(ticks) / FPS) ** 2
    origin = np.stack([0 * along, along], axis=-1)
    facing = np.tile([0.0, 1.0], (ticks, 1))
    found = reference.path_features(origin, facing, (20, 40, 60))
    origin = jnp.broadcast_to(person.float32(origin), (number, ticks, 2))
    return with_extra(frames, bone_origin=origin), found


def test_promised_error_is_that_of_the_frames_features():
    frames, _ = speeding()
    wanted = frames.extra["path"].at[0].add(0.3).at[1, :, :6].add(-0.1)
    row = aamdm_evaluation.control_row(with_extra(frames, wanted_path=wanted), fps=FPS)
    np.testing.assert_allclose(row["te_promised"].value, (0.3 + 0.05) / 2, rtol=1e-5)
    assert row["te_promised"].samples == 2


@pytest.mark.parametrize("offset", [0.0, 0.2])
def test_realized_error_is_that_of_where_it_went(offset):
    frames, came_true = speeding()
    # What is asked for at a tick is asked of the bone after the tick before; the start
    # and the last second have nothing to compare with.
    wanted = np.full((100, 12), 9.0)
    wanted[1:40] = came_true[:39] + offset
    wanted = jnp.broadcast_to(person.float32(wanted), (2, 100, 12))
    row = aamdm_evaluation.control_row(with_extra(frames, wanted_path=wanted), fps=FPS)
    np.testing.assert_allclose(row["te_realized"].value, offset, atol=1e-5)


def test_trajectory_error_is_the_angle_to_the_command():
    frames = stiff(1.0, ticks=100)
    aside = person.float32(1.3 * person.directions(np.deg2rad(25.0)))
    desired = jnp.broadcast_to(aside, frames.extra["bone_velocity"].shape)
    found = aamdm_evaluation.control_row(
        dataclasses.replace(frames, desired_velocity=desired), fps=FPS
    )
    np.testing.assert_allclose(found["trajectory_error"].value, 25.0, rtol=1e-3)


# --- long rollouts -----------------------------------------------------------------


def health(limbs, seconds, *, speed=None, diverge=False):
    """Counts of one rollout at 10 frames per second whose limbs move that fast."""
    ticks = round(10 * seconds) + 1
    positions = np.zeros((1, ticks, 6, 3))
    positions[..., 1] = 0.9
    positions[0, ticks // 2, 0, 1] += 9.0 * diverge
    swing = np.where(np.arange(ticks) % 2, limbs / 10.0, 0.0)
    positions[0, :, 1:, 0] += swing[:, None]
    wanted = None
    if speed is not None:
        wanted = jnp.full((1, ticks, 2), speed / 2**0.5)
    found = aamdm_evaluation.long_health(
        person.float32(positions), wanted, yardstick(), fps=10.0
    )
    assert found["rollouts"] == 1
    return found["diverged"], found["frozen"]


def test_free_rollouts_are_frozen_after_half_a_minute_of_rest():
    assert health(0.0, 30) == (0, 1)
    assert health(0.0, 29) == (0, 0)
    assert health(0.1, 30) == (0, 0)


def test_steered_rollouts_are_frozen_after_two_seconds_of_disobedience():
    assert health(0.0, 2, speed=1.0) == (0, 1)
    assert health(0.0, 1.9, speed=1.0) == (0, 0)
    assert health(0.0, 2, speed=0.2) == (0, 0)
    assert health(0.1, 2, speed=1.0) == (0, 0)


def test_a_leap_is_a_divergence():
    assert health(0.1, 2, diverge=True)[0] == 1
