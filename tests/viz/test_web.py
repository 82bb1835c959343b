"""The page's modules, run by Node, against the library they stand in for."""

import base64
import json
import math
import shutil
import subprocess
from pathlib import Path

import numpy as np
import pytest

from jaxmotion.control import goals, steering, waypoints
from jaxmotion.control.steering import Inputs, Wish
from jaxmotion.data import bvh as bvh_motion
from jaxmotion.data import bvh_text, walker
from jaxmotion.export import slim, web
from jaxmotion.motion.skeleton import global_transforms, joint_positions
from jaxmotion.viz import mannequin, packed, page, viewer
from tests import tiny
from tests.viz import samples

pytestmark = pytest.mark.skipif(shutil.which("node") is None, reason="needs Node")
WEB = Path(page.__file__).with_name("web")


def run(module, name, *calls):
    """What a function of a module gives for each tuple of arguments."""
    return _node("web.mjs", {"module": module, "name": name, "calls": calls})


def tab(*events, hash=""):
    """What the page says and shows after each event; see `tab.mjs`."""
    return _node("tab.mjs", {"hash": hash, "events": events})


def _node(script, message):
    done = subprocess.run(
        ["node", str(Path(__file__).with_name(script)), str(WEB)],
        input=json.dumps(message),
        capture_output=True,
        text=True,
    )
    assert done.returncode == 0, done.stderr[-2000:]
    return json.loads(done.stdout)


def floats(values):
    return {"float32": np.asarray(values, float).ravel().tolist()}


def data(content):
    return {"base64": base64.b64encode(content).decode()}


def wish_json(wish):
    return {"velocity": wish.velocity, "facing": wish.facing}


def random_inputs(random):
    held = [x for x in steering.MOVES if random.random() < 0.2]
    stick = lambda: tuple(random.uniform(-0.7, 0.7, 2).tolist())  # noqa: E731
    some = lambda x: x if random.random() < 0.4 else None  # noqa: E731
    return Inputs(
        held=frozenset(held),
        azimuth=float(random.uniform(-4, 4)),
        target=some(tuple(random.uniform(-1, 1, 2).tolist())),
        stick=some(stick()),
        face=some(stick()),
    )


def test_the_page_steers_as_the_library_does():
    random, calls, wants = np.random.default_rng(0), [], []
    for _ in range(300):
        inputs, angle = random_inputs(random), random.uniform(-math.pi, math.pi)
        speed = random.choice([0.0, 1.4])
        facing = (math.sin(angle), math.cos(angle))
        last = Wish(velocity=tuple(speed * x for x in facing), facing=facing)
        more = dict(position=tuple(random.uniform(-1, 1, 2).tolist()), speed=1.4)
        wants.append(steering.wanted(inputs, last, seconds=1 / 30, **more))
        given = {
            "held": sorted(inputs.held),
            "azimuth": inputs.azimuth,
            "target": inputs.target,
            "stick": inputs.stick,
            "face": inputs.face,
        }
        calls.append((given, wish_json(last), more | {"seconds": 1 / 30}))
    found = run("steer.js", "wanted", *calls)
    assert len({len(x.velocity) for x in wants}) == 1
    for a, b in zip(found, wants, strict=True):
        np.testing.assert_allclose(a["velocity"], b.velocity, atol=1e-9)
        np.testing.assert_allclose(a["facing"], b.facing, atol=1e-9)
    calls, kept = [], []
    for a, b in zip(wants[:-1], wants[1:], strict=True):
        for other in (b, Wish(velocity=(a.velocity[0], a.velocity[1] + 0.1))):
            for steady in (False, True):
                calls.append((wish_json(a), wish_json(other), steady))
                kept.append(steering.settled(a, other, steady=steady))
    for a, b in zip(run("steer.js", "settled", *calls), kept, strict=True):
        assert a == json.loads(json.dumps(wish_json(b)))


