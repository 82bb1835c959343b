"""What held keys ask for, the session's ticks, and what it records."""

import asyncio
import concurrent.futures
import dataclasses
import json
import math
import threading
import time

import numpy as np
import pytest

from jaxmotion.control import steering
from jaxmotion.control.steering import Inputs, Wish
from jaxmotion.viz import page, viewer
from tests.viz.strider import strider

TICK = 1 / 30


def ask(*held, azimuth=0.0, target=None, last=None, position=(0.0, 0.0), speed=1.0):
    inputs = Inputs(held=frozenset(held), azimuth=azimuth, target=target)
    last = Wish() if last is None else last
    return steering.wanted(inputs, last, position=position, speed=speed, seconds=TICK)


@pytest.mark.parametrize(
    ("held", "azimuth", "want"),
    [
        (("forward",), 0.0, (0, 1)),
        (("back",), 0.0, (0, -1)),
        # To the right of who looks along +z lies -x.
        (("right",), 0.0, (-1, 0)),
        (("left",), 0.0, (1, 0)),
        (("forward",), math.pi / 2, (1, 0)),
        (("right",), math.pi / 2, (0, 1)),
        (("forward", "left"), 0.0, (math.sqrt(0.5), math.sqrt(0.5))),
        (("forward", "back", "left"), 0.0, (1, 0)),
    ],
)
def test_keys_walk_where_the_camera_looks(held, azimuth, want):
    wish = ask(*held, azimuth=azimuth)
    np.testing.assert_allclose(wish.velocity, want, atol=1e-9)
    np.testing.assert_allclose(wish.facing, want, atol=1e-9)
    twice = ask(*held, "run", azimuth=azimuth)
    np.testing.assert_allclose(twice.velocity, steering.RUN * np.array(want), atol=1e-9)


def test_who_lets_go_stands_and_faces_where_he_went():
    went = ask("left")
    assert ask(last=went) == Wish(facing=went.facing)
    assert ask("forward", "back", last=went) == Wish(facing=went.facing)
    assert ask("run").speed == 0


def test_turning_on_the_spot():
    wish = Wish()
    for _ in range(18):  # 0.6 s at 150 degrees per second
        wish = ask("turn_left", last=wish)
    assert wish.speed == 0
    np.testing.assert_allclose(wish.facing, (1, 0), atol=1e-6)
    # Who walks does not turn.
    assert ask("forward", "turn_left") == ask("forward")


def test_a_target_is_walked_to_and_kept():
    far = ask(target=(0.0, 5.0), position=(0.0, 1.0))
    np.testing.assert_allclose(far.velocity, (0, 1), atol=1e-9)
    near = ask(target=(0.5, 0.0), last=far)
    np.testing.assert_allclose(near.velocity, (0.5 / steering.ARRIVE, 0), atol=1e-9)
    assert ask(target=(0.1, 0.0), last=near).speed == 0
    # Who stands does not start again for a hand's breadth.
    assert ask(target=(0.3, 0.0)).speed == 0
    assert ask(target=(0.5, 0.0)).speed > 0
    assert ask("back", target=(0.0, 5.0)).velocity[1] < 0


def test_small_changes_are_not_told():
    told, steps = ask("forward"), []
    for degrees in range(0, 28, 2):
        wish = ask("forward", azimuth=math.radians(degrees))
        new = steering.settled(told, wish, steady=False)
        steps.append(new is not told)
        told = new
    assert sum(steps) == 2
    slow = Wish(velocity=(0.0, 0.95))
    assert steering.settled(told, told, steady=False) is told
    assert steering.settled(ask("forward"), slow, steady=False) != slow
    assert steering.settled(ask("forward"), slow, steady=True) == slow
    assert steering.settled(ask("forward"), Wish(), steady=False) == Wish()


def test_another_way_to_go_is_told_though_the_facing_is_held():
    """A stick that turns by six degrees a tick, a second one that does not."""
    told = ask("forward")
    for degrees in range(0, 361, 6):
        way = math.sin(math.radians(degrees)), math.cos(math.radians(degrees))
        wish = Wish(velocity=way, facing=told.facing)
        told = steering.settled(told, wish, steady=False)
        assert np.dot(told.velocity, way) > math.cos(steering.HEADING_STEP) - 1e-9


