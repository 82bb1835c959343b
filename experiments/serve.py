"""Serves characters of a model over TCP, for a game engine to steer and to show.

Examples:
  python experiments/serve.py
  python experiments/serve.py --run runs/smgdiff
  python benchmarks/serve_client.py --port 7777 --seconds 60
"""

import asyncio
import contextlib
import dataclasses
import gc
import ipaddress
import signal
import socket
import sys
import time
from pathlib import Path

import tyro
from serving import protocol, simulation
from serving.server import Limits, Server

import jaxmotion
from jaxmotion import cli
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


def is_local(host: str) -> bool:
    """Whether only this machine reaches an address; False where it is not known."""
    with contextlib.suppress(ValueError):
        return ipaddress.ip_address(host).is_loopback
    return host == "localhost"


def check_address(host: str, port: int) -> None:
    """Raises if an address cannot be listened on; before minutes of compiling.

    Raises:
      OSError: names the address.
    """
    try:
        found = socket.getaddrinfo(
            host, port, type=socket.SOCK_STREAM, flags=socket.AI_PASSIVE
        )
        for family, kind, number, _, address in found:
            with socket.socket(family, kind, number) as probe:
                if sys.platform != "win32":
                    probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
                probe.bind(address)
    except OSError as error:
        raise OSError(f"cannot listen on {host}:{port}: {error.strerror}") from error


async def listen(args: Config, characters: simulation.Simulation) -> None:
    """Serves until SIGINT or SIGTERM."""
    stop = asyncio.Event()
    if sys.platform != "win32":  # where Ctrl-C cancels this coroutine instead
        for number in (signal.SIGINT, signal.SIGTERM):
            asyncio.get_running_loop().add_signal_handler(number, stop.set)
    server = Server(characters, limits=Limits(clients=args.max_clients), seed=args.seed)
    ready = lambda port: print(f"listening on {args.host}:{port}", flush=True)  # noqa: E731
    await server.serve(args.host, args.port, stop=stop, ready=ready)
    print("closed", flush=True)


def load(run: str, data: Path | None) -> simulation.Simulation:
    """A model's characters; of clips only what a start needs is kept."""
    clips = None if data is None else clips_io.load_clips(data)
    return simulation.Characters(jaxmotion.load(run), clips=clips)


def serve(args: Config) -> None:
    """Loads, compiles, and serves.

    Raises:
      OSError: if the model cannot be read or the address not be listened on.
      ValueError: if the model cannot be served.
    """
    cli.check(args)
    if not is_local(args.host):
        print(
            f"warning: {args.host} may be reached from other machines, and there is no "
            "authentication: whoever connects can steer characters",
            file=sys.stderr,
            flush=True,
        )
    check_address(args.host, args.port)
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
