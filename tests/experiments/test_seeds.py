"""experiments/seeds.py: several seeds of a system's command as one program."""

import pytest

from jaxmotion.data import clips_io, procedural
from jaxmotion.learning import loop
from jaxmotion.systems.emdm import data as emdm_data
from jaxmotion.systems.emdm import training as emdm_training

SIZES = (
    "--steps 3 --batch 8 --width 16 --hidden 16 --depth 1 --discriminator-width 64 "
    "--merge --least 2 --frames 20"
)


@pytest.fixture(scope="module")
def data(tmp_path_factory):
    path = tmp_path_factory.mktemp("data") / "clips.npz"
    clips_io.save_clips(path, procedural.make_clips(minutes=2.0))
    return path


@pytest.mark.slow
def test_seeds_are_what_the_script_makes_of_each(tmp_path, invoke, data):
    """A GAN: two seeds as one program, and the second by the script."""
    line = f"train --task action --field style --data {data} {SIZES}"
    invoke("seeds", f"--seed 1 --seeds 2 -- emdm {line} --out {tmp_path}/both")
    invoke("emdm", f"{line} --seed 2 --out {tmp_path}/alone")
    found, other, alone = (
        loop.read_losses(tmp_path / name / "emdm/losses.jsonl")[-1]
        for name in ("both_seed2", "both_seed1", "alone")
    )
    for name, value in alone.items():
        if name != "steps_per_second":
            assert found[name] == pytest.approx(value, rel=5e-3, abs=1e-5), name
    assert other["loss"] != pytest.approx(alone["loss"], rel=5e-3)
    one, other = (
        emdm_training.load_row(emdm_data.load_run(tmp_path / x).record, "emdm")[1]
        for x in ("both_seed2", "alone")
    )
    assert one == other


@pytest.mark.parametrize(
    "line, message",
    [
        ("", "no command: expected -- and one of camdm"),
        ("--seeds 2 -- camdm evaluate", "then train"),
        ("-- mdm train", "-- mdm train: expected -- and one of camdm"),
        ("-- camdm train --seed 3", "--seed 3 after --"),
        ("-- camdm train --distributed auto", "one device trains"),
    ],
)
def test_what_is_no_training_is_refused(invoke, line, message):
    with pytest.raises(ValueError, match=message):
        invoke("seeds", line)
