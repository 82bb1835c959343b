"""Eight virtual devices, and two processes, give what one device gives."""

import os
import socket
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

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


def test_two_processes_train_as_one(single, tmp_path):
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port = probe.getsockname()[1]
    processes = [start("process", tmp_path / f"{i}.npz", port, i) for i in range(2)]
    try:
        for process in processes:
            finish(process)
    finally:
        for process in processes:
            process.kill()
    for i in range(2):
        compare(tmp_path / f"{i}.npz", single)