def test_a_formation_has_the_first_in_front_and_room():
    for number in (1, 2, 7, 64):
        places = viewer.formation(number)
        assert places.shape == (number, 2) and not places[0].any()
        assert places[:, 1].max() == 0
        if number > 1:
            gaps = np.linalg.norm(places[:, None] - places[None], axis=-1)
            gaps[np.diag_indices(number)] = np.inf
            assert gaps.min() > 1


STATE = {"models": ["a", "b"], "labels": ["x", "y"], "steps": [1, 8], "scales": [0, 2]}


@pytest.mark.parametrize(
    ("name", "value", "message"),
    [
        ("label", 2, "label is '2', expected 0 to 1"),
        ("label", 0.5, "expected 0 to 1"),
        ("speed", float("nan"), "expected 0.3 to 4"),
        ("speed", "fast", "expected 0.3 to 4"),
        ("characters", 65, "expected 1 to 64"),
        ("characters", True, "expected 1 to 64"),
        ("model", "c", "expected one of a, b"),
        ("model", ["a"], "expected one of a, b"),
        ("num_steps", 3, "num_steps is '3', expected one of 1, 8"),
        ("paused", 1, "expected one of False, True"),
        ("color", 1, "unknown setting 'color'"),
    ],
)
def test_settings_out_of_range_are_refused(name, value, message):
    settings = viewer.Settings(model="a")
    with pytest.raises(ValueError, match=message):
        viewer.changed(settings, name, value, STATE)


def test_settings_in_range():
    settings = viewer.Settings(model="a")
    for name, value in (("label", 1), ("speed", 2), ("model", "b"), ("paused", True)):
        settings = viewer.changed(settings, name, value, STATE)
        assert getattr(settings, name) == value


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("{", "no JSON"),
        ("[" * 5000, "no JSON"),
        ("[1]", "no JSON object"),
        ('{"held": ["fly"], "azimuth": 0, "target": null}', "held is wrong"),
        ('{"held": [[]], "azimuth": 0, "target": null}', "held is wrong"),
        ('{"held": [], "azimuth": NaN, "target": null}', "no finite number"),
        ('{"held": [], "azimuth": 0, "target": [1]}', "target is wrong"),
        ('{"held": [], "azimuth": 0, "target": [1, true]}', "no finite number"),
        ('{"held": [], "target": null}', "no finite number"),
        ('{"held": [], "azimuth": 1' + "0" * 400 + "}", "no finite number"),
        ('{"held": [], "azimuth": 0, "path": [1, 2]}', "path is wrong"),
        ('{"held": [], "azimuth": 0, "path": [[1, NaN]]}', "no finite number"),
        (
            json.dumps({"held": [], "azimuth": 0, "path": [[1, 2]] * 33}),
            "path has 33 points, expected at most 32",
        ),
        ('{"held": [], "azimuth": 0, "stick": [2, 0]}', "stick is wrong"),
        ('{"held": [], "azimuth": 0, "face": [NaN, 0]}', "face is wrong"),
    ],
)
def test_wrong_messages_are_refused(text, message):
    with pytest.raises(ValueError, match=message):
        page.read_message(text)


def test_inputs_are_read():
    text = '{"held": ["run", "left"], "azimuth": 1, "target": [2, -3.5]}'
    want = Inputs(held=frozenset(("run", "left")), azimuth=1.0, target=(2.0, -3.5))
    assert page.read_message(text) == {"inputs": want}
    text = (
        '{"held": [], "azimuth": 0, "target": null, "stick": [0, 0.5], "face": [1, 0]}'
    )
    found = page.read_message(text)["inputs"]
    assert found.path == ()
    assert (found.stick, found.face) == ((0.0, 0.5), (1.0, 0.0))
    text = '{"held": [], "azimuth": 0, "path": [[0, 1], [2.5, 3]]}'
    assert page.read_message(text)["inputs"].path == ((0.0, 1.0), (2.5, 3.0))
    assert page.read_message('{"do": "reset"}') == {"do": "reset"}


