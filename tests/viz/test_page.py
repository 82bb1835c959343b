"""The live page in a real browser, on a character without a network."""

import asyncio
import contextlib
import json
import shutil
import socket
import threading
import time
import urllib.error
import urllib.request
from pathlib import Path

import numpy as np
import pytest

import jaxmotion
from jaxmotion import cli
from jaxmotion.control import steering
from jaxmotion.data import bvh, bvh_text
from jaxmotion.motion.skeleton import joint_positions
from jaxmotion.viz import page, viewer
from tests.viz.strider import strider

pytestmark = pytest.mark.slow
websockets = pytest.importorskip("websockets.sync.client", reason="needs websockets")

CHROMIUM = shutil.which("chromium") or shutil.which("google-chrome")
# No connections of the browser's own; WebGL without a GPU.
OPTIONS = (
    "--no-sandbox --disable-quic --no-first-run --disable-background-networking "
    "--disable-component-update --disable-sync --use-gl=angle "
    "--use-angle=swiftshader --enable-unsafe-swiftshader"
).split()
# Generous: a shared machine without a GPU draws a frame a second.
PATIENCE = 120_000


class Served:
    """A page in a thread of its own."""

    def __init__(self, out, **options):
        self.shown = []
        self.session = viewer.Session(
            {"strider": lambda: strider(**options)[0], "other": lambda: strider()[0]}
        )
        self.page = page.Page(
            self.session, out=out, save=jaxmotion.save, is_local=cli.is_local
        )
        publish = self.session.on_frame

        def keep(shown):
            self.shown.append(shown)
            publish(shown)

        self.session.on_frame = keep
        found = threading.Event()

        async def serve():
            self.stop, self.loop = asyncio.Event(), asyncio.get_running_loop()

            def ready(port):
                self.port = port
                found.set()

            await self.page.serve("127.0.0.1", 0, stop=self.stop, ready=ready)

        self.thread = threading.Thread(target=lambda: asyncio.run(serve()))
        self.thread.start()
        assert found.wait(60)
        self.address = f"http://127.0.0.1:{self.port}"

    def socket(self, **options):
        return websockets.connect(
            f"ws://127.0.0.1:{self.port}/live", compression=None, **options
        )

    def close(self):
        self.loop.call_soon_threadsafe(self.stop.set)
        self.thread.join(30)
        assert not self.thread.is_alive()


@pytest.fixture(scope="module")
def served(tmp_path_factory):
    served = Served(tmp_path_factory.mktemp("takes"), ball=True)
    yield served
    served.close()


def receive(connection, kind, seconds=120):
    """The next message of a kind: "frame", or a key of the JSON."""
    end = time.time() + seconds
    while time.time() < end:
        data = connection.recv(timeout=seconds)
        if isinstance(data, bytes):
            if kind == "frame":
                return np.frombuffer(data, "<f4")
        elif kind in (message := json.loads(data)):
            return message[kind]
    raise AssertionError(f"no {kind} in {seconds} s")


def status(url, **headers):
    try:
        with urllib.request.urlopen(urllib.request.Request(url, headers=headers)) as x:
            return x.status, x.read()
    except urllib.error.HTTPError as error:
        return error.code, error.read()


def test_what_is_served_and_what_not(served):
    assert status(served.address)[1].startswith(b"<!doctype html>")
    for path in ("/takes/../page.py", "/takes/", "/favicon", "/takes/%2e%2e/x"):
        assert status(served.address + path)[0] == 404
    assert status(served.address, Host="example.org")[0] == 403
    assert status(served.address, Host="127.0.0.2:80")[0] == 200
    with pytest.raises(Exception, match="403"), served.socket(origin="http://a.org"):
        pass
    for name in ("", "/page.js", "/socket.js", "/scene.js"):
        text = status(served.address + name)[1].decode()
        assert "http" not in text.replace('replace("http", "ws")', "")
    # What only the static page needs is not there.
    assert status(served.address + "/worker.js")[0] == 404


def test_wrong_input_is_answered_in_one_line_and_changes_nothing(served):
    with served.socket() as one:
        receive(one, "state")
        for text, want in (
            ("{", "no JSON"),
            ('{"set": {"label": 9}}', "label is '9'"),
            ('{"do": "close"}', "unknown message"),
            ('{"save": ".exe"}', "unknown message"),
            ('{"held": ["fly"]}', "held is wrong"),
        ):
            one.send(text)
            error = receive(one, "error")
            assert want in error and "\n" not in error
        assert receive(one, "frame").size


def test_a_body_that_cannot_be_drawn_is_told(served, monkeypatch):
    def refuse(*_):
        raise ValueError("300 joints, expected at most 256 for the page")

    monkeypatch.setattr(page.packed, "body_arrays", refuse)
    monkeypatch.setattr(served.page, "_body", (-1, b""))
    with served.socket() as one:
        assert "300 joints" in receive(one, "error")
        receive(one, "frame")  # all else goes on