def test_a_stick_walks_as_far_as_it_is_pushed_and_another_one_faces():
    half = Inputs(stick=(0.0, 0.5), face=(1.0, 0.0))
    more = dict(position=(0.0, 0.0), speed=2.0, seconds=1 / 30)
    wish = steering.wanted(half, Wish(), **more)
    np.testing.assert_allclose(wish.velocity, (0, 1), atol=1e-9)
    np.testing.assert_allclose(wish.facing, (-1, 0), atol=1e-9)
    assert steering.wanted(Inputs(stick=(0.1, 0.0)), Wish(), **more) == Wish()
    # A gamepad's corners are beyond what is all the way.
    corner = steering.wanted(Inputs(stick=(-0.9, 0.9)), Wish(), **more)
    np.testing.assert_allclose(corner.velocity, (2**0.5, 2**0.5), atol=1e-9)
    stands = steering.wanted(Inputs(face=(0.0, -1.0)), Wish(), **more)
    np.testing.assert_allclose(stands.facing, (0, -1), atol=1e-9)
    assert stands.speed == 0


def test_the_page_goes_along_waypoints_as_the_library_does():
    """Of somebody who obeys late and sways: the same wish in each tick."""
    random, fps, calls, wants = np.random.default_rng(0), 30.0, [], []
    points = np.cumsum(random.normal(0, 1.5, (6, 2)), axis=0).tolist()
    points = tuple(map(tuple, points))
    for number in (1, 3, 6):
        route = waypoints.routed(waypoints.Route(), points[:number], (0.3, -0.2))
        last, place, velocity = Wish(), np.array([0.3, -0.2]), np.zeros(2)
        own = velocity
        for _ in range(round(30 * 4.0 * number)):
            where = dict(
                position=tuple(place.tolist()),
                velocity=tuple(velocity.tolist()),
                speed=1.4,
                ahead=0.35 if number == 1 else 0.8,
            )
            given = {"points": route.points, "way": route.way}
            calls.append((given, wish_json(last), where))
            last, route = waypoints.along(route, last, **where)
            wants.append((last, route))
            own = 0.85 * own + 0.15 * np.array(last.velocity)
            moved = own + random.normal(0, 0.1, 2)
            place = place + moved / fps
            velocity = goals.averaged(velocity, moved, fps)
        assert np.linalg.norm(place - points[number - 1]) < 0.2 and last.speed == 0
    away = []
    for (wish, route), (want, further) in zip(
        run("waypoints.js", "along", *calls), wants, strict=True
    ):
        # A nearest point may be its neighbor where both are as near.
        assert abs(route["way"] - further.way) < 0.026
        away += [
            np.abs(np.subtract(wish[x], getattr(want, x))).max()
            for x in ("velocity", "facing")
        ]
    assert np.mean(np.array(away) < 1e-4) > 0.98 and np.max(away) < 0.1
    (found,) = run("waypoints.js", "averaged", ([1.0, 2.0], [3.0, -1.0], fps))
    want = goals.averaged(np.array([1.0, 2.0]), np.array([3.0, -1.0]), fps)
    np.testing.assert_allclose(found, want)


def test_waypoints_lengthen_a_route_or_begin_another_one():
    a, b, c, here = (0.0, 1.0), (1.0, 1.0), (5.0, 5.0), (0.5, 0.5)
    went = waypoints.Route(points=((0.0, 0.0), a), way=0.4)
    calls = [(went, (a,)), (went, (a, b)), (went, (c, b)), (went, ()), (None, (a,))]
    wants = [
        went,
        waypoints.Route(points=((0.0, 0.0), a, b), way=0.4),
        waypoints.Route(points=(here, c, b)),
        waypoints.Route(),
        waypoints.Route(points=(here, a)),
    ]
    given = []
    for (route, points), want in zip(calls, wants, strict=True):
        found = waypoints.routed(route or waypoints.Route(), points, here)
        assert found == want
        own = None if route is None else {"points": route.points, "way": route.way}
        given.append((own, points, here))
    for found, want in zip(run("waypoints.js", "routed", *given), wants, strict=True):
        expected = {"points": [list(x) for x in want.points], "way": want.way}
        assert found == (expected if want.points else None)
    assert waypoints.routed(went, (c,), here).points == (here, c)
    assert waypoints.MOST == 32


