"""Files of graphs: what they compute is what JAX computes, elsewhere too."""

import functools
import json
import subprocess
import sys

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxmotion.control import courses, rollout
from jaxmotion.export import graph, onnx, stablehlo
from jaxmotion.systems.camdm import controller as camdm_controller
from jaxmotion.systems.camdm import model as camdm_model
from jaxmotion.typing import Exported
from tests import tiny

TICKS = 40


@functools.cache
def graphs():
    """Graphs of a tiny character with two planners, its state and its commands."""
    config = tiny.config(heading="facing", depth=1, num_steps=2)
    made = camdm_controller.controller(
        tiny.random_params(camdm_model.init, config),
        tiny.skeleton(),
        config=config,
        control=camdm_controller.Control(apply=5, reuse=6),
    )
    state = camdm_controller.init_state(
        tiny.skeleton(), tiny.walk(config.past), config=config
    )
    command = courses.segment_commands(
        [(0.5, 0.0, 0.0, 1.0, 0), (0.5, 90.0, 90.0, 1.5, 1)],
        seconds=TICKS / 30,
        fps=30.0,
    )
    arguments = {"state": state, "command": jax.tree.map(lambda x: x[0], command)}
    exported = rollout.exports(made)
    made = {name: graph.make(name, f, arguments) for name, f in exported.items()}
    return made, arguments["state"], command


def named(trees):
    """Arrays of trees by the names of the ports."""
    leaves = map(np.asarray, jax.tree.leaves(list(trees.values())))
    return dict(zip((x.name for x in graph.ports(trees)), leaves, strict=True))


def frames(call):
    """What a player shows: the order of calls of the JSON, noise from a seed."""
    made, state, commands = graphs()
    state, draw = named({"state": state}), np.random.default_rng(0).standard_normal
    shown, levels = [], set()

    def run(name, command):
        ports = made[name].inputs
        given = state | named({"command": command})
        given |= {
            x.name: draw(x.shape, np.float32) for x in ports if x.name[:5] == "noise"
        }
        found = call(name, [given[x.name] for x in ports])
        names = [x.name.removeprefix(graph.OUT) for x in made[name].outputs]
        found = dict(zip(names, found, strict=True))
        state.update({name: x for name, x in found.items() if name in state})
        return found

    for i in range(TICKS):
        command = jax.tree.map(lambda x, i=i: x[i], commands)
        level = int(run("plan_level", command)["level"])
        levels.add(level)
        if level:
            run("plan" if level == 1 else f"plan_{level}", command)
        found = run("advance", command)
        shown.append((found["frame.root_position"], found["frame.joint_rotation"]))
    assert levels == {0, 1, 2}
    return [np.stack(x) for x in zip(*shown, strict=True)]


@functools.cache
def expected():
    made, _, _ = graphs()
    jitted = {name: jax.jit(one.run) for name, one in made.items()}
    return frames(lambda name, arrays: jitted[name](*arrays))


def test_a_missing_extra_is_one_line(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "jax2onnx", None)
    double = Exported(lambda x: 2 * x, ("x",), ("y",))
    made = graph.make("double", double, {"x": jnp.ones(2)})
    with pytest.raises(ValueError, match=r'pip install -e "\.\[export\]"'):
        onnx.write(tmp_path / "double.onnx", made)


@pytest.mark.slow
def test_onnx_shows_what_jax_shows(tmp_path):
    """A rollout with the same noise, by onnxruntime from the files."""
    pytest.importorskip("jax2onnx")
    runtime = pytest.importorskip("onnxruntime")
    made, _, _ = graphs()
    sessions = {}
    for name, one in made.items():
        onnx.write(tmp_path / f"{name}.onnx", one)
        sessions[name] = runtime.InferenceSession(tmp_path / f"{name}.onnx")

    def call(name, arrays):
        taken = {x.name for x in sessions[name].get_inputs()}
        given = zip(made[name].inputs, arrays, strict=True)
        return sessions[name].run(
            None, {x.name: v for x, v in given if x.name in taken}
        )

    for found, wanted in zip(frames(call), expected(), strict=True):
        np.testing.assert_allclose(found, wanted, atol=1e-4)