def test_people_come_and_go(served):
    with served.socket() as stays:
        receive(stays, "frame")
        for number in range(20):
            with served.socket() as leaves:
                leaves.send('{"held": ["forward"], "azimuth": 0, "target": null}')
                if number % 2:  # as if its machine were switched off
                    leaves.socket.shutdown(socket.SHUT_RDWR)
        before = receive(stays, "frame")[1]
        time.sleep(1)
        assert receive(stays, "frame")[1] > before
    # What the last of them held is let go.
    deadline = time.time() + 20
    while served.session.state()["people"] and time.time() < deadline:
        time.sleep(0.1)
    assert served.session.state()["people"] == 0


def test_200_page_loads_and_too_many_people(served):
    for _ in range(200):
        assert status(served.address)[0] == 200
    with contextlib.ExitStack() as stack:
        people = [stack.enter_context(served.socket()) for _ in range(page.MOST_PEOPLE)]
        receive(people[-1], "frame")
        with served.socket() as more, pytest.raises(Exception, match="busy"):
            more.recv(timeout=60)
        receive(people[0], "frame")
    assert threading.active_count() < 20


def test_a_browser_that_does_not_read_holds_up_nobody(served):
    with served.socket(max_queue=1) as lazy, served.socket() as other:
        lazy.send('{"set": {"speed": 1.0}}')
        begin = receive(other, "frame")[1]
        time.sleep(2)
        for _ in range(20):
            end = receive(other, "frame")[1]
        assert end - begin > 15


@pytest.fixture(scope="module")
def browser():
    driver = pytest.importorskip("playwright.sync_api", reason="needs playwright")
    with driver.sync_playwright() as run:
        # One of the system's is enough, which Playwright does not know of.
        path = CHROMIUM or run.chromium.executable_path
        if not Path(path).exists():
            # A browser is no Python package: .ci/run fetches one, others may lack it.
            pytest.skip("needs a browser: playwright install chromium")
        chromium = run.chromium.launch(
            executable_path=path, args=OPTIONS, headless=True
        )
        yield chromium
        chromium.close()


@pytest.fixture
def tab(browser, served):
    tab = browser.new_page(viewport={"width": 900, "height": 640})
    errors = []
    tab.on("pageerror", lambda error: errors.append(str(error)))
    tab.on("console", lambda m: errors.append(m.text) if m.type == "error" else None)
    tab.goto(served.address)
    tab.wait_for_function("window.shown", timeout=PATIENCE)
    # W walks along +z.
    tab.evaluate("input.camera.azimuth = 0; input.on.change()")
    served.session.reset()
    yield tab
    assert not errors
    tab.close()


def after_ticks(served, ticks):
    """Waits until so many more ticks were shown; the last of them."""
    end, deadline = len(served.shown) + ticks, time.time() + PATIENCE / 1000
    while len(served.shown) < end and time.time() < deadline:
        time.sleep(0.005)
    return served.shown[-1]


def shows(served, condition):
    """Waits until a tick is shown for which a condition holds; that tick."""
    first, deadline = len(served.shown), time.time() + PATIENCE / 1000
    while time.time() < deadline:
        for tick in served.shown[first:]:
            if condition(tick):
                return tick
        time.sleep(0.005)
    raise AssertionError(
        f"never so in {PATIENCE / 1000:.0f} s: {served.shown[-1].told}"
    )


def walks_at(speed):
    return lambda tick: tick.told.speed == pytest.approx(speed)


@pytest.mark.parametrize(
    ("key", "way"),
    [("w", (0, 1)), ("ArrowDown", (0, -1)), ("d", (-1, 0)), ("ArrowLeft", (1, 0))],
)
def test_held_keys_walk(tab, served, key, way):
    before = after_ticks(served, 15).roots[0, ::2]
    tab.keyboard.down(key)
    # Keys may be late here. Then three seconds of the character's time.
    shows(served, lambda tick: tick.told.speed > 0)
    went = after_ticks(served, 90).roots[0, ::2] - before
    assert went @ np.array(way) > 1 and abs(went @ np.array(way[::-1])) < 0.3
    tab.keyboard.up(key)
    shows(served, walks_at(0))


