"""Foot lock: planted feet stand, legs reach, nothing jumps or flips."""

import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxmotion.control import foot_lock, rollout, sampling, steering
from jaxmotion.control.frame import Frame
from jaxmotion.motion import trajectory
from jaxmotion.motion.skeleton import (
    Motion,
    Skeleton,
    forward_kinematics,
    global_transforms,
)
from tests import tiny

FPS = 30.0
LOCK = foot_lock.FootLock()
MOST = 120  # frames of the motions that share a program
NAMES = ("Hips", "LHip", "LKnee", "LFoot", "LToe", "RHip", "RKnee", "RFoot", "RToe")
SKELETON = Skeleton(
    offsets=jnp.array(
        [[0, 0, 0]]
        + [[0.1, 0, 0], [0, -0.45, 0], [0, -0.42, 0], [0, -0.06, 0.14]]
        + [[-0.1, 0, 0], [0, -0.45, 0], [0, -0.42, 0], [0, -0.06, 0.14]],
        jnp.float32,
    ),
    parents=(-1, 0, 1, 2, 3, 0, 5, 6, 7),
    names=NAMES,
    feet=(4, 8),
)
ROOT = np.array([0.0, 0.93, 0.0])


def pitch(angle):
    c, s = np.cos(angle), np.sin(angle)
    return np.array([1, 0, 0, 0, c, s], np.float32)


def pose(bend=0.3):
    """Both knees bent so that the ankles stay under the hips, roughly."""
    joints = np.tile(pitch(0.0), (9, 1))
    for hip in (1, 5):
        joints[hip], joints[hip + 1] = pitch(-bend), pitch(2 * bend)
        joints[hip + 2] = pitch(-bend)
    return jnp.asarray(joints)


def stood(bend=0.3):
    """Height of the root at which the toes are 2.5 cm high."""
    toes = toes_of(np.zeros(3, np.float32), pose(bend))
    return np.array([0.0, 0.025 - toes[0, 1], 0.0], np.float32)


def toes_of(root, joints):
    return positions_of(root, joints)[[4, 8]].astype(np.float32)


def drift(speed, seconds=2.0):
    """A pose that slides over the ground without moving a joint."""
    frames = round(seconds * FPS)
    path = np.zeros((frames, 3), np.float32)
    path[:, 2] = speed / FPS * np.arange(frames)
    return Motion(
        root_position=jnp.asarray(stood() + path),
        joint_rotation=jnp.tile(pose(), (frames, 1, 1)),
        fps=FPS,
    )


@functools.partial(jax.jit, static_argnames=("lock", "fps"))
def lock_frames(skeleton, frames, *, fps, lock):
    def step(state, frame):
        given = skeleton, state, *frame
        state, *shown = foot_lock.lock_frame(*given, fps=fps, lock=lock)
        return state, tuple(shown)

    return jax.lax.scan(step, foot_lock.init_lock(skeleton), frames)[1]


def lock_motion(skeleton, motion, *, lock):
    """A motion of one character with its feet locked, frame after frame.

    Shorter ones stand at their end, so that one program does for all.
    """
    count = len(motion.root_position)
    assert count <= MOST
    index = np.minimum(np.arange(MOST), count - 1)
    frames = motion.root_position[index], motion.joint_rotation[index]
    found = lock_frames(skeleton, frames, fps=motion.fps, lock=lock)
    root, rotations = (x[:count] for x in found)
    return dataclasses.replace(motion, root_position=root, joint_rotation=rotations)


@jax.jit
def solve(root, joints, toes):
    placed = global_transforms(SKELETON, root, joints)
    return foot_lock.place_toes(SKELETON, *placed, joints, toes, lock=LOCK)


def place(root, joints, toes):
    return solve(*(jnp.asarray(x, jnp.float32) for x in (root, joints, toes)))


@jax.jit
def _positions(root, joints):
    return forward_kinematics(SKELETON, root, joints)


def positions_of(root, joints):
    return np.asarray(_positions(jnp.asarray(root), jnp.asarray(joints)), np.float64)


def test_a_pose_whose_toes_are_right_stays():
    for bend in (0.05, 0.3, 0.9):
        root, joints = stood(bend), pose(bend)
        found = place(root, joints, toes_of(root, joints))
        np.testing.assert_allclose(found, joints, atol=2e-4)


