"""The table of steering finds what is planted in characters that need no network."""

import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxmotion.control import courses, rollout, steering
from jaxmotion.control.frame import Frame
from jaxmotion.data import windows
from jaxmotion.motion import spring, trajectory
from jaxmotion.systems import steering_table
from tests import tiny

FPS, SECONDS = 30.0, 14.0
HONEST = dict(gain=1.0, aside=0.0, creep=0.0, late=0.0, swing=0.5, sink=0.0, jump=0.0)
HONEST |= dict(ball=0.0)
KICKS = 30  # ticks from one to the next


def yaw_columns(direction):
    """A rotation about y that turns +z to a direction, as two columns."""
    x, z = direction
    zero = jnp.zeros_like(x)
    return jnp.stack([z, zero, -x, zero, jnp.ones_like(x), zero])


def pitch_columns(angle):
    c, s, zero = jnp.cos(angle), jnp.sin(angle), jnp.zeros_like(angle)
    return jnp.stack([zero + 1, zero, zero, zero, c, s])


def advance(faults, state, command):
    """Goes and faces as told, but for its faults; turns `late` seconds late."""
    times = dict(half_life=0.27, dt=1.0 / FPS)
    position, velocity, acceleration = spring.velocity_spring(
        *state["motion"], command.velocity, **times
    )
    facing, rate = spring.facing_spring(*state["turn"], command.facing, **times)
    wait = jnp.where(
        jnp.all(command.facing == state["told"]),
        state["wait"] - 1,
        faults["late"] * FPS,
    )
    hips = jnp.where(wait <= 0, command.facing, state["hips"])
    tick = state["tick"] + 1
    right = jnp.array([facing[1], -facing[0]])
    place = faults["gain"] * position + faults["aside"] * right
    place = place + faults["creep"] * tick / FPS * jnp.array([1.0, 0.0])
    place = place + jnp.where(tick == 200, faults["jump"], 0.0)
    swing = faults["swing"] * jnp.sin(2 * jnp.pi * tick / FPS)
    still = pitch_columns(jnp.zeros(()))
    legs = [pitch_columns(swing), still, pitch_columns(-swing), still]
    # Pushed aside by 5 cm, and back.
    kicked = 0.05 * (tick // KICKS % 2)
    root = jnp.array([place[0], 0.9 - faults["sink"], place[1]])
    frame = Frame(
        root_position=root,
        joint_rotation=jnp.stack([yaw_columns(hips), *legs]),
        desired_velocity=velocity,
        desired_facing=facing,
        planned=tick % 15 == 1,
        extra={"ball": root + jnp.array([kicked + faults["ball"], -0.8, 0.0])},
        fps=FPS,
    )
    return {
        "motion": (position, velocity, acceleration),
        "turn": (facing, rate),
        "told": command.facing,
        "hips": hips,
        "wait": wait,
        "tick": tick,
    }, frame


@dataclasses.dataclass(frozen=True)
class Method:
    def __call__(self, faults):
        return rollout.Controller(
            plan_level=lambda state, command: jnp.zeros((), jnp.int32),
            plans=(),
            advance=functools.partial(advance, faults),
        )


def starts(clips, labels, seed):
    zero, ahead = jnp.zeros(2), jnp.array([0.0, 1.0])
    state = {
        "motion": (zero, zero, zero),
        "turn": (ahead, jnp.zeros(())),
        "told": ahead,
        "hips": ahead,
        "wait": jnp.zeros(()),
        "tick": jnp.zeros((), jnp.int32),
    }
    return jax.tree.map(lambda x: jnp.stack([x] * len(labels)), state)


@functools.cache
def clips():
    return tiny.clips(120)


def table(*names, speeds=(), rollouts=2, speed=(1.0,), chunk=2, **faults):
    faults = jax.tree.map(jnp.float32, HONEST | faults)
    character = steering.Character(
        skeleton=clips().skeleton,
        labels=tiny.STYLES,
        fps=FPS,
        source="tests",
        params=faults,
        method=Method(),
        starts=functools.partial(starts, None),
        clip_starts=starts,
    )
    return steering_table.steering_table(
        character,
        clips(),
        clips(),
        label="calm",
        speeds=speeds,
        names=names,
        course_speeds=speed,
        rollouts=rollouts,
        seconds=SECONDS,
        chunk=chunk,
    )


def value(found, row, column):
    return found.rows[row][column].value


@pytest.mark.slow
def test_who_does_as_told_has_no_errors():
    found = table("figure_eight", speeds=(0.0, 1.0))
    stands, goes = "straight at 0 m/s", "straight at 1 m/s"
    for row in (stands, goes, "figure eight at 1 m/s"):
        assert value(found, row, "path_error") < 0.1
        assert value(found, row, "frozen") == value(found, row, "diverged") == 0
        assert value(found, row, "minutes") == pytest.approx(2 * SECONDS / 60)
    assert value(found, stands, "creep") == 0
    assert value(found, goes, "speed") == pytest.approx(1.0, abs=1e-3)
    assert value(found, goes, "speed_error") < 0.1
    # Nothing to say of who stands' speed, or of who goes' creep.
    assert found.rows[stands]["speed_error"].samples == 0
    assert found.rows[goes]["creep"].samples == 0
    # Real windows: the calm walker goes at 0.7 m/s and never at 1.
    assert value(found, "held-out, about 1 m/s", "windows") == 0
    assert found.report["character_minutes"] == pytest.approx(6 * SECONDS / 60)
    assert set(found.by_plan) == {stands, goes, "figure eight at 1 m/s"}
    assert len(found.by_plan[goes]["jerk"]) == 15


@pytest.mark.slow
def test_a_circle_beside_the_path_is_as_far_off_as_it_is():
    found = table("figure_eight", aside=0.1)
    row = "figure eight at 1 m/s"
    # Averaged over half a second of a turn, a little less.
    assert value(found, row, "path_error") == pytest.approx(10.0, rel=0.03)
    assert value(found, row, "path_error_max") == pytest.approx(10.0, rel=0.03)


def test_creep_is_centimeters_in_ten_seconds():
    found = table(speeds=(0.0,), creep=0.003)
    assert value(found, "straight at 0 m/s", "creep") == pytest.approx(3.0, rel=0.01)


def test_who_is_slow_has_an_error_of_speed_and_falls_behind():
    found = table(speeds=(1.0,), gain=0.9)
    row = "straight at 1 m/s"
    assert value(found, row, "speed_error") == pytest.approx(10.0, abs=0.1)
    assert value(found, row, "speed") == pytest.approx(0.9, abs=1e-3)
    # A tenth of the way of 14 m, less what the spring's start took.
    assert value(found, row, "path_error_max") == pytest.approx(136.0, abs=5.0)


def test_who_is_slow_lags_behind_by_the_part_that_is_missing():
    """At the ends of two stops after 3 m ahead, and 3 m more at 60 degrees."""
    found = table("stop_and_go", gain=0.9)
    lead = found.by_time["stop and go at 1 m/s, stop"]["path_lead"]
    assert lead[9] == pytest.approx(-(30.0 + 30.0 * (1 + 0.5)) / 2, abs=0.5)


@pytest.mark.parametrize("late", [0.0, 1.0])
def test_who_turns_late_takes_that_long(late):
    found = table("turn_on_the_spot", late=late)
    # Turned at once, a tick after the command at the earliest.
    expected = max(late, 1 / FPS) + (1 / FPS if late else 0)
    assert value(found, "turn on the spot", "turn_time") == pytest.approx(
        expected, abs=0.01
    )
    # All at once: half of the turn takes no less.
    half = value(found, "turn on the spot", "half_turn_time")
    assert half == value(found, "turn on the spot", "turn_time")
    assert value(found, "turn on the spot", "disobeyed") == 0
    turning = found.by_time["turn on the spot, turn"]["facing_error"]
    np.testing.assert_allclose(turning[:5], 90.0 if late else 0.0, atol=0.1)
    np.testing.assert_allclose(turning[6:10], 0.0, atol=0.1)
    # Commands come every two seconds.
    assert np.isnan(turning[10:]).all()


def test_half_of_a_turn_takes_the_springs_less_time():
    found = table("reversals", "turn_around", speeds=(1.0,))
    row = "reversals at 1 m/s, the springs themselves"
    rate = 2 * np.log(2) / 0.27
    seconds = np.arange(0.0, 1.5, 1e-3)
    left = 180.0 * (1 + rate * seconds) * np.exp(-rate * seconds)
    for column, degrees in (("half_turn_time", 90.0), ("turn_time", 10.0)):
        expected = seconds[np.argmax(left < degrees)]
        # A tick later at most; a turn that the next one cuts short is no slower.
        assert value(found, row, column) == pytest.approx(expected, abs=2 / FPS)


def test_courses_go_at_each_speed_and_turns_have_rows_of_real_motion():
    found = table("turn_around", "turn_on_the_spot", speed=(0.5, 1.0))
    courses_ = {"turn around at 0.5 m/s", "turn around at 1 m/s", "turn on the spot"}
    assert set(found.by_plan) == courses_
    cut = windows.eval_windows(clips(), stride=30, field="style")
    calm = np.asarray(cut.label) == tiny.STYLES.index("calm")
    facing = trajectory.root_trajectory(clips().skeleton, cut.motion).facing
    x, z = np.moveaxis(np.asarray(facing)[calm], -1, 0)
    heading = np.unwrap(np.arctan2(x, z))
    turned = np.abs(np.rad2deg(heading[:, -1] - heading[:, 0]))
    assert 0 < (turned > 90).sum() < len(turned) and turned.max() < 180
    assert value(found, "held-out, turning", "windows") == (turned > 90).sum()


def test_who_never_turns_disobeys():
    found = table("turn_around", late=100.0)
    row = "turn around at 1 m/s"
    # It faces ahead all along, which is what the second of three turns asks for; the
    # last one has two seconds left.
    assert value(found, row, "disobeyed") == pytest.approx(2 / 3)
    seconds = (4 + 1 / FPS + 2) / 3
    assert value(found, row, "turn_time") == pytest.approx(seconds, abs=1e-4)


def test_stops_and_starts_take_the_springs_time():
    found = table("stop_and_go")
    row, springs = "stop and go at 1 m/s", "stop and go at 1 m/s, the springs"
    rate = 2 * np.log(2) / 0.27
    seconds = np.arange(0.0, 2.0, 1e-3)
    left = (1 + rate * seconds) * np.exp(-rate * seconds)
    for column in ("stop_time", "start_time"):
        own = value(found, row, column)
        assert own == value(found, f"{springs} themselves", column)
        # Half a second is looked at: what is not steady comes a little later.
        assert own == pytest.approx(seconds[np.argmax(left < 0.1)], abs=0.1)


def test_frozen_and_diverged_rollouts_are_counted():
    found = table(speeds=(1.0,), swing=0.0, rollouts=4, chunk=3)
    assert value(found, "straight at 1 m/s", "frozen") == 4
    found = table(speeds=(0.0,), swing=0.0)
    assert value(found, "straight at 0 m/s", "frozen") == 0
    found = table(speeds=(1.0,), jump=2.0)
    assert value(found, "straight at 1 m/s", "diverged") == 2


def test_sunk_toes_are_that_deep():
    row = "straight at 0 m/s"
    plain, sunk = (
        table(speeds=(0.0,), swing=0.0, sink=x).rows[row] for x in (0.0, 0.05)
    )
    rest = plain["toe_sink"].value
    assert sunk["toe_sink"].value - rest == pytest.approx(5.0, abs=0.01)
    # Who stands still is as deep on the mean; above the ground there is no depth.
    assert sunk["toe_depth"].value == pytest.approx(5.0 + rest, abs=0.01)
    assert plain["toe_depth"].value == pytest.approx(max(rest, 0.0), abs=0.01)


def test_toes_that_drift_on_the_ground_skate_in_all_frames():
    """Creeping at .3 m/s; frames count from .2 m/s on, of feet that are low."""

    def skating(creep, sink):
        row = table(speeds=(0.0,), swing=0.0, creep=creep, sink=sink)
        return row.rows["straight at 0 m/s"]["ffr_mann"].value

    still = table(speeds=(0.0,), swing=0.0).rows["straight at 0 m/s"]
    low = -still["toe_sink"].value / 100.0  # how far the toes are above their rest
    assert skating(0.3, low) == 1.0
    assert skating(0.1, low) == 0.0
    assert skating(0.3, low - 0.1) == 0.0


@pytest.mark.parametrize("away", [0.0, 3.0])
def test_touches_are_counted_and_missed_where_no_foot_is(away):
    row = table(speeds=(0.0,), swing=0.0, ball=away).rows["straight at 0 m/s"]
    assert row["touches"].value == pytest.approx(60.0, rel=0.1)
    assert row["missed"].value == (row["touches"].value if away else 0.0)
    assert row["ball_away"].value == pytest.approx(away + 0.025, abs=0.01)


def test_changes_are_stops_starts_and_turns():
    commands = courses.course_commands(
        "stop_and_go", seconds=9.0, fps=FPS, speed=1.0, label=0
    )
    assert steering_table.changes(commands) == [
        ("stop", 90, 150, pytest.approx(0.0, abs=0.1)),
        ("start", 150, 240, pytest.approx(60.0, abs=0.1)),
        ("stop", 240, 270, pytest.approx(0.0, abs=0.1)),
    ]
    since = steering_table.since_changes(steering_table.changes(commands), 270, FPS)
    assert (since[:, :90] == -1).all() and (since[2] == -1).all()
    np.testing.assert_array_equal(since[0, 90:102], [0] * 6 + [1] * 6)
    assert since[0, 149] == 9 and since[0, 150] == -1 and since[1, 150] == 0


def test_rollouts_too_short_to_measure_are_named(monkeypatch):
    monkeypatch.setattr("tests.systems.test_steering_table.SECONDS", 4.0)
    with pytest.raises(ValueError, match="4 s are too short to measure"):
        table(speeds=(1.0,))
