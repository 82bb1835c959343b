"""What the scripted client of the server stands on: a connection, a server process."""

import asyncio
import contextlib
import dataclasses
import json
import signal
import subprocess
import sys
import time
from collections.abc import AsyncIterator, Iterator
from pathlib import Path
from typing import Any

SERVER = Path(__file__).parents[1] / "experiments" / "serve.py"


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
        """Sends a command.

        Args:
          **command: Its fields.
        """
        self.writer.write(json.dumps(command).encode() + b"\n")

    async def read(self, reader: asyncio.StreamReader) -> None:
        """Keeps what arrives, until the server hangs up.

        Args:
          reader: Where from.
        """
        while line := await reader.readline():
            arrival, message = time.perf_counter(), json.loads(line)
            if "error" in message:
                self.errors.append(message["error"])
            else:
                self.frames.append({"arrival": arrival} | message)


@contextlib.asynccontextmanager
async def connected(port: int) -> AsyncIterator[Connection]:
    """A connection for as long as the block runs.

    Args:
      port: Of the server.

    Yields:
      The connection.

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
    """Memory of a process, on Linux.

    Args:
      process: The process.

    Returns:
      Megabytes.
    """
    text = Path(f"/proc/{process.pid}/status").read_text()
    return int(text.split("VmRSS:")[1].split()[0]) / 1000


@contextlib.contextmanager
def server_of(run: Path) -> Iterator[tuple[subprocess.Popen, int]]:
    """A server for as long as the block runs.

    Args:
      run: Run folder.

    Yields:
      Its process and port.

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