@pytest.mark.parametrize("seed", range(5))
def test_a_leg_reaches_within_its_length(seed):
    """By kinematics: toes are there, bones keep their length, feet do not turn."""
    generator = np.random.default_rng(seed)
    root, joints = stood(0.5), pose(0.5)
    toes = toes_of(root, joints)
    wanted = toes + generator.uniform(-0.08, 0.08, toes.shape).astype(np.float32)
    wanted[:, 1] = np.maximum(wanted[:, 1], 0.06)
    found = place(root, joints, wanted)
    after, before = positions_of(root, found), positions_of(root, joints)
    np.testing.assert_allclose(after[[4, 8]], wanted, atol=2e-4)
    for joint, parent in enumerate(SKELETON.parents[1:], start=1):
        length = lambda x, j=joint, p=parent: np.linalg.norm(x[j] - x[p])  # noqa: E731
        assert length(after) == pytest.approx(length(before), abs=1e-5)
    # The foot moved with the ankle and did not turn.
    np.testing.assert_allclose(
        after[[4, 8]] - after[[3, 7]], before[[4, 8]] - before[[3, 7]], atol=2e-4
    )


def test_angles_are_those_of_the_law_of_cosines():
    root, joints = stood(0.5), pose(0.5)
    wanted = toes_of(root, joints) + np.array([0.0, 0.1, 0.05])
    hip, knee, ankle = positions_of(root, place(root, joints, wanted))[1:4]
    d = np.linalg.norm(ankle - hip)
    want = np.arccos((0.45**2 + 0.42**2 - d**2) / (2 * 0.45 * 0.42))
    cosine = np.dot(hip - knee, ankle - knee) / (0.45 * 0.42)
    assert np.arccos(cosine) == pytest.approx(want, abs=1e-4)


@pytest.mark.parametrize("yaw", [0.0, 1.5])
def test_knees_stay_in_front(yaw):
    """From far back to far ahead, also through a straight leg, wherever they face."""
    root, c, s = stood(0.05), np.cos(yaw), np.sin(yaw)
    facing = np.array([s, 0.0, c])
    for bend in (0.0, 0.02, 0.3):
        joints = pose(bend).at[0].set(jnp.array([c, 0, -s, 0, 1, 0]))
        for ahead in np.linspace(-0.5, 0.5, 11):
            away = np.array([0.0, 0.1, 0.0]) + ahead * facing
            wanted = toes_of(root, joints) + away
            hip, knee, ankle = positions_of(root, place(root, joints, wanted))[1:4]
            # In front of the line from hip to ankle, and not aside.
            line = (ankle - hip) / np.linalg.norm(ankle - hip)
            out = (knee - hip) - np.dot(knee - hip, line) * line
            assert np.dot(out, facing - np.dot(facing, line) * line) > -1e-3
            assert abs(np.dot(out, [c, 0.0, -s])) < 1e-3, (bend, ahead)


def test_a_straight_leg_that_stands_apart_reaches():
    """Its axis is at right angles to the leg, although the hips' line is not."""
    root, joints = stood(0.0), pose(0.0)
    c, s = np.cos(0.6), np.sin(0.6)
    joints = joints.at[1].set(jnp.array([c, s, 0, -s, c, 0]))
    wanted = toes_of(root, joints) + np.array([[-0.02, 0.15, 0.04], [0, 0, 0]])
    found = positions_of(root, place(root, joints, wanted))
    np.testing.assert_allclose(found[4], wanted[0], atol=1e-3)


def test_the_plane_of_a_nearly_straight_leg_does_not_jump():
    """A leg bent a little sideways bends on as it is; straighter ones turn ahead."""
    root, sines, asides = stood(0.0), np.array([0.0, 0.01, 0.019, 0.0196, 0.03]), []
    for s in sines:
        c = np.sqrt(1.0 - s**2)
        joints = pose(0.0).at[2].set(jnp.array([c, s, 0, -s, c, 0]))
        wanted = toes_of(root, joints) + np.array([0.0, 0.2, 0.0])
        hip, knee, ankle = positions_of(root, place(root, joints, wanted))[1:4]
        line = (ankle - hip) / np.linalg.norm(ankle - hip)
        out = (knee - hip) - np.dot(knee - hip, line) * line
        asides.append(np.degrees(np.arctan2(abs(out[0]), out[2])))
    expected = np.degrees(np.arctan2(sines, np.maximum(1.0 - sines / 0.02, 0.0)))
    np.testing.assert_allclose(asides, expected, atol=3.0)


