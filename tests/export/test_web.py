"""The page's folder: every graph in onnxruntime-web, and its motion against JAX."""

import json
import lzma
import shutil
import subprocess
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxmotion as jm
from jaxmotion import files
from jaxmotion.control.foot_lock import lock_feet
from jaxmotion.export import graph, onnx, slim, web
from jaxmotion.systems import registry
from jaxmotion.typing import Exported
from tests.viz.strider import strider

CACHE = Path.home() / ".cache" / "jaxmotion" / "web"
NODE = pytest.mark.skipif(shutil.which("npm") is None, reason="needs Node")
# Seconds, direction of travel and of facing (degrees from +z to +x), m/s, label.
COURSE = ((1, 0, 0, 0.0, 0), (3, 0, 0, 1.4, 0), (2, 90, 90, 1.4, 0), (2, 90, 0, 2.5, 1))
COURSE += ((2, 0, 0, 0.0, 0),)


@pytest.fixture(scope="module")
def packages():
    pytest.importorskip("jax2onnx")
    try:
        return web.packages(CACHE)
    except ValueError as error:
        pytest.skip(f"needs packages of npm: {error}")


def shipped(name):
    return lock_feet(jm.load(name, foot_lock=False))


def tick(character):
    commands = jm.commands("stand", character, 1, seconds=1.0)
    return jax.tree.map(lambda x: x[0, 0], commands)


def course(fps, labels):
    made = []
    for seconds, way, face, speed, label in COURSE:
        to = lambda x: [np.sin(np.radians(x)), np.cos(np.radians(x))]  # noqa: E731
        one = {
            "velocity": [speed * x for x in to(way)],
            "facing": to(face),
            "label": min(label, max(len(labels) - 1, 0)),
        }
        made += [one] * round(seconds * fps)
    return made


def play(packages, folder, **asked):
    """What Node says of it, and root and rotations if it wrote some."""
    done = subprocess.run(
        [
            *("node", str(Path(__file__).with_name("web.mjs"))),
            *(str(web.SOURCES), str(packages), str(folder)),
        ],
        input=json.dumps({"commands": [], **asked}),
        capture_output=True,
        text=True,
    )
    assert done.returncode == 0, done.stderr[-2000:]
    return json.loads(done.stdout)


def in_jax(character, steps, commands, noise, *, scale, locks, start=0):
    """The same by the functions that were exported, as the page calls them."""
    labels = character.labels or (None,)
    states = character.start(labels=list(range(len(labels))))
    names = [port.name for port in graph.ports({"state": states})]
    state = dict(zip(names, (x[start] for x in jax.tree.leaves(states)), strict=True))
    arguments = {
        "state": jax.tree.map(lambda x: x[0], states),
        "command": tick(character),
        **web.SETTINGS,
    }
    made = {
        name: graph.make(name, function, arguments)
        for name, function in web.functions(character, steps).items()
    }
    jitted = {name: jax.jit(one.run) for name, one in made.items()}
    at, shown = 0, []

    def call(name, told):
        nonlocal at
        given = []
        for port in made[name].inputs:
            if port.name.startswith("noise"):
                size = int(np.prod(port.shape))
                given.append(noise[at : at + size].reshape(port.shape))
                at += size
            else:
                given.append(state.get(port.name, told.get(port.name)))
        found = jitted[name](*given)
        named = [x.name.removeprefix(graph.OUT) for x in made[name].outputs]
        found = dict(zip(named, found, strict=True))
        state.update({name: x for name, x in found.items() if name in state})
        return found

    for one in commands:
        told = {
            "command.velocity": jnp.array(one["velocity"], jnp.float32),
            "command.facing": jnp.array(one["facing"], jnp.float32),
            "command.label": jnp.int32(one["label"]),
            "scale": jnp.float32(scale),
            "locks": jnp.bool_(locks),
        }
        if "step" in made:
            found = call("step", told)
        else:
            level = int(call("plan_level", told)["level"])
            if level:
                call("plan" if level == 1 else f"plan_{level}", told)
            found = call("advance", told)
        shown.append((found["frame.root_position"], found["frame.joint_rotation"]))
    return [np.stack(x) for x in zip(*shown, strict=True)], at


