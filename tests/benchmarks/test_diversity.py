"""benchmarks/diversity.py with few rollouts, and the arithmetic of its chunks."""

import dataclasses
import functools
import json
import os
import socket
import subprocess
import sys

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxmotion.motion.trajectory import Command
from jaxmotion.systems.camdm import controller as camdm_controller
from jaxmotion.systems.camdm import model as camdm_model
from tests import tiny
from tests.benchmarks.conftest import FOLDER

CONFIG = tiny.config(depth=1, heading="facing", num_steps=2)
CONTROL = camdm_controller.Control(apply=4, reuse=6)
TICKS = 10


@pytest.mark.slow
def test_the_script_measures_and_says_what_it_has_no_parameters_for(tmp_path):
    arguments = ["--rollouts", 4, 2, "--sets", 2, "--seconds", 0.4, "--every", 4]
    arguments += ["--steps", 4, 8, "--guidance", 0, 1, "--pairs", 50, "--chunk", 2]
    printed = subprocess.run(
        [sys.executable, FOLDER / "diversity.py", *map(str, arguments)]
        + ["--out", str(tmp_path)],
        capture_output=True,
        text=True,
        check=True,
        env=os.environ | {"JAX_PLATFORMS": "cpu"},
    ).stdout
    value = json.loads((tmp_path / "diversity.json").read_text())
    rows = value["rows"]
    assert [name.split(" (")[0] for name in rows] == [
        *("2 rollouts", "4 rollouts", "4 steps", "8 steps"),
        *("guidance 0", "guidance 1"),
    ]
    assert rows["4 steps (no parameters: give --step-runs)"] == {}
    whole = rows["4 rollouts"]
    assert list(whole) == ["world_m", "pose_m", "diversity_m", "variance_m2"]
    assert all(cell["value"] > 0 and cell["samples"] == 2 for cell in whole.values())
    # A scale of 1 is no guidance, by another program's branch; 0 forgets the past.
    for column, cell in whole.items():
        one = rows["guidance 1"][column]["value"]
        assert one == pytest.approx(cell["value"], rel=1e-2), column
        assert rows["guidance 0"][column]["value"] != pytest.approx(one, rel=5e-3)
    (memory,) = value["memory"]
    assert memory["chunk"] == 2 and memory["total"] > memory["results"] > 0
    assert value["seeds"] == [0, 1]
    assert value["peak_memory"]["bytes"] > memory["total"]
    assert "commit" in value and value["environment"]["jax"]
    assert (tmp_path / "diversity.md").read_text().strip() in printed
    assert "2 rollouts at a time" in printed


def test_measures_of_a_known_set(load):
    """Two groups that stand 0.5 m apart, with the same pose in both."""
    workload = load("diversity")
    pose = np.random.default_rng(0).normal(size=(1, 3, 4, 3))
    pose = np.broadcast_to(pose, (8, 3, 4, 3)).astype(np.float32)
    world = pose + np.repeat([[0.0, 0, 0], [0.3, 0, 0.4]], 4, axis=0)[:, None, None]
    motions = workload.Motions(
        world=jnp.asarray(world, jnp.float32), pose=jnp.asarray(pose)
    )
    found = workload.measure(jax.random.key(0), motions, num_pairs=4000)
    # 4 of the 7 others stand in the other group.
    error = 0.5 * np.sqrt(4 / 7 * 3 / 7 / 4000)
    assert abs(float(found["world_m"]) - 0.5 * 4 / 7) < 4 * error
    for name in ("pose_m", "diversity_m", "variance_m2"):
        assert float(found[name]) == pytest.approx(0.0, abs=1e-6), name


def test_chunks_shrink_to_the_limit(load):
    memory = load("suite")
    needs = dict(chunk=64, arguments=10, results=20, intermediate=6400, total=6430)
    assert memory.next_chunk(needs, 3230.0) == 32
    assert memory.next_chunk(needs, 530.0) == 5
    assert memory.next_chunk(needs, 6429.0) == 32
    assert memory.next_chunk(needs, 31.0) == 1
    for case in (needs, needs | dict(chunk=1)):
        with pytest.raises(ValueError, match="--memory-gib .*: expected a higher"):
            memory.next_chunk(case, 29.0)
    with pytest.raises(ValueError, match="one rollout at a time"):
        memory.next_chunk(needs | dict(chunk=1), 5000.0)


def test_the_program_that_fits_is_found(load):
    """For a program that holds `chunk` matrices at a time."""
    memory = load("suite")
    tried = []

    def compiled(size):
        tried.append(size)
        one = lambda i: jnp.sum(jnp.linalg.qr(jnp.eye(64) + i)[0])  # noqa: E731
        run = jax.jit(lambda x: jax.lax.map(one, x, batch_size=size))
        return run.lower(jnp.arange(64.0)).compile()

    most = memory.needs_of(compiled(64), 64)["total"]
    assert most > 64 * 64 * 64 * 4
    for limit in (most / 3, most / 20):
        tried.clear()
        program, needs = memory.fit(compiled, 64, limit=limit, shrink=True)
        assert needs["total"] <= limit
        assert tried[-1] == needs["chunk"] < 64
        assert memory.needs_of(compiled(4 * needs["chunk"]), 1)["total"] > limit
        assert program(jnp.arange(64.0)).shape == (64,)
    with pytest.raises(ValueError, match="--chunk 64: .* more than --memory-gib"):
        memory.fit(compiled, 64, limit=most / 3, shrink=False)


