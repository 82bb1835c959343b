import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxmotion.data import dribble, procedural
from jaxmotion.data.clips import take_clips
from jaxmotion.data.dribble import Dribble
from jaxmotion.data.gaits import GAITS
from jaxmotion.motion.ball import control_weight
from jaxmotion.motion.skeleton import Motion
from tests.data.test_procedural import fk, still

FPS = 30.0
SETTINGS = Dribble()
RADIUS, FRICTION = SETTINGS.radius, SETTINGS.deceleration
TOES = list(procedural.walker_skeleton().feet)


@functools.cache
def walks():
    some = {name: GAITS[name] for name in ("neutral", "proud")}
    return procedural.make_clips(seed=2, minutes=0.8, gaits=some, clip_seconds=12.0)


@functools.cache
def made(seed=0, **changes):
    return dribble.dribble_clips(
        walks(), skill="dribble", settings=Dribble(**changes), seed=seed
    )


def joints(clips):
    return fk(
        Motion(root_position=clips.root_position, joint_rotation=clips.joint_rotation)
    )


@dataclasses.dataclass
class Part:
    """One stretch as its frames say: where the ball's velocity jumps is a push."""

    name: str
    ball: np.ndarray
    touch: np.ndarray
    joints: np.ndarray

    @property
    def velocity(self):
        return np.diff(self.ball, axis=0) * FPS

    @property
    def pushes(self):
        bends = np.linalg.norm(np.diff(self.velocity, axis=0), axis=-1) * FPS
        inside = np.flatnonzero(bends > 5 * FRICTION) + 1
        # A stretch that does not begin with a rest begins with a touch; the last frame
        # is one.
        first = [0] if np.linalg.norm(self.velocity[0]) > 0.05 else []
        return np.array([*first, *inside, len(self.ball) - 1])

    @property
    def feet(self):
        return np.array([int(np.flatnonzero(self.touch[k])[0]) for k in self.pushes])


def parts(data):
    ends, place = np.asarray(data.clips.offsets), joints(data.clips)
    ball, touch = np.asarray(data.position, float), np.asarray(data.touch)
    return [
        Part(name, ball[a:b], touch[a:b], place[a:b])
        for name, a, b in zip(data.clips.clip_names, ends[:-1], ends[1:], strict=True)
    ]


def test_there_is_something_to_test():
    found = parts(made())
    assert len(found) >= 3
    assert sum(len(part.pushes) for part in found) > 30
    assert min(len(part.ball) for part in found) >= SETTINGS.min_frames


def test_between_pushes_the_ball_rolls_straight_and_friction_alone_slows_it():
    rolling = stopping = lying = 0
    for part in parts(made()):
        assert np.ptp(part.ball[:, 1]) < 1e-6
        ends = np.union1d(0, part.pushes)
        for a, b in zip(ends[:-1], ends[1:], strict=True):
            velocity = part.velocity[a:b]
            speed = np.linalg.norm(velocity, axis=-1)
            # On one line, forwards. Millimeters of single precision.
            ahead = velocity @ velocity[0] / max(speed[0], 1e-9)
            np.testing.assert_allclose(ahead, speed, atol=1e-3)
            change = np.diff(speed) * FPS
            rolls, lies = speed[1:] > FRICTION / FPS, speed[:-1] < 1e-4
            np.testing.assert_allclose(change[rolls], -FRICTION, atol=5e-3)
            np.testing.assert_allclose(change[lies], 0.0, atol=5e-3)
            # In the frame in which it stops it slows down by less than that.
            assert change.max(initial=0) < 5e-3
            assert change.min(initial=0) > -FRICTION - 5e-3
            rolling, lying = rolling + rolls.sum(), lying + lies.sum()
            stopping += np.sum(~rolls & ~lies)
    assert rolling > 200 and lying > 20 and stopping > 5


