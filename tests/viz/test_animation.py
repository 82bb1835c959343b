import time

import numpy as np
import pytest
from PIL import Image

from jaxmotion.viz import animation
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
    save(tmp_path / "a.gif", positions)
    pictures, _, _ = frames(tmp_path / "a.gif")
    steps = np.mean(np.any(np.diff(pictures, axis=0) != 0, axis=-1), axis=(1, 2))
    assert steps.min() > 0.002
    raised = positions.copy()
    raised[:, 2, 1] += 0.5  # only the left hand, which is blue
    save(tmp_path / "b.gif", raised)
    other, _, _ = frames(tmp_path / "b.gif")
    blue = lambda x: (x[..., 2] > x[..., 0] + 60) & (x[..., 2] > 120)  # noqa: E731
    red = lambda x: (x[..., 0] > x[..., 2] + 90) & (x[..., 1] < 90)  # noqa: E731
    rows = [np.argwhere(blue(x[0]))[:, 0].mean() for x in (pictures, other)]
    assert rows[1] < rows[0] - 5, "higher on the picture"
    legs = [np.argwhere(red(x[0])) for x in (pictures, other)]
    assert len(legs[0]) > 10
    assert abs(legs[0].mean(0) - legs[1].mean(0)).max() < 3


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


@pytest.mark.parametrize("size", [100, 333, 360])
def test_a_long_title_stays_on_the_picture(tmp_path, size):
    words = "a title that is much longer than any picture could be wide " * 3
    for title in (words, "W" * 150, "unbroken_$math_^" * 6):
        save(tmp_path / "a.gif", samples.circle(2)[0], title=title, size=size)
        pictures, _, _ = frames(tmp_path / "a.gif")
        assert pictures.shape[1:3] == (size, size)
        dark = pictures[0].sum(axis=-1) < 600
        top = dark[: size // 4]
        assert top.sum() > 50
        assert not top[:, :1].any() and not top[:, -1:].any() and not dark[0].any()


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