def test_a_frame_is_packed_as_the_page_reads_it():
    shown = viewer.Shown(
        engine=3,
        tick=7,
        roots=np.array([[1.0, 9, 2], [3, 9, 4]]),
        rotations=np.arange(24.0).reshape(2, 2, 6),
        ball=np.ones((2, 3)),
        plan=(np.arange(6).reshape(2, 3), np.arange(12).reshape(2, 6)),
        told=Wish(velocity=(0.5, 0.25)),
        planned=1,
        milliseconds=12.5,
    )
    data = np.frombuffer(page.frame_bytes(shown, 30.0), "<f4")
    want = [3, 7, 12.5, 1, 2, 2, 2, 30, 0.5, 0.25, 0, 1, 2, 1, 9, 2, 3, 9, 4]
    np.testing.assert_array_equal(data[:19], want)
    np.testing.assert_array_equal(data[19:43], np.arange(24))
    np.testing.assert_array_equal(data[43:49], np.ones(6))
    np.testing.assert_array_equal(data[49:56], [0, 2, 3, 5, 3, 4, 5])
    np.testing.assert_array_equal(data[56:], np.arange(12))


def build(session):
    """What its thread does before the next tick, at once."""
    session._build()
    session._builder.join()
    session._swap()


class Ticking:
    """A session on a character without a network, ticked by hand."""

    def __init__(self, dress=None, **options):
        self.character, self.traces = strider(**options)
        self.shown = []
        self.session = viewer.Session(
            {"strider": lambda: self.character, "other": lambda: strider()[0]},
            dress=dress,
        )
        self.session.on_frame = self.shown.append
        self.load()
        self.session.join("me")

    def load(self):
        build(self.session)
        assert self.session.note == ""

    def tick(self, *held, times=1, **more):
        self.session.steer("me", Inputs(held=frozenset(held), **more))
        for _ in range(times):
            self.session.tick()
        return self.shown[-1]


@pytest.mark.slow
def test_a_session_walks_and_compiles_once():
    it = Ticking()
    assert it.session.state()["labels"] == ["calm", "crouch"]
    start = it.tick(times=5).roots[0]
    went = it.tick("forward", times=60).roots[0] - start
    assert went[2] > 2 and abs(went[0]) < 0.05
    traces = len(it.traces)
    height = it.shown[-1].roots[0, 1]
    for name, value in (("label", 1), ("speed", 2.0), ("scale", 1.3)):
        it.session.change(name, value)
        it.tick("left", "run", times=3)
    assert it.shown[-1].roots[0, 1] < height - 0.1
    assert len(it.traces) == traces
    here = it.shown[-1].roots[0]
    it.session.leave("me")  # with keys held down: they are let go
    it.session.join("you")
    for _ in range(60):
        it.session.tick()
    assert it.shown[-1].told.speed == 0
    assert np.abs(it.shown[-1].roots[0] - it.shown[-2].roots[0]).max() < 1e-3
    assert not np.allclose(here, it.shown[-1].roots[0])


@pytest.mark.slow
def test_waypoints_are_walked_by_all_side_by_side():
    it = Ticking()
    it.session.change("characters", 3)
    it.load()
    start = it.tick(times=2).roots
    went = it.tick(path=((0.0, 2.0),), times=20).roots[0]
    it.tick(path=((0.0, 2.0), (2.0, 2.0)), times=150)
    roots = np.stack([x.roots[0, ::2] for x in it.shown])
    assert went[2] > 0.2 and np.linalg.norm(roots - [0.0, 2.0], axis=1).min() < 0.3
    end = it.shown[-1]
    assert np.linalg.norm(end.roots[0, ::2] - [2.0, 2.0]) < 0.2 and end.told.speed == 0
    # One of them plans a tick: the others are told a little later.
    np.testing.assert_allclose(end.roots - end.roots[:1], start - start[:1], atol=0.3)
    # Another path begins where he is; who drops it stands; a reset drops it, too.
    it.tick(path=((2.0, 5.0),), times=30)
    assert it.shown[-1].told.velocity[1] > 1.0
    assert it.tick().told.speed == 0
    it.tick(path=((2.0, 5.0),), times=9)
    it.session.reset()
    it.tick(times=9)
    assert it.shown[-1].told.speed == 0
    assert np.abs(it.shown[-1].roots[0, ::2]).max() < 0.1


@pytest.mark.slow
def test_more_characters_join_beside_the_first():
    it = Ticking()
    before = it.tick("forward", times=30).roots[0]
    it.session.change("characters", 7)
    it.load()
    shown = it.tick("forward", times=1)
    assert shown.roots.shape == (7, 3) and shown.engine == 2
    assert np.abs(shown.roots[0] - before).max() < 0.1
    gaps = np.linalg.norm(shown.roots[:, None] - shown.roots[None], axis=-1)
    assert gaps[0].max() < 8
    # A plan is due in every tick, and one character of seven gets it.
    assert max(x.planned for x in it.shown[-1:]) <= 1
    shown = it.tick("forward", times=60)
    speeds = np.diff([x.roots[:, 2] for x in it.shown[-2:]], axis=0) * 30
    np.testing.assert_allclose(speeds, 1.4, atol=0.1)
    it.session.change("characters", 1)
    it.load()
    after = it.tick("forward", times=1).roots[0]
    assert np.abs(after - shown.roots[0]).max() < 0.1
    it.session.reset()
    assert np.abs(it.tick().roots[0, ::2]).max() < 0.1