def test_formations_are_the_same():
    numbers = (1, 2, 7, 16, 64)
    found = run("crowd.js", "formation", *((n,) for n in numbers))
    for number, places in zip(numbers, found, strict=True):
        np.testing.assert_allclose(places, viewer.formation(number), atol=1e-6)


def test_a_crowd_walks_the_same_on_several_cores():
    """Helpers behind messages, as Workers are; graphs are written in the script."""
    joint = {"names": ["a"], "parents": [-1], "offsets": [[0.0, 0.0, 0.0]]}
    sizes = {"command.velocity": 2, "out.frame.root_position": 3}
    sizes |= {"out.frame.joint_rotation": 6}
    port = lambda *names: [  # noqa: E731
        {"name": x, "dtype": "float32", "shape": [sizes.get(x, 1)]} for x in names
    ]
    graphs = {
        "plan_level": (port("state.age"), port("out.level")),
        "plan@2": (port("state.age"), port("out.state.age")),
        "advance": (
            port("state.age", "state.z", "command.velocity"),
            port("out.state.age", "out.state.z", "out.frame.root_position")
            + port("out.frame.joint_rotation"),
        ),
    }
    about = {
        "skeleton": joint,
        "fps": 30,
        "patience": 30,
        "graphs": {
            name: {
                "file": name,
                "crowd": {"file": f"{name}.crowd", "number": 4},
                "inputs": takes,
                "outputs": gives,
            }
            for name, (takes, gives) in graphs.items()
        },
        "runs": {2: list(graphs)},
        "plan": None,
        "weights": {"files": ["weights", "fine"], "parts": []},
    }
    starts = {f"state.{x}": np.zeros((1, 1), np.float32) for x in ("age", "z")}
    kinds = {x: x.split("@")[0] for x in graphs}
    files = {name: kind.encode() for name, kind in kinds.items()}
    files |= {f"{name}.crowd": f"{kind}.crowd".encode() for name, kind in kinds.items()}
    files |= {"character.bin": packed.pack(about, starts), "weights": b"", "fine": b""}
    done = subprocess.run(
        ["node", str(Path(__file__).with_name("crowd.mjs")), str(WEB)],
        input=json.dumps({k: base64.b64encode(v).decode() for k, v in files.items()}),
        capture_output=True,
        text=True,
    )
    assert done.returncode == 0, done.stderr[-2000:]
    found = json.loads(done.stdout)
    for way in ("together", "helped"):
        for one, other in zip(found["alone"], found[way], strict=True):
            np.testing.assert_allclose(one["roots"], other["roots"], atol=1e-6)
    # Due every third tick; without time for plans, when none can wait any longer.
    eager, late = found["plans"]
    assert eager["plans"] == 5 * 26 and late["plans"] == 5 * 2
    np.testing.assert_allclose(eager["roots"], late["roots"], atol=1e-6)
    # Nine are two calls of four and one of one; two are moved one by one.
    assert set(found["single"]["advance"]) == {1}
    several = found["several"]["advance"]
    assert several[:60] == [4, 4, 1] * 20 and several[60:80] == [4] * 20
    assert several[80:180] == [4, 4, 4, 1, 1] * 20 and several[180:] == [1] * 40
    assert 4 in found["several"]["plan"]
    last = [np.reshape(x["roots"], (-1, 3)) for x in found["helped"]]
    assert [len(x) for x in last] == [9, 3, 14, 2]
    # All walked for as long as they were there, and from the start after a reset.
    assert (last[1][:, 2] > last[0][:3, 2] + 0.5).all()
    assert (last[3][:, 2] < last[1][:2, 2]).all() and (last[3][:, 2] > 0.5).all()
    # One core is thought to bear six until it was measured, and bears these easily.
    assert [x["groups"] for x in found["alone"]] == [1] * 4
    assert [x["groups"] for x in found["helped"]] == [2] * 4
    owners = [x["owners"] for x in found["helped"]]
    assert (
        sorted(owners[0]) == [0] * 5 + [1] * 4
        and sorted(owners[2]) == [0] * 7 + [1] * 7
    )
    assert found["asked"] == ["http://here/worker.js"]