def test_the_ball_lies_on_the_ground_that_the_toes_stand_on():
    for part in parts(made()):
        np.testing.assert_allclose(part.ball[:, 1], RADIUS, atol=1e-4)


def test_legs_never_come_into_the_ball():
    for part in parts(made()):
        near = np.abs(np.arange(len(part.ball))[:, None] - part.pushes).min(axis=1) <= 2
        for toe in TOES:
            leg = part.joints[:, [toe, toe - 1, toe - 2]]
            # Bones as many points.
            share = np.linspace(0.0, 1.0, 41)[:, None]
            points = leg[:, :-1, None] + share * (leg[:, 1:] - leg[:, :-1])[:, :, None]
            away = np.linalg.norm(points - part.ball[:, None, None], axis=-1)
            away = away.min(axis=(1, 2))
            assert away[~near].min() > RADIUS + SETTINGS.thickness - 1e-4
            least = RADIUS + SETTINGS.thickness - SETTINGS.give
            assert away.min() > least - 1e-4
        root = part.joints[:, 0] - part.ball
        assert np.linalg.norm(root[:, ::2], axis=-1).max() <= SETTINGS.reach + 1e-4


def test_each_push_is_a_touch_of_one_low_swinging_foot_behind_the_ball():
    for part in parts(made()):
        assert (part.touch[part.pushes].sum(axis=1) == 1).all()
        gaps = np.diff(part.pushes) / FPS
        assert gaps.min() >= SETTINGS.gap[0] - 1e-6
        assert gaps.max() <= SETTINGS.gap[1] + 1e-6
        for frame, foot in zip(part.pushes, part.feet, strict=True):
            toe = part.joints[frame, TOES[foot]]
            away = part.ball[frame] - toe
            assert abs(np.linalg.norm(away) - RADIUS - SETTINGS.thickness) < 1e-4
            assert toe[1] <= SETTINGS.max_height + 1e-4
            if 0 < frame < len(part.ball) - 1:
                step = part.joints[[frame - 1, frame + 1], TOES[foot]][:, ::2]
                step = (step[1] - step[0]) / 2 * FPS
                speed = np.linalg.norm(step)
                assert speed >= SETTINGS.min_toe_speed - 1e-3
                cosine = away[::2] @ step / np.linalg.norm(away[::2]) / speed
                assert cosine > 1 - 1e-4
                assert (toe - part.joints[frame, 0])[::2] @ step > 0


def test_each_push_is_along_the_foot_and_no_faster_than_its_bounce():
    count = 0
    for part in parts(made()):
        velocity = part.velocity[:, ::2]
        for frame, foot in zip(part.pushes, part.feet, strict=True):
            if not 0 < frame < len(part.ball) - 1:
                continue
            step = part.joints[[frame - 1, frame + 1], TOES[foot]][:, ::2]
            toe = (step[1] - step[0]) / 2 * FPS
            speed = np.linalg.norm(toe)
            toe = toe / speed
            # Velocities at the push: half a frame of friction away from the means.
            half = FRICTION / FPS / 2
            after, before = velocity[frame], velocity[frame - 1]
            after = after * (1 + half / np.linalg.norm(after))
            if np.linalg.norm(before) > 2 * half:
                before = before * (1 - half / np.linalg.norm(before))
            change = after - before
            slack = 2 * half
            assert change @ toe > SETTINGS.min_push - slack
            size = np.linalg.norm(change)
            assert change @ toe > size * np.cos(SETTINGS.cone) - slack
            came = speed - before @ toe
            assert after @ toe - speed < SETTINGS.restitution * came + slack
            assert np.linalg.norm(after) <= SETTINGS.max_speed
            count += 1
    assert count > 20


