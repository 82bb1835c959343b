"""The host's loop: resuming to the bit, stopping at NaN, Ctrl-C and kill -9."""

import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest

from jaxmotion.data import clips_io
from jaxmotion.learning import checkpoint, training
from jaxmotion.learning.loop import Loop, TrainingDiverged, train
from jaxmotion.systems import camdm, camdm_model
from tests import tiny

pytestmark = pytest.mark.usefixtures("quick_compile")
ROOT = Path(__file__).parents[2]


def loop_of(folder, num_steps, chunk=2, save_every=2):
    return Loop(
        num_steps=num_steps,
        chunk=chunk,
        save_every=save_every,
        folder=folder,
        config={"a": 1},
    )


def small_parts(bad_step=None):
    """A line fitted to points; from `bad_step` on (counted from 1) the loss is NaN."""

    def loss(params, key, batch):
        count, x = batch
        bad = jnp.zeros(()) if bad_step is None else jnp.where(count, jnp.nan, 0.0)
        value = jnp.mean((params["w"] * x - 2.0 * x) ** 2) + bad
        return value, {"other": 2.0 * value}

    optimizer = optax.adam(0.1)
    update = training.make_update(loss, optimizer)

    def counted(state, key, batch):
        is_bad = state.step + 1 >= (bad_step or 0)
        return update(state, key, (is_bad, batch))

    def sample_batch(key, data):
        return data[jax.random.randint(key, (4,), 0, data.shape[0])]

    run = training.train_chunk(counted, sample_batch, num_steps=2)
    state = training.init_train_state({"w": jnp.zeros(())}, optimizer)
    return run, state, jax.random.key(0), jnp.linspace(-1.0, 1.0, 32)


def rows(folder):
    return [json.loads(line) for line in open(folder / "losses.jsonl")]


def test_half_stop_restore_and_resume_is_the_whole_to_the_bit(tmp_path):
    """With the real loss and network; the second half starts from what is on disk."""
    config = tiny.config(dropout=0.1)
    run, state, key, data = tiny.training_parts(config, num_steps=3)
    fresh = lambda: jax.tree.map(jnp.copy, state)  # noqa: E731
    first = fresh()
    settings = dict(chunk=3, save_every=6)
    whole = train(run, fresh(), key, data, loop=loop_of(tmp_path / "a", 12, **settings))

    train(run, fresh(), key, data, loop=loop_of(tmp_path / "b", 6, **settings))
    assert checkpoint.latest_step(tmp_path / "b/checkpoints") == 6
    like = jax.tree.map(jnp.zeros_like, first)
    restored = checkpoint.restore(tmp_path / "b/checkpoints", like)
    # Through NumPy: arrays that are committed to a device would compile once more.
    restored = jax.tree.map(lambda x: jnp.asarray(np.asarray(x)), restored)
    resumed = train(
        run, restored, key, data, loop=loop_of(tmp_path / "b", 12, **settings)
    )
    assert whole.step == resumed.step == 12
    jax.tree.map(np.testing.assert_array_equal, resumed, whole)
    moved = jax.tree.map(
        lambda a, b: float(jnp.abs(a - b).max()), whole.params, first.params
    )
    assert max(jax.tree.leaves(moved)) > 1e-3
    strip = lambda folder: [  # noqa: E731
        {k: v for k, v in row.items() if k != "steps_per_second"}
        for row in rows(folder)
    ]
    assert strip(tmp_path / "a") == strip(tmp_path / "b")
    assert [row["step"] for row in rows(tmp_path / "a")] == [3, 6, 9, 12]
    assert {"loss", "data", "velocity", "foot", "grad_norm"} <= set(
        rows(tmp_path / "a")[0]
    )


def test_a_nan_loss_names_the_step_and_the_last_good_checkpoint(tmp_path):
    run, state, key, data = small_parts(bad_step=8)
    with pytest.raises(TrainingDiverged) as caught:
        train(run, state, key, data, loop=loop_of(tmp_path, 20, save_every=4))
    message = str(caught.value)
    assert "step 8" in message
    assert f"{tmp_path / 'checkpoints'} step 4" in message
    assert "'other': nan" in message
    assert checkpoint.latest_step(tmp_path / "checkpoints") == 4
    assert [row["step"] for row in rows(tmp_path)] == [2, 4, 6]


def test_a_nan_before_any_checkpoint(tmp_path):
    run, state, key, data = small_parts(bad_step=1)
    with pytest.raises(TrainingDiverged, match="step 1.*there is none"):
        train(run, state, key, data, loop=loop_of(tmp_path, 20))
    assert checkpoint.latest_step(tmp_path / "checkpoints") is None


