"""Saved glTF files as three.js plays them, in a browser."""

import functools
import http.server
import io
import shutil
import threading
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

import jaxmotion as jm
from jaxmotion.export import rig as rigging
from jaxmotion.motion import anatomy
from jaxmotion.motion.skeleton import joint_positions
from tests.export.test_gltf import installed
from tests.retarget import rigs
from tests.viz import samples
from tests.viz.test_page import PATIENCE
from tests.viz.test_static_page import Quiet, browser  # noqa: F401

pytestmark = pytest.mark.slow
FRAME = 13


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    found = installed(tmp_path_factory.mktemp("three"), "three@0.180.0")
    shutil.copy(Path(__file__).with_name("three.html"), found / "index.html")
    return found


@pytest.fixture(scope="module")
def tab(folder, browser):  # noqa: F811
    handler = functools.partial(Quiet, directory=str(folder))
    with http.server.ThreadingHTTPServer(("127.0.0.1", 0), handler) as server:
        threading.Thread(target=server.serve_forever).start()
        tab = browser.new_page(viewport={"width": 400, "height": 400})
        tab.goto(f"http://127.0.0.1:{server.server_port}/")
        tab.wait_for_function("window.ready", timeout=PATIENCE)
        yield tab
        server.shutdown()


HEROES = {
    "hero.glb": lambda: rigs.glb(rigs.person("child")),
    "skinless.vrm": lambda: rigs.vrm(rigs.glb(rigs.person("giant")), skin=False),
}


@pytest.mark.parametrize("hero", [None, *HEROES])
def test_three_plays_what_was_saved(hero, folder, tab):
    skeleton, motion = samples.person(seconds=1.0)
    path = folder / "walk.glb"
    if hero is None:
        jm.save(path, skeleton, motion)
        skeleton, motion = anatomy.as_t_pose(skeleton, motion)
        nodes = range(skeleton.num_joints)
    else:
        (folder / hero).write_bytes(HEROES[hero]())
        jm.save(path, skeleton, motion, onto=folder / hero)
        target = rigging.read_rig(folder / hero)
        motion = jm.retarget(skeleton, folder / hero, motion=motion)(motion)
        skeleton, nodes = target.skeleton, target.nodes
    found = tab.evaluate(f"look('walk.glb', {FRAME / motion.fps})")
    places = np.array([found["nodes"][str(node)] for node in nodes])
    expected = np.asarray(joint_positions(skeleton, motion))[FRAME]
    np.testing.assert_allclose(places, expected, atol=1e-3)
    if hero != "skinless.vrm":  # a stiff body says nothing of the ground
        assert -0.015 < found["lowest"] < 0.03
    picture = np.asarray(Image.open(io.BytesIO(tab.screenshot())).convert("L"))
    assert 0.01 < (picture < 150).mean() < 0.5
