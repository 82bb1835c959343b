import dataclasses
import functools
import warnings

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxmotion.control import courses, foot_lock
from jaxmotion.data import gaits, procedural
from jaxmotion.data.clips import clip_motion
from jaxmotion.motion.skeleton import Motion
from tests import mostly_slow, tiny

FPS, SECONDS = 30.0, 16.0
BONES = procedural.walker_skeleton()
TOES = list(BONES.feet)


def fk(motion):
    """Joints in float64, so that what moves is the motion and not the arithmetic."""
    six = np.asarray(motion.joint_rotation, np.float64)
    x = six[..., :3] / np.linalg.norm(six[..., :3], axis=-1, keepdims=True)
    y = six[..., 3:] - np.sum(x * six[..., 3:], axis=-1, keepdims=True) * x
    y = y / np.linalg.norm(y, axis=-1, keepdims=True)
    local = np.stack([x, y, np.cross(x, y)], axis=-1)
    position = [np.asarray(motion.root_position, np.float64)]
    turn = [local[:, 0]]
    offsets = np.asarray(BONES.offsets, np.float64)
    for joint in range(1, BONES.num_joints):
        parent = BONES.parents[joint]
        position.append(position[parent] + turn[parent] @ offsets[joint])
        turn.append(turn[parent] @ local[:, joint])
    return np.stack(position, axis=1)


def still(frames, **changes):
    options = dict(
        velocity=jnp.zeros((frames, 2)),
        facing=jnp.tile(jnp.array([[0.0, 1.0]]), (frames, 1)),
        label=jnp.zeros(frames, jnp.int32),
    )
    return procedural.Command(**(options | changes))


@functools.cache
def steered(gait, course, part=1.0):
    """A gait steered along a course at a part of its top speed."""
    made = gaits.GAITS[gait]
    speed = part * made.max_speed
    commands = courses.course_commands(
        course, seconds=SECONDS, fps=FPS, speed=speed, label=0
    )
    found = procedural.walk(commands, made, fps=FPS, seed=5)
    return commands, found, fk(found.motion)


COURSES = ("forward", "strafe", "stop_and_go")
# Each gait on one course, and all of them with all.
CASES = mostly_slow(
    [(gait, course) for gait in gaits.GAITS for course in COURSES],
    [(gait, COURSES[i % 3]) for i, gait in enumerate(gaits.GAITS)],
)


def check_contacts(walk, position):
    toe = position[:, TOES]
    both = walk.contact[1:] & walk.contact[:-1]
    moved = np.linalg.norm(np.diff(toe, axis=0), axis=-1)
    assert both.any(axis=0).all()
    assert moved[both].max() < 1e-5
    np.testing.assert_allclose(toe[walk.contact][:, 1], 0.03, atol=1e-5)
    # Off the ground a toe is above where it stands: contact is known, not guessed.
    assert toe[~walk.contact][:, 1].min(initial=1.0) > 0.03
    assert position[..., 1].min() > 0.03 - 1e-5


@pytest.mark.parametrize(("gait", "course"), CASES)
def test_contacts_are_exact_and_nothing_is_below_the_ground(gait, course):
    _, walk, position = steered(gait, course)
    check_contacts(walk, position)


@pytest.mark.parametrize("gait", gaits.GAITS)
def test_bones_keep_their_length(gait):
    _, walk, expected = steered(gait, "strafe")
    position = np.asarray(tiny.positions(BONES, walk.motion))
    np.testing.assert_allclose(position, expected, atol=2e-5)
    parents = np.array(BONES.parents[1:])
    length = np.linalg.norm(position[:, 1:] - position[:, parents], axis=-1)
    lengths = np.linalg.norm(np.asarray(BONES.offsets), axis=-1)[1:]
    np.testing.assert_allclose(
        length, np.broadcast_to(lengths, length.shape), atol=2e-5
    )


@pytest.mark.parametrize(("gait", "course"), CASES)
def test_no_joint_jumps(gait, course):
    _, _, position = steered(gait, course)
    gait = gaits.GAITS[gait]
    top = gait.max_speed
    speed = np.linalg.norm(np.diff(position, axis=0), axis=-1) * FPS
    # A foot covers two steps while it is in the air, and a smooth step peaks at 15/8
    # of its mean speed; a fifth more for turns, lift and what the knee adds.
    assert speed.max() < 1.2 * 2 * 15 / 8 * top / (1 - gait.double_support)
    acceleration = np.linalg.norm(np.diff(position, 2, axis=0), axis=-1) * FPS**2
    assert acceleration.max() < 180.0
    assert speed[:, 0].max() < 1.6 * top + 0.3, "the root"