@pytest.mark.slow
@pytest.mark.parametrize("batch", [3, graph.ANY])
def test_onnx_of_many_characters(tmp_path, batch):
    """Each gets what it would get alone, whatever the number."""
    pytest.importorskip("jax2onnx")
    runtime = pytest.importorskip("onnxruntime")

    def walk(key, place, speed):
        def step(place, i):
            shaken = place + jax.random.normal(jax.random.fold_in(key, i), (2,))
            return jnp.where(speed > 0, shaken, place), jnp.sin(shaken)

        return jax.lax.scan(step, place, jnp.arange(4))

    walk = Exported(walk, ("key", "place", "speed"), ("place", "path"))
    one = graph.make("walk", walk, {"place": jnp.zeros(2), "speed": jnp.ones(())})
    onnx.write(tmp_path / "walk.onnx", one, batch=batch)
    session = runtime.InferenceSession(tmp_path / "walk.onnx")
    draw = np.random.default_rng(0).standard_normal
    for number in (3,) if batch == 3 else (1, 3, 7):
        rows = [draw((number, *x.shape), np.float32) for x in one.inputs]
        names = [x.name for x in one.inputs]
        found = session.run(None, dict(zip(names, rows, strict=True)))
        wanted = jax.vmap(one.run)(*map(jnp.asarray, rows))
        for a, b in zip(found, wanted, strict=True):
            np.testing.assert_allclose(a, b, atol=1e-5)


@pytest.mark.slow
def test_onnx_of_gradients(tmp_path):
    """Through a loop, which runs backward, and products, whose matrices turn."""
    pytest.importorskip("jax2onnx")
    runtime = pytest.importorskip("onnxruntime")
    square = jnp.asarray(np.random.default_rng(1).standard_normal((3, 3)), jnp.float32)

    def value(x):
        def step(place, row):
            place = jnp.tanh(place + row)
            return place, place * row

        return jnp.sum(jax.lax.scan(step, x[0], square @ x)[1] ** 2)

    slope = Exported(jax.grad(value), ("x",), ("y",))
    one = graph.make("slope", slope, {"x": jnp.ones((3, 2))})
    onnx.write(tmp_path / "slope.onnx", one)
    session = runtime.InferenceSession(tmp_path / "slope.onnx")
    x = np.random.default_rng(0).standard_normal((3, 2), np.float32)
    (found,) = session.run(None, {"x": x})
    np.testing.assert_allclose(found, one.run(x)[0], atol=1e-5)


@pytest.mark.slow
def test_what_onnx_lacks_is_one_line(tmp_path):
    pytest.importorskip("jax2onnx")
    called = lambda x: jax.pure_callback(np.sin, x, x)  # noqa: E731
    wrong = Exported(called, ("x",), ("y",))
    made = graph.make("wrong", wrong, {"x": jnp.eye(2)})
    with pytest.raises(ValueError, match="'wrong' has no form in ONNX: "):
        onnx.write(tmp_path / "wrong.onnx", made)
    assert not list(tmp_path.iterdir())


PLAY = """
import json, sys
import jax, jax.export, numpy as np
from pathlib import Path

folder = Path(sys.argv[1])
call = jax.export.deserialize((folder / "plan.stablehlo").read_bytes()).call
arrays = np.load(folder / "given.npz")
found = call(*(arrays[name] for name in arrays.files))
np.savez(folder / "found.npz", *found)
print(json.dumps(sorted(name for name in sys.modules if name.startswith("jaxm"))))
"""