def test_touch_labels_are_where_the_rule_says():
    limit = RADIUS + 0.05
    more = 0
    for part in parts(made()):
        toes = part.joints[:, TOES]
        away = np.linalg.norm(toes - part.ball[:, None], axis=-1)
        expected = np.zeros_like(part.touch)
        for frame, foot in zip(part.pushes, part.feet, strict=True):
            for f in range(max(frame - 1, 0), min(frame + 2, len(away))):
                expected[f, foot] = away[f, foot] <= limit
        sure = np.abs(away - limit) > 1e-4
        np.testing.assert_array_equal(part.touch[sure], expected[sure])
        more += part.touch.sum() - len(part.pushes)
    assert more > 0


def test_before_its_first_touch_the_ball_lies_a_second_at_most():
    rests = [part.pushes[0] for part in parts(made())]
    assert max(rests) == 30 and made(wait=0.0).clips.num_clips > 0
    assert all(part.pushes[0] == 0 for part in parts(made(wait=0.0)))


def test_stretches_are_the_recorded_frames_and_do_not_overlap():
    source, data = walks(), made()
    used = np.zeros(source.num_frames, int)
    ends = np.asarray(data.clips.offsets)
    for i, name in enumerate(data.clips.clip_names):
        clip, span = name.split("@")
        number = source.clip_names.index(clip)
        start, length = (int(x) for x in span.split("+"))
        assert length == ends[i + 1] - ends[i]
        first = int(source.offsets[number]) + start
        assert first + length <= int(source.offsets[number + 1])
        used[first : first + length] += 1
        for field in ("root_position", "joint_rotation"):
            np.testing.assert_array_equal(
                getattr(data.clips, field)[ends[i] : ends[i + 1]],
                getattr(source, field)[first : first + length],
            )
        assert data.clips.labels["style"][i] == source.labels["style"][number]
    assert used.max() == 1
    assert data.clips.names("skill") == ("dribble",)
    assert (np.asarray(data.clips.labels["skill"]) == 0).all()
    assert data.joints == source.skeleton.feet and data.radius == RADIUS
    assert data.clips.source == (
        f"{source.source}; synthetic ball (jaxmotion dribble synthesis, seed 0)"
    )


def test_the_seed_decides():
    options = dict(skill="dribble", settings=SETTINGS, seed=0)
    again = dribble.dribble_clips(walks(), **options)
    for a, b in zip(jax.tree.leaves(made()), jax.tree.leaves(again), strict=True):
        np.testing.assert_array_equal(a, b)
    assert made().clips.clip_names == again.clips.clip_names
    assert made().clips.clip_names != made(seed=1).clips.clip_names


def test_further_clips_change_nothing():
    few = dribble.dribble_clips(
        take_clips(walks(), [0, 1]), skill="dribble", settings=SETTINGS, seed=0
    )
    count, frames = few.clips.num_clips, few.clips.num_frames
    assert 0 < count < made().clips.num_clips
    assert few.clips.clip_names == made().clips.clip_names[:count]
    np.testing.assert_array_equal(few.position, made().position[:frames])
    np.testing.assert_array_equal(few.touch, made().touch[:frames])


def standing(frames=90):
    """Clips of people who stand in some places, facing +x."""
    facing = jnp.tile(jnp.array([[1.0, 0.0]]), (frames, 1))
    motion = procedural.walk(still(frames, facing=facing), GAITS["neutral"]).motion
    return dataclasses.replace(
        take_clips(walks(), [0]),
        root_position=motion.root_position,
        joint_rotation=motion.joint_rotation,
        offsets=jnp.array([0, frames]),
        clip_names=("stands",),
    )


def test_nothing_found_and_a_second_skill_are_errors():
    options = dict(skill="dribble", settings=SETTINGS, seed=0)
    with pytest.raises(ValueError, match="no stretch of 60 frames to dribble"):
        dribble.dribble_clips(standing(), **options)
    with pytest.raises(ValueError, match="'skill' already"):
        dribble.dribble_clips(made().clips, **options)


