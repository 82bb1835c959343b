import html.parser
import json
import re
import shutil
import subprocess

import numpy as np
import pytest

from jaxmotion.viz import html as page
from jaxmotion.viz import sketch as body
from tests.viz import samples


class Reader(html.parser.HTMLParser):
    """Text of each element by tag, and all tags with their attributes."""

    def __init__(self, text):
        super().__init__()
        self.texts, self.tags, self.open = {}, [], []
        self.feed(text)

    def handle_starttag(self, tag, attrs):
        self.tags.append((tag, dict(attrs)))
        self.open.append(tag)

    def handle_endtag(self, tag):
        while self.open and self.open.pop() != tag:
            pass

    def handle_data(self, data):
        if self.open:
            tag = self.open[-1]
            self.texts[tag] = self.texts.get(tag, "") + data


def save(path, positions=None, **changes):
    made, walked = samples.circle()
    options = dict(
        fps=samples.FPS, names=samples.NAMES, walked=walked, commanded=walked + 0.5
    )
    positions = made if positions is None else positions
    page.save_html(path, positions, samples.PARENTS, **(options | changes))
    return path.read_text(encoding="utf-8") if path.exists() else None


def data_of(text):
    line = re.search(r"^const data = (.*);$", Reader(text).texts["script"], re.M)
    return json.loads(line.group(1))


def test_the_page_holds_the_positions_to_a_millimeter(tmp_path):
    positions, walked = samples.circle()
    data = data_of(save(tmp_path / "a.html", positions))
    np.testing.assert_allclose(data["positions"], positions, atol=5.001e-4)
    np.testing.assert_allclose(data["walked"], walked, atol=5.001e-4)
    np.testing.assert_allclose(data["commanded"], walked + 0.5, atol=5.001e-4)
    # Three bones: gray, blue and red.
    assert [shape[:2] for shape in data["shapes"]] == [[0, 1], [1, 2], [0, 3]]
    assert data["fps"] == samples.FPS
    assert len({shape[4] for shape in data["shapes"]}) == 3
    longest = max(len(x) for x in re.findall(r"\.\d+", json.dumps(data["positions"])))
    assert longest <= 4, "three decimals"


def test_without_paths_there_are_none(tmp_path):
    data = data_of(save(tmp_path / "a.html", walked=None, commanded=None, names=None))
    assert data["walked"] is None and data["commanded"] is None
    assert len({shape[4] for shape in data["shapes"]} - {body.SKIN}) == 1


@pytest.mark.parametrize(
    "title",
    [
        "</title><script>alert(1)</script>",
        '"><img src=x onerror="alert(1)">',
        "__DATA__ __TITLE__ __CAPTION__ \\1 & <b>",
        "Schritt – ñ 歩く",
    ],
)
def test_a_title_is_text_whatever_it_says(tmp_path, title):
    text = save(tmp_path / "a.html", title=title, caption=title)
    reader = Reader(text)
    assert reader.texts["p"] == title
    assert reader.texts["title"] == title
    assert reader.texts["h1"] == title
    assert [tag for tag, _ in reader.tags].count("script") == 1
    assert "img" not in {tag for tag, _ in reader.tags}
    data_of(text)


def test_the_page_needs_no_network(tmp_path):
    text = save(tmp_path / "a.html", title="plain")
    assert not re.search(r"https?:|//[a-z]|\bimport\b|fetch\(|XMLHttp|@import", text)
    for _, attributes in Reader(text).tags:
        assert not {"src", "href", "srcset", "action"} & set(attributes)


def test_the_script_is_javascript(tmp_path):
    node = shutil.which("node")
    if node is None:
        pytest.skip("node is not installed")
    script = tmp_path / "a.js"
    script.write_text(Reader(save(tmp_path / "a.html")).texts["script"])
    done = subprocess.run([node, "--check", script], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr


BROWSER = """
const drawn = [];
let points = [];
const fake = {
  beginPath() { points = []; }, closePath() {}, clearRect() { drawn.length = 0; },
  moveTo(x, y) { points.push([x, y]); }, lineTo(x, y) { points.push([x, y]); },
  arc(x, y, r) { points.push([x, y, r]); },
  fill() { drawn.push([this.fillStyle, points]); },
  stroke() { drawn.push([this.strokeStyle, points]); }};
const parts = {};
globalThis.document = {getElementById(id) { return parts[id] ??= {
  clientWidth: 320, clientHeight: 320, getContext() { return fake; }}; }};
globalThis.window = globalThis;
let next; globalThis.requestAnimationFrame = f => { next = f; };
globalThis.performance = {now: () => 0};
"""


def test_the_script_draws_every_bone_and_both_paths(tmp_path):
    node = shutil.which("node")
    if node is None:
        pytest.skip("node is not installed")
    script = tmp_path / "a.js"
    # The first time may lie before the script's own, as in real browsers.
    play = (
        "next(-16); next(84); console.log(JSON.stringify([drawn, parts.time.value]));"
    )
    source = Reader(save(tmp_path / "a.html")).texts["script"]
    script.write_text(BROWSER + source + play)
    done = subprocess.run([node, script], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    drawn, shown = json.loads(done.stdout)
    assert shown == 3, "frame 3 after 0.1 s at 30 fps"
    of = lambda color: [points for found, points in drawn if found == color]  # noqa: E731
    assert len(of("#dde4ec")) == 50, "every other of a hundred tiles"
    for path in ("#2ca02c", "#ff7f0e"):
        assert len(of(path)) == 1 and len(of(path)[0]) == 4, "what is walked so far"
        assert len(of(path + "55")) == 1
    skeleton = {
        color: np.array(of(color)[0]) for color in (body.MIDDLE, body.LEFT, body.RIGHT)
    }
    assert all(bone.shape == (2, 3) for bone in skeleton.values())
    # Ends and radius; up the page is smaller y.
    spine, foot = skeleton[body.MIDDLE], skeleton[body.RIGHT]
    assert spine[1, 1] < spine[0, 1] and foot[1, 1] > foot[0, 1]
    assert all(
        np.isfinite(bone).all() and bone[:, 2].min() > 0 for bone in skeleton.values()
    )


def test_a_path_below_a_file_is_an_error_that_names_it(tmp_path):
    (tmp_path / "plain").write_text("")
    with pytest.raises(OSError, match=r"plain/a\.html: cannot write here"):
        save(tmp_path / "plain" / "a.html")


@pytest.mark.parametrize(
    "bad, message",
    [
        (dict(positions=np.zeros((5, 3, 3))), r"positions are \(5, 3, 3\)"),
        (dict(positions=np.zeros((0, 4, 3))), "0 frames"),
        (dict(positions=np.full((12, 4, 3), np.nan)), "frame 0 is not finite"),
        (dict(fps=-1.0), "-1.0 fps"),
        (dict(walked=np.zeros((7, 2))), r"walked path is \(7, 2\), expected \(12, 2\)"),
        (dict(commanded=np.zeros(12)), r"commanded path is \(12,\)"),
    ],
)
def test_wrong_input_is_named_and_nothing_is_written(tmp_path, bad, message):
    with pytest.raises(ValueError, match=message):
        save(tmp_path / "a.html", **bad)
    assert list(tmp_path.iterdir()) == []
