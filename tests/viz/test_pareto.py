import numpy as np
import pytest
from PIL import Image

from jaxmotion.viz import plots

X = np.array([[1.0, 0.9, 1.1], [4.0, 3.9, 4.2], [16.0, 15.0, 17.0]])
Y = np.array([[9.0, 8.0, 10.0], [2.0, 1.8, 2.2], [3.0, 2.5, 3.5]])


def test_the_front_is_what_nothing_beats():
    assert plots.pareto_front(X[:, 0], Y[:, 0]).tolist() == [True, True, False]
    # Equal points do not beat each other; equal in one and lower in the other does.
    x, y = np.array([1.0, 1.0, 1.0]), np.array([2.0, 2.0, 3.0])
    assert plots.pareto_front(x, y).tolist() == [True, True, False]


def test_the_front_against_every_pair():
    x, y = np.random.default_rng(0).integers(0, 6, (2, 40)).astype(float)
    expected = [
        not any(
            x[j] <= x[i] and y[j] <= y[i] and (x[j], y[j]) != (x[i], y[i])
            for j in range(40)
        )
        for i in range(40)
    ]
    assert plots.pareto_front(x, y).tolist() == expected


def draw(path, **more):
    settings = dict(
        references={"data": np.array([1.0, 0.9, 1.2])},
        xlabel="ms",
        ylabel="FID",
        title="a",
    )
    plots.write_pareto(path, ("2", "8", "32"), X, Y, **(settings | more))
    with Image.open(path) as image:
        return np.asarray(image.convert("RGB")).astype(int)


def test_a_picture_shows_points_and_lines(tmp_path):
    with_line = draw(tmp_path / "a.png")
    without = draw(tmp_path / "b.png", references={})
    green = lambda p: (  # noqa: E731
        (p[..., 1] > p[..., 0] + 60) & (p[..., 1] > p[..., 2] + 60)
    ).sum()
    blue = lambda p: (p[..., 2] > p[..., 0] + 60).sum()  # noqa: E731
    assert green(with_line) > 100 and green(without) == 0
    assert blue(with_line) > 100 and blue(without) > 100


def test_what_is_broken_is_hollow_and_off_the_line(tmp_path):
    pictures = [draw(tmp_path / "a.png"), draw(tmp_path / "b.png", broken=("2",))]
    filled = [(p[..., 2] > p[..., 0] + 60).sum() for p in pictures]
    assert 100 < filled[1] < filled[0]
    # All may be broken.
    draw(tmp_path / "c.png", broken=("2", "8", "32"))
    with pytest.raises(ValueError, match="broken: no point is named 4"):
        draw(tmp_path / "d.png", broken=("4",))


def test_an_unwritable_file_is_named(tmp_path):
    (tmp_path / "file").write_text("")
    with pytest.raises(OSError, match=r"a\.png"):
        draw(tmp_path / "file" / "a.png")