@pytest.mark.slow
@pytest.mark.parametrize("batch", [None, 2, graph.ANY])
def test_stablehlo_in_a_process_without_the_library(tmp_path, batch):
    pytest.importorskip("flatbuffers")
    made, state, commands = graphs()
    one = made["plan"]
    stablehlo.write(tmp_path / "plan.stablehlo", one, batch=batch)
    command = jax.tree.map(lambda x: x[0], commands)
    draw = np.random.default_rng(0).standard_normal
    given = named({"state": state, "command": command})
    rows = [given.get(x.name, draw(x.shape, np.float32)) for x in one.inputs]
    wanted = jax.jit(one.run)(*rows)
    many = rows if batch is None else [np.stack([x, x]) for x in rows]
    np.savez(tmp_path / "given.npz", *many)
    done = subprocess.run(
        [sys.executable, "-c", PLAY, str(tmp_path)],
        capture_output=True,
        text=True,
        cwd=tmp_path,
    )
    assert done.returncode == 0, done.stderr[-2000:]
    assert json.loads(done.stdout) == []
    with np.load(tmp_path / "found.npz") as found:
        for name, expected in zip(found.files, wanted, strict=True):
            for row in [found[name]] if batch is None else found[name]:
                np.testing.assert_allclose(row, expected, atol=1e-5)


@pytest.mark.slow
def test_onnx_of_choices_and_slices(tmp_path):
    """Between truth values; a slice beyond the end moves back, as JAX has it."""
    pytest.importorskip("jax2onnx")
    runtime = pytest.importorskip("onnxruntime")

    def choose(start, yes):
        part = jax.lax.dynamic_slice(jnp.arange(12.0).reshape(6, 2), (start, 0), (4, 2))
        return part, jnp.where(yes, part > 3, part < 1)

    chosen = Exported(choose, ("start", "yes"), ("part", "which"))
    one = graph.make("choose", chosen, {"start": jnp.int32(0), "yes": jnp.bool_(True)})
    onnx.write(tmp_path / "choose.onnx", one)
    session = runtime.InferenceSession(tmp_path / "choose.onnx")
    for start in (-1, 0, 2, 5):
        for yes in (False, True):
            given = {"start": np.int32(start), "yes": np.bool_(yes)}
            found = session.run(None, {k: np.array(v) for k, v in given.items()})
            for a, b in zip(found, one.run(*given.values()), strict=True):
                np.testing.assert_array_equal(a, b)


@pytest.mark.slow
def test_onnx_of_several_characters_at_once():
    """Rows and windows of inner axes, by indices of all and of each, and products."""
    pytest.importorskip("jax2onnx")
    pick = jnp.array([3, 1, 1])

    def run(x, matrix, at):  # x: [4, 3, 5]
        rows = x[pick] + x[:, pick[1:]][jnp.array([0, 2, 3]), :1]
        window = jax.lax.dynamic_slice(x, (at, 0, at + 1), (2, 3, 2))
        each = jnp.take_along_axis(x, jnp.argmax(x, axis=1, keepdims=True), axis=1)
        changed = x.at[pick[:2]].set(2.0).at[:, 1].add(x[:, 0]).at[..., 4].max(0.0)
        turned = jnp.einsum("ij,jk,lk->il", matrix, matrix, matrix) @ x[0]
        other = jnp.stack([matrix, matrix.T])[at % 2] @ x[1]
        return rows, window, each, changed, turned + other

    gives = ("rows", "window", "each", "changed", "turned")
    arguments = {"x": jnp.ones((4, 3, 5)), "matrix": jnp.ones((3, 3))}
    arguments["at"] = jnp.int32(0)
    one = graph.make("run", Exported(run, tuple(arguments), gives), arguments)
    draw = np.random.default_rng(3).standard_normal
    x, matrix = draw((6, 4, 3, 5), np.float32), draw((6, 3, 3), np.float32)
    at = np.array([0, 1, 2, 3, 9, -4], np.int32)  # the last ones reach beyond the ends
    given = {"x": x, "matrix": matrix, "at": at}
    session = onnx.open_session(onnx.content(graph.together(one, 6)))
    wanted = jax.vmap(run)(*given.values())
    for a, b in zip(session.run(None, given), wanted, strict=True):
        np.testing.assert_allclose(a, b, atol=1e-5)
    single = onnx.open_session(onnx.content(one))
    for i in range(6):
        found = single.run(None, {k: np.array(v[i]) for k, v in given.items()})
        for a, b in zip(found, wanted, strict=True):
            np.testing.assert_allclose(a, b[i], atol=1e-5)
