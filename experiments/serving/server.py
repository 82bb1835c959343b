"""The server: one character a connection, all on the same ticks.

One event loop reads commands and writes frames; the simulation runs in one worker
thread, one character after the other, so that the loop answers while it works. A tick
of all clients therefore takes the sum of theirs: with more than fits into 1/fps every
client gets fewer frames. (One batched program would serve many characters faster, but
every tick of it would cost as much as its most expensive character.)

Tick n is due at t0 + n / fps. A tick that takes too long makes the next ones late,
which then follow at once, until all are on time again; ticks are left out only where
they would be later than `Limits.catch_up`.

What a client sends or does not read takes no more memory than its limits: input is read
in pieces and no faster than `Limits.lines_per_tick`, output is dropped where
`Limits.buffer` waits.
"""

import asyncio
import contextlib
import dataclasses
import socket
import struct
import sys
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from typing import Any

from serving import protocol
from serving.simulation import Characters, first_command

# A piece of input; none counts for less than a line.
_READ = 4096
# Frames wait in our own buffer, where they are counted, rather than in the kernel's.
_KERNEL_BUFFER = 65536


@dataclasses.dataclass(frozen=True, kw_only=True)
class Limits:
    """What clients may use.

    Attributes:
      clients: Connections at a time.
      buffer: Bytes that may wait for a client to read them; beyond, frames and answers
        are dropped.
      stuck: Seconds that they may wait before the client is disconnected.
      lines_per_tick: Lines read from a client in a tick; more wait in its own buffers.
      catch_up: Seconds that ticks may be late before some are left out.
    """

    clients: int = 8
    buffer: int = 256 * 1024
    stuck: float = 10.0
    lines_per_tick: int = 32
    catch_up: float = 0.25


@dataclasses.dataclass(kw_only=True, eq=False)
class _Client:
    """A connection and its character.

    Attributes:
      transport: Where frames go.
      command: What it wants.
      state: State of its character; None until it has one.
      ticks: Ticks since it has one.
      late: How many of them it got no frame of.
      lines: How many more may be read in this tick.
      stuck_since: Loop time when its buffer was found full; None while it is not.
    """

    transport: asyncio.WriteTransport
    command: protocol.Command
    state: Any = None
    ticks: int = 0
    late: int = 0
    lines: int
    stuck_since: float | None = None