@pytest.mark.parametrize(("gait", "course"), CASES)
def test_the_body_follows_the_commanded_velocity(gait, course):
    commands, _, position = steered(gait, course)
    path = position[:, 0, ::2]
    velocity = np.asarray(commands.velocity, float)
    # Springs of half-life h lag by h / ln 2 in both directions of a change; within
    # stretches of one command their end velocity is the command's.
    ends = np.flatnonzero(np.any(np.diff(velocity, axis=0) != 0, axis=-1))
    starts = np.concatenate([[0], ends + 1])[:-1]
    tops, errors = [], []
    for start, end in zip(starts, ends, strict=True):
        if end - start < 45 or np.linalg.norm(velocity[end]) < 0.1:
            continue
        # Over the last step or so, whole strides would be better: allow for the sway.
        span = slice(end - 24, end)
        mean = (path[span][-1] - path[span][0]) / 23 * FPS
        tops.append(np.linalg.norm(velocity[end]))
        errors.append(np.sum(mean * velocity[end]) / tops[-1] ** 2 - 1.0)
    assert len(errors) >= 3
    assert abs(np.mean(errors)) < 0.1
    # All in all: the net displacement, but for the springs' lag.
    asked = velocity.sum(axis=0) / FPS
    lag = 0.8 * np.linalg.norm(velocity, axis=-1).max() + 0.1
    assert np.linalg.norm(path[-1] - path[0] - asked) < lag


@pytest.mark.parametrize(("gait", "course"), CASES)
def test_knees_bend_forward(gait, course):
    _, _, position = steered(gait, course)
    for thigh in (14, 18):
        hip, knee, ankle, toe = (position[:, thigh + i] for i in range(4))
        line = ankle - hip
        on_line = hip + line * (
            np.sum((knee - hip) * line, -1, keepdims=True)
            / np.sum(line * line, -1, keepdims=True)
        )
        ahead = (toe - ankle) * [1, 0, 1]
        assert np.sum((knee - on_line) * ahead, axis=-1).min() > 0


def test_straight_walk_has_the_commanded_speed():
    for name, gait in gaits.GAITS.items():
        speed = 0.8 * gait.max_speed
        commands = still(300, velocity=jnp.tile(jnp.array([[0.0, speed]]), (300, 1)))
        found = procedural.walk(commands, gait, seed=2)
        path = np.asarray(found.motion.root_position)[90:, 2]
        measured = (path[-1] - path[0]) / (len(path) - 1) * FPS
        assert abs(measured / speed - 1.0) < 0.02, name


def test_standing_still_moves_no_foot():
    for name, gait in gaits.GAITS.items():
        found = procedural.walk(still(90), gait, seed=3)
        assert found.contact.all(), name
        position = fk(found.motion)
        assert np.abs(np.diff(position[:, TOES], axis=0)).max() < 1e-6, name


def test_path_and_facing_are_the_springs_of_a_first_order_reference():
    """A step of velocity, integrated in small steps by NumPy in float64."""
    speed, half_life, frames = 1.3, 0.27, 60
    commands = still(
        frames,
        velocity=jnp.tile(jnp.array([[speed, 0.0]]), (frames, 1)),
        facing=jnp.tile(jnp.array([[0.0, 1.0]]), (frames, 1)),
    )
    path, facing = procedural.follow_commands(
        commands, jnp.float32(FPS), jnp.float32(half_life)
    )
    # Critically damped spring on the velocity; damping as 4 ln 2 / half-life, halved.
    y = 2 * np.log(2) / half_life
    x = v = a = 0.0
    expected, fine = [], 400
    for _ in range(frames):
        for _ in range(fine):
            dt = 1 / FPS / fine
            a += dt * (y * y * (speed - v) - 2 * y * a)
            v += dt * a
            x += dt * v
        expected.append(x)
    np.testing.assert_allclose(path[:, 0], expected, atol=3e-3)
    np.testing.assert_allclose(path[:, 1], 0.0, atol=1e-6)
    np.testing.assert_allclose(facing, np.asarray(commands.facing), atol=1e-6)


