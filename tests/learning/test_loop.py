"""The host's loop: resuming to the bit, stopping at NaN, Ctrl-C and kill -9."""

import functools
import json
import os
import shutil
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
from jaxmotion.learning.loop import (
    Loop,
    TrainingDiverged,
    _Pieces,
    check_writable,
    train,
)
from jaxmotion.systems.camdm import model as camdm_model
from tests import mostly_slow, tiny

ROOT = Path(__file__).parents[2]


def loop_of(folder, num_steps, chunk=2, save_every=2):
    return Loop(
        num_steps=num_steps,
        chunk=chunk,
        save_every=save_every,
        folder=folder,
        config={"a": 1},
    )


@functools.cache
def small_program(bad_step):
    """Two updates of a line that is fitted to points, and their optimizer."""

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

    return training.train_chunk(counted, sample_batch, num_steps=2), optimizer


def small_parts(bad_step=None):
    """A line fitted to points; from `bad_step` on (counted from 1) the loss is NaN."""
    run, optimizer = small_program(bad_step)
    state = training.init_train_state({"w": jnp.zeros(())}, optimizer)
    return run, state, jax.random.key(0), jnp.linspace(-1.0, 1.0, 32)


def rows(folder):
    return [json.loads(line) for line in open(folder / "losses.jsonl")]


@pytest.mark.parametrize("kind", mostly_slow(["line", "network"], ["line"]))
def test_half_stop_restore_and_resume_is_the_whole_to_the_bit(tmp_path, kind):
    """The second half starts from what is on disk."""
    chunk, terms = 2, {"loss", "other", "grad_norm"}
    run, state, key, data = small_parts()
    if kind == "network":
        chunk, terms = 3, {"loss", "data", "velocity", "foot", "grad_norm"}
        config = tiny.config(dropout=0.1, depth=1)
        run, state, key, data = tiny.training_parts(config, num_steps=3)
    fresh = lambda: jax.tree.map(jnp.copy, state)  # noqa: E731
    first = fresh()
    settings = dict(chunk=chunk, save_every=6)
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
    steps = [row["step"] for row in rows(tmp_path / "a")]
    assert steps == list(range(chunk, 13, chunk))
    assert terms <= set(rows(tmp_path / "a")[0])


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


@pytest.mark.parametrize("bad_step", [1, 2])  # 2: of a chunk in two pieces
def test_a_nan_before_any_checkpoint(tmp_path, bad_step):
    run, state, key, data = small_parts(bad_step=bad_step)
    with pytest.raises(TrainingDiverged, match=f"at step {bad_step}:.*there is none"):
        train(run, state, key, data, loop=loop_of(tmp_path, 20))
    assert checkpoint.latest_step(tmp_path / "checkpoints") is None


def test_an_unwritable_folder_is_named_before_any_work(tmp_path):
    (tmp_path / "file").write_text("not a folder")
    _, state, key, data = small_parts()

    def run(*args):
        raise AssertionError("work was done")

    with pytest.raises(OSError, match=str(tmp_path / "file" / "run")):
        train(run, state, key, data, loop=loop_of(tmp_path / "file" / "run", 4))


def test_chunks_need_not_divide(tmp_path):
    run, state, key, data = small_parts()
    settings = loop_of(tmp_path, 7, chunk=2, save_every=3)
    final = train(run, state, key, data, loop=settings)
    assert final.step == 7
    assert [row["step"] for row in rows(tmp_path)] == [2, 3, 5, 6, 7]
    assert checkpoint.latest_step(tmp_path / "checkpoints") == 7
    at_6 = checkpoint.restore(tmp_path / "checkpoints", small_parts()[1], step=6)
    assert at_6.step == 6


def test_the_end_is_saved_even_between_checkpoints(tmp_path):
    run, state, key, data = small_parts()
    final = train(run, state, key, data, loop=loop_of(tmp_path, 6, save_every=4))
    assert checkpoint.latest_step(tmp_path / "checkpoints") == 6
    assert checkpoint.load_config(tmp_path / "checkpoints") == {"a": 1}
    again = train(run, final, key, data, loop=loop_of(tmp_path, 6, save_every=4))
    assert again.step == 6


