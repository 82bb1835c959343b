"""The simulation of a run, by the system that its config names."""

from pathlib import Path

from jaxmotion import files
from jaxmotion.learning import checkpoint
from serving import camdm, smgdiff
from serving.simulation import Simulation

# By field "system" of a run's config; each is `load(run, data)`.
SYSTEMS = {"camdm": camdm.load, "smgdiff": smgdiff.load}


def system_of(run: Path) -> str:
    """Name of the system that a run is of.

    Args:
      run: Run folder with a config.json, or exported file.

    Returns:
      One of `SYSTEMS`.

    Raises:
      OSError: if there is no such folder or file.
      ValueError: if it is of no system that can be served; names those that can.
    """
    if run.is_file():
        value = checkpoint.import_params(run)[1]
    else:
        what = "expected a run folder of `train`"
        value = files.read_object(run / "config.json", what=what)
    system = value.get("system")
    if system not in SYSTEMS:
        raise ValueError(
            f"{run}: field 'system' is {system!r}, expected one of {', '.join(SYSTEMS)}"
        )
    return system


def load(run: Path, data: Path | None = None) -> Simulation:
    """The simulation of a run.

    Args:
      run: Run folder or exported file.
      data: Clips to start from; None for what the system has without.

    Returns:
      The simulation.

    Raises:
      OSError: if a file cannot be read.
      ValueError: if the run is of no system that can be served.
    """
    return SYSTEMS[system_of(run)](run, data)