def test_a_leg_that_is_pulled_too_far_never_snaps():
    root, joints = stood(0.3), pose(0.3)
    toes, lengths = toes_of(root, joints), []
    for away in np.linspace(0.0, 1.0, 41):
        joints_now = place(root, joints, toes + np.array([0.0, 0.0, away]))
        hip, _, ankle = positions_of(root, joints_now)[1:4]
        lengths.append(np.linalg.norm(ankle - hip))
    # The approach to full stretch, in closed form.
    hip, _, ankle = positions_of(root, joints)[1:4]
    asked = np.linalg.norm(ankle + np.linspace([0] * 3, [0, 0, 1.0], 41) - hip, axis=1)
    begin, rest = 0.87 - LOCK.softness, LOCK.softness
    expected = begin + rest * (1.0 - np.exp(-(asked - begin) / rest))
    expected = np.where(asked > begin, expected, asked)
    np.testing.assert_allclose(lengths, expected, atol=3e-4)
    assert max(lengths) < 0.45 + 0.42
    assert np.all(np.diff(lengths) > -1e-4)
    assert np.abs(np.diff(lengths)).max() < 0.03


def test_no_toe_and_no_ankle_goes_below_the_ground():
    root, joints = stood(), pose()
    found = positions_of(root, place(root, joints, toes_of(root, joints) - 0.2))
    assert found[[4, 8], 1].min() > LOCK.toe_height - 2e-3
    assert found[[3, 7], 1].min() > LOCK.ankle_height - 2e-3


def test_a_heel_does_not_sink_under_raised_toes():
    """Toes above the ankles: held down, they would take the ankles below the ground."""
    root, joints = stood(0.9), np.asarray(pose(0.9)).copy()
    joints[[3, 7]] = pitch(-1.9)
    wanted = toes_of(root, joints)
    assert (wanted[:, 1] > positions_of(root, joints)[[3, 7], 1] + 0.04).all()
    wanted[:, 1] = LOCK.toe_height
    found = positions_of(root, place(root, joints, wanted))
    assert found[[3, 7], 1].min() > LOCK.ankle_height - 2e-3


def test_feet_that_slide_stand():
    motion = drift(0.05)
    found = lock_motion(SKELETON, motion, lock=LOCK)
    toes = tiny.positions(SKELETON, found)[:, jnp.array(SKELETON.feet)]
    # The first frame has no speed, and the second begins the contact.
    moved = np.linalg.norm(np.asarray(toes)[15:] - np.asarray(toes)[15], axis=-1)
    assert moved.max() < 1e-3
    still = dataclasses.replace(LOCK, body_reach=0.0)
    found = lock_motion(SKELETON, motion, lock=still)
    np.testing.assert_array_equal(found.root_position, motion.root_position)


def test_a_body_that_creeps_stays_over_its_feet_and_goes_with_a_free_one():
    motion = drift(0.03, seconds=2.0)
    lifted = np.asarray(motion.joint_rotation).copy()
    lifted[45:] = np.asarray(pose(0.9))
    walks = dataclasses.replace(motion, joint_rotation=jnp.asarray(lifted))
    root = lambda x: np.asarray(  # noqa: E731
        lock_motion(SKELETON, x, lock=LOCK).root_position
    )[:, ::2]
    own, stands = np.asarray(motion.root_position)[:, ::2], root(motion)
    strayed = lambda x: np.linalg.norm(x - x[0], axis=-1)  # noqa: E731
    assert strayed(own).max() > 0.05 and strayed(stands).max() < 0.015
    free = root(walks)
    np.testing.assert_array_equal(free[:40], stands[:40])
    assert np.linalg.norm(free - own, axis=-1)[-1] < 0.01
    assert np.linalg.norm(np.diff(free, axis=0), axis=-1).max() * FPS < 0.3


def test_a_body_stays_with_its_model_while_a_foot_is_free():
    motion = drift(0.05)
    joints = np.asarray(motion.joint_rotation).copy()
    joints[:, 1:5] = np.asarray(pose(0.9))[1:5]
    lifted = dataclasses.replace(motion, joint_rotation=jnp.asarray(joints))
    found = lock_motion(SKELETON, lifted, lock=LOCK)
    np.testing.assert_array_equal(found.root_position, motion.root_position)


def test_a_body_strays_from_its_plan_by_its_reach_at_most():
    motion = drift(0.2, seconds=2.0)
    lock = dataclasses.replace(LOCK, body_reach=0.04, radius=10.0)
    found = lock_motion(SKELETON, motion, lock=lock)
    away = np.linalg.norm(found.root_position - motion.root_position, axis=-1)
    assert 0.03 < away.max() < 0.04 + 1e-5