def test_shift_runs_and_a_label_changes(tab, served):
    height = after_ticks(served, 15).roots[0, 1]
    tab.keyboard.down("w")
    tab.keyboard.down("Shift")
    shows(served, walks_at(steering.RUN * served.session.settings.speed))
    tab.keyboard.up("Shift")
    shows(served, walks_at(served.session.settings.speed))
    tab.keyboard.press("2")
    shows(served, lambda x: x.roots[0, 1] < height - 0.1)
    tab.wait_for_selector("#labels button.on:has-text('crouch')", timeout=PATIENCE)
    tab.click("#labels button:has-text('calm')")
    shows(served, lambda x: x.roots[0, 1] > height - 0.1)
    # Who switches to another window lets all keys go.
    tab.evaluate("window.dispatchEvent(new Event('blur'))")
    shows(served, walks_at(0))


def test_a_click_on_the_ground_is_a_target(tab, served):
    after_ticks(served, 15)
    tab.mouse.click(300, 450)
    tab.wait_for_function("input.target", timeout=PATIENCE)
    target = tab.evaluate("input.target")
    far = lambda x: np.linalg.norm(x.roots[0, ::2] - target)  # noqa: E731
    shows(served, lambda x: far(x) < steering.FAR)


def test_shift_clicks_are_waypoints(tab, served):
    after_ticks(served, 15)
    tab.keyboard.down("Shift")
    tab.mouse.click(220, 420)
    tab.mouse.click(520, 400)
    tab.keyboard.up("Shift")
    tab.wait_for_function("input.path.length === 2", timeout=PATIENCE)
    path = tab.evaluate("input.path")
    for place in path:
        shows(served, lambda x, at=place: np.linalg.norm(x.roots[0, ::2] - at) < 0.4)
    shows(served, walks_at(0))
    assert np.linalg.norm(after_ticks(served, 30).roots[0, ::2] - path[-1]) < 0.3
    tab.keyboard.press("a")
    assert tab.evaluate("input.path.length") == 0
    shows(served, walks_at(0))


def test_a_take_is_saved_as_it_was_shown(tab, served):
    before = len(served.shown)
    after_ticks(served, 5)
    tab.keyboard.down("a")
    tab.click("#record")
    tab.wait_for_selector("#record.on", timeout=PATIENCE)
    after_ticks(served, 30)
    tab.click("#record")
    tab.wait_for_selector("#save button", state="visible", timeout=PATIENCE)
    tab.keyboard.up("a")
    _, take = served.session.take
    with tab.expect_download(timeout=PATIENCE) as download:
        tab.click("#save button:has-text('.bvh')")
        tab.click("#saved a", timeout=PATIENCE)
    skeleton, motion = bvh.motion_from_bvh(bvh_text.read_bvh(download.value.path()))
    found = np.asarray(joint_positions(skeleton, motion))
    want = np.asarray(joint_positions(strider()[0].skeleton, take))
    count = len(skeleton.parents)
    assert count >= 22 and found.shape[0] == want.shape[0] >= 30
    np.testing.assert_allclose(found[:, :22], want, atol=1e-3)
    # The take is a stretch of what was shown; other walks here began alike.
    roots = np.stack([x.roots[0] for x in served.shown[before:]])
    first = np.asarray(take.root_position[0])
    start = int(np.abs(roots - first).sum(axis=-1).argmin())
    shown = roots[start : start + len(want)]
    np.testing.assert_allclose(take.root_position, shown, atol=1e-5)


def test_many_characters_and_other_steps_compile_beside_the_running_ones(tab, served):
    engine = served.session.engine_number
    tab.evaluate("panel.say({ set: { characters: 5 } })")
    tab.wait_for_function("shown.n === 5", timeout=PATIENCE)
    assert served.session.engine_number == engine + 1
    assert tab.evaluate("shown.ball.length") == 15
    tab.evaluate("panel.say({ set: { characters: 1, num_steps: 3 } })")
    tab.wait_for_function("shown.n === 1", timeout=PATIENCE)
    tab.wait_for_function("panel.state.num_steps === 3", timeout=PATIENCE)
    assert tab.evaluate("panel.state.note") == ""


def test_the_plan_is_drawn_when_asked_for(tab, served):
    assert tab.evaluate("shown.ghost") is None
    tab.click("#plan")
    tab.wait_for_function("shown.ghost", timeout=PATIENCE)
    ticks = served.session._engine.character.tuning.patience
    assert tab.evaluate("shown.path.length") == 2 * ticks
    tab.click("#plan")
    tab.wait_for_function("!shown.ghost", timeout=PATIENCE)


def test_pause_and_step(tab, served):
    tab.keyboard.press("Space")
    tab.wait_for_selector("#paused.on", timeout=PATIENCE)
    time.sleep(0.5)
    count = len(served.shown)
    tab.click("#step")
    deadline = time.time() + PATIENCE / 1000
    while len(served.shown) == count and time.time() < deadline:
        time.sleep(0.005)
    time.sleep(0.3)
    assert len(served.shown) == count + 1
    tab.keyboard.press("Space")
    after_ticks(served, 3)
