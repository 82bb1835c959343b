"""The systems, a record each: what experiments, benchmarks and serving ask.

A system is a package of this folder with rooms of agreed names: "model" always,
"training" where it is trained here, "controller" where it is steered, else "sampler",
"evaluation" where numbers of steps are compared. A record imports a room when it is
asked for something in it, so that this module is cheap to import and knows no more than
names.
"""

import dataclasses
import importlib
from types import ModuleType
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from jaxmotion.evaluation.bench import Bench


@dataclasses.dataclass(frozen=True, kw_only=True)
class System:
    """One system.

    Attributes:
      name: Its package in `jaxmotion.systems`, and its name on command lines.
      title: As its paper writes it.
      paper: Authors, venue and number of the paper.
      steerable: Whether its room "controller" has `load_character(path)`, which makes a
        `control.steering.Character` of a run folder or an exported file; if not, its
        room "sampler" has `load_sampler(path)`, which makes a
        `control.sampling.Sampler`.
      swept: Whether its room "evaluation" has `BENCH`, which a sweep over numbers of
        steps asks.
    """

    name: str
    title: str
    paper: str
    steerable: bool = True
    swept: bool = True

    def room(self, name: str) -> ModuleType:
        """A module of the system's package, such as "training"."""
        return importlib.import_module(f"{__package__}.{self.name}.{name}")

    @property
    def bench(self) -> "Bench":
        """Points, budgets and evaluation of its sweep over numbers of steps."""
        return self.room("evaluation").BENCH


SYSTEMS = {
    system.name: system
    for system in (
        System(
            name="camdm",
            title="CAMDM",
            paper="Chen et al., SIGGRAPH 2024",
        ),
        System(
            name="aamdm",
            title="AAMDM",
            paper="Li et al., CVPR 2024, arXiv:2401.06146",
        ),
        System(
            name="emdm",
            title="EMDM",
            paper="Zhou et al., ECCV 2024, arXiv:2312.02256",
            steerable=False,
        ),
        System(
            name="smgdiff",
            title="SMGDiff",
            paper="Yang et al., 2024, arXiv:2411.16216",
        ),
    )
}


def get(name: str) -> System:
    """The record of a system."""
    if name not in SYSTEMS:
        raise ValueError(
            f"system: unknown system {name!r}, expected one of {', '.join(SYSTEMS)}"
        )
    return SYSTEMS[name]