def test_ctrl_c_saves_what_was_reached(tmp_path):
    run, state, key, data = small_parts()

    def interrupted(state, *args):
        if int(state.step) == 4:
            os.kill(os.getpid(), signal.SIGINT)
        return run(state, *args)

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


def test_ctrl_c_within_the_last_chunk_ends_the_script(tmp_path):
    """Which would go on with its next stage; the one that ends is saved."""
    run, state, key, data = small_parts()

    def interrupted(state, *args):
        if int(state.step) == 4:
            os.kill(os.getpid(), signal.SIGINT)
        return run(state, *args)

    settings = loop_of(tmp_path, 6, save_every=50)
    with pytest.raises(KeyboardInterrupt, match="step 6"):
        train(interrupted, state, key, data, loop=settings)
    assert checkpoint.latest_step(tmp_path / "checkpoints") == 6


def test_pieces_last_a_second_and_grow_fourfold_at_most():
    pieces, sizes = _Pieces(1000), []
    for seconds in (40.0, 0.001, 0.01, 2.0, 30.0):  # the first one is compiled
        pieces.note(pieces.size, seconds)
        sizes.append(pieces.size)
    assert sizes == [1, 4, 16, 8, 1]


def test_the_log_forgets_steps_that_no_checkpoint_has(tmp_path):
    run, state, key, data = small_parts()
    train(run, state, key, data, loop=loop_of(tmp_path, 4))
    with open(tmp_path / "losses.jsonl", "a") as log:
        log.write('{"step": 6, "loss": 1.0}\n{"step": 8, "lo')
    restored = checkpoint.restore(tmp_path / "checkpoints", small_parts()[1])
    train(run, restored, key, data, loop=loop_of(tmp_path, 8))
    assert [row["step"] for row in rows(tmp_path)] == [2, 4, 6, 8]


@pytest.mark.slow
def test_a_chunk_in_pieces_is_the_whole_to_the_bit():
    config = tiny.config(dropout=0.1)
    run, state, key, data = tiny.training_parts(config, num_steps=6)
    fresh = lambda: jax.tree.map(jnp.copy, state)  # noqa: E731
    whole, rows = run(fresh(), key, data, 6)
    scanned, _ = run(fresh(), key, data)
    part, found = fresh(), []
    for count in (1, 3, 2):
        part, info = run(part, key, data, count)
        found.append(jax.tree.map(lambda x, n=count: np.asarray(x)[:n], info))
        assert not np.any(np.asarray(info["loss"])[count:])
    jax.tree.map(np.testing.assert_array_equal, part, whole)
    joined = jax.tree.map(lambda *x: np.concatenate(x), *found)
    jax.tree.map(np.testing.assert_array_equal, joined, rows)
    # Another program: equal up to how the compiler fused it.
    close = lambda a, b: np.testing.assert_allclose(a, b, rtol=1e-4, atol=1e-6)  # noqa: E731
    jax.tree.map(close, scanned.params, whole.params)


@pytest.mark.slow
def test_compiling_is_announced_and_the_bar_moves_from_the_first_step(tmp_path, capsys):
    run, state, key, data = small_parts()
    counts, seen = [], []

    def slow(state, key, data, count):
        counts.append(count)
        seen.append(capsys.readouterr().err)
        time.sleep(0.4 * count)
        return run(state, key, data, count)

    train(slow, state, key, data, loop=loop_of(tmp_path, 4))
    assert seen[0].startswith("compiling the training step, about ")
    assert "first step after" in seen[1] and "1/4" in seen[1]
    assert counts[:2] == [1, 1] and sum(counts) == 4