def test_a_lock_ends_at_its_radius_and_begins_anew():
    """At 0.3 m/s the toe lies 0.2 m behind after two thirds of a second."""
    states, state = [], foot_lock.init_lock(SKELETON)
    motion = drift(0.3, seconds=1.5)
    step = jax.jit(functools.partial(foot_lock.step_lock, fps=FPS, lock=LOCK))
    toes = tiny.positions(SKELETON, motion)[:, jnp.array(SKELETON.feet)]
    for now in toes:
        state = step(state, now)
        states.append(np.asarray(state.locked))
    locked = np.array(states)[:, 0]
    first = np.flatnonzero(locked)[0]
    end = first + np.flatnonzero(~locked[first:])[0]
    assert abs(end / FPS - (0.2 / 0.3 + 1 / FPS)) < 0.1
    # It catches up for a while, and stands again.
    again = np.flatnonzero(locked[end:])[0]
    assert 3 <= again <= 12 and locked[end + again :].all()


@functools.partial(jax.jit, static_argnames="lock")
def step_toes(toes, side=None, *, lock=LOCK):
    """States after each frame of animated toes [frames, feet, 3]."""

    def step(state, now):
        state = foot_lock.step_lock(state, now, fps=FPS, lock=lock, side=side)
        return state, state

    return jax.lax.scan(step, foot_lock.init_lock(SKELETON), toes)[1]


def both_toes(path, height=0.02):
    """Two toes, one meter apart, that go along x; float32."""
    path = np.asarray(path, np.float32)
    toe = np.stack([path, 0 * path + height, 0 * path], axis=-1)
    return jnp.asarray(np.stack([toe, toe + np.float32([0, 0, 1])], axis=1))


def test_a_toe_comes_to_rest_at_its_lock_as_a_spring_does():
    """From the speed u that it has: u t exp(-y t) beyond the point, y = 2 ln 2 / h."""
    speed, frame = 0.3, np.arange(12)
    found = step_toes(both_toes(speed / FPS * frame)).shown[:, 0, 0]
    time, rate = (frame[1:] - 1) / FPS, 2 * np.log(2) / LOCK.half_life
    beyond = speed * time * np.exp(-rate * time)
    np.testing.assert_allclose(found[1:], speed / FPS + beyond, atol=1e-6)


def test_a_heel_that_rises_over_its_point_ends_no_lock():
    """The radius is that of a circle on the ground."""
    lock = dataclasses.replace(LOCK, radius=0.1, end_height=1.0)
    frame = np.arange(40)
    found = step_toes(both_toes(0 * frame, 0.02 + 0.3 / FPS * frame), lock=lock)
    assert found.locked[1:].all()


def test_of_locks_that_would_cross_the_worse_one_ends():
    frame = np.arange(30)
    toes = np.zeros((30, 2, 3), np.float32)
    toes[..., 1] = 0.02
    toes[:, 0, 0] = 0.02 + 0.2 / FPS * frame  # it goes aside, the other one stands
    found = step_toes(jnp.asarray(toes), jnp.array([1.0, 0.0, 0.0]))
    locked = np.asarray(found.locked)[1:]
    assert locked[0].all() and locked[:, 1].all() and not locked[:, 0].all()


def test_a_toe_that_hurries_after_its_lock_is_off_the_ground():
    """Released by the radius it moves faster than it is animated, and still stands."""
    found = step_toes(both_toes(0.3 / FPS * np.arange(45)))
    shown, contact = np.asarray(found.shown), np.asarray(found.contact)
    speed = np.linalg.norm(np.diff(shown[..., ::2], axis=0), axis=-1) * FPS
    free = ~np.asarray(found.locked)[1:] & contact[1:]
    assert speed[free].max() > 1.0
    least = 0.02 + 0.035 * (1.0 - np.exp(-np.maximum(speed - 0.15, 0.0)))
    assert (shown[1:, :, 1] > least - 1e-5)[free].all()


def test_nothing_jumps():
    """Toes go from a stand to a swing and back: steps stay near the model's own."""
    frames = 120
    time = np.arange(frames) / FPS
    swing = np.clip(np.sin(2 * np.pi * time / 2), 0, None)
    joints = np.stack([np.asarray(pose(0.3 + 0.6 * float(x))) for x in swing])
    path = np.zeros((frames, 3), np.float32)
    path[:, 2] = 0.1 * time
    motion = Motion(
        root_position=jnp.asarray(stood() + path),
        joint_rotation=jnp.asarray(joints),
        fps=FPS,
    )
    found = lock_motion(SKELETON, motion, lock=LOCK)
    step = lambda x: np.abs(np.diff(tiny.positions(SKELETON, x), axis=0)).max()  # noqa: E731
    assert step(found) < step(motion) + 0.02