@pytest.mark.parametrize(
    "bad",
    [
        dict(deceleration=0.0),
        dict(restitution=-0.1),
        dict(thickness=0.06),
        dict(give=0.04),
        dict(gap=(1.2, 0.3)),
        dict(cone=np.pi),
        dict(reach=np.nan),
    ],
)
def test_bad_settings_are_named(bad):
    with pytest.raises(ValueError, match=next(iter(bad))):
        Dribble(**bad)


def test_a_ball_off_which_the_person_is_lies_out_of_control():
    data = dribble.resting_clips(walks(), skill="off_ball", distance=(2.5, 5.0), seed=3)
    assert data.clips.num_clips == walks().num_clips
    assert not np.asarray(data.touch).any()
    distances = []
    for part in parts(data):
        assert np.ptp(part.ball, axis=0).max() == 0.0
        away = np.linalg.norm((part.ball - part.joints[:, 0])[:, ::2], axis=-1)
        distances.append(away.min())
    assert 2.5 - 1e-3 <= min(distances) < max(distances) <= 5.0 + 1e-3
    weight = control_weight(data.position, data.clips.root_position, reach=2.0)
    assert (np.asarray(weight) == 0).all()
    np.testing.assert_allclose(np.asarray(data.position)[:, 1], RADIUS, atol=1e-4)


def test_a_ball_lies_in_front_of_who_stands():
    both = [standing(), walks()]
    rule = dict(distance=(0.4, 0.8), angle=np.pi / 4, travel=0.5)
    for seed in range(5):
        data = dribble.resting_clips(both[0], skill="stand", seed=seed, **rule)
        (part,) = parts(data)
        way = (part.ball - part.joints[:, 0])[:, ::2]
        distance = np.linalg.norm(way, axis=-1)
        assert distance.min() >= 0.4 - 1e-3 and distance.min() <= 0.8 + 1e-3
        assert (way[:, 0] > distance * np.cos(np.pi / 4) - 1e-2).all()
        legs = np.linalg.norm(part.joints[:, 14:] - part.ball[:, None], axis=-1)
        assert legs.min() >= RADIUS + 0.03 - 1e-4
    with pytest.raises(ValueError, match="no place for a ball"):
        dribble.resting_clips(both[1], skill="stand", seed=0, **rule)


def test_a_ball_finds_no_place_within_the_legs():
    with pytest.raises(ValueError, match="no place for a ball beside 1 clips"):
        dribble.resting_clips(standing(), skill="x", distance=(0.01, 0.02), seed=0)
    with pytest.raises(ValueError, match="distance is"):
        dribble.resting_clips(standing(), skill="x", distance=(2.0, 1.0), seed=0)


def test_sets_of_several_skills_become_one():
    rest = dribble.resting_clips(walks(), skill="off_ball", distance=(3.0, 4.0), seed=0)
    joined = dribble.concatenate_ball_clips([made(), rest, made(seed=1)])
    assert joined.clips.names("skill") == ("dribble", "off_ball")
    counts = np.bincount(np.asarray(joined.clips.labels["skill"]))
    assert counts[1] == rest.clips.num_clips
    assert counts[0] == made().clips.num_clips + made(seed=1).clips.num_clips
    first = made().clips.num_frames
    second = first + rest.clips.num_frames
    assert joined.clips.num_frames == len(joined.position) == len(joined.touch)
    np.testing.assert_array_equal(joined.position[:first], made().position)
    np.testing.assert_array_equal(joined.position[first:second], rest.position)
    np.testing.assert_array_equal(joined.touch[second:], made(seed=1).touch)


def test_sets_with_other_balls_or_joints_are_not_joined():
    for change in (dict(radius=0.12), dict(joints=(0, 1))):
        other = dataclasses.replace(made(), **change)
        with pytest.raises(ValueError, match=f"{next(iter(change))} of the parts"):
            dribble.concatenate_ball_clips([made(), other])
    with pytest.raises(ValueError, match="no clips"):
        dribble.concatenate_ball_clips([])
