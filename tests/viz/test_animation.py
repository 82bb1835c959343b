import dataclasses
import time

import jax.numpy as jnp
import numpy as np
import pytest
from PIL import Image

from jaxmotion.motion.skeleton import Motion
from jaxmotion.viz import animation, camera, stage
from tests.viz import samples


def save(path, shown=None, **changes):
    shown = samples.circle_stage() if shown is None else shown
    animation.save_gif(path, shown, **(dict(size=160) | changes))


def frames(path):
    with Image.open(path) as image:
        found, durations = [], []
        for i in range(image.n_frames):
            image.seek(i)
            found.append(np.asarray(image.convert("RGB"), int))
            durations.append(image.info["duration"])
        return np.stack(found), durations, image.info.get("loop")


@pytest.mark.parametrize("every, fps", [(1, 30.0), (2, 30.0), (3, 60.0)])
def test_count_size_and_duration_are_those_asked_for(tmp_path, every, fps):
    shown = samples.circle_stage(samples.circle(31, fps=fps)[0])
    save(tmp_path / "a.gif", shown, every=every)
    pictures, durations, loop = frames(tmp_path / "a.gif")
    count = len(range(0, 31, every))
    assert pictures.shape == (count, 160, 160, 3)
    assert loop == 0
    # Hundredths of a second; the whole is as long as the motion, to one of them.
    assert abs(sum(durations) - 1000 * count * every / fps) <= 10
    assert np.ptp(durations) <= 10


def test_the_picture_changes_with_the_motion(tmp_path):
    save(tmp_path / "a.gif")
    pictures, _, _ = frames(tmp_path / "a.gif")
    steps = np.mean(np.any(np.diff(pictures, axis=0) != 0, axis=-1), axis=(1, 2))
    assert steps.min() > 0.002
    # Only the left hand, which is blue.
    raised = samples.circle_stage(skeleton=samples.figure(raised=0.5))
    save(tmp_path / "b.gif", raised)
    other, _, _ = frames(tmp_path / "b.gif")
    blue = lambda x: (x[..., 2] > x[..., 0] + 60) & (x[..., 2] > 120)  # noqa: E731
    red = lambda x: (x[..., 0] > x[..., 2] + 80) & (x[..., 1] < 75)  # noqa: E731

    def reach(picture):
        """Height of the hand over the foot, in lengths of the leg."""
        hand, leg = (np.argwhere(mask(picture))[:, 0] for mask in (blue, red))
        return (leg.max() - hand.min()) / np.ptp(leg)

    assert reach(other[0]) > reach(pictures[0]) + 0.3, "higher on the picture"


def green(pictures):
    """Pixels per picture that are green."""
    found = pictures[..., 1] > np.maximum(pictures[..., 0], pictures[..., 2]) + 20
    return found.sum(axis=(1, 2))


def test_the_wanted_path_and_touches_are_drawn(tmp_path):
    _, path = samples.circle()
    touch = np.zeros((len(path), 1), bool)
    touch[::4] = True
    place = np.stack([path[:, 0] + 0.5, 0 * path[:, 0] + 0.11, path[:, 1]], axis=-1)
    ball = stage.Ball(position=place, touch=touch, joints=(3,), radius=0.11)
    counts = {}
    for name, options in {
        "bare": {},
        "path": dict(wanted=path + 0.05),
        "touch": dict(ball=ball),
    }.items():
        save(tmp_path / "a.gif", samples.circle_stage(**options))
        counts[name] = green(frames(tmp_path / "a.gif")[0])
    assert counts["bare"].max() == 0
    assert counts["path"].min() > 10
    assert np.all((counts["touch"] > 5) == touch[::2, 0])