def test_contacts_have_hysteresis():
    ask = functools.partial(foot_lock.contacts, lock=LOCK)
    between = jnp.array([(LOCK.begin_speed + LOCK.end_speed) / 2])
    low, no, yes = jnp.array([0.0]), jnp.array([False]), jnp.array([True])
    assert not ask(no, between, low)[0] and ask(yes, between, low)[0]
    high = jnp.array([LOCK.toe_height + (LOCK.begin_height + LOCK.end_height) / 2])
    assert not ask(no, low, high)[0] and ask(yes, low, high)[0]
    # Of a skeleton whose toes rest higher, heights are over theirs.
    other = dataclasses.replace(LOCK, toe_height=LOCK.toe_height + 0.03)
    assert foot_lock.contacts(no, low, high, lock=other)[0]
    assert not foot_lock.contacts(no, low, high + 0.03, lock=other)[0]
    assert not ask(yes, jnp.array([LOCK.end_speed]), low)[0]


@pytest.mark.slow
def test_gradients_are_finite_everywhere():
    def loss(angles):
        joints = pose(0.3).at[:, 4:].add(angles)
        motion = drift(0.05, seconds=0.3)
        motion = dataclasses.replace(
            motion, joint_rotation=jnp.broadcast_to(joints, (9, 9, 6))
        )
        found = lock_motion(SKELETON, motion, lock=LOCK)
        return jnp.sum(found.joint_rotation**2)

    gradient = jax.grad(loss)(jnp.zeros((9, 2)))
    assert np.isfinite(np.asarray(gradient)).all()
    straight = jax.grad(lambda x: jnp.sum(place(stood(), pose(0.0), x)))
    assert np.isfinite(np.asarray(straight(toes_of(stood(), pose(0.0))))).all()


@pytest.mark.slow
def test_many_are_each_alone():
    motions = [drift(0.05), drift(0.3)]
    both = jax.tree.map(lambda *x: jnp.stack(x), *motions)
    run = functools.partial(lock_motion, SKELETON, lock=LOCK)
    found = jax.vmap(run)(both)
    for i, motion in enumerate(motions):
        np.testing.assert_allclose(
            found.joint_rotation[i], run(motion).joint_rotation, atol=1e-5
        )


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True)
class Pose:
    """What a controller displays."""

    root_position: jax.Array
    joint_rotation: jax.Array


def creeping(speed, *, knows):
    """A controller whose plans of ten frames creep on from the last pose it knows."""
    own = Pose(jnp.asarray(stood(), jnp.float32), pose())

    def plan(key, state, command):
        return state | {"start": state["last"], "cursor": jnp.zeros((), jnp.int32)}

    def advance(state, command):
        cursor, start = state["cursor"] + 1, state["start"]
        root = start.root_position.at[2].add(speed / FPS * cursor)
        now = Pose(root, start.joint_rotation)
        return state | {"cursor": cursor, "last": now}, now

    start = {"start": own, "last": own, "cursor": jnp.full((), 10, jnp.int32)}
    made = rollout.Controller(
        plan_level=lambda state, command: (state["cursor"] >= 10).astype(jnp.int32),
        plans=(plan,),
        advance=advance,
        shown=(lambda s, frame: s | {"last": frame}) if knows else None,
    )
    return made, start


@pytest.mark.slow
def test_plans_go_on_from_what_is_displayed():
    """So no offset outlives a plan: feet and body are where the next one has them."""
    offsets = {}
    for knows in (True, False):
        made, start = creeping(0.1, knows=knows)
        made = foot_lock.locked(made, SKELETON, fps=FPS, lock=LOCK)

        def tick(state, i, made=made):
            state, frame = rollout.tick(made, jax.random.key(0), state, i)
            return state, (frame, state)

        state = foot_lock.LockedState(inner=start, feet=foot_lock.init_lock(SKELETON))
        run = jax.jit(lambda s, f=tick: jax.lax.scan(f, s, jnp.arange(40))[1])
        frames, states = run(state)
        for first in (10, 20, 30):
            began = jax.tree.map(lambda x, i=first: x[i], states.inner["start"])
            same = jax.tree.map(lambda x, i=first: x[i - 1], frames)
            equal = [
                np.array_equal(*x)
                for x in zip(*map(jax.tree.leaves, (began, same)), strict=True)
            ]
            assert all(equal) == knows
            offsets[knows] = float(np.linalg.norm(states.feet.body[first]))
        steps = np.abs(np.diff(frames.root_position, axis=0)).max() * FPS
        assert steps < 0.15
    assert offsets[True] < 0.005 and offsets[False] > 0.05


