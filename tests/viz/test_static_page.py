"""The page without a server in a real browser: keys, pad, thumb, mouse, bad input."""

import base64
import contextlib
import functools
import http.server
import json
import math
import shutil
import subprocess
import sys
import threading
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxmotion as jm
from jaxmotion.control import steering
from jaxmotion.data import bvh, bvh_text
from jaxmotion.export import rig as rigging
from jaxmotion.export import web
from jaxmotion.motion.skeleton import joint_positions
from jaxmotion.retarget import transfer
from tests.retarget import rigs
from tests.viz.strider import strider
from tests.viz.test_page import CHROMIUM, OPTIONS, PATIENCE

pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(shutil.which("npm") is None, reason="needs Node"),
]
# Small: a shared machine without a GPU draws the picture.
VIEW = {"width": 720, "height": 400}
# A pad of the standard mapping, as `navigator.getGamepads` gives it.
PAD = """
window.gamepad = {connected: true, mapping: "standard", axes: [0, 0, 0, 0],
  buttons: [...Array(17)].map(() => ({pressed: false, value: 0}))};
navigator.getGamepads = () => [gamepad];
"""


# Where the first character was in every frame, however few are drawn.
TRAIL = """
window.trail = [];
let last;
Object.defineProperty(window, "shown", {
  get: () => last,
  set: x => { last = x; trail.push([x.roots[0], x.roots[2]]); },
});
"""


@pytest.fixture(scope="module")
def site(tmp_path_factory):
    pytest.importorskip("jax2onnx")
    folder = tmp_path_factory.mktemp("site")
    cache = Path.home() / ".cache" / "jaxmotion" / "web"
    try:
        written = web.write_page(folder, cache=cache)
    except ValueError as error:
        pytest.skip(f"needs packages of npm: {error}")
    character = strider(ball=True)[0]
    commands = jm.commands("stand", character, 1, seconds=1.0)
    command = jax.tree.map(lambda x: x[0, 0], commands)
    written += web.write_character(
        folder / "strider", "strider", character, command, steps=(2,)
    )
    web.finish(folder, ["strider", "broken"], written)
    shutil.copytree(folder / "strider", folder / "broken")
    damaged = folder / "broken" / "advance.onnx.packed"
    damaged.write_bytes(damaged.read_bytes()[:-300])
    return folder


class Quiet(http.server.SimpleHTTPRequestHandler):
    def log_message(self, *args):
        pass


@pytest.fixture(scope="module")
def address(site):
    """Of the server that the README names."""
    handler = functools.partial(Quiet, directory=str(site))
    with http.server.ThreadingHTTPServer(("127.0.0.1", 0), handler) as server:
        thread = threading.Thread(target=server.serve_forever)
        thread.start()
        yield f"http://127.0.0.1:{server.server_port}/"
        server.shutdown()
        thread.join()


@pytest.fixture(scope="module")
def browser():
    driver = pytest.importorskip("playwright.sync_api", reason="needs playwright")
    with driver.sync_playwright() as run:
        path = CHROMIUM or run.chromium.executable_path
        if not Path(path).exists():
            pytest.skip("needs a browser: playwright install chromium")
        chromium = run.chromium.launch(executable_path=path, args=OPTIONS)
        yield chromium
        chromium.close()


def test_the_page_is_measured(site, tmp_path):
    pytest.importorskip("playwright.sync_api", reason="needs playwright")
    folder = tmp_path / "site"
    shutil.copytree(site, folder)
    (folder / "models.json").write_text('{"models": ["strider"]}')
    script = Path(__file__).parents[2] / "benchmarks" / "page.py"
    command = [sys.executable, script, "--site", folder, "--out", tmp_path]
    command += ["--seconds", "2", "--characters", "2"]
    subprocess.run([str(x) for x in command], check=True, capture_output=True)
    report = json.loads((tmp_path / "page.json").read_text())
    (row,) = report["rows"]
    assert row["row"] == "strider, 2 characters"
    assert row["real_time"] > 0 and row["memory"] > 1 and row["own_99"] >= row["own"]
    sent = sum(x.stat().st_size for x in (folder / "strider").iterdir()) / 1e6
    (found,) = [x["value"] for x in report["metrics"] if x["name"] == "strider size"]
    assert found == pytest.approx(sent)


