"""Serves characters of a model over TCP, for a game engine to steer and to show.

Examples:
  python experiments/serve.py
  python experiments/serve.py --run runs/smgdiff
  python benchmarks/serve_client.py --port 7777 --seconds 60
"""

import asyncio
import dataclasses
import gc
import time
from pathlib import Path

import tyro
from serving import protocol, simulation
from serving.server import Limits, Server

import jaxmotion
from jaxmotion import cli
from jaxmotion.control import steering
from jaxmotion.data import clips_io


@dataclasses.dataclass(frozen=True)
class Config:
    """The command line.

    Attributes:
      run: Shipped model, run folder (CAMDM, AAMDM, SMGDiff), or exported file.
      data: Clips to start from, for CAMDM; None for the model's own start.
      host: Address. There is no authentication: whoever reaches it can steer.
      port: Port to listen on; 0 for any that is free.
      max_clients: Connections at a time. All of their characters are computed in one
        tick (1/30 s).
      seed: Seeds the noise of the first character; the next ones count on.
    """

    run: str = "locomotion"
    data: Path | None = None
    host: str = "127.0.0.1"
    port: int = 7777
    max_clients: int = 8
    seed: int = 0


async def listen(args: Config, characters: simulation.Characters) -> None:
    """Serves until SIGINT or SIGTERM."""
    stop = cli.until_stopped()
    server = Server(characters, limits=Limits(clients=args.max_clients), seed=args.seed)
    ready = lambda port: print(f"listening on {args.host}:{port}", flush=True)  # noqa: E731
    await server.serve(args.host, args.port, stop=stop, ready=ready)
    print("closed", flush=True)


def load(run: str, data: Path | None) -> simulation.Characters:
    """A model's characters; of clips only what a start needs is kept."""
    clips = None if data is None else clips_io.load_clips(data)
    character = steering.steered(jaxmotion.load(run), what=run)
    return simulation.Characters(character, clips=clips)


def serve(args: Config) -> None:
    """Loads, compiles, and serves.

    Raises:
      OSError: if the model cannot be read or the address not be listened on.
      ValueError: if the model cannot be served.
    """
    cli.check(args)
    cli.check_address(args.host, args.port)
    characters = load(args.run, args.data)
    begin = time.perf_counter()
    cli.announce("compiling all that a tick may need", 60)
    simulation.warm(characters)
    seconds = time.perf_counter() - begin
    print(
        f"{len(characters.joints)} joints, {characters.fps:g} frames per second, "
        f"labels {', '.join(characters.labels)}; compiled in {seconds:.0f} s"
    )
    # What was loaded stays: the collector need not look through it during a tick.
    gc.collect()
    gc.freeze()
    asyncio.run(listen(args, characters))


def main() -> None:
    """Parses the command line and serves."""
    serve(tyro.cli(Config, description=f"{__doc__}\n{protocol.__doc__}"))


if __name__ == "__main__":
    cli.start(main)