@pytest.mark.slow
@pytest.mark.parametrize("speed", [2.0, 3.0, 5.0, 9.0])
@pytest.mark.parametrize("course", COURSES)
def test_too_fast_is_an_error_or_still_exact(course, speed):
    commands = courses.course_commands(
        course, seconds=12.0, fps=FPS, speed=speed, label=0
    )
    for name in ("neutral", "sneaky"):
        try:
            found = procedural.walk(commands, gaits.GAITS[name], seed=1)
        except ValueError as error:
            assert "command a lower speed" in str(error)
            assert "frame" in str(error)
        else:
            assert speed < 9.0
            check_contacts(found, fk(found.motion))


@pytest.mark.parametrize("fps", [12.0, 60.0])
def test_other_rates_walk_the_same_path_with_exact_contacts(fps):
    made = []
    for rate in (30.0, fps):
        commands = courses.course_commands(
            "forward", seconds=8.0, fps=rate, speed=1.2, label=0
        )
        made.append(procedural.walk(commands, gaits.GAITS["neutral"], fps=rate, seed=1))
    position = fk(made[1].motion)
    check_contacts(made[1], position)
    assert made[1].motion.fps == fps
    ends = [np.asarray(walk.motion.root_position)[-1, ::2] for walk in made]
    np.testing.assert_allclose(ends[1], ends[0], atol=0.25)


def features(clips):
    """Statistics of poses, one row a clip: means and spreads of joint heights and of
    joints relative to the root, facing +z."""
    position = fk(
        Motion(
            root_position=clips.root_position,
            joint_rotation=clips.joint_rotation,
            fps=30.0,
        )
    )
    across = position[:, 14] - position[:, 18]
    yaw = np.arctan2(-across[:, 2], across[:, 0])
    local = position - position[:, :1] * [1, 0, 1]
    c, s = np.cos(yaw)[:, None], np.sin(yaw)[:, None]
    x, z = c * local[..., 0] - s * local[..., 2], s * local[..., 0] + c * local[..., 2]
    shape = np.concatenate([x, local[..., 1], z], axis=-1)
    ends = np.asarray(clips.offsets)
    return np.stack(
        [
            np.concatenate([shape[a:b].mean(0), shape[a:b].std(0)])
            for a, b in zip(ends[:-1], ends[1:], strict=True)
        ]
    )


@pytest.mark.slow
def test_styles_can_be_told_apart_by_the_nearest_mean():
    train = procedural.make_clips(seed=1, minutes=6.0)
    held_out = procedural.make_clips(seed=2, minutes=6.0)
    x, y = features(train), np.asarray(train.labels["style"])
    scale = x.std(axis=0) + 1e-6
    means = np.stack([x[y == style].mean(axis=0) for style in np.unique(y)])
    gap = (features(held_out)[:, None] - means) / scale
    guess = np.argmin(np.sum(gap**2, axis=-1), axis=1)
    assert len(means) == len(gaits.GAITS) == 8
    assert np.mean(guess == np.asarray(held_out.labels["style"])) > 0.9


def test_the_same_seed_gives_the_same_clips_and_another_seed_others():
    options = dict(minutes=0.2, clip_seconds=2.0)
    first, again, other = (
        procedural.make_clips(seed=seed, **options) for seed in (4, 4, 5)
    )
    for a, b in zip(jax.tree.leaves(first), jax.tree.leaves(again), strict=True):
        np.testing.assert_array_equal(a, b)
    assert first.clip_names == again.clip_names
    assert np.abs(np.asarray(first.root_position - other.root_position)).max() > 0.01


def test_clips_are_labeled_and_finite():
    some = {name: gaits.GAITS[name] for name in ("proud", "zombie")}
    clips = procedural.make_clips(seed=0, minutes=0.5, gaits=some, clip_seconds=5.0)
    assert clips.num_clips == 6 and clips.num_frames == 6 * 150
    assert clips.names("style") == ("proud", "zombie")
    np.testing.assert_array_equal(clips.labels["style"], [0, 0, 0, 1, 1, 1])
    assert clips.clip_names[0] == "proud_000" and clips.clip_names[-1] == "zombie_002"
    assert "procedural" in clips.source
    assert np.isfinite(np.asarray(clips.root_position)).all()
    assert np.isfinite(np.asarray(clips.joint_rotation)).all()


def test_random_commands_stand_walk_turn_and_strafe():
    found = procedural.random_commands(
        np.random.default_rng(0), frames=20000, fps=FPS, max_speed=1.5
    )
    velocity, facing = np.asarray(found.velocity), np.asarray(found.facing)
    speed = np.linalg.norm(velocity, axis=-1)
    assert speed.max() <= 1.5 + 1e-6
    assert 0.08 < np.mean(speed == 0) < 0.28
    np.testing.assert_allclose(np.linalg.norm(facing, axis=-1), 1.0, atol=1e-6)
    cosine = np.sum(velocity * facing, -1)[speed > 0] / speed[speed > 0]
    aside = cosine < 0.5
    assert 0.1 < aside.mean() < 0.4
    assert speed[speed > 0][aside].max() <= 0.75 + 1e-6
    lengths = np.diff(np.flatnonzero(np.any(np.diff(velocity, axis=0) != 0, axis=-1)))
    assert lengths.min() >= 30


