import time

import numpy as np
import pytest
from PIL import Image

from jaxmotion.viz import animation, camera
from jaxmotion.viz import sketch as body
from tests.viz import samples


def save(path, positions=None, **changes):
    made, walked = samples.circle()
    positions = made if positions is None else positions
    walked = None if len(positions) != len(walked) else walked
    options = dict(fps=samples.FPS, names=samples.NAMES, walked=walked, size=160)
    animation.save_gif(path, positions, samples.PARENTS, **(options | changes))


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
    positions, _ = samples.circle(31)
    save(tmp_path / "a.gif", positions, every=every, fps=fps)
    pictures, durations, loop = frames(tmp_path / "a.gif")
    count = len(range(0, 31, every))
    assert pictures.shape == (count, 160, 160, 3)
    assert loop == 0
    # Hundredths of a second; the whole is as long as the motion, to one of them.
    assert abs(sum(durations) - 1000 * count * every / fps) <= 10
    assert np.ptp(durations) <= 10


def test_the_picture_changes_with_the_motion(tmp_path):
    positions, _ = samples.circle()
    save(tmp_path / "a.gif", positions, walked=None)
    pictures, _, _ = frames(tmp_path / "a.gif")
    steps = np.mean(np.any(np.diff(pictures, axis=0) != 0, axis=-1), axis=(1, 2))
    assert steps.min() > 0.002
    raised = positions.copy()
    raised[:, 2, 1] += 0.5  # only the left hand, which is blue
    save(tmp_path / "b.gif", raised, walked=None)
    other, _, _ = frames(tmp_path / "b.gif")
    blue = lambda x: (x[..., 2] > x[..., 0] + 60) & (x[..., 2] > 120)  # noqa: E731
    red = lambda x: (x[..., 0] > x[..., 2] + 80) & (x[..., 1] < 110)  # noqa: E731

    def reach(picture):
        """Height of the hand over the foot, in lengths of the leg."""
        hand, leg = (np.argwhere(mask(picture))[:, 0] for mask in (blue, red))
        return (leg.max() - hand.min()) / np.ptp(leg)

    assert reach(other[0]) > reach(pictures[0]) + 0.3, "higher on the picture"


def test_paths_and_contacts_are_drawn(tmp_path):
    positions, path = samples.circle()
    green = lambda x: x[..., 1] > np.maximum(x[..., 0], x[..., 2]) + 20  # noqa: E731
    counts = {}
    contact = np.zeros((len(positions), 1), bool)
    contact[::4] = True
    for name, options in {
        "bare": dict(walked=None),
        "paths": dict(commanded=path + 0.05),
        "feet": dict(walked=None, feet=(3,), contact=contact),
    }.items():
        save(tmp_path / "a.gif", **options)
        pictures, _, _ = frames(tmp_path / "a.gif")
        counts[name] = green(pictures).sum(axis=(1, 2))
    assert counts["bare"].max() == 0
    assert counts["paths"].min() > 10
    assert np.all((counts["feet"] > 5) == contact[::2, 0])


LONG = ("a title much longer than any picture is wide " * 5)[:200]