class Server:
    """Serves a simulation until it is told to stop."""

    def __init__(
        self, simulation: Characters, *, limits: Limits | None = None, seed: int
    ) -> None:
        """Opens nothing yet.

        Args:
          simulation: What each client gets a character of.
          limits: What clients may use; None for the defaults.
          seed: Seeds the first character; the next ones count on.
        """
        self._simulation = simulation
        self._limits = Limits() if limits is None else limits
        self._seed = seed
        self._clients: list[_Client] = []
        self._worker = ThreadPoolExecutor(max_workers=1)

    async def serve(
        self,
        host: str,
        port: int,
        *,
        stop: asyncio.Event,
        ready: Callable[[int], None],
    ) -> None:
        """Listens, and ticks until `stop` is set.

        Args:
          host: Address to listen on.
          port: Port; 0 for any that is free.
          stop: Ends it.
          ready: Called with the port as soon as clients can connect.

        Raises:
          OSError: if the address cannot be listened on.
        """
        listener = await asyncio.start_server(self._connected, host, port, limit=_READ)
        tasks = [asyncio.create_task(x) for x in (self._run(), stop.wait())]
        try:
            ready(listener.sockets[0].getsockname()[1])
            done, _ = await asyncio.wait(tasks, return_when="FIRST_COMPLETED")
            for task in done:
                task.result()  # an error of the ticks' own code ends the server
        finally:
            for task in tasks:
                task.cancel()
            listener.close()
            for client in self._clients:
                client.transport.abort()
            while self._clients:  # each leaves when it notices
                await asyncio.sleep(0.01)
            self._worker.shutdown()

    async def _connected(
        self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter
    ) -> None:
        """Life of a connection: hello, then commands until it ends."""
        client = _Client(
            transport=writer.transport,
            command=first_command(self._simulation),
            lines=self._limits.lines_per_tick,
        )
        if len(self._clients) >= self._limits.clients:
            client.transport.write(protocol.error_line("busy"))
            client.transport.close()
            return
        self._clients.append(client)
        connection = writer.get_extra_info("socket")
        with contextlib.suppress(OSError):  # whatever a vanished client raises
            connection.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, _KERNEL_BUFFER)
        try:
            self._send(client, protocol.hello_line(self._simulation))
            self._seed += 1
            client.state = await self._work(self._simulation.start, self._seed - 1)
            await self._read(client, reader)
        except OSError:
            pass
        finally:
            self._clients.remove(client)
            client.transport.abort()  # who hung up will not read what still waits

    async def _read(self, client: _Client, reader: asyncio.StreamReader) -> None:
        """Takes commands until the client closes its side."""
        splitter = protocol.LineSplitter()
        while data := await reader.read(_READ):
            await self._wait_turn(client)
            for line in splitter.feed(data):
                await self._wait_turn(client)
                self._obey(client, line)

    async def _wait_turn(self, client: _Client) -> None:
        """Counts a line; where a tick's are used up, waits for the next tick.

        Nothing is read meanwhile: the client's own sends wait, and nothing piles up.
        """
        while client.lines <= 0 and not client.transport.is_closing():
            await asyncio.sleep(1 / self._simulation.fps)
        client.lines -= 1

    def _obey(self, client: _Client, line: bytes) -> None:
        try:
            client.command = protocol.parse_command(
                line, client.command, self._simulation.labels
            )
        except protocol.ProtocolError as error:
            self._send(client, protocol.error_line(str(error)))

    def _send(self, client: _Client, line: bytes) -> bool:
        """Writes a line, or drops it; never waits."""
        transport = client.transport
        if transport.is_closing():
            return False
        if transport.get_write_buffer_size() <= self._limits.buffer:
            client.stuck_since = None
            transport.write(line)
            return True
        now = asyncio.get_running_loop().time()
        if client.stuck_since is None:
            client.stuck_since = now
        elif now - client.stuck_since > self._limits.stuck:
            _reset(transport)
        return False

    async def _work(self, function: Callable, *arguments: Any) -> Any:
        loop = asyncio.get_running_loop()
        return await loop.run_in_executor(self._worker, function, *arguments)

    async def _run(self) -> None:
        """Ticks, on a schedule of absolute times that no delay moves."""
        loop, fps = asyncio.get_running_loop(), self._simulation.fps
        begin, n = loop.time(), 0
        while True:
            await asyncio.sleep(max(begin + n / fps - loop.time(), 0))
            missed = 0
            if loop.time() - begin - n / fps > self._limits.catch_up:
                missed = int((loop.time() - begin) * fps) - n
            n += missed + 1
            for client in tuple(self._clients):
                client.lines = self._limits.lines_per_tick
                if client.state is not None and not client.transport.is_closing():
                    client.ticks += missed
                    client.late += missed
                    await self._tick(client)

    async def _tick(self, client: _Client) -> None:
        """One frame of one client; what fails there is its own."""
        try:
            client.state, line = await self._work(self._step, client)
        except Exception as error:
            print(f"a character failed: {error!r}", file=sys.stderr, flush=True)
            self._send(client, protocol.error_line("the simulation failed"))
            client.transport.close()  # when it has read the error, or not for long
            loop = asyncio.get_running_loop()
            loop.call_later(self._limits.stuck, client.transport.abort)
            return
        client.ticks += 1
        if not self._send(client, line):
            client.late += 1

    def _step(self, client: _Client) -> tuple[Any, bytes]:
        """In the worker: the next state, and the line that shows it."""
        simulation = self._simulation
        state, frame = simulation.step(client.state, client.command, client.ticks)
        line = protocol.frame_line(
            client.ticks, frame, fps=simulation.fps, late=client.late
        )
        return state, line


def _reset(transport: asyncio.WriteTransport) -> None:
    """Ends a connection at once; what the kernel has not sent is dropped as well."""
    connection = transport.get_extra_info("socket")
    with contextlib.suppress(OSError):
        at_once = struct.pack("ii", 1, 0)
        connection.setsockopt(socket.SOL_SOCKET, socket.SO_LINGER, at_once)
    transport.abort()
