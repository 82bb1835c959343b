"""Trains several seeds of a system as one program, which fills a large device.

What follows -- is a script and its own options of `train`, --seed left out. Folders are
OUT for seed 0 and OUT_seedN, as train_queue.py has them. Each is what the script alone
would make of that seed, up to rounding; the same command goes on where all stopped.

Examples:
  python experiments/seeds.py --seeds 12 -- emdm train --task action --out runs/emdm
"""

import dataclasses
import functools
import importlib
import sys

import tyro

from jaxmotion import cli
from jaxmotion.learning import runs, together
from jaxmotion.systems import registry


@dataclasses.dataclass(frozen=True)
class Config:
    """Train several seeds as one program: [options] -- SYSTEM train [its options].

    Attributes:
      seed: The first.
      seeds: How many.
    """

    seed: int = 0
    seeds: int = 3


def parts_of(words: list[str]) -> tuple[list[str], list[str]]:
    """Own options, and a system's command; raises `ValueError` if there is none."""
    at = words.index("--") if "--" in words else len(words)
    own, command = words[:at], words[at + 1 :]
    is_known = bool(command) and command[0] in registry.SYSTEMS
    if not {"-h", "--help"} & set(own) and not (is_known and command[1:2] == ["train"]):
        raise ValueError(
            f"{' '.join(words[at:]) or 'no command'}: expected -- and one of "
            f"{', '.join(registry.SYSTEMS)}, then train and its options"
        )
    return own, command


def train(args: Config, command: list[str]) -> None:
    """Trains all seeds by a system's own command."""
    system, *options = command
    script = importlib.import_module(system)
    each = cli.check(
        tyro.cli(cli.kind_of(script.COMMANDS), args=options, prog=f"{system}.py")
    )
    if each.distributed or getattr(each, "devices", 1) > 1:
        raise ValueError("--distributed, --devices: one device trains several seeds")
    if each.seed != type(each).seed:
        raise ValueError(f"--seed {each.seed} after --: expected before it")
    together.run(
        [
            functools.partial(
                script.train,
                dataclasses.replace(each, seed=seed, out=runs.of_seed(each.out, seed)),
            )
            for seed in range(args.seed, args.seed + args.seeds)
        ]
    )


def main() -> None:
    """Parses both command lines and trains."""
    own, command = parts_of(sys.argv[1:])
    train(cli.check(tyro.cli(Config, description=__doc__, args=own)), command)


if __name__ == "__main__":
    cli.start(main)