@contextlib.contextmanager
def opened(browser, address, *, script="", **options):
    """A tab on the page; nothing else may be asked for, and no error be logged."""
    context = browser.new_context(viewport=VIEW, **options)
    tab = context.new_page()
    errors, asked = [], []
    tab.on("pageerror", lambda error: errors.append(str(error)))
    tab.on("console", lambda m: errors.append(m.text) if m.type == "error" else None)
    tab.on("request", lambda request: asked.append(request.url))
    if script:
        tab.add_init_script(script)
    tab.goto(address)
    tab.wait_for_function("window.shown", timeout=PATIENCE)
    tab.evaluate("input.camera.azimuth = 0")
    tab.asked = asked
    try:
        yield tab
    finally:
        context.close()
    home = address.split("#")[0].rsplit("/", 1)[0]
    assert all(url.startswith((home, "blob:", "data:")) for url in asked)
    assert not errors, errors


def root(tab):
    return np.array(tab.evaluate("[...shown.roots]"))[[0, 2]]


def walks(tab, way, speed=1.4, start=None):
    """Waits until the person went two meters and is told to go so."""
    start = root(tab) if start is None else start
    tab.wait_for_function(
        f"Math.hypot(shown.roots[0] - {start[0]}, shown.roots[2] - {start[1]}) > 2",
        timeout=PATIENCE,
    )
    told = tab.evaluate("shown.told")
    np.testing.assert_allclose(told[:2], speed * np.array(way), atol=0.02)
    went = root(tab) - start
    assert went @ np.array(way) > 0.9 * np.linalg.norm(went)


def stops(tab):
    tab.wait_for_function("Math.hypot(shown.told[0], shown.told[1]) < 1e-6")


def test_keys_and_what_is_loaded(browser, address):
    with opened(browser, address) as tab:
        loaded = len(tab.asked)
        tab.keyboard.down("w")
        walks(tab, (0, 1))
        tab.keyboard.up("w")
        stops(tab)
        tab.keyboard.down("ArrowLeft")
        tab.keyboard.down("Shift")
        walks(tab, (1, 0), steering.RUN * 1.4)
        tab.keyboard.up("ArrowLeft")
        tab.keyboard.up("Shift")
        stops(tab)
        tab.keyboard.down("q")
        tab.wait_for_function("shown.told[2] < 0.8", timeout=PATIENCE)
        tab.keyboard.up("q")
        height = tab.evaluate("shown.roots[1]")
        tab.keyboard.press("c")
        tab.wait_for_function(f"shown.roots[1] < {height - 0.1}", timeout=PATIENCE)
        assert tab.inner_text("#labels .on").endswith("crouch")
        tab.keyboard.press("c")
        tab.wait_for_function(f"shown.roots[1] > {height - 0.1}", timeout=PATIENCE)
        # What was there at the first step is all: nothing is fetched while it walks.
        assert len(tab.asked) == loaded


def test_a_gamepad_walks_as_far_as_its_stick_is_pushed(browser, address):
    with opened(browser, address, script=PAD) as tab:
        tab.evaluate("gamepad.axes = [0, -0.55, 1, 0]")  # half ahead, facing right
        walks(tab, (0, 1), 0.7)
        np.testing.assert_allclose(
            tab.evaluate("shown.told.slice(2)"), (-1, 0), atol=0.02
        )
        tab.evaluate("gamepad.axes = [1, 0, 0, 0]; gamepad.buttons[7].pressed = true")
        walks(tab, (-1, 0), steering.RUN * 1.4)
        tab.evaluate("gamepad.axes = [0, 0, 0, 0]; gamepad.buttons[7].pressed = false")
        stops(tab)
        azimuth = tab.evaluate("input.camera.azimuth")
        tab.evaluate("gamepad.buttons[4].pressed = true")
        tab.wait_for_function(f"input.camera.azimuth > {azimuth + 0.3}")
        tab.evaluate(
            "gamepad.buttons[4].pressed = false; gamepad.buttons[0].pressed = true"
        )
        tab.wait_for_selector("#labels .on:has-text('crouch')", timeout=PATIENCE)


