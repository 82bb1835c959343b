"""A scripted client of experiments/serve.py: does it keep time, and does it last?

Steers a character and measures when frames arrive; then sends what no client should,
hangs up rudely, and stops reading; and looks whether the server still serves. Exits
with 1 if it does not, or if a twentieth of the frames is missing.

Example:
  python benchmarks/serve_client.py --serve runs/camdm --seconds 60
  python benchmarks/serve_client.py --port 7777 --seconds 60
"""

import asyncio
import contextlib
import dataclasses
import json
import math
import select
import signal
import socket
import struct
import subprocess
import sys
import time
from collections.abc import AsyncIterator, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import tyro

SERVER = Path(__file__).parents[1] / "experiments" / "serve.py"
MALFORMED, ABRUPT = 1000, 20
# Seconds between two commands, as of a thumb on a stick.
STEERING = 0.5
# Seconds in which a server should notice that a client does not read.
NOTICED = 60.0


@dataclasses.dataclass(kw_only=True)
class Connection:
    """A client that reads all it gets.

    Attributes:
      hello: The server's first line.
      frames: Frames so far, each with its "arrival" in seconds of `time.perf_counter`.
      errors: Errors so far.
      writer: Where commands go.
      reading: The task that reads; done when the server has hung up.
    """

    hello: dict[str, Any]
    writer: asyncio.StreamWriter
    frames: list[dict[str, Any]] = dataclasses.field(default_factory=list)
    errors: list[str] = dataclasses.field(default_factory=list)
    reading: asyncio.Task | None = None

    def send(self, **command: Any) -> None:
        """Sends a command of these fields."""
        self.writer.write(json.dumps(command).encode() + b"\n")

    async def read(self, reader: asyncio.StreamReader) -> None:
        """Keeps what arrives, until the server hangs up."""
        while line := await reader.readline():
            arrival, message = time.perf_counter(), json.loads(line)
            if "error" in message:
                self.errors.append(message["error"])
            else:
                self.frames.append({"arrival": arrival} | message)


@contextlib.asynccontextmanager
async def connected(port: int) -> AsyncIterator[Connection]:
    """A connection for as long as the block runs.

    Raises:
      OSError: if nobody answers.
      RuntimeError: if the server does not let the client in.
    """
    reader, writer = await asyncio.open_connection("127.0.0.1", port)
    line = await asyncio.wait_for(reader.readline(), 10)
    if b'"hello"' not in line:
        raise RuntimeError(f"the server said {line!r}, expected a hello")
    connection = Connection(hello=json.loads(line)["hello"], writer=writer)
    connection.reading = asyncio.create_task(connection.read(reader))
    try:
        yield connection
    finally:
        connection.reading.cancel()
        writer.close()


def resident_mb(process: subprocess.Popen) -> float:
    """Megabytes of memory of a process, on Linux."""
    text = Path(f"/proc/{process.pid}/status").read_text()
    return int(text.split("VmRSS:")[1].split()[0]) / 1000


@contextlib.contextmanager
def server_of(run: Path) -> Iterator[tuple[subprocess.Popen, int]]:
    """A server of a run, its process and port, for as long as the block runs.

    Raises:
      RuntimeError: if it does not start, or does not end well.
    """
    command = [sys.executable, str(SERVER), "--run", str(run), "--port", "0"]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as process:
        try:
            for line in process.stdout:
                print(line, end="", flush=True)
                if line.startswith("listening on"):
                    yield process, int(line.rpartition(":")[2])
                    break
        finally:
            process.send_signal(signal.SIGTERM)
            rest, _ = process.communicate(timeout=20)
    if process.returncode or "closed" not in rest:
        raise RuntimeError(f"the server ended with {process.returncode}: {rest}")


@dataclasses.dataclass(frozen=True)
class Config:
    """The command line.

    Attributes:
      port: Port of a server on this machine that runs already.
      serve: Shipped model, run folder or exported file: start a server of it, and stop
        it in the end.
      seconds: How long to steer.
    """

    port: int = 7777
    serve: Path | None = None
    seconds: float = 60.0


def timing(
    frames: list[dict[str, Any]], *, fps: float, until: float
) -> dict[str, float]:
    """How regular frames came.

    Args:
      frames: Frames of one connection.
      fps: The rate they should have.
      until: When they ended, on the clock of their arrivals.

    Returns:
      Received and expected frames; percentiles, milliseconds: of the jitter, which is
      |interval - 1/fps| of neighbors, and of the lateness against the schedule of the
      frame that was the earliest for its number.

    Raises:
      RuntimeError: if there are fewer than two.
    """
    if len(frames) < 2:
        raise RuntimeError(f"got {len(frames)} frames, expected at least 2")
    arrival = np.array([frame["arrival"] for frame in frames])
    tick = np.array([frame["tick"] for frame in frames])
    expected = int((until - arrival[0]) * fps) + 1
    jitter = 1000 * np.abs(np.diff(arrival) - 1 / fps)
    late = 1000 * (arrival - tick / fps)
    late -= late.min()
    found = {"frames received": len(frames), "frames expected": expected}
    for name, values in (("jitter", jitter), ("lateness", late)):
        for percent in (50, 95, 99):
            found[f"{name} p{percent} ms"] = float(np.percentile(values, percent))
    return found