def test_people_who_save_at_once_get_a_file_each(tmp_path):
    together = threading.Barrier(3)

    def save(path, skeleton, motion):
        time.sleep(0.05)  # while others look for a free name
        path.write_text(f"{skeleton} {motion}")

    session = object.__new__(viewer.Session)
    session.take = ("bones", "walk")
    served = page.Page(session, out=tmp_path, save=save, is_local=lambda host: True)

    def one(_):
        together.wait()
        return served._write(".bvh").name

    with concurrent.futures.ThreadPoolExecutor(3) as pool:
        found = [*pool.map(one, range(3))]
    assert sorted(found) == [f"take_00{i}.bvh" for i in (1, 2, 3)]
    assert {x.read_text() for x in tmp_path.iterdir()} == {"bones walk"}
    assert len([*tmp_path.iterdir()]) == 3


def test_inputs_are_obeyed_while_a_take_is_saved(tmp_path):
    may_end, done = threading.Event(), []

    def save(path, skeleton, motion):
        assert may_end.wait(10)
        path.write_text("a take")

    session = object.__new__(viewer.Session)
    session.take, session.record = ("bones", "walk"), lambda: done.append("record")
    served = page.Page(session, out=tmp_path, save=save, is_local=lambda host: True)

    async def converse():
        client = page._Client()
        served._obey(client, '{"save": ".bvh"}')
        await asyncio.sleep(0.05)
        served._obey(client, '{"do": "record"}')
        assert done == ["record"] and not client.saved
        with pytest.raises(ValueError, match="still being saved"):
            served._obey(client, '{"save": ".bvh"}')
        may_end.set()
        await client.saving
        assert client.saved == "take_001.bvh" and not client.errors
        session.take = None
        served._obey(client, '{"save": ".bvh"}')
        await client.saving
        assert client.errors == ["nothing is recorded yet"]

    asyncio.run(converse())
    assert [x.name for x in tmp_path.iterdir()] == ["take_001.bvh"]


@pytest.mark.slow
def test_a_take_is_what_was_shown():
    it = Ticking(ball=True)
    it.tick("forward", times=10)
    it.session.record()
    it.tick("left", times=20)
    assert it.session.state()["recording"]
    it.session.record()
    it.tick(times=5)
    _, take = it.session.take
    want = [x.roots[0] for x in it.shown[10:30]]
    np.testing.assert_allclose(take.root_position, want, atol=1e-6)
    assert take.fps == 30 and not it.session.state()["recording"]
    assert it.shown[-1].ball.shape == (1, 3)
    it.session.record()
    it.tick(times=2)
    it.session.reset()  # who is somewhere else is in no take
    it.tick("forward", times=3)
    assert it.session.take[1].root_position.shape == (2, 3)
    it.session.record()
    it.tick(times=3)
    it.session.change("model", "other")  # of another skeleton, perhaps: the take ends
    it.load()
    assert it.session.take[1].root_position.shape == (3, 3)
    assert not it.session.state()["recording"]


@pytest.mark.slow
def test_another_body_is_worn_at_the_size_of_the_model():
    skeleton = strider()[0].skeleton
    half = dataclasses.replace(skeleton, offsets=0.5 * skeleton.offsets)

    def dress(character, motion):
        assert motion.root_position.shape == (30, 3), "a second"
        assert motion.root_position[-1, 2] > 0.5, "of walking"
        return viewer.Dress(
            skeleton=half,
            wear=lambda root, turns: (0.5 * root, turns),
            scale=2.0,
            packed=b"body",
        )

    it, plain = Ticking(dress=dress), Ticking()
    assert it.session.dress.packed == b"body"
    it.session.record()
    walked = it.tick("forward", times=20).roots[0]
    it.session.record()
    assert walked[2] > 0.2
    same = plain.tick("forward", times=20).roots[0]
    np.testing.assert_allclose(walked, same, atol=1e-5)
    # Shown where the model is; recorded in the body's own meters.
    assert it.session.take[0] is half
    np.testing.assert_allclose(
        it.session.take[1].root_position[-1], 0.5 * walked, atol=1e-5
    )