@pytest.mark.parametrize("size", [100, 333, (480, 360)])
def test_a_long_title_stays_in_one_line_on_the_picture(tmp_path, size):
    positions, skeleton = samples.person(seconds=0.1)
    for title in (LONG, "W" * 200, "unbroken_$math_^" * 13, "two\nlines " * 20):
        animation.save_gif(
            tmp_path / "a.gif",
            positions,
            skeleton.parents,
            fps=samples.FPS,
            title=title,
            size=size,
        )
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
    positions, skeleton = samples.person(turn=turn)
    made = body.build(positions, skeleton.parents, skeleton.names)
    box = (16, 40, 464, 330)
    view = camera.follow(
        made, fps=samples.FPS, azimuth=35.0, elevation=elevation, box=box
    )
    now = np.arange(len(positions))[:, None]
    places = np.concatenate([made.points[:, made.ends.ravel()], positions], axis=1)
    radii = np.concatenate([made.radii.ravel(), np.zeros(positions.shape[1])])
    pixels, scale, _ = view.project(places, now)
    low, high = pixels - (radii * scale)[..., None], pixels + (radii * scale)[..., None]
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
    positions, skeleton = samples.person(seconds=3.0, turn=0.0)
    paths = {}
    for name, still in (("walk", False), ("still", True)):
        shown = np.repeat(positions[:1], len(positions), 0) if still else positions
        path = tmp_path / f"{name}.gif"
        animation.save_gif(path, shown, skeleton.parents, fps=samples.FPS)
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
    positions, skeleton = samples.person(seconds=8.0)
    walked = positions[:, 0, ::2]
    animation.save_gif(
        tmp_path / "a.gif",
        positions,
        skeleton.parents,
        fps=samples.FPS,
        names=skeleton.names,
        walked=walked,
        commanded=walked + 0.1,
        title="a walk",
        caption="data (license)",
    )
    assert (tmp_path / "a.gif").stat().st_size < 1_500_000
    with Image.open(tmp_path / "a.gif") as image:
        assert image.size == (480, 360)
        assert 12 <= image.n_frames / 8.0 <= 20


def test_a_caption_is_below_and_the_title_above(tmp_path):
    positions, skeleton = samples.person(seconds=0.1)
    place = {}
    for name in ("title", "caption"):
        text = {name: "data and its license " * 2}
        path = tmp_path / "a.gif"
        animation.save_gif(
            path, positions, skeleton.parents, fps=samples.FPS, size=240, **text
        )
        ink = frames(tmp_path / "a.gif")[0][0][:, :70].sum(axis=-1) < 450
        place[name] = [bool(part.any()) for part in (ink[:24], ink[-16:])]
    assert place == {"title": [True, False], "caption": [False, True]}


def test_a_single_frame_is_a_picture(tmp_path):
    save(tmp_path / "a.gif", samples.circle(1)[0])
    assert frames(tmp_path / "a.gif")[0].shape[0] == 1


def test_a_path_below_a_file_is_an_error_before_any_drawing(tmp_path):
    (tmp_path / "plain").write_text("")
    many = np.repeat(samples.circle()[0], 2000, axis=0)
    start = time.perf_counter()
    with pytest.raises(OSError, match=r"plain/a\.gif"):
        save(tmp_path / "plain" / "a.gif", many)
    assert time.perf_counter() - start < 5.0


BAD = [
    (
        dict(positions=np.zeros((5, 3, 3))),
        r"positions are \(5, 3, 3\).*\[frames, 4, 3\]",
    ),
    (dict(positions=np.zeros((5, 4))), r"positions are \(5, 4\)"),
    (dict(positions=np.zeros((0, 4, 3))), "0 frames"),
    (dict(fps=0.0), "0.0 fps"),
    (dict(every=0), "every 0"),
    (dict(size=10), "size 10"),
    (dict(walked=np.zeros((5, 2))), r"walked path is \(5, 2\), expected \(12, 2\)"),
    (dict(commanded=np.zeros((12, 3))), r"commanded path is \(12, 3\)"),
    (dict(contact=np.zeros((12, 2), bool), feet=(3,)), r"contact is \(12, 2\)"),
    (dict(contact=np.zeros((12, 1), bool)), "of feet None"),
]


@pytest.mark.parametrize("bad, message", BAD)
def test_wrong_shapes_are_named(tmp_path, bad, message):
    with pytest.raises(ValueError, match=message):
        save(tmp_path / "a.gif", **bad)
    assert list(tmp_path.iterdir()) == []


def test_a_frame_that_is_not_finite_is_named(tmp_path):
    positions, path = samples.circle()
    positions[7, 1, 2] = np.nan
    with pytest.raises(ValueError, match="positions: frame 7 is not finite"):
        save(tmp_path / "a.gif", positions)
    path[3] = np.inf
    with pytest.raises(ValueError, match="walked: frame 3 is not finite"):
        save(tmp_path / "a.gif", walked=path)