def test_a_ghost_is_pale_and_many_characters_are_set_apart(tmp_path):
    motion, _ = samples.circle(2)
    ahead = samples.circle(2, radius=1.5)[0]
    # Under [characters, frames] both; both start in one place.
    many = stage.make_stage(
        samples.figure(),
        Motion(
            root_position=jnp.stack([motion.root_position] * 3),
            joint_rotation=jnp.stack([motion.joint_rotation] * 3),
            fps=samples.FPS,
        ),
    )
    start = many.walked[:, 0]
    away = np.linalg.norm(start[:, None] - start, axis=-1) + 9 * np.eye(3)
    assert away.min() > 1.0
    shown = []
    for made in (
        samples.circle_stage(motion),
        samples.circle_stage(motion, ghost=ahead),
        many,
    ):
        save(tmp_path / "a.gif", made)
        first = frames(tmp_path / "a.gif")[0][0]
        blue = first[..., 2] - first[..., 0]
        shown.append([(blue > 60).any(), ((blue > 12) & (blue < 50)).sum()])
    assert all(strong for strong, _ in shown)
    assert shown[1][1] > shown[0][1] + 100, "pale blue where the ghost is"


LONG = ("a title much longer than any picture is wide " * 5)[:200]


@pytest.mark.slow
@pytest.mark.parametrize("size", [100, 333, (480, 360)])
def test_a_long_title_stays_in_one_line_on_the_picture(tmp_path, size):
    shown = stage.make_stage(*samples.person(seconds=0.1))
    for title in (LONG, "W" * 200, "unbroken_$math_^" * 13, "two\nlines " * 20):
        animation.save_gif(tmp_path / "a.gif", shown, title=title, size=size)
        picture = frames(tmp_path / "a.gif")[0][0]
        height, width = picture.shape[:2]
        ink = picture.sum(axis=-1) < 350
        ink[height // 12 :, width // 3 : -(width // 3)] = False  # the body
        rows = np.flatnonzero(ink[: height // 4].any(axis=1))
        assert rows[0] > 0 and len(rows) > 2
        assert np.ptp(rows) < height / 16 + 4, "one line"
        assert not ink[: rows[-1] + 1, :2].any() and not ink[: rows[-1] + 1, -2:].any()


def test_text_is_shrunk_before_it_is_elided():
    short, size = animation.fit_text("a walk", 300, size=16, least=9)
    assert (short, size) == ("a walk", 16)
    middle, size = animation.fit_text(LONG[:39], 240, size=16, least=9)
    assert middle == LONG[:39] and 9 <= size < 16
    cut, size = animation.fit_text(LONG, 240, size=16, least=9)
    assert size == 9 and cut.endswith("…") and LONG.startswith(cut[:-1])
    assert len(cut) > 30, "as much as there is room for"


@pytest.mark.parametrize("turn, elevation", [(0.0, 16.0), (1.2, 16.0), (-2.5, 40.0)])
def test_the_whole_body_is_in_the_picture_in_all_frames(turn, elevation):
    shown = stage.make_stage(*samples.person(turn=turn))
    positions = shown.positions[0]
    box = (16, 40, 464, 330)
    view = camera.follow(
        shown.outline,
        fps=samples.FPS,
        azimuth=35.0,
        elevation=elevation,
        box=box,
    )
    now = np.arange(len(positions))[:, None]
    pixels = view.project(shown.body.skin(positions, shown.rotations[0])[0], now)[0]
    low = high = pixels
    assert np.all(low >= [box[:2]]) and np.all(high <= [box[2:]])
    # And no farther than that needs: somewhere it touches the box.
    gap = min((low - box[:2]).min(), (box[2:] - high).min())
    assert gap < 8
    # Smoothly: the camera is shaken much less than the root is.
    jerk = lambda x: np.abs(np.diff(x[:, [0, 2]], 3, axis=0)).max()  # noqa: E731
    assert jerk(view.targets) < 0.3 * jerk(positions[:, 0])
    # And it stays with it.
    assert np.linalg.norm(view.targets - positions[:, 0], axis=-1).max() < 0.4


def test_a_mean_over_time_keeps_a_straight_line():
    line = np.arange(50.0)[:, None] * [1.0, -2.0]
    np.testing.assert_allclose(camera.smooth(line, 6.0), line, atol=1e-9)
    np.testing.assert_allclose(camera.smooth(line[:1], 6.0), line[:1])


@pytest.mark.slow
def test_the_ground_moves_under_the_character_and_stands_in_the_world(tmp_path):
    skeleton, motion = samples.person(seconds=3.0, turn=0.0)
    paths = {}
    for name, still in (("walk", False), ("still", True)):
        frame = np.zeros(90, int) if still else np.arange(90)
        shown = Motion(
            root_position=motion.root_position[frame],
            joint_rotation=motion.joint_rotation[frame],
            fps=samples.FPS,
        )
        path = tmp_path / f"{name}.gif"
        animation.save_gif(path, stage.make_stage(skeleton, shown))
        paths[name] = frames(path)[0][:, 250:, :100]  # beside the body
    assert len(paths["still"]) == 1, "equal pictures are one"
    changed = np.any(np.diff(paths["walk"], axis=0), axis=-1).mean(axis=(1, 2))
    assert changed[5:].min() > 0.005
    # Tiles have whole meters as corners wherever the camera is.
    for center in ([0.3, 0.9, 7.7], [-2.2, 0.9, 0.1]):
        corners = animation.tiles(np.array(center), 2.0)
        np.testing.assert_array_equal(corners, np.round(corners))
        assert np.all(corners[:, 0, [0, 2]].sum(axis=-1) % 2 == 0)
        assert np.all(np.abs(corners.mean(axis=1) - center)[:, [0, 2]] < 3)


@pytest.mark.slow
def test_eight_seconds_are_small_and_at_most_20_pictures_a_second(tmp_path):
    skeleton, motion = samples.person(seconds=8.0)
    wanted = motion.root_position[:, ::2] + 0.1
    animation.save_gif(
        tmp_path / "a.gif",
        stage.make_stage(skeleton, motion, wanted=wanted),
        title="a walk",
        caption="data (license)",
    )
    assert (tmp_path / "a.gif").stat().st_size < 1_500_000
    with Image.open(tmp_path / "a.gif") as image:
        assert image.size == (480, 360)
        assert 12 <= image.n_frames / 8.0 <= 20


def test_a_caption_is_below_and_the_title_above(tmp_path):
    shown = stage.make_stage(*samples.person(seconds=0.1))
    place = {}
    for name in ("title", "caption"):
        text = {name: "data and its license " * 4}
        animation.save_gif(tmp_path / "a.gif", shown, size=240, **text)
        ink = frames(tmp_path / "a.gif")[0][0][:, 180:235].sum(axis=-1) < 450
        place[name] = [bool(part.any()) for part in (ink[:24], ink[-16:])]
    assert place == {"title": [True, False], "caption": [False, True]}


def test_a_single_frame_is_a_picture(tmp_path):
    save(tmp_path / "a.gif", samples.circle_stage(samples.circle(1)[0]))
    assert frames(tmp_path / "a.gif")[0].shape[0] == 1


def test_a_path_below_a_file_is_an_error_before_any_drawing(tmp_path):
    (tmp_path / "plain").write_text("")
    many = samples.circle_stage(samples.circle(20_000)[0])
    start = time.perf_counter()
    with pytest.raises(OSError, match=r"plain/a\.gif"):
        save(tmp_path / "plain" / "a.gif", many)
    assert time.perf_counter() - start < 5.0


def test_wrong_options_are_named(tmp_path):
    for bad, message in ((dict(every=0), "every 0"), (dict(size=10), "size 10")):
        with pytest.raises(ValueError, match=message):
            save(tmp_path / "a.gif", **bad)
    # A GIF counts hundredths of a second: 240 pictures in one would take 2.4 s.
    fast = samples.circle_stage(dataclasses.replace(samples.circle(8)[0], fps=240.0))
    with pytest.raises(ValueError, match=r"every 1, .* every >= 3 \(at 240 frames"):
        save(tmp_path / "a.gif", fast, every=1)
    assert list(tmp_path.iterdir()) == []