def test_a_finished_run_is_not_compiled_again(tmp_path, capsys):
    run, state, key, data = small_parts()
    final = train(run, state, key, data, loop=loop_of(tmp_path, 4))
    capsys.readouterr()

    def never(*_):
        raise AssertionError("work was done")

    train(never, final, key, data, loop=loop_of(tmp_path, 4))
    assert "compiling" not in capsys.readouterr().err
    with pytest.raises(ValueError, match="has 4 steps, expected at most the 2"):
        train(never, final, key, data, loop=loop_of(tmp_path, 2))


def test_two_trainings_do_not_share_a_folder(tmp_path):
    run, state, key, data = small_parts()
    loop = loop_of(tmp_path, 4)

    def meanwhile(*given):
        with pytest.raises(ValueError, match="another training is under way here"):
            train(run, *small_parts()[1:], loop=loop)
        return run(*given)

    train(meanwhile, state, key, data, loop=loop)
    assert [row["step"] for row in rows(tmp_path)] == [2, 4]


@pytest.mark.parametrize("field", ["num_steps", "chunk", "save_every"])
def test_zero_is_refused_before_the_first_chunk(tmp_path, field):
    """save_every=0 divided by zero after it, and the chunk was lost."""
    sizes = {"num_steps": 4, "chunk": 2, "save_every": 2} | {field: 0}
    with pytest.raises(ValueError, match=f"{field} is 0, expected at least 1"):
        loop_of(tmp_path, **sizes)


@pytest.mark.slow
@pytest.mark.parametrize("line", ["5", "null", "[2]", "{}", '{"step": "2"}', "loss"])
def test_a_row_of_the_log_that_is_none_is_named(tmp_path, line):
    run, state, key, data = small_parts()
    state = train(run, state, key, data, loop=loop_of(tmp_path, 4))
    path = tmp_path / "losses.jsonl"
    whole = path.read_text() + line + "\n"
    path.write_text(whole)
    with pytest.raises(ValueError, match=f"{path}: line 3 is .*'step'"):
        train(run, state, key, data, loop=loop_of(tmp_path, 8))
    assert path.read_text() == whole


def test_the_log_is_replaced_whole(tmp_path, monkeypatch):
    """A kill while rows after the checkpoint are dropped leaves the log as it was."""
    run, state, key, data = small_parts()
    state = train(run, state, key, data, loop=loop_of(tmp_path, 4))
    path = tmp_path / "losses.jsonl"
    whole = path.read_text() + '{"step": 6, "loss": 1.0}\n'
    path.write_text(whole)

    def killed(*_):
        raise SystemExit

    monkeypatch.setattr(os, "replace", killed)
    with pytest.raises(SystemExit):
        train(run, state, key, data, loop=loop_of(tmp_path, 8))
    assert path.read_text() == whole


def test_checking_a_folder_does_not_make_it(tmp_path):
    check_writable(tmp_path / "a" / "b")
    check_writable(tmp_path)
    assert list(tmp_path.iterdir()) == []


FILLED = """
import resource, sys
from pathlib import Path
from tests.learning import test_loop
from jaxmotion import cli
def main():
    run, state, key, data = test_loop.small_parts()
    def fill(state, *rest):
        if int(state.step) == 2:
            resource.setrlimit(resource.RLIMIT_FSIZE, (1024, 1024))
        return run(state, *rest)
    loop = test_loop.loop_of(Path(sys.argv[1]), 6)
    test_loop.train(fill, state, key, data, loop=loop)
cli.start(main)
"""


@pytest.mark.slow
def test_a_disk_that_takes_no_more_ends_in_one_line_and_keeps_the_checkpoint(tmp_path):
    """A limit on the size of files needs no rights to set."""
    command = [sys.executable, "-c", FILLED, str(tmp_path)]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True)
    assert done.returncode == 1, done.stderr
    line = done.stderr.strip().splitlines()[-1]
    folder = tmp_path / "checkpoints"
    assert line.startswith(f"error: {folder}: cannot write step 4: ")
    assert line.endswith("last good checkpoint: step 2")
    assert checkpoint.latest_step(folder) == 2