def touch(session, kind, *points):
    session.send(
        "Input.dispatchTouchEvent",
        {
            "type": kind,
            "touchPoints": [
                {"x": x, "y": y, "id": i} for i, (x, y) in enumerate(points)
            ],
        },
    )


def test_a_thumb_walks_and_a_tap_is_a_target(browser, address):
    with opened(browser, address, has_touch=True) as tab:
        session = tab.context.new_cdp_session(tab)
        touch(session, "touchStart", (150, 300))
        touch(session, "touchMove", (150, 272))  # half of what the stick reaches
        assert tab.is_visible("#stick")
        walks(tab, (0, 1), 0.7)
        touch(session, "touchMove", (150, 160))
        walks(tab, (0, 1), 1.4)
        touch(session, "touchEnd")
        stops(tab)
        assert not tab.is_visible("#stick")
        azimuth = tab.evaluate("input.camera.azimuth")
        touch(session, "touchStart", (430, 120))
        touch(session, "touchMove", (330, 120))
        touch(session, "touchEnd")
        tab.wait_for_function(f"input.camera.azimuth > {azimuth + 0.5}")
        assert tab.evaluate("input.target") is None
        far = tab.evaluate("input.camera.distance")
        touch(session, "touchStart", (340, 150), (420, 150))
        touch(session, "touchMove", (300, 150), (440, 150))
        touch(session, "touchEnd")
        tab.wait_for_function(f"input.camera.distance < {0.7 * far}")
        touch(session, "touchStart", (400, 330))
        touch(session, "touchEnd")
        tab.wait_for_function("input.target")


def test_a_click_is_a_target_and_the_view_orbits_and_zooms(browser, address):
    with opened(browser, address) as tab:
        tab.mouse.click(150, 250)
        target = np.array(tab.evaluate("input.target"))
        tab.wait_for_function(
            f"Math.hypot(shown.roots[0] - {target[0]}, shown.roots[2] - {target[1]})"
            f" < {steering.FAR}",
            timeout=PATIENCE,
        )
        azimuth, far = tab.evaluate("[input.camera.azimuth, input.camera.distance]")
        tab.mouse.move(200, 100)
        tab.mouse.down(button="right")
        tab.mouse.move(300, 100)
        tab.mouse.up(button="right")
        tab.mouse.wheel(0, 300)
        tab.wait_for_function(f"input.camera.distance > {1.2 * far}")
        assert tab.evaluate("input.camera.azimuth") == pytest.approx(azimuth - 0.6)


def test_shift_clicks_are_waypoints(browser, address):
    with opened(browser, address, script=TRAIL) as tab:
        tab.keyboard.down("Shift")
        tab.mouse.click(150, 250)
        tab.mouse.click(400, 230)
        tab.keyboard.up("Shift")
        path = np.array(tab.evaluate("input.path"))
        assert len(path) == 2 and tab.evaluate("input.target") is None
        tab.wait_for_function(
            f"Math.hypot(shown.roots[0] - {path[1][0]}, shown.roots[2] - {path[1][1]})"
            " < 0.3 && Math.hypot(shown.told[0], shown.told[1]) < 1e-6",
            timeout=PATIENCE,
        )
        # By way of the first one, whose corner he cuts a little; and there he stays.
        trail = np.array(tab.evaluate("trail"))
        assert np.linalg.norm(trail - path[0], axis=1).min() < 0.5
        tab.wait_for_timeout(1000)
        assert np.linalg.norm(root(tab) - path[1]) < 0.3
        tab.mouse.click(150, 250)
        assert tab.evaluate("input.path.length") == 0 and tab.evaluate("input.target")