def test_the_pages_kinematics_and_skinning():
    """Positions of joints, and of points that stay where their joint carries them."""
    motion, skeleton = tiny.walk(3, turn=1.0), tiny.skeleton()
    places, turns = map(
        np.asarray,
        global_transforms(skeleton, motion.root_position, motion.joint_rotation),
    )
    about, joints = packed.skeleton_json(skeleton), len(skeleton.parents)
    world = floats(np.zeros(12 * joints))
    calls = [
        (about, floats(root), floats(rotation), world)
        for root, rotation in zip(
            motion.root_position, motion.joint_rotation, strict=True
        )
    ]
    found = np.array(run("body.js", "kinematics", *calls)).reshape(-1, joints, 4, 3)
    np.testing.assert_allclose(found[:, :, 3], places, atol=1e-4)
    columns = np.swapaxes(turns, -1, -2)
    np.testing.assert_allclose(found[:, :, :3], columns, atol=1e-4)


def test_a_packed_body_is_unpacked():
    skeleton = tiny.skeleton()
    arrays = packed.body_arrays(skeleton)
    about = {"skeleton": packed.skeleton_json(skeleton)}
    (found,) = run("body.js", "unpack", (data(packed.pack(about, arrays)),))
    assert found["skeleton"]["names"] == list(skeleton.names)
    assert set(found["arrays"]) == set(arrays)
    for name, values in arrays.items():
        got = found["arrays"][name]
        got = (
            np.frombuffer(base64.b64decode(got["base64"]), np.uint8)
            if isinstance(got, dict)
            else np.array(got)
        )
        np.testing.assert_allclose(got, values.ravel(), rtol=1e-6)
    weights = arrays["weights"].astype(int)
    assert (weights.sum(axis=-1) == 255).all()
    exact = mannequin.describe(skeleton).vertices
    assert 0 < np.abs(arrays["positions"] - exact).max() < 1e-4
    for part in ("", "crowd."):
        count = len(arrays[f"{part}positions"])
        assert arrays[f"{part}faces"].max() == count - 1
    assert count < len(arrays["positions"]) / 2


def takes(frames=20, change=lambda motion: motion):
    motion, skeleton = change(tiny.walk(frames, turn=1.0)), tiny.skeleton()
    parts = (motion.root_position, motion.joint_rotation)
    return skeleton, motion, [[floats(x) for x in part] for part in parts]


@pytest.mark.parametrize("change", [lambda motion: motion, tiny.upturned])
def test_the_pages_bvh_is_what_was_shown(change):
    skeleton, motion, parts = takes(change=change)
    about = packed.skeleton_json(skeleton)
    about["names"][1] += " {1}"
    (text,) = run("save.js", "bvh", (about, float(motion.fps), *parts))
    read, found = bvh_motion.motion_from_bvh(bvh_text.parse_bvh(text))
    assert read.names[1] == "LeftUpLeg _1_"
    expected = joint_positions(skeleton, motion)
    np.testing.assert_allclose(joint_positions(read, found), expected, atol=1e-4)


