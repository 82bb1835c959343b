"""jaxmotion.viz.plots: values, intervals and lines where they belong."""

import numpy as np
import pytest
from matplotlib.figure import Figure
from PIL import Image

from jaxmotion.viz import figure, plots

NAN = float("nan")
OPTIONS = dict(sources=("paper", "here"), absent=("none", "–"), title="a title")
LEFT = np.array([[1.0, NAN, NAN], [2.0, 1.5, 2.5], [NAN, NAN, NAN]])
RIGHT = np.array([[0.2, -0.1, 0.5], [30.0, 20.0, 40.0], [900.0, 800.0, 1000.0]])


@pytest.fixture
def drawn(monkeypatch, tmp_path):
    """Draws panels and returns the canvas with its axes, line by line."""

    def draw(panels):
        kept = []
        save = Figure.savefig
        monkeypatch.setattr(
            Figure, "savefig", lambda self, p: (kept.append(self), save(self, p))
        )
        plots.write_dots(tmp_path / "a.png", ("A", "B", "C"), panels, **OPTIONS)
        with Image.open(tmp_path / "a.png") as image:
            assert min(image.size) > 100
        return kept[0]

    return draw


def places(axes):
    """x and y of the dots."""
    line = axes.containers[0].lines[0]
    return np.array(line.get_xdata()), np.array(line.get_ydata())


def test_dots_are_at_the_values_and_missing_ones_are_said(drawn):
    canvas = drawn((plots.Panel(title="FID", left=LEFT, right=RIGHT, target=1),))
    left, right = canvas.axes
    np.testing.assert_allclose(places(left), ([1.0, 2.0], [0, 1]))
    np.testing.assert_allclose(places(right), ([0.2, 30.0, 900.0], [0, 1, 2]))
    assert [text.get_text() for text in left.texts] == ["none"]
    assert not right.texts
    assert left.get_title() == "FID, paper" and right.get_title() == "FID, here"
    assert [tick.get_text() for tick in left.get_yticklabels()] == ["A", "B", "C"]
    # The first method is on top.
    assert left.get_ylim()[0] > left.get_ylim()[1]
    assert canvas.get_suptitle() == "a title"


def test_wide_values_are_logarithmic_even_where_an_interval_is_not_positive(drawn):
    canvas = drawn((plots.Panel(title="FID", left=LEFT, right=RIGHT),))
    left, right = canvas.axes
    assert left.get_xscale() == "linear" and right.get_xscale() == "log"
    low, high = right.get_xlim()
    assert 0 < low < 0.2 and high > 1000
    low, high = left.get_xlim()
    assert low < 1.0 and high > 2.5


def test_a_target_is_a_line(drawn):
    panels = tuple(
        plots.Panel(title="DIV", left=LEFT, right=RIGHT, target=target)
        for target in (None, 1, 2)
    )
    lines = [
        [line for line in axes.lines if line.get_color() == figure.COMMANDED]
        for axes in drawn(panels).axes
    ]
    assert [len(found) for found in lines] == [0, 0, 1, 1, 0, 1]
    assert lines[3][0].get_xdata()[0] == 30.0


def test_many_metrics_are_wrapped_and_nothing_measured_is_no_error(drawn):
    empty = np.full((3, 3), NAN)
    panels = (plots.Panel(title="m", left=empty, right=empty),) * 4
    canvas = drawn(panels)
    assert len(canvas.axes) == 12
    assert sum(axes.axison for axes in canvas.axes) == 8


def test_a_place_that_cannot_be_written_is_named(tmp_path):
    (tmp_path / "file").write_text("")
    panel = plots.Panel(title="m", left=LEFT, right=RIGHT)
    with pytest.raises(OSError, match="file"):
        plots.write_dots(
            tmp_path / "file" / "a.png", ("A", "B", "C"), (panel,), **OPTIONS
        )


# --- quality over time ----------------------------------------------------------------


def costs(**more):
    """Two points of one sampler and one of another, held-out data and two peers."""
    ends = lambda x: np.array([[x, 0.9 * x, 1.1 * x], [20 / x, 18 / x, 22 / x]])  # noqa: E731
    return plots.Costs(
        title="a system",
        xlabel="a plan, ms",
        ylabel="FID",
        points={
            "ancestral": {"1": ends(2.0), "2": ends(4.0)},
            "DDIM": {"2": ends(3.0)},
        },
        data=np.array([4.0, 3.0, 5.0]),
        peers={"ours": 0.5, "theirs": 90.0},
        call="a call",
        **more,
    )


def test_costs_are_at_their_time_and_quality_beside_data_and_peers(monkeypatch):
    kept, save = [], Figure.savefig
    monkeypatch.setattr(
        Figure,
        "savefig",
        lambda self, *a, **k: (kept.append(self), save(self, *a, **k)),
    )
    made = [plots.costs_svg((costs(), costs(), costs()), title="all") for _ in range(2)]
    assert made[0] == made[1]
    axes = kept[0].axes
    top, strip = axes[0], axes[2]
    dots = [container.lines[0].get_xydata()[0] for container in top.containers]
    np.testing.assert_allclose(dots, [[2.0, 10.0], [4.0, 5.0], [3.0, 20 / 3]])
    assert [text.get_text() for text in top.texts] == ["1", "2", "2"]
    data, front = top.lines[:2]
    np.testing.assert_allclose(data.get_ydata(), 4.0)
    np.testing.assert_allclose(front.get_xdata(), [2.0, 3.0, 4.0])
    np.testing.assert_allclose([x.get_xdata()[0] for x in strip.lines], [0.5, 90.0])
    # One axis of time, wide enough for the peers.
    assert top.get_xlim() == strip.get_xlim()
    assert strip.get_xlim()[0] < 0.5 and strip.get_xlim()[1] > 90
    # A place without a panel is empty.
    assert [one.axison for one in axes] == [True] * 5 + [False, True, False]
    words = [text.get_text() for text in kept[0].legends[0].texts]
    assert words[:2] == ["ancestral", "DDIM"] and words[-2:] == ["ours", "theirs"]