def test_settings_and_a_link_that_holds_them(browser, address):
    with opened(browser, address) as tab:
        tab.evaluate("panel.set('num_steps', 2); panel.set('characters', 5)")
        tab.evaluate("panel.set('speed', 2.5); panel.set('label', 1)")
        tab.wait_for_function("shown.n === 5", timeout=PATIENCE)
        assert tab.is_disabled("#plan")  # the strider's plan has no poses
        tab.click("#link")
        tab.wait_for_function("location.hash.includes('az=')")
        link = tab.url
    with opened(browser, link) as tab:
        state = tab.evaluate("panel.state")
        assert [state[x] for x in ("num_steps", "characters", "speed", "label")] == [
            *(2, 5, 2.5, 1)
        ]
        assert tab.evaluate("shown.n") == 5
        assert state["steps"] == [2, 8] and tab.evaluate("shown.ball.length") == 15
        # One plan a tick, for whoever has waited longest.
        tab.keyboard.down("w")
        tab.wait_for_function("shown.roots[14] > 2", timeout=PATIENCE)


def test_where_one_model_does_not_load_another_one_does(browser, address):
    with opened(browser, address) as tab:
        tab.select_option("#model", "broken")
        tab.wait_for_selector("#note.bad", state="visible", timeout=PATIENCE)
        assert "broken/advance.onnx.packed is damaged" in tab.inner_text("#note")
        tab.select_option("#model", "strider")
        tab.wait_for_selector("#note", state="hidden", timeout=PATIENCE)
        tab.keyboard.down("w")
        walks(tab, (0, 1))
        tab.wait_for_function("location.hash.includes('model=strider')")


def test_the_last_seconds_are_saved_as_they_were_shown(browser, address, tmp_path):
    with opened(browser, address) as tab:
        tab.keyboard.down("d")
        walks(tab, (-1, 0))
        tab.click("#paused")
        tab.wait_for_function("panel.state.paused", timeout=PATIENCE)
        with tab.expect_download(timeout=PATIENCE) as download:
            tab.click("#last button:has-text('.bvh')")
        download.value.save_as(tmp_path / "last.bvh")
        with tab.expect_download(timeout=PATIENCE) as download:
            tab.click("#last button:has-text('.glb')")
        download.value.save_as(tmp_path / "last.glb")
        tab.wait_for_timeout(1000)
        last = tab.evaluate("[[...shown.roots], [...shown.rotations]]")
    skeleton, motion = bvh.motion_from_bvh(bvh_text.read_bvh(tmp_path / "last.bvh"))
    found = np.asarray(joint_positions(skeleton, motion))[-1]
    body = strider()[0].skeleton
    shown = jm.motion.skeleton.Motion(
        root_position=jnp.array(last[0], jnp.float32)[None],
        joint_rotation=jnp.array(last[1], jnp.float32).reshape(1, -1, 6),
        fps=30.0,
    )
    want = np.asarray(joint_positions(body, shown))[0]
    np.testing.assert_allclose(found, want, atol=0.06)  # a tick's way
    content = (tmp_path / "last.glb").read_bytes()
    size = int.from_bytes(content[12:16], "little")
    text = json.loads(content[20 : 20 + size])
    assert len(text["nodes"]) == len(body.parents) + 1 and text["animations"]
    assert math.isclose(len(content), int.from_bytes(content[8:12], "little"))


def test_a_crowd_is_spread_over_cores(browser, address):
    """More characters than one core is thought to bear; all walk, and go on walking."""
    with opened(browser, address + "#characters=9&workers=3") as tab:
        tab.wait_for_function("shown.n === 9 && shown.tick > 2", timeout=PATIENCE)
        count = lambda: len(  # noqa: E731
            [w for w in tab.workers if w.url.endswith("/worker.js")]
        )
        assert count() >= 2
        places = np.reshape(tab.evaluate("[...shown.roots]"), (9, 3))
        tab.keyboard.down("w")
        walks(tab, (0, 1))
        tab.wait_for_timeout(1500)
        went = np.reshape(tab.evaluate("[...shown.roots]"), (9, 3)) - places
        assert went[:, 2].min() > 0.5 and np.abs(went[:, 0]).max() < 0.3
        tab.evaluate("panel.set('characters', 14)")
        tab.wait_for_function("shown.n === 14", timeout=PATIENCE)
        tab.evaluate("panel.set('characters', 1); panel.set('num_steps', 2)")
        tab.wait_for_function("shown.n === 1", timeout=PATIENCE)
        tab.click("#reset")
        tab.wait_for_function("shown.tick < 60 && shown.roots[2] < 1", timeout=PATIENCE)