def test_a_new_plan_from_what_is_displayed_ends_no_lock():
    """Toes are no faster for being where they are displayed, not where animated."""
    made, start = creeping(0.2, knows=True)
    made = foot_lock.locked(made, SKELETON, fps=FPS, lock=LOCK)

    def tick(state, i):
        state, _ = rollout.tick(made, jax.random.key(0), state, i)
        return state, state.feet.locked

    state = foot_lock.LockedState(inner=start, feet=foot_lock.init_lock(SKELETON))
    run = jax.jit(lambda s: jax.lax.scan(tick, s, jnp.arange(40))[1])
    assert run(state)[1:].all()


def test_a_controller_displays_locked_feet():
    """A controller that plays a clip: the same as the clip locked on its own."""
    motion = drift(0.05)

    def advance(tick, command):
        return tick + 1, Pose(motion.root_position[tick], motion.joint_rotation[tick])

    plays = rollout.Controller(
        plan_level=lambda state, command: jnp.zeros((), jnp.int32),
        plans=(),
        advance=advance,
    )
    made = foot_lock.locked(plays, SKELETON, fps=FPS, lock=LOCK)
    start = foot_lock.LockedState(
        inner=jnp.zeros((), jnp.int32), feet=foot_lock.init_lock(SKELETON)
    )
    _, frames = jax.lax.scan(made.advance, start, jnp.zeros(60))
    want = lock_motion(SKELETON, motion, lock=LOCK)
    np.testing.assert_allclose(frames.joint_rotation, want.joint_rotation, atol=1e-6)


def test_a_lock_that_is_off_changes_nothing_and_forgets():
    made, start = creeping(0.1, knows=False)
    off = foot_lock.locked(
        made, SKELETON, fps=FPS, lock=LOCK, enabled=jnp.zeros((), bool)
    )
    on = foot_lock.locked(made, SKELETON, fps=FPS, lock=LOCK)
    none = foot_lock.init_lock(SKELETON)
    state = foot_lock.LockedState(inner=start, feet=none)

    @jax.jit
    def play(state):
        step = lambda s, _: on.advance(s, jnp.zeros(()))  # noqa: E731
        return jax.lax.scan(step, state, None, length=8)[0]

    state = play(state)
    assert np.all(state.feet.locked)
    after, shown = jax.jit(off.advance)(state, jnp.zeros(()))
    _, plain = made.advance(state.inner, jnp.zeros(()))
    np.testing.assert_array_equal(shown.root_position, plain.root_position)
    np.testing.assert_array_equal(shown.joint_rotation, plain.joint_rotation)
    for left, want in zip(*map(jax.tree.leaves, (after.feet, none)), strict=True):
        np.testing.assert_array_equal(left, want)


def test_offsets_are_those_of_the_normal_equations():
    """A dense solve in float64, from the three terms as rows."""
    generator, frames = np.random.default_rng(3), 40
    path = np.cumsum(generator.normal(0, 0.01, (frames, 2)), axis=0)
    planted = generator.uniform(size=frames - 1) < 0.6
    first = np.diff(np.eye(frames), axis=0)
    stand, smooth = 1e3, 10.0
    rows = [
        np.eye(frames),
        np.sqrt(stand) * planted[:, None] * first,
        np.sqrt(smooth) * np.diff(np.eye(frames), n=2, axis=0),
    ]
    right = [np.zeros((frames, 2)), -rows[1] @ path, np.zeros((frames - 2, 2))]
    want = np.linalg.lstsq(np.concatenate(rows), np.concatenate(right), rcond=None)[0]
    toes = np.zeros((frames, 1, 3), np.float32)
    toes[:, 0, ::2] = path
    run = functools.partial(foot_lock.toe_offsets, stand=stand, smooth=smooth)
    found = jax.jit(run)(toes, planted[:, None])
    np.testing.assert_allclose(found[:, 0], want, atol=2e-5)


