"""Trainings that are killed at random times end as if nothing had been.

As a program it makes more kills: python -m tests.experiments.test_kills FOLDER camdm=20
"""

import json
import os
import random
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from jaxmotion.data import clips_io, procedural
from jaxmotion.data.ball_clips import save_ball_clips
from jaxmotion.learning import checkpoint
from tests import ball_walker, tiny

ROOT = Path(__file__).parents[2]
# Tiny models, of stages that save every 1000 updates but for CAMDM's.
COMMANDS = {
    "camdm": "--held-out 0.5 --contents --width 16 --depth 1 --batch 2 --warmup 1 "
    "--diffusion-steps 2 --chunk 2 --save-every 4 --steps 200",
    "aamdm": "--field style --labels --rows aamdm --autoencoder-steps 2500 "
    "--polisher-steps 2500 --generator-steps 2500 --batch 4 --width 32",
    "emdm": "--task action --field style --least 2 --held-out 0.3 --frames 20 --merge "
    "--rows emdm ddpm_50 --steps 2500 --ddpm-steps 2500 --batch 2 --width 8 --depth 1 "
    "--hidden 8 --discriminator-width 64",
    "smgdiff": "--width 8 --depth 1 --steps 2500 --draft-steps 1500 --path-steps 2500 "
    "--batch 2 --held-out 0.3",
}


def prepare(folder):
    """Data of all systems."""
    clips_io.save_clips(folder / "camdm.npz", tiny.clips())
    clips = procedural.make_clips(minutes=2.0)
    for system in ("aamdm", "emdm"):
        clips_io.save_clips(folder / f"{system}.npz", clips)
    save_ball_clips(folder / "smgdiff.npz", ball_walker.clips(80))


def start(system, folder, out):
    """Starts a training."""
    line = f"experiments/{system}.py train --data {folder / system}.npz --out {out} "
    return subprocess.Popen(
        [sys.executable, *(line + COMMANDS[system]).split()],
        cwd=ROOT,
        env=os.environ | {"JAX_DISABLE_MOST_OPTIMIZATIONS": "1"},
        stdout=subprocess.DEVNULL,
        stderr=subprocess.PIPE,
    )


def rows(out):
    """Rows of losses so far, of all stages; checkpoints come and go meanwhile."""
    number = 0
    for place, folders, files in os.walk(out):
        folders[:] = [name for name in folders if name != "checkpoints"]
        if "losses.jsonl" in files:
            number += Path(place, "losses.jsonl").read_bytes().count(b"\n")
    return number


def kill_some(system, folder, out, kills, generator):
    """Starts a training and kills it, so many times; then lets it end.

    Every fifth kill comes while it starts; the others so many rows, and some of a
    second, after it went on.
    """
    made = 0
    while True:
        process, known = start(system, folder, out), rows(out)
        begun = time.monotonic()
        early = made % 5 == 4
        wait = generator.uniform(0.0, 8.0) if early else generator.uniform(0.0, 0.3)
        more = 0 if early else generator.randint(1, 8)
        while made < kills and process.poll() is None:
            if rows(out) >= known + more and (more or time.monotonic() > begun + wait):
                time.sleep(0.0 if early else wait)
                break
            time.sleep(0.02)
        if made < kills and process.poll() is None:
            process.send_signal(signal.SIGKILL)
            made += process.wait() == -signal.SIGKILL
            process.stderr.close()
            continue
        _, text = process.communicate()
        assert process.returncode == 0, text.decode()[-2000:]
        return made


def left(out):
    """What a training leaves: rows but for their speed, and checksums of states."""
    found = {}
    for path in sorted(out.rglob("losses.jsonl")):
        lines = [json.loads(line) for line in path.read_text().splitlines()]
        for row in lines:
            del row["steps_per_second"]
        steps = path.parent / "checkpoints"
        step = checkpoint.latest_step(steps)
        sums = json.loads((steps / str(step) / "checksums" / "metadata").read_text())
        found[str(path.relative_to(out))] = (lines, step, sums["state"])
    return found


def check(system, folder, kills):
    """Asserts that kills change nothing; returns how many there were, and rows."""
    whole, killed = folder / f"{system}_whole", folder / f"{system}_killed"
    assert kill_some(system, folder, whole, 0, random.Random(0)) == 0
    made = kill_some(system, folder, killed, kills, random.Random(kills))
    expected, found = left(whole), left(killed)
    assert found == expected
    torn = [x for x in killed.rglob("*") if "tmp" in x.name or "partial" in x.name]
    return made, {x: len(y[0]) for x, y in found.items()}, torn


@pytest.mark.slow
@pytest.mark.long
@pytest.mark.parametrize("system", COMMANDS)
def test_kills_change_nothing(tmp_path, system):
    prepare(tmp_path)
    made, found, torn = check(system, tmp_path, 3)
    assert made > 0 and sum(found.values()) > 50
    assert torn == []


def main(folder, *wanted):
    """Makes as many kills as told, and prints what came of them."""
    folder = Path(folder)
    folder.mkdir(parents=True)
    prepare(folder)
    for one in wanted:
        system, _, kills = one.partition("=")
        begun = time.monotonic()
        made, found, torn = check(system, folder, int(kills))
        seconds = time.monotonic() - begun
        words = f"{system}: {made} kills, {seconds:.0f} s, rows {found}, left {torn}"
        print(words, flush=True)


if __name__ == "__main__":
    main(*sys.argv[1:])
