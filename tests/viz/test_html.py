import base64
import html.parser
import json
import re
import shutil
import subprocess

import jax.numpy as jnp
import numpy as np
import pytest

from jaxmotion.motion.skeleton import Motion
from jaxmotion.viz import html as page
from jaxmotion.viz import stage
from tests.viz import samples


@pytest.fixture
def node():
    """Node, which runs the page's script; it is no package of Python's."""
    found = shutil.which("node")
    if found is None:
        pytest.skip("node is not installed")
    return found


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


def save(path, shown=None, **changes):
    shown = shown or samples.circle_stage(wanted=samples.circle()[1] + 0.5)
    page.save_html(path, shown, **changes)
    return path.read_text(encoding="utf-8")


def data_of(text):
    line = re.search(r"^const data = (.*);$", Reader(text).texts["script"], re.M)
    return json.loads(line.group(1))


def test_without_a_wanted_path_there_is_none(tmp_path):
    names = lambda text: [name for name, *_ in data_of(text)["paths"]]  # noqa: E731
    assert names(save(tmp_path / "a.html", samples.circle_stage())) == ["walked"]
    assert names(save(tmp_path / "a.html")) == ["commanded", "walked"]


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
    text = re.sub(r"^const data = .*;$", "", text, flags=re.M)  # base64 has slashes
    assert not re.search(r"https?:|//[a-z]|\bimport\b|fetch\(|XMLHttp|@import", text)
    for _, attributes in Reader(text).tags:
        assert not {"src", "href", "srcset", "action"} & set(attributes)


def test_the_script_is_javascript(tmp_path, node):
    script = tmp_path / "a.js"
    script.write_text(Reader(save(tmp_path / "a.html")).texts["script"])
    done = subprocess.run([node, "--check", script], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr


BROWSER = """
const drawn = [];
const special = {getShaderParameter: () => true, getProgramParameter: () => true,
  drawArrays: (mode, start, count) => drawn.push(count),
  drawElementsInstanced: (m, count, kind, start, many) => drawn.push([count, many])};
const fake = new Proxy(special, {get: (t, name) =>
  t[name] ?? (/^[A-Z_0-9]+$/.test(name) ? 1 : () => ({}))});
const parts = {};
globalThis.document = {
  createElement: () => ({style: {}}),
  getElementById: id => parts[id] ??= {clientWidth: 320, clientHeight: 240,
    append() {}, addEventListener() {}, getContext: () => fake}};
globalThis.window = globalThis;
let next; globalThis.requestAnimationFrame = f => { next = f; };
"""
# Frame 3 is shown after 0.1 s at 30 fps; the first time may lie before the script's
# own, as in real browsers.
PLAY = """
next(-16); next(84);
assemble(body, 3, mesh);
const matrices = Array.from(mesh.matrices);
const round = gather(3).map(([place, radius]) => [...place, radius]);
console.log(JSON.stringify([drawn, parts.time.value, matrices, round]));
"""


def test_the_script_draws_the_same_body(tmp_path, node):
    """The page's matrices, with its mesh, put vertices where Python has them."""
    skeleton, motion = samples.person(seconds=0.4)
    ball = stage.Ball(
        position=np.full((12, 3), 0.5),
        touch=np.arange(12)[:, None] == 3,
        joints=(4,),
        radius=0.2,
    )
    shown = stage.make_stage(
        skeleton, motion, wanted=motion.root_position[:, ::2], ghost=motion, ball=ball
    )
    source = Reader(save(tmp_path / "a.html", shown)).texts["script"]
    script = tmp_path / "a.js"
    script.write_text(BROWSER + source + PLAY)
    done = subprocess.run([node, script], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    drawn, frame, matrices, round_ = json.loads(done.stdout)
    assert frame == 3
    told = data_of((tmp_path / "a.html").read_text())["body"]
    array = lambda name, kind: np.frombuffer(base64.b64decode(told[name]), kind)  # noqa: E731
    places = array("places", "<u2").reshape(-1, 3) * told["step"] + told["low"]
    weights = array("weights", "u1").reshape(-1, 4) / 255
    np.testing.assert_allclose(weights.sum(axis=1), 1.0)
    moved = np.array(matrices).reshape(-1, 3, 4)[array("joints", "<u2").reshape(-1, 4)]
    four = np.concatenate([places, np.ones((len(places), 1))], axis=1)
    found = np.einsum("vk,vkrc,vc->vr", weights, moved, four)
    expected = shown.body.skin(shown.positions[0, 3], shown.rotations[0, 3])[0]
    np.testing.assert_allclose(found, expected, atol=3e-3)
    faces = array("faces", "<u2")
    np.testing.assert_array_equal(faces, shown.body.faces.ravel())
    assert told["palette"] == list(shown.body.palette)
    assert len(round_) == 2, "a ball, and a mark where it is touched"
    np.testing.assert_allclose(round_[0], [0.5, 0.5, 0.5, 0.2], atol=1e-6)
    np.testing.assert_allclose(round_[1][:3], shown.positions[0, 3, 4], atol=1e-3)
    # Body and ball as shadow and solid, twice the ghost; the ground, and paths.
    last = drawn[len(drawn) - 1 - drawn[::-1].index(4) :]
    solid = [made for made in last if isinstance(made, list)]
    assert solid.count([len(faces), 1]) == 4 and len(solid) == 8
    assert [made for made in last if not isinstance(made, list)] == [4, 24, 8, 8]


def test_a_path_below_a_file_is_an_error_that_names_it(tmp_path):
    (tmp_path / "plain").write_text("")
    with pytest.raises(OSError, match=r"plain/a\.html: cannot write here"):
        save(tmp_path / "plain" / "a.html")


def test_the_script_draws_a_ball_of_each_character(tmp_path, node):
    skeleton, motion = samples.person(seconds=0.4)
    two = Motion(
        root_position=jnp.stack([motion.root_position, motion.root_position + 3.0]),
        joint_rotation=jnp.stack([motion.joint_rotation] * 2),
        fps=motion.fps,
    )
    place = np.arange(2 * 12 * 3.0).reshape(2, 12, 3)
    shown = stage.make_stage(skeleton, two, ball=stage.Ball(position=place, radius=0.2))
    source = Reader(save(tmp_path / "a.html", shown)).texts["script"]
    script = tmp_path / "a.js"
    script.write_text(
        BROWSER + source + "next(-16); next(84);\nconsole.log(JSON.stringify(gather(3)"
        ".map(([place, radius]) => [...place, radius])));"
    )
    done = subprocess.run([node, script], capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    expected = np.concatenate([place[:, 3], [[0.2], [0.2]]], axis=1)
    np.testing.assert_allclose(json.loads(done.stdout), expected, atol=1e-5)