def angles(a, b):
    """Degrees between rotations of two columns."""

    def matrices(x):
        u = x[..., :3] / np.linalg.norm(x[..., :3], axis=-1, keepdims=True)
        v = x[..., 3:] - np.sum(u * x[..., 3:], axis=-1, keepdims=True) * u
        v /= np.linalg.norm(v, axis=-1, keepdims=True)
        return np.stack([u, v, np.cross(u, v)], axis=-1).astype(float)

    trace = np.einsum("...ij,...ij->...", matrices(a), matrices(b))
    return np.degrees(np.arccos(np.clip((trace - 1) / 2, -1, 1)))


def plays_as_jax_does(packages, folder, character, *, locks):
    """Whether ten seconds are the same with the same noise; prints by how much."""
    steps = character.tuning.own_steps
    commands = course(character.fps, character.labels)
    noise = np.random.default_rng(0).standard_normal(4_000_000, np.float32)
    noise.tofile(folder / "noise.f32")
    settings = {"scale": float(character.tuning.scale), "locks": locks}
    said = play(
        packages,
        folder,
        steps=steps,
        commands=commands,
        noise=str(folder / "noise.f32"),
        out=str(folder / "shown.f32"),
        **settings,
    )
    assert "error" not in said, said
    (roots, turns), used = in_jax(character, steps, commands, noise, **settings)
    assert said["noise"] == used <= len(noise)
    shown = np.fromfile(folder / "shown.f32", np.float32).reshape(len(roots), -1)
    away = np.linalg.norm(shown[:, :3] - roots, axis=-1).max()
    turned = angles(shown[:, 3:].reshape(turns.shape), turns).max()
    print(f"root {away:.2e} m, rotations {turned:.2e} degrees, {said}")
    assert np.ptp(roots[:, 2]) > 3
    assert away < 1e-3 and turned < 0.5
    return said


def moves_a_crowd_as_one_by_one(
    packages, folder, character, *, locks, scale=None, people=11
):
    """Whether one call for several gives each what a call of their own does."""
    scale = character.tuning.scale if scale is None else scale
    steps, noise = character.tuning.own_steps, folder / "noise.f32"
    np.random.default_rng(0).standard_normal(200_000, np.float32).tofile(noise)
    asked = {
        "steps": steps,
        "people": people,
        "commands": course(character.fps, character.labels),
        "noise": str(noise),
        "scale": float(scale),
        "locks": locks,
    }
    shown, said = [], []
    for several in (False, True):
        out = folder / "shown.f32"
        said.append(play(packages, folder, several=several, out=str(out), **asked))
        assert "error" not in said[-1], said
        frames = np.fromfile(out, np.float32)
        shown.append(frames.reshape(len(asked["commands"]), people, -1))
    alone, together = shown
    away = np.linalg.norm((together - alone)[..., :3], axis=-1).max(axis=0)
    turns = [x[..., 3:].reshape(*x.shape[:2], -1, 6) for x in shown]
    turned = angles(*turns).reshape(len(alone), people, -1).max(axis=(0, 2))
    print(f"root {away} m, rotations {turned} degrees, {said}")
    assert not said[0]["crowds"] and set(said[1]["crowds"]) == set(said[1]["graphs"])
    assert np.ptp(alone[..., 2]) > 3
    assert away.max() < 1e-3 and turned.max() < 0.5


def test_an_unknown_number_of_steps_is_one_line():
    character = strider()[0]
    assert web.step_choices(character, (2, 2, 8)) == (2, 8)
    with pytest.raises(ValueError, match="--steps has 9, expected some of 1, 2, 3"):
        web.step_choices(character, (9,))


def test_without_node_it_says_what_is_missing(monkeypatch):
    monkeypatch.setattr(onnx, "check", lambda: None)
    monkeypatch.setattr(shutil, "which", lambda name: None)
    with pytest.raises(
        ValueError, match="bundled by Node 20 or newer: node and npm not"
    ):
        web.check()