def test_an_unwritable_folder_is_named_before_any_work(tmp_path):
    (tmp_path / "file").write_text("not a folder")
    _, state, key, data = small_parts()

    def run(*args):
        raise AssertionError("work was done")

    with pytest.raises(OSError, match=str(tmp_path / "file" / "run")):
        train(run, state, key, data, loop=loop_of(tmp_path / "file" / "run", 4))


@pytest.mark.parametrize("sizes", [(5, 2, 2), (4, 2, 3)])
def test_chunks_must_divide(tmp_path, sizes):
    num_steps, chunk, save_every = sizes
    run, state, key, data = small_parts()
    with pytest.raises(ValueError, match="multiples of the chunk"):
        train(
            run, state, key, data, loop=loop_of(tmp_path, num_steps, chunk, save_every)
        )


def test_the_end_is_saved_even_between_checkpoints(tmp_path):
    run, state, key, data = small_parts()
    final = train(run, state, key, data, loop=loop_of(tmp_path, 6, save_every=4))
    assert checkpoint.latest_step(tmp_path / "checkpoints") == 6
    assert checkpoint.load_config(tmp_path / "checkpoints") == {"a": 1}
    again = train(run, final, key, data, loop=loop_of(tmp_path, 6, save_every=4))
    assert again.step == 6


def test_ctrl_c_saves_what_was_reached(tmp_path):
    run, state, key, data = small_parts()
    calls = []

    def interrupted(*args):
        calls.append(1)
        if len(calls) == 3:
            os.kill(os.getpid(), signal.SIGINT)
        return run(*args)

    before = signal.getsignal(signal.SIGINT)
    settings = loop_of(tmp_path, 100, save_every=50)
    with pytest.raises(KeyboardInterrupt, match="step 6"):
        train(interrupted, state, key, data, loop=settings)
    assert signal.getsignal(signal.SIGINT) is before
    assert checkpoint.latest_step(tmp_path / "checkpoints") == 6
    _, like, _, _ = small_parts()
    saved = checkpoint.restore(tmp_path / "checkpoints", like)
    expected = like
    for _ in range(3):
        expected, _ = run(expected, key, data)
    jax.tree.map(np.testing.assert_array_equal, saved, expected)


def test_the_log_forgets_steps_that_no_checkpoint_has(tmp_path):
    run, state, key, data = small_parts()
    train(run, state, key, data, loop=loop_of(tmp_path, 4))
    with open(tmp_path / "losses.jsonl", "a") as log:
        log.write('{"step": 6, "loss": 1.0}\n{"step": 8, "lo')
    restored = checkpoint.restore(tmp_path / "checkpoints", small_parts()[1])
    train(run, restored, key, data, loop=loop_of(tmp_path, 8))
    assert [row["step"] for row in rows(tmp_path)] == [2, 4, 6, 8]


def command(folder, steps):
    sizes = "--width 16 --depth 1 --batch 2 --diffusion-steps 2 --contents"
    times = f"--chunk 1 --save-every 1 --steps {steps} --warmup 1"
    data = f"--data {folder.parent / 'walker.npz'} --out {folder} --held-out 0.5"
    line = f"experiments/camdm.py train {data} {sizes} {times}"
    return [sys.executable, *line.split()]


@pytest.mark.slow
def test_a_killed_training_goes_on_and_ends_as_if_nothing_had_been(tmp_path):
    clips_io.save_clips(tmp_path / "walker.npz", tiny.clips())
    steps = 40
    killed, whole = tmp_path / "killed", tmp_path / "whole"
    quick = os.environ | {"JAX_DISABLE_MOST_OPTIMIZATIONS": "1"}
    process = subprocess.Popen(command(killed, steps), cwd=ROOT, env=quick)
    give_up = time.monotonic() + 300
    reached = lambda: checkpoint.latest_step(killed / "checkpoints") or 0  # noqa: E731
    while reached() < 3 and process.poll() is None and time.monotonic() < give_up:
        time.sleep(0.05)
    process.send_signal(signal.SIGKILL)
    assert process.wait() == -signal.SIGKILL
    step = checkpoint.latest_step(killed / "checkpoints")
    assert 3 <= step < steps
    camdm_model.load(killed)

    for folder in (killed, whole):
        subprocess.run(command(folder, steps), cwd=ROOT, env=quick, check=True)
    states = []
    for folder in (killed, whole):
        model, _, config = camdm_model.load(folder)
        assert config["experiment"]["steps"] == steps
        assert checkpoint.latest_step(folder / "checkpoints") == steps
        params = jax.eval_shape(lambda m=model: camdm.init(jax.random.key(0), m.config))
        like = {"params": params, "ema_params": params}
        states.append(checkpoint.restore_part(folder / "checkpoints", like))
    jax.tree.map(np.testing.assert_array_equal, *states)
