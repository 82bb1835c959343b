"""What a figure was made with."""

import datetime
import importlib.metadata
import os
import platform
import subprocess
import sys
from pathlib import Path
from typing import Any

import jax

_PACKAGES = ("jaxmotion", "jax", "jaxlib", "flax", "optax", "numpy")


def processor() -> str:
    """Name of the processor.

    Returns:
      As Linux or Python name it.
    """
    try:
        lines = Path("/proc/cpuinfo").read_text().splitlines()
        return next(x.split(":")[1].strip() for x in lines if "model name" in x)
    except (OSError, StopIteration):
        return platform.processor()


def git_commit() -> str | None:
    """Commit of this code.

    Returns:
      Its hash, with "+" behind it if files differ from it; None outside a repository.
    """

    def git(*words: str) -> str:
        found = subprocess.run(
            ["git", *words],
            cwd=Path(__file__).parent,
            capture_output=True,
            text=True,
            check=True,
        )
        return found.stdout.strip()

    try:
        changed = git("status", "--porcelain", "--untracked-files=no")
        return git("rev-parse", "HEAD") + ("+" if changed else "")
    except (OSError, subprocess.CalledProcessError):
        return None


def provenance() -> dict[str, Any]:
    """What a table was made with.

    Returns:
      Versions, hardware, commit, command and date, as a JSON object.
    """
    found: dict[str, Any] = {"python": platform.python_version()}
    for name in _PACKAGES:
        try:
            found[name] = importlib.metadata.version(name)
        except importlib.metadata.PackageNotFoundError:
            found[name] = None
    return found | {
        "machine": platform.machine(),
        "cpu": processor(),
        "cores": os.cpu_count(),
        "devices": [str(device) for device in jax.devices()],
        "git_commit": git_commit(),
        "command": " ".join(["python", *sys.argv]),
        "date": datetime.datetime.now(datetime.UTC).isoformat(timespec="seconds"),
    }