@pytest.mark.slow
def test_slim_graphs_are_what_they_were():
    """Half-precision constants are exact; loops keep their own names; less nodes."""
    pytest.importorskip("jax2onnx")
    runtime = pytest.importorskip("onnxruntime")
    draw = np.random.default_rng(0).standard_normal
    table = jnp.asarray(draw((40, 40)).astype(np.float16).astype(np.float32))
    fine = jnp.asarray(draw((40, 40)), jnp.float32)

    def run(x):
        step = lambda x, _: (jnp.tanh(x @ table + 0.1), x[0])  # noqa: E731
        x, path = jax.lax.scan(step, x @ fine, length=3)
        return x, path

    one = graph.make("run", Exported(run, ("x",), ("y", "path")), {"x": jnp.ones(40)})
    content, weights = onnx.content(one), slim.Weights("weights.bin")
    small = slim.slim(content, weights)
    size = lambda: sum(map(len, weights.packed()))  # noqa: E731
    assert size() == 40 * 40 * (2 + 4) and len(small) < 10_000
    assert sorted(weights.parts) == [(False, 6400), (True, 3200)]
    options = runtime.SessionOptions()
    options.add_external_initializers_from_files_in_memory(
        ["weights.bin"], [weights.content()], [len(weights.content())]
    )
    session = runtime.InferenceSession(small, options)
    x = np.asarray(draw(40), np.float32)
    for a, b in zip(session.run(None, {"x": x}), one.run(x), strict=True):
        np.testing.assert_allclose(a, b, atol=1e-5)
    # The same constant of another graph is not kept twice.
    slim.slim(content, weights)
    assert size() == 40 * 40 * (2 + 4)


@NODE
@pytest.mark.slow
def test_a_character_plays_in_the_browsers_runtime(packages, tmp_path):
    """One without a network, with a damaged, a missing and an unknown part as well."""
    character, folder = strider(ball=True)[0], tmp_path / "strider"
    web.write_character(folder, "strider", character, tick(character), steps=(2,))
    said = plays_as_jax_does(packages, folder, character, locks=False)
    assert said["graphs"] == ["plan_level", "plan@2", "advance", "plan@8"]
    # Another model of this skeleton adds no body.
    (body,) = tmp_path.glob("body.*")
    more = web.write_character(tmp_path / "b", "b", character, tick(character))
    assert body in more and [body] == [*tmp_path.glob("body.*")]
    moves_a_crowd_as_one_by_one(packages, folder, character, locks=False)
    path = folder / "advance.onnx.packed"
    path.write_bytes(web.pack(lzma.decompress(path.read_bytes())[:-400]))
    error = play(packages, folder)["error"]
    assert error.startswith("character/advance.onnx is no graph") and "\n" not in error
    path.unlink()
    assert "advance.onnx" in play(packages, folder)["error"]


@NODE
@pytest.mark.slow
@pytest.mark.long
@pytest.mark.parametrize("name", ["locomotion", "locomotion_fast", "dribble"])
def test_a_shipped_model_plays_as_in_jax(packages, tmp_path, name):
    character, folder = shipped(name), tmp_path / name
    web.write_character(folder, name, character, tick(character))
    plays_as_jax_does(packages, folder, character, locks=True)
    # Contact guidance decides by thresholds, and rounding may tip one: with it, one of
    # eleven gets a plan that is 2 mm away; without it, all agree to .1 mm.
    scale = 0.0 if name == "dribble" else None
    moves_a_crowd_as_one_by_one(packages, folder, character, locks=True, scale=scale)


@NODE
@pytest.mark.slow
@pytest.mark.long
def test_a_sampler_of_emdm_opens_in_the_browsers_runtime(packages, tmp_path):
    """No page shows it, but its graph is one that others may."""
    system = registry.get("emdm").room("evaluation")
    path = files.SHIPPED["actions"]
    functions, condition, _ = system.exports(path, row="emdm", scale=None)
    weights, graphs = slim.Weights(web.WEIGHTS), {}
    for name, function in functions.items():
        made = graph.make(name, function, {"condition": condition})
        small = slim.slim(onnx.content(made), weights)
        (tmp_path / f"{name}.onnx.packed").write_bytes(web.pack(small))
        graphs[name] = {"file": f"{name}.onnx", "inputs": [], "outputs": []}
    about = {"graphs": graphs, "runs": {1: list(graphs)}, "steps": [1]}
    names = [web.WEIGHTS, web.FINE]
    about |= {"weights": {"files": names, "parts": weights.parts}}
    content = web.packed.pack(about, {})
    (tmp_path / "character.bin.packed").write_bytes(web.pack(content))
    for file, content in zip(names, weights.packed(), strict=True):
        (tmp_path / f"{file}.packed").write_bytes(web.pack(content))
    said = play(packages, tmp_path, several=False)
    assert said["graphs"] == list(graphs) and "error" not in said