def test_a_full_disk_is_noticed_before_a_checkpoint_is_begun(tmp_path, monkeypatch):
    run, state, key, data = small_parts()

    def fill(state, *rest):
        if int(state.step) == 2:
            full = shutil._ntuple_diskusage(9, 9, 9)
            monkeypatch.setattr(shutil, "disk_usage", lambda _: full)
        return run(state, *rest)

    message = "disk full: step 4 needs 0.0 MB, 0.0 MB are free.*checkpoint: step 2$"
    with pytest.raises(OSError, match=message):
        train(fill, state, key, data, loop=loop_of(tmp_path, 6))
    assert checkpoint.latest_step(tmp_path / "checkpoints") == 2


def test_a_full_disk_under_the_log_names_it(tmp_path):
    run, state, key, data = small_parts()
    log = tmp_path / "losses.jsonl"

    def fill(*args):
        if not log.exists():
            log.symlink_to("/dev/full")
        return run(*args)

    with pytest.raises(OSError, match=f"No space left on device: '{log}'"):
        train(fill, state, key, data, loop=loop_of(tmp_path, 4))


def command(folder, steps):
    sizes = "--width 16 --depth 1 --batch 2 --diffusion-steps 2 --contents"
    times = f"--chunk 1 --save-every 1 --steps {steps} --warmup 1"
    data = f"--data {folder.parent / 'walker.npz'} --out {folder} --held-out 0.5"
    line = f"experiments/camdm.py train {data} {sizes} {times}"
    return [sys.executable, *line.split()]


@pytest.mark.slow
def test_a_killed_training_goes_on_and_ends_as_if_nothing_had_been(tmp_path):
    clips_io.save_clips(tmp_path / "walker.npz", tiny.clips())
    steps = 16
    killed, whole = tmp_path / "killed", tmp_path / "whole"
    quick = os.environ | {"JAX_DISABLE_MOST_OPTIMIZATIONS": "1"}
    process = subprocess.Popen(command(killed, steps), cwd=ROOT, env=quick)
    give_up = time.monotonic() + 300
    stage = killed / "motion" / "checkpoints"
    # Names alone: a manager would stumble over steps that are being removed.
    reached = lambda: any((stage / str(i)).exists() for i in range(3, steps))  # noqa: E731
    while not reached() and process.poll() is None and time.monotonic() < give_up:
        time.sleep(0.05)
    process.send_signal(signal.SIGKILL)
    assert process.wait() == -signal.SIGKILL
    step = checkpoint.latest_step(killed / "motion" / "checkpoints")
    assert 3 <= step < steps
    camdm_model.load(killed)

    for folder in (killed, whole):
        subprocess.run(command(folder, steps), cwd=ROOT, env=quick, check=True)
    states = []
    for folder in (killed, whole):
        model, _ = camdm_model.load(folder)
        stage = folder / "motion" / "checkpoints"
        assert checkpoint.latest_step(stage) == steps
        params = jax.eval_shape(
            lambda m=model: camdm_model.init(jax.random.key(0), m.config)
        )
        like = {"params": params, "ema_params": params}
        states.append(checkpoint.restore_part(stage, like))
    jax.tree.map(np.testing.assert_array_equal, *states)


def test_parameters_that_are_not_finite_are_not_saved(tmp_path):
    """The root of a square is finite at zero, and its gradient there is none."""

    def loss(params, key, batch):
        return jnp.sqrt(params["w"] ** 2), {}

    optimizer = optax.sgd(1.0)
    update = training.make_update(loss, optimizer)
    state = training.init_train_state({"w": jnp.float32(1.0)}, optimizer)
    run = training.train_chunk(update, lambda key, data: data, num_steps=1)
    place = Loop(num_steps=2, chunk=1, save_every=1, folder=tmp_path, config={})
    message = "parameters are not finite after step 2; last good checkpoint: .* step 1"
    with pytest.raises(TrainingDiverged, match=message):
        train(run, state, jax.random.key(0), jnp.zeros(1), loop=place)
    assert checkpoint.latest_step(tmp_path / "checkpoints") == 1
