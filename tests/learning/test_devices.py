"""Eight virtual devices, and several processes, give what one device gives."""

import os
import socket
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest

from jaxmotion.data import clips_io, procedural
from jaxmotion.data.ball_clips import save_ball_clips
from jaxmotion.learning import checkpoint, loop
from tests import ball_walker, tiny

pytestmark = pytest.mark.slow

ROOT = Path(__file__).parents[2]


def start(*arguments, flags=""):
    environment = os.environ | {
        "XLA_FLAGS": flags,
        "JAX_PLATFORMS": "cpu",
        "JAX_DISABLE_MOST_OPTIMIZATIONS": "1",
    }
    command = [sys.executable, "-m", "tests.workers", *map(str, arguments)]
    return subprocess.Popen(
        command, cwd=ROOT, env=environment, stderr=subprocess.PIPE, text=True
    )


def finish(process):
    _, errors = process.communicate(timeout=300)
    assert process.returncode == 0, errors


def compare(found, expected):
    with np.load(found) as a, np.load(expected) as b:
        assert a.files
        for name in a.files:
            np.testing.assert_allclose(
                a[name], b[name], atol=1e-5, rtol=1e-5, err_msg=name
            )


@pytest.fixture(scope="module")
def single(tmp_path_factory):
    path = tmp_path_factory.mktemp("single") / "single.npz"
    finish(start("single", path))
    with np.load(path) as result:
        losses = result["['info']['loss']"]
        assert losses.shape == (4,) and np.ptp(losses) > 1e-2
        planned = result["['frames'].planned"]
        assert 0.2 < planned.mean() < 0.8
    return path


def test_eight_devices_train_and_roll_out_as_one(single, tmp_path):
    flags = "--xla_force_host_platform_device_count=8"
    finish(start("mesh", tmp_path / "mesh.npz", flags=flags))
    compare(tmp_path / "mesh.npz", single)


def free_port():
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return probe.getsockname()[1]


TRAIN = (
    "experiments/camdm.py train --held-out 0.5 --contents --network mlp --width 16 "
    "--depth 1 --batch 8 --warmup 1 --diffusion-steps 2 --chunk 5 --save-every 10 "
)


# The other systems train several stages, which hand over to each other.
OTHERS = {
    "aamdm": "--field style --labels --rows aamdm --autoencoder-steps 4 "
    "--polisher-steps 4 --generator-steps 4 --batch 4 --width 32",
    "emdm": "--task action --field style --least 2 --held-out 0.3 --frames 20 --merge "
    "--rows emdm ddpm_50 --steps 4 --ddpm-steps 4 --batch 4 --width 8 --depth 1 "
    "--hidden 8 --discriminator-width 64",
    "smgdiff": "--width 8 --depth 1 --steps 4 --draft-steps 4 --path-steps 4 "
    "--batch 4 --held-out 0.3",
}


def start_training(folder, out, steps, processes, more=""):
    """Starts the processes of one training of CAMDM."""
    line = f"{TRAIN} --data {folder}/clips.npz --out {out} --steps {steps} {more}"
    return start_processes(line, processes)


def start_processes(line, processes):
    """Starts the processes of a script."""
    environment = os.environ | {
        "JAX_PLATFORMS": "cpu",
        "JAX_DISABLE_MOST_OPTIMIZATIONS": "1",
    }
    port = free_port()

    def one(index):
        joined = f" --distributed 127.0.0.1:{port} {processes} {index}"
        return subprocess.Popen(
            [sys.executable, *(line + joined * (processes > 1)).split()],
            cwd=ROOT,
            env=environment,
            stdout=subprocess.DEVNULL,
            stderr=subprocess.PIPE,
            text=True,
        )

    return [one(index) for index in range(processes)]


def losses_of(out):
    return [row["loss"] for row in loop.read_losses(out / "motion" / "losses.jsonl")]


@pytest.fixture(scope="module")
def alone(tmp_path_factory):
    """A folder with clips, and a training of 20 steps by one process."""
    folder = tmp_path_factory.mktemp("alone")
    clips_io.save_clips(folder / "clips.npz", tiny.clips())
    finish(*start_training(folder, folder / "run", 20, 1))
    return folder


@pytest.mark.parametrize("processes", [2, 4])
def test_processes_of_the_script_train_as_one(alone, tmp_path, processes):
    for process in start_training(alone, tmp_path, 20, processes):
        finish(process)
    found = losses_of(tmp_path)
    assert len(found) == 4
    np.testing.assert_allclose(found, losses_of(alone / "run"), rtol=1e-5)


@pytest.mark.parametrize(
    "system",
    ["aamdm", *(pytest.param(x, marks=pytest.mark.long) for x in ("emdm", "smgdiff"))],
)
def test_stages_of_other_systems_train_as_one(system, tmp_path):
    clips = tmp_path / "clips.npz"
    if system == "smgdiff":
        save_ball_clips(clips, ball_walker.clips(80))
    else:
        clips_io.save_clips(clips, procedural.make_clips(minutes=2.0))
    line = f"experiments/{system}.py train --data {clips} {OTHERS[system]}"
    for processes in (1, 2):
        for process in start_processes(
            f"{line} --out {tmp_path}/{processes}", processes
        ):
            finish(process)
    alone = sorted((tmp_path / "1").rglob("losses.jsonl"))
    assert len(alone) == {"aamdm": 3, "emdm": 2, "smgdiff": 3}[system]
    for path in alone:
        together = tmp_path / "2" / path.relative_to(tmp_path / "1")
        found, expected = (loop.read_losses(x)[-1] for x in (together, path))
        assert found["step"] == expected["step"] == 4
        assert found["loss"] == pytest.approx(expected["loss"], rel=5e-3), path


def test_a_killed_process_ends_the_run_and_it_resumes(alone, tmp_path):
    first, second = start_training(alone, tmp_path, 10**6, 2)
    folder = tmp_path / "motion" / "checkpoints"
    try:
        while not (folder / "10").is_dir():
            assert first.poll() is None and second.poll() is None
            time.sleep(0.2)
        second.kill()
        _, errors = first.communicate(timeout=120)
    finally:
        first.kill()
        second.kill()
    assert first.returncode == 1
    assert errors.splitlines()[-1].startswith("process 0 of 2: error: "), errors
    done = checkpoint.latest_step(folder)
    for process in start_training(alone, tmp_path, done + 5, 2, "--override"):
        finish(process)
    assert checkpoint.latest_step(folder) == done + 5


def test_two_processes_train_as_one(single, tmp_path):
    port = free_port()
    processes = [start("process", tmp_path / f"{i}.npz", port, i) for i in range(2)]
    try:
        for process in processes:
            finish(process)
    finally:
        for process in processes:
            process.kill()
    for i in range(2):
        compare(tmp_path / f"{i}.npz", single)