DROP = """([content, name]) => {
  const bytes = Uint8Array.from(atob(content), x => x.charCodeAt(0));
  const dataTransfer = new DataTransfer();
  dataTransfer.items.add(new File([bytes], name));
  for (const kind of ["dragover", "drop"])
    window.dispatchEvent(new DragEvent(kind, { dataTransfer, cancelable: true }));
}"""


def test_a_rig_that_is_dropped_walks(browser, address, tmp_path):
    hero = rigs.glb(rigs.person("child"))
    drop = lambda tab, content, name: tab.evaluate(  # noqa: E731
        DROP, [base64.b64encode(content).decode(), name]
    )
    with opened(browser, address) as tab:
        before = tab.screenshot()
        drop(tab, hero, "hero.glb")
        tab.wait_for_selector("#wear:has-text('hero.glb')", timeout=PATIENCE)
        drop(tab, hero[:-99], "broken.glb")
        tab.wait_for_selector("#note.bad", state="visible", timeout=PATIENCE)
        said = tab.inner_text("#note")
        assert said == "broken.glb: damaged: its second part is cut off"
        assert tab.inner_text("#wear") == "hero.glb"  # as before
        tab.click("#bare")
        assert tab.inner_text("#wear") == "choose a .glb"
        tab.set_input_files(
            "#file", {"name": "hero.glb", "mimeType": "", "buffer": hero}
        )
        tab.wait_for_selector("#wear:has-text('hero.glb')", timeout=PATIENCE)
        assert tab.screenshot() != before
        tab.keyboard.down("w")
        walks(tab, (0, 1))
        with tab.expect_download(timeout=PATIENCE) as download:
            tab.click("#last button:has-text('.glb')")
        download.value.save_as(tmp_path / "last.glb")
    found = rigging.read_rig(tmp_path / "last.glb")
    names = {"mixamorig:Hips", "mixamorig:LeftFoot", "mixamorig:RightHand"}
    assert names <= set(found.skeleton.names)
    # As large as the character, whose legs are as long.
    leg = transfer.rest(strider()[0].skeleton).leg
    assert abs(found.rest().leg - leg) < 1e-3
    animated = found.content["animations"][0]["channels"]
    assert len(animated) == len(found.skeleton.names) + 1


@pytest.mark.parametrize(
    ("link", "prepare", "line"),
    [
        ("#model=nobody", "", "unknown model nobody, expected one of strider, broken"),
        ("#model=broken", "", "broken/advance.onnx.packed is damaged"),
        ("", "missing", "strider/advance.onnx.packed is missing (404)"),
        ("", "simd", "this browser has no WebAssembly SIMD"),
        ("", "gl", "this browser has no WebGL 2"),
    ],
)
def test_what_is_wrong_is_one_line_on_the_page(browser, address, link, prepare, line):
    script = "HTMLCanvasElement.prototype.getContext = () => null;"
    context = browser.new_context(viewport=VIEW)
    tab = context.new_page()
    if prepare == "gl":
        tab.add_init_script(script)
    if prepare == "missing":
        tab.route("**/advance.onnx.packed", lambda route: route.fulfill(status=404))
    if prepare == "simd":

        def refuse(route):
            code = route.fetch().text()
            body = "WebAssembly.validate = () => false;" + code
            route.fulfill(body=body, content_type="text/javascript")

        tab.route("**/worker.js", refuse)
    tab.goto(address + link)
    tab.wait_for_selector("#note.bad", state="visible", timeout=PATIENCE)
    text = tab.inner_text("#note")
    assert line in text and "\n" not in text
    context.close()