@pytest.mark.parametrize(
    "bad, message",
    [
        (dict(minutes=0.0), "minutes 0.0"),
        (dict(minutes=float("nan")), "minutes nan"),
        (dict(clip_seconds=-1.0), "clip_seconds -1.0"),
        (dict(clip_seconds=0.02), "two frames"),
        (dict(clip_seconds=float("inf")), "clip_seconds inf"),
        (dict(gaits={}), "0 gaits"),
        (dict(fps=0.0), "fps is 0.0"),
        (dict(fps=-30.0), "fps is -30.0"),
        (dict(fps=0.2), "fps is 0.2, expected at least 8"),
    ],
)
def test_bad_arguments_are_named(bad, message):
    with pytest.raises(ValueError, match=message):
        procedural.make_clips(**({"minutes": 0.1} | bad))


def test_bad_commands_are_named():
    gait = gaits.GAITS["neutral"]
    velocity = jnp.zeros((9, 2)).at[4, 1].set(jnp.nan)
    with pytest.raises(ValueError, match="velocity of frame 4 .*expected finite"):
        procedural.walk(still(9, velocity=velocity), gait)
    facing = jnp.tile(jnp.array([[0.0, 1.0]]), (9, 1)).at[6].set(0.0)
    with pytest.raises(ValueError, match="facing of frame 6 .*unit vector"):
        procedural.walk(still(9, facing=facing), gait)
    with pytest.raises(ValueError, match="at least 2 frames"):
        procedural.walk(still(1), gait)
    with pytest.raises(ValueError, match="fps is -1"):
        procedural.walk(still(9), gait, fps=-1.0)


@pytest.mark.slow
def test_clips_and_the_lock_of_clips_in_double_precision():
    with jax.enable_x64(True), warnings.catch_warnings():
        warnings.simplefilter("error")
        clips = procedural.make_clips(minutes=0.1)
        motion = clip_motion(clips, 0)
        lock = foot_lock.FootLock()
        found = foot_lock.clean_motion(clips.skeleton, motion, lock=lock)
        assert np.isfinite(np.asarray(found.joint_rotation)).all()


def test_a_gait_is_data():
    slow = dataclasses.replace(gaits.GAITS["neutral"], cadence=0.8, cadence_slope=0.2)
    commands = still(300, velocity=jnp.tile(jnp.array([[0.0, 0.7]]), (300, 1)))
    steps = [
        int(
            (
                np.diff(procedural.walk(commands, gait).contact.astype(int), axis=0) < 0
            ).sum()
        )
        for gait in (slow, gaits.GAITS["neutral"])
    ]
    assert steps[0] < 0.7 * steps[1]


@pytest.mark.parametrize(
    ("seed", "minutes"), mostly_slow([(1, 16.0), (2, 16.0), (3, 4.0)], [(3, 4.0)])
)
def test_random_clips_have_no_jump(seed, minutes):
    """Quick half turns among them, where a foot may lag far behind the body."""
    clips = procedural.make_clips(seed=seed, minutes=minutes)
    position = fk(
        Motion(
            root_position=clips.root_position,
            joint_rotation=clips.joint_rotation,
            fps=FPS,
        )
    )
    speed = np.linalg.norm(np.diff(position, axis=0), axis=-1) * FPS
    speed[np.asarray(clips.offsets)[1:-1] - 1] = 0.0
    assert speed.max() < 8.5


@pytest.mark.parametrize("gait", gaits.GAITS)
@pytest.mark.parametrize("part", mostly_slow([0.25, 0.5], [0.5]))
@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_feet_do_not_pass_through_each_other_sideways(gait, part, sign):
    speed = sign * part * gaits.GAITS[gait].max_speed
    commands = still(240, velocity=jnp.tile(jnp.array([[speed, 0.0]]), (240, 1)))
    position = fk(procedural.walk(commands, gaits.GAITS[gait], seed=1).motion)
    apart = position[:, TOES[0]] - position[:, TOES[1]]
    # It faces +z: its left is +x.
    assert apart[:, 0].min() > 0.05