def test_the_pages_glb_is_what_was_shown(tmp_path):
    """Read by another importer: names, tree, and the mesh in its bind pose."""
    trimesh = pytest.importorskip("trimesh")
    skeleton, motion, parts = takes()
    arrays = packed.body_arrays(skeleton)
    listed = {
        name: floats(x) if x.dtype == np.float32 else x.ravel().tolist()
        for name, x in arrays.items()
    }
    for name in ("joints", "weights"):  # as bytes, which have `subarray`
        listed[name] = {"float64": listed[name]}
    body = {"skeleton": packed.skeleton_json(skeleton), "arrays": listed}
    (found,) = run("save.js", "glb", (body, float(motion.fps), *parts))
    content = base64.b64decode(found["base64"])
    (tmp_path / "take.glb").write_bytes(content)
    scene = trimesh.load(tmp_path / "take.glb")
    assert set(skeleton.names) <= set(scene.graph.nodes)
    (mesh,) = scene.geometry.values()
    assert len(mesh.faces) == len(arrays["faces"]) // 3
    low, high = arrays["positions"].min(0), arrays["positions"].max(0)
    np.testing.assert_allclose(mesh.bounds, [low, high], atol=1e-4)
    length = int.from_bytes(content[12:16], "little")
    text = json.loads(content[20 : 20 + length])
    (animation,) = text["animations"]
    assert len(animation["channels"]) == len(skeleton.parents) + 1
    places = text["accessors"][animation["samplers"][-1]["output"]]
    view = text["bufferViews"][places["bufferView"]]
    start = 28 + length + view["byteOffset"]
    values = np.frombuffer(content[start : start + view["byteLength"]], "<f4")
    roots = np.asarray(motion.root_position).ravel()
    np.testing.assert_allclose(values, roots, atol=1e-5)


def test_packed_files_are_unpacked():
    """Programs as LZMA, noise as gzip; a damaged file is refused."""
    draw = np.random.default_rng(0)
    noise = draw.bytes(3000)
    lines = [f"line {i} {draw.integers(9)} of {i % 7}\n" for i in range(4000)]
    text = "".join(lines).encode() + noise[:400] + bytes(900) + noise[:400]
    files = [web.pack(text), web.pack(noise), b"plain", web.pack(2 * text)]
    assert [x[0] for x in files] == [0x5D, 0x1F, ord("p"), 0x5D]
    some = lambda x: ({"bytes": data(x)["base64"]},)  # noqa: E731
    found = run("packing.js", "unpacked", *map(some, files))
    wanted = [text, noise, b"plain", 2 * text]
    for one, content in zip(found, wanted, strict=True):
        assert base64.b64decode(one["base64"]) == content
    cut = [files[0][:-300], files[0][:12]]
    for _ in range(20):
        at, other = draw.integers(13, len(files[0]) - 1), bytearray(files[0])
        other[at] ^= 1 << int(draw.integers(8))
        cut.append(bytes(other))
    said = run("packing.js", "unpacked", *map(some, cut))
    assert said == [{"error": "damaged"}] * len(cut)


def test_half_precision_constants_are_widened():
    """All 16-bit floats, between others."""
    halves = np.arange(65536, dtype=np.uint16).view(np.float16)
    halves = np.where(np.isnan(halves), 0, halves)
    others = np.arange(3, dtype=np.int64)
    weights = slim.Weights("weights.bin")
    weights.add(others, half=False)
    weights.add(halves.astype(np.float32), half=True)
    given = [{"bytes": data(part)["base64"]} for part in weights.packed()]
    calls = (*given, weights.parts)
    (found,) = run("player.js", "widen", calls)
    assert base64.b64decode(found["base64"]) == weights.content()


def test_the_pages_body_is_bound_as_that_of_pictures():
    """The walker's thighs are half a turn about themselves from its zero pose."""
    skeleton, motion = samples.person(seconds=1.0, turn=0.0)
    poses = np.asarray(motion.joint_rotation)
    found = packed.body_arrays(skeleton, poses[::8])["inverse"]
    turns = packed.world_turns(skeleton, poses)
    expected = mannequin.describe(skeleton, rotations=turns).inverse_bind
    np.testing.assert_allclose(found.reshape(expected.shape), expected, atol=2e-3)
    untold = packed.body_arrays(skeleton)["inverse"]
    assert np.abs(found - untold).max() > 1.0


def test_poses_of_straight_limbs_say_nothing():
    skeleton = walker.walker_skeleton()
    poses = np.tile(np.array([1.0, 0, 0, 0, 1, 0], np.float32), (2, 22, 1))
    found = packed.body_arrays(skeleton, poses)["inverse"]
    np.testing.assert_array_equal(found, packed.body_arrays(skeleton)["inverse"])


# --- a tab ---------------------------------------------------------------------------