def test_the_plan_is_shown_to_its_end():
    it = Ticking()
    it.tick("forward", times=20)
    assert it.shown[-1].plan is None and it.session.state()["planning"]
    it.session.change("plan", True)
    it.load()
    path, ghost = it.tick("forward", times=1).plan
    assert path.shape == (it.character.tuning.patience, 3)
    it.tick("forward", times=len(path))
    np.testing.assert_allclose(it.shown[-1].roots[0], path[-1], atol=1e-3)
    np.testing.assert_allclose(it.shown[-1].rotations[0], ghost, atol=1e-2)


@pytest.mark.slow
def test_a_model_that_cannot_be_loaded_is_told_and_another_one_goes_on():
    def broken():
        raise ValueError("no such\nmodel")

    character = strider()[0]
    session = viewer.Session({"one": lambda: character, "two": broken})
    build(session)
    session.change("model", "two")
    session._build()
    session._builder.join()
    assert session.note == "error: no such model"
    session.tick()
    session._build()  # is not tried again and again
    assert not session._builder.is_alive()
    session.change("model", "one")
    session._build()
    session._builder.join()
    assert session.note == ""


def test_who_still_holds_a_key_steers_when_another_one_leaves():
    session = viewer.Session({"one": lambda: None})
    for who in ("one", "two"):
        session.join(who)
    ahead = Inputs(held=frozenset({"forward"}))
    session.steer("one", ahead)
    for held in ({"left"}, set()):
        session.steer("two", Inputs(held=frozenset(held)))
    assert session._active == "two"
    session.leave("two")
    assert session._inputs[session._active] == ahead


def test_settings_chosen_while_a_model_compiles_are_those_that_it_has():
    character = strider()[0]
    wild = viewer.Settings(model="one", label=7, num_steps=20, scale=9.0)
    found = viewer._fitting(wild, character)
    assert (found.label, found.num_steps, found.scale) == (0, 8, 2.0)
    own = viewer.Settings(model="one", label=1, num_steps=3, scale=0.5)
    assert viewer._fitting(own, character) == own


@pytest.mark.slow
def test_another_model_may_be_chosen_while_one_loads():
    """The page goes on all the while, which asks for the state in each tick."""
    loads, goes_on = ({x: threading.Event() for x in "bc"} for _ in range(2))
    models = {name: strider()[0] for name in "abc"}
    tuning = dataclasses.replace(models["b"].tuning, own_steps=3)
    models["b"] = dataclasses.replace(models["b"], tuning=tuning)

    def slow(name):
        loads[name].set()
        assert goes_on[name].wait(60)
        return models[name]

    session = viewer.Session(
        {"a": lambda: models["a"], "b": lambda: slow("b"), "c": lambda: slow("c")}
    )
    build(session)
    for name in "bc":
        session.change("model", name)
        session._build()
        if name == "c":
            goes_on["b"].set()  # while c is wanted
        assert loads[name].wait(60)
    asks = threading.Thread(target=session.state, daemon=True)
    asks.start()
    asks.join(10)
    assert not asks.is_alive()
    session.change("model", "a")
    goes_on["c"].set()
    session._builder.join()
    session._swap()
    assert session.settings.model == "a" and session._engine.character is models["a"]
    session._build()
    assert not session._builder.is_alive()  # there is nothing left to make


@pytest.mark.slow
def test_a_session_runs_only_while_somebody_looks():
    shown = []
    session = viewer.Session({"strider": lambda: strider()[0]})
    session.on_frame = shown.append
    thread = threading.Thread(target=session.run, daemon=True)
    thread.start()
    deadline = time.time() + 300
    while session.skeleton is None and time.time() < deadline:
        time.sleep(0.05)
    time.sleep(0.3)
    assert not shown
    session.join("me")
    while len(shown) < 5 and time.time() < deadline:
        time.sleep(0.05)
    session.change("paused", True)
    time.sleep(0.5)
    count = len(shown)
    session.step()
    while len(shown) == count and time.time() < deadline:
        time.sleep(0.05)
    time.sleep(0.3)
    assert len(shown) == count + 1
    session.close()
    thread.join(10)
    assert not thread.is_alive()