@pytest.mark.slow
def test_a_clip_is_cleaned():
    motion = drift(0.05)
    found = foot_lock.clean_motion(SKELETON, motion, lock=LOCK)
    toes = tiny.positions(SKELETON, found)[:, jnp.array(SKELETON.feet)]
    speed = np.linalg.norm(np.diff(toes, axis=0), axis=-1) * FPS
    assert speed.max() < 0.005
    # A fast one that is planted is not lifted.
    slid = foot_lock.clean_motion(SKELETON, drift(0.45, seconds=0.5), lock=LOCK)
    low = np.asarray(tiny.positions(SKELETON, slid))[1:-1, np.array(SKELETON.feet), 1]
    np.testing.assert_allclose(low, 0.025, atol=1e-3)
    # What goes backward at 2 m/s swings: it keeps clear of the ground.
    fast = tiny.positions(
        SKELETON, foot_lock.clean_motion(SKELETON, drift(-2.0), lock=LOCK)
    )
    heights = np.asarray(fast)[:-1, np.array(SKELETON.feet), 1]
    clear = LOCK.clearance * (1.0 - np.exp(-1.85))
    assert heights.min() > LOCK.toe_height + clear - 2e-3


def test_a_samplers_motions_are_cleaned():
    """Motion by motion, as `clean_motion` does."""
    motion = drift(0.05)

    def method(params):
        return lambda key, label: jax.tree.map(lambda x: x + 0 * params, motion)

    plain = sampling.Sampler(
        skeleton=SKELETON,
        labels=("drift",),
        fps=FPS,
        frames=len(motion.root_position),
        source="tests",
        params=jnp.zeros(()),
        method=method,
    )
    draw = functools.partial(sampling.sample_motions, labels=np.zeros(2, int), chunk=2)
    found = draw(foot_lock.clean_sampler(plain), jax.random.key(0))
    want = foot_lock.clean_motion(SKELETON, motion, lock=LOCK)
    for one in (found[0], found[1]):
        np.testing.assert_allclose(one.joint_rotation, want.joint_rotation, atol=1e-5)
    raw = draw(plain, jax.random.key(0))
    assert np.abs(raw.joint_rotation - found.joint_rotation).max() > 1e-3


@pytest.mark.slow
def test_a_character_is_displayed_with_locked_feet_by_one_program():
    """As its rollout locked afterwards; other values compile nothing."""
    skeleton = SKELETON

    def advance(state, command):
        place, joints = state
        place = place + command.velocity[0] / FPS * jnp.array([0.0, 0.0, 1.0])
        return (place, joints), Frame(
            root_position=place,
            joint_rotation=joints,
            desired_velocity=command.velocity,
            desired_facing=command.facing,
            planned=jnp.zeros((), bool),
            fps=FPS,
        )

    traces = []

    def method(params):
        traces.append(params)
        return rollout.Controller(
            plan_level=lambda state, command: jnp.zeros((), jnp.int32),
            plans=(),
            advance=advance,
        )

    def starts(labels, seed):
        number = len(labels)
        places = jnp.tile(jnp.asarray(stood()), (number, 1))
        return places, jnp.tile(pose(), (number, 1, 1))

    plain = steering.Character(
        skeleton=skeleton,
        labels=(),
        fps=FPS,
        source="tests",
        params={},
        method=method,
        starts=starts,
    )
    character = foot_lock.lock_feet(plain)
    for speed in (0.05, 0.1):
        commands = trajectory.Command(
            velocity=jnp.full((2, 40, 2), speed),
            facing=jnp.ones((2, 40, 2)),
            label=jnp.zeros((2, 40), jnp.int32),
        )
        roll = functools.partial(steering.steered_rollouts, commands=commands)
        frames = roll(character, jax.random.key(0), character.start(2))
        raw = roll(plain, jax.random.key(0), plain.start(2))
        want = lock_motion(skeleton, raw[0].motion, lock=LOCK)
        np.testing.assert_allclose(
            frames.joint_rotation[0], want.joint_rotation, atol=1e-5
        )
    assert len(traces) == 2


def test_the_lock_of_a_tuned_character_can_be_switched():
    tuning = steering.Tuning(
        method=lambda num_steps, scale: lambda params: (num_steps, scale, params),
        num_steps=(2, 4),
        own_steps=4,
        scale=1.0,
        scales=(0.0, 2.0),
        patience=3,
    )
    plain = steering.Character(
        skeleton=SKELETON,
        labels=(),
        fps=FPS,
        source="tests",
        params={},
        method=lambda params: None,
        tuning=tuning,
        starts=lambda labels, seed: None,
    )
    found = foot_lock.lock_feet(plain).tuning
    assert found.lockable and not tuning.lockable and found.num_steps == (2, 4)
    method = found.method(2, 0.5, locks=False)
    assert method.enabled is False and method.method("p") == (2, 0.5, "p")


def test_a_skeleton_without_legs_is_refused(skeleton):
    with pytest.raises(ValueError, match="expected hip, knee and ankle"):
        foot_lock.legs(skeleton)
    with pytest.raises(ValueError, match="names no feet"):
        foot_lock.legs(dataclasses.replace(SKELETON, feet=()))