async def steer(port: int, seconds: float) -> dict[str, float]:
    """Walks about, with another direction every half second and now and then a style.

    Returns:
      What `timing` returns.
    """
    async with connected(port) as client:
        labels = client.hello["labels"]
        for i in range(max(round(seconds / STEERING), 1)):
            angle = 0.4 * i
            direction = [math.sin(angle), math.cos(angle)]
            client.send(velocity=direction, facing=direction)
            if labels and i % 10 == 9:
                client.send(label=labels[i // 10 % len(labels)])
            await asyncio.sleep(STEERING)
        return timing(client.frames, fps=client.hello["fps"], until=time.perf_counter())


def malformed(number: int) -> Iterator[bytes]:
    """Lines that no server should obey, with their newlines."""
    kinds = [
        b"",
        b"hello",
        b"[]",
        b"null",
        b'{"velocity":',
        b'{"velocity":[1]}',
        b'{"velocity":[NaN,0]}',
        b'{"velocity":[1e999,0]}',
        b'{"velocity":[1' + b"0" * 400 + b",0]}",
        b'{"velocity":[21,0]}',
        b'{"velocity":["1",0]}',
        b'{"velocity":[true,0]}',
        b'{"velocity":{"x":1}}',
        b'{"facing":[0,0]}',
        b'{"facing":[1e308,1e308]}',
        b'{"label":"no such label"}',
        b'{"label":0}',
        b'{"jump":true}',
        b'{"velocity":[5,5],"jump":true}',
        b"\xff\xfe\x00",
        b"[" * 4000,
        b'{"velocity":' + b"[" * 900 + b"]" * 900 + b"}",
        b'{"label":"' + b"x" * 4000 + b'"}',
        b"x" * 5000,
        b"y" * 70000,
    ]
    for i in range(number):
        yield kinds[i % len(kinds)] + b"\n"


async def abuse(port: int) -> dict[str, float]:
    """Sends malformed lines, then a command.

    Returns:
      How many lines were sent and answered, frames meanwhile, and how far the character
      then walked in 3 s of the 3 m that it was told to.
    """
    async with connected(port) as client:
        for line in malformed(MALFORMED):
            client.writer.write(line)
            await client.writer.drain()
        deadline = time.perf_counter() + 10
        while len(client.errors) < MALFORMED and time.perf_counter() < deadline:
            await asyncio.sleep(0.05)
        meanwhile, begin = len(client.frames), np.array(client.frames[-1]["root"])
        client.send(velocity=[0.0, 1.0], facing=[0.0, 1.0])
        await asyncio.sleep(3)
        moved = np.array(client.frames[-1]["root"]) - begin
        return {
            "malformed lines": MALFORMED,
            "answered": len(client.errors),
            "frames meanwhile": meanwhile,
            "walked afterwards m": float(moved[2]),
            "still connected": not client.reading.done(),
        }


def hang_up(port: int) -> None:
    """Connects, and resets the connection at once or after some frames."""
    for i in range(ABRUPT):
        with socket.create_connection(("127.0.0.1", port)) as connection:
            at_once = struct.pack("ii", 1, 0)
            connection.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, at_once)
            connection.sendall(b'{"velocity":[0,1]}\n{"fac')
            time.sleep(0.03 * (i % 5))


def lazy_client(port: int) -> socket.socket:
    """The socket of a client that never reads."""
    connection = socket.socket()
    connection.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4096)
    connection.connect(("127.0.0.1", port))
    return connection


async def dropped_after(connection: socket.socket, begin: float) -> float:
    """Seconds from `begin` until the server hangs up; infinite if it takes too long."""
    poll = select.poll()
    poll.register(connection, 0)  # reports only that the connection has ended
    while time.perf_counter() - begin < NOTICED:
        if poll.poll(0):
            return time.perf_counter() - begin
        await asyncio.sleep(0.1)
    return math.inf


async def visit(port: int, seconds: float) -> tuple[dict[str, float], list[str]]:
    """All that the client does: what was measured, and what failed."""
    found = await steer(port, seconds)
    found |= await abuse(port)
    await asyncio.to_thread(hang_up, port)
    begin = time.perf_counter()
    with lazy_client(port) as lazy:
        afterwards = await steer(port, 5.0)
        found["frames afterwards"] = afterwards["frames received"]
        found["who did not read was left after s"] = await dropped_after(lazy, begin)
    checks = {
        "frames are missing": found["frames received"]
        >= 0.95 * max(found["frames expected"], 1),
        "malformed lines were not answered": found["answered"] == MALFORMED,
        "malformed lines ended the connection": found["still connected"],
        "commands behind malformed lines had no effect": found["walked afterwards m"]
        > 1.0,
        "a new client was not served": found["frames afterwards"] > 0,
        "a client that did not read was kept": math.isfinite(
            found["who did not read was left after s"]
        ),
    }
    return found, [name for name, passed in checks.items() if not passed]


def main() -> None:
    """Visits the server and prints a table."""
    args = tyro.cli(Config, description=__doc__)
    if args.serve is None:
        found, failed = asyncio.run(visit(args.port, args.seconds))
    else:
        with server_of(args.serve) as (process, port):
            before = resident_mb(process)
            found, failed = asyncio.run(visit(port, args.seconds))
            found["memory before MB"] = before
            found["memory afterwards MB"] = resident_mb(process)
    for name, value in found.items():
        print(f"{name:36}{value:10.1f}" if value % 1 else f"{name:36}{value:10.0f}")
    for name in failed:
        print(f"failed: {name}")
    sys.exit(bool(failed))


if __name__ == "__main__":
    try:
        main()
    except (OSError, RuntimeError) as error:
        sys.exit(f"error: {error}")