STATE = {
    **{"model": "walker", "models": ["walker", "runner"], "labels": [], "label": 0},
    **{"speed": 1.2, "speeds": [0.0, 4.0], "characters": 1, "most_characters": 64},
    **{"steps": [], "num_steps": 1, "scales": None, "scale": 1.0, "note": "loading"},
    **{"foot_lock": True, "lockable": True, "plan": False, "planning": True},
    **{"paused": False, "engine": 0, "fps": 30, "source": "", "recording": False},
    **{"taken": 0.0, "people": 1},
}
THERE = {"labels": ["a", "b", "c"], "steps": [1, 2, 4], "note": "", "num_steps": 4}


def settings(found):
    return [x["set"] for x in found["said"] if "set" in x]


def test_a_link_is_asked_for_when_its_model_is_there():
    """Labels and steps are a model's own: before, no server knows them."""
    events = [("state", STATE | x) for x in ({}, {"speed": 2.0}, THERE | {"engine": 1})]
    hash = "#model=walker&label=2&speed=2&num_steps=2&foot_lock=1"
    first, second, third = tab(*events, hash=hash)
    assert settings(first) == [{"speed": 2}] and settings(second) == []
    assert settings(third) == [{"label": 2}, {"num_steps": 2}]
    # On a server that runs another one, which goes on until the link's is there.
    running = STATE | THERE | {"engine": 3}
    loading = running | {"model": "runner", "note": "loading runner"}
    there = loading | {"engine": 4, "note": ""}
    events = [("state", x) for x in (running, loading, there, there)]
    hash = "#model=runner&label=1&scale=0.5&foot_lock=0"
    last = [{"label": 1}, {"scale": 0.5}, {"foot_lock": False}]
    wants = [[{"model": "runner"}], [], last, []]
    assert [settings(x) for x in tab(*events, hash=hash)] == wants


def body():
    """Of the tiny skeleton, as events."""
    skeleton = tiny.skeleton()
    content = packed.pack(
        {"skeleton": packed.skeleton_json(skeleton)}, packed.body_arrays(skeleton)
    )
    return ("state", STATE | THERE), ("body", base64.b64encode(content).decode(), 1)


def at(tick, z=0.0):
    joints = tiny.skeleton().num_joints
    rotations = np.tile([1.0, 0, 0, 0, 1.0, 0], joints)
    head = [1, tick, 3, 0, 1, joints, 0, 30, 0, 1, 0, 1, 0]
    return ("frame", [*head, 0.0, 1.0, z, *rotations.tolist()])


def test_a_hidden_tab_keeps_no_frames():
    """No picture takes them there; the last one is shown when it is seen again."""
    found = tab(*body(), at(0), ("hidden", True), *map(at, range(1, 9)))
    assert [x["shown"] for x in found[-8:]] == list(range(1, 9))


@pytest.mark.parametrize("event", [("press", "reset"), at(9, 0.4)])
def test_what_is_saved_of_the_page_has_no_jumps(event):
    """Who begins anew, in whatever tab that was told, begins another take."""
    before = [at(t, 0.05 * t) for t in range(40)]
    after = [at(40 + t, 0.05 * t) for t in range(10)]
    saved = tab(*body(), *before, event, *after, ("save",))[-1]["made"]
    read, found = bvh_motion.motion_from_bvh(bvh_text.parse_bvh(saved))
    count = 10 + (event[0] == "frame")
    assert read.names == tiny.NAMES and len(found.root_position) == count
    steps = np.diff(found.root_position[-10:, 2])
    np.testing.assert_allclose(steps, 0.05, atol=1e-5)


def test_a_gamepad_that_is_unplugged_holds_nothing():
    up, down = {"pressed": False}, {"pressed": True}
    pad = {"connected": True, "mapping": "standard", "axes": [0, 0, 1, 0]}
    pad |= {"buttons": [up, up, up, up, down]}
    plugged, without = tab(("pad", pad), ("pad", None))
    assert plugged["pad"][1:] == [[1, 0], 1]
    assert without["pad"] == [None, None, None]