def run_main(load, monkeypatch, *arguments):
    monkeypatch.setattr(sys, "argv", ["diversity.py", *map(str, arguments)])
    load("diversity").main()


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (["--rollouts", 1], "--rollouts 1: expected 2 or more"),
        (["--sets", 1], "--sets 1: expected 2 or more"),
        (["--every", 0], "--every 0"),
        (["--memory-gib", 0], "--memory-gib 0.0: expected more than 0"),
        (["--chunk", 0], "--chunk 0"),
        (["--run", "no/such.npz"], "no/such.npz: no such file"),
        (["--course", "zigzag"], "--course zigzag: there are straight"),
    ],
)
def test_bad_input_is_named_before_the_work(
    load, monkeypatch, tmp_path, arguments, message
):
    with pytest.raises(ValueError, match=message):
        run_main(load, monkeypatch, *arguments, "--out", tmp_path)


@pytest.fixture(scope="module")
def small(load, skeleton):
    """`one_rollout` of a small model, and keys and states to map it over."""
    workload = load("diversity")
    model = camdm_model.Model(
        config=CONFIG, skeleton=skeleton, labels=tiny.STYLES, source="made in the tests"
    )
    state = camdm_controller.init_state(skeleton, tiny.walk(CONFIG.past), config=CONFIG)
    ahead = jnp.broadcast_to(jnp.array([0.0, 1.0]), (TICKS, 2))
    commands = Command(velocity=ahead, facing=ahead, label=jnp.zeros(TICKS, jnp.int32))
    given = workload.Load(
        name="small",
        model=model,
        params=tiny.random_params(camdm_model.init, CONFIG),
        state=state,
        commands=commands,
    )

    def one(key, state):
        return workload.one_rollout(
            given.params,
            key,
            dataclasses.replace(given, state=state),
            control=CONTROL,
            guided=0,
            every=4,
        )

    return one, state


@pytest.mark.slow
def test_planners_stay_conditions_in_many_rollouts(small):
    """As long as only the keys differ; with other states all of them would run."""
    one, state = small
    shared = jax.vmap(functools.partial(one, state=state))
    keys = jax.random.split(jax.random.key(0), 3)
    assert " cond[" in str(jax.make_jaxpr(shared)(keys))
    states = jax.tree.map(lambda x: jnp.stack([x] * 3), state)
    # All branches then take the same key, which the checks of the tests refuse.
    with jax.debug_key_reuse(False):
        assert " cond[" not in str(jax.make_jaxpr(jax.vmap(one))(keys, states))


@pytest.mark.slow
def test_chunks_do_not_change_a_rollout(small):
    one, state = small
    keys = jax.random.split(jax.random.key(0), 5)

    @functools.partial(jax.jit, static_argnums=1)
    def run(keys, chunk):
        return jax.lax.map(lambda k: one(k, state), keys, batch_size=chunk)

    whole, parts = run(keys, 5), run(keys, 2)
    # Frames 1, 5 and 9 of ten: every fourth, and the last.
    assert whole.world.shape == whole.pose.shape == (5, 3, len(tiny.NAMES), 3)
    for a, b in zip(whole, parts, strict=True):
        np.testing.assert_allclose(a, b, atol=1e-4)
    assert np.std(whole.world, axis=0).max() > 1e-3
    # The root of a pose stands at its height above the origin.
    np.testing.assert_allclose(whole.pose[:, :, 0, 1], whole.world[:, :, 0, 1])
    np.testing.assert_array_equal(whole.pose[:, :, 0, ::2], 0.0)


@pytest.mark.slow
def test_two_processes_end_with_the_moments_of_one(tmp_path):
    """To the bit: rollout i draws what it draws alone, in chunks of the same size."""
    arguments = ["--rollouts", 8, "--stream", 24, "--seconds", 0.4, "--every", 4]
    arguments += ["--pairs", 20, "--chunk", 2]
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        address = f"127.0.0.1:{free.getsockname()[1]}"

    def run(out, *more):
        command = [sys.executable, FOLDER / "diversity.py", *map(str, arguments)]
        return subprocess.Popen(
            [*command, "--out", tmp_path / out, *more],
            env=os.environ | {"JAX_PLATFORMS": "cpu"},
        )

    shared = [run("two", "--distributed", address, "2", str(i)) for i in range(2)]
    for process in (*shared, run("one")):
        assert process.wait(timeout=600) == 0
    one, two = (np.load(tmp_path / x / "diversity_stream.npz") for x in ("one", "two"))
    moments = [
        name for name in one.files if name.endswith(("count", "mean", "squares"))
    ]
    assert "pose_mean" in moments and one["pose_count"] == 24
    for name in moments:
        np.testing.assert_array_equal(one[name], two[name], err_msg=name)