def test_legs_begin_at_the_hips_whatever_is_above_them():
    trunk = Skeleton(
        offsets=jnp.zeros((10, 3)),
        parents=(-1, 0, *(parent + 1 for parent in SKELETON.parents[1:])),
        names=("Root", *NAMES),
        feet=(5, 9),
    )
    assert foot_lock.legs(trunk) == ((2, 3, 4, 5), (6, 7, 8, 9))


def test_a_body_that_turns_over_its_feet_does_not_cross_them():
    angles = np.linspace(0.0, np.deg2rad(120.0), 90)
    c, s, o = np.cos(angles), np.sin(angles), 0 * angles
    turned = np.tile(np.asarray(pose()), (90, 1, 1))
    turned[:, 0] = np.stack([c, o, -s, o, 1 + o, o], axis=1)
    motion = Motion(
        root_position=jnp.tile(jnp.asarray(stood()), (90, 1)),
        joint_rotation=jnp.asarray(turned),
        fps=FPS,
    )
    found = tiny.positions(SKELETON, lock_motion(SKELETON, motion, lock=LOCK))
    side = np.stack([c, o, -s], axis=1)
    gap = np.sum((np.asarray(found[:, 4]) - np.asarray(found[:, 8])) * side, axis=-1)
    assert gap.min() > 0.02  # -0.02 without the rule


def test_feet_that_stand_close_together_stay_locked():
    """Less than `crossing` apart, but no lock has brought them there."""
    side = jnp.array([1.0, 0.0, 0.0])
    state, locked = foot_lock.init_lock(SKELETON), []
    step = jax.jit(functools.partial(foot_lock.step_lock, fps=FPS, lock=LOCK))
    for i in range(30):
        # The model spreads them slowly, from 25 to 51 mm.
        toes = jnp.array([[0.015 + 0.0009 * i, 0.02, 0.0], [-0.01, 0.02, 0.0]])
        state = step(state, toes, side=side)
        locked.append(state.locked)
    assert np.all(locked[1:])


def test_a_toe_that_swings_is_off_the_ground():
    """A faster one by more; a slow one stays where it is."""
    each = np.array([2.0, 0.52, 0.15, 0.0])
    speeds = np.repeat(each, 5)
    height = LOCK.toe_height + 0.001
    toe = np.stack([np.cumsum(speeds / FPS), np.full(20, height), 0 * speeds], axis=1)
    still = np.broadcast_to([0.0, height, 1.0], toe.shape)
    toes = jnp.asarray(np.stack([toe, still], axis=1), jnp.float32)

    def step(state, now):
        state = foot_lock.step_lock(state, now, fps=FPS, lock=LOCK)
        return state, state.shown[:, 1]

    _, heights = jax.lax.scan(step, foot_lock.init_lock(SKELETON), toes)
    expected = np.full((20, 2), height)
    lifted = 0.02 + 0.035 * (1.0 - np.exp(-np.maximum(each - 0.15, 0.0)))
    expected[1:, 0] = np.repeat(np.maximum(lifted, height), 5)[1:]
    np.testing.assert_allclose(heights, expected, atol=1e-6)


def test_locks_do_not_cross_legs():
    """A body turns by 120 degrees over toes 20 cm apart that creep with it."""
    angles = np.linspace(0.0, np.deg2rad(120.0), 90)
    side = np.stack([np.cos(angles), 0 * angles, -np.sin(angles)], axis=1)
    toes = jnp.asarray(np.stack([0.1 * side, -0.1 * side], axis=1), jnp.float32)

    def run(with_side):
        def step(state, now):
            toes, side = now
            state = foot_lock.step_lock(
                state, toes, fps=FPS, lock=LOCK, side=side if with_side else None
            )
            return state, (state.shown, state.locked)

        start = foot_lock.init_lock(SKELETON)
        return jax.lax.scan(step, start, (toes, jnp.asarray(side, jnp.float32)))[1]

    gaps, locks = {}, {}
    for with_side in (False, True):
        shown, locks[with_side] = map(np.asarray, run(with_side))
        gaps[with_side] = np.sum((shown[:, 0] - shown[:, 1]) * side, axis=-1)
    assert gaps[False].min() < -0.05
    assert gaps[True].min() > -0.03
    # One foot steps at a time, and stands again.
    free = ~locks[True][5:]
    assert 0 < free.any(axis=1).mean() < 0.5
    assert locks[True][-10:].any()
