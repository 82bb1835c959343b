"""experiments/serve.py: its protocol, its robustness, and CAMDM's characters in it.

The server's tests run it in this process, on a simulation that costs nothing and shows
in its poses what it was asked for.
"""

import asyncio
import contextlib
import gc
import importlib
import json
import os
import re
import signal
import socket
import struct
import threading
import time
from pathlib import Path

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxmotion.control import rollout, steering
from jaxmotion.control.frame import Frame
from jaxmotion.data import clips_io
from jaxmotion.learning import checkpoint
from jaxmotion.systems.camdm import model as camdm_model
from tests import mostly_slow, samples, tiny

ROOT = Path(__file__).parents[2]
FPS = 100.0
LABELS = ("calm", "brisk")


@pytest.fixture(scope="module", autouse=True)
def folders():
    """Scripts import the modules beside them."""
    with pytest.MonkeyPatch.context() as patch:
        patch.syspath_prepend(str(ROOT / "experiments"))
        patch.syspath_prepend(str(ROOT / "benchmarks"))
        yield


def load(name):
    return importlib.import_module(name)


@pytest.fixture
def protocol():
    return load("serving.protocol")


class Fake:
    """Shows each command as a pose: root (velocity x, label, velocity z)."""

    labels = LABELS
    parents = (-1, 0)
    joints = ("hips", "head")
    offsets = np.array([[0.0, 0.0, 0.0], [0.0, 0.6, 0.0]], np.float32)

    def __init__(self, fps=FPS, size=2, fail_at=None, pause=None):
        self.fps, self.size, self.fail_at, self.pause = fps, size, fail_at, pause
        self.seeds = []

    def start(self, seed):
        self.seeds.append(seed)
        return seed, 0

    def step(self, state, command, n):
        seed, steps = state
        if self.pause:
            time.sleep(self.pause(n))
        if seed == 0 and n == self.fail_at:
            raise RuntimeError("no more plans")
        x, z = command.velocity
        root = np.array([x, LABELS.index(command.label), z])
        rotations = np.full((self.size, 6), 0.123456789, np.float32)
        ball = np.array([seed, steps, *command.facing[:1]])
        return (seed, steps + 1), {"root": root, "rotations": rotations, "ball": ball}


class Client:
    """One connection, read line by line."""

    def __init__(self, reader, writer):
        self.reader, self.writer = reader, writer

    def send(self, *lines):
        for line in lines:
            text = line if isinstance(line, bytes) else json.dumps(line).encode()
            self.writer.write(text + b"\n")

    async def message(self):
        line = await asyncio.wait_for(self.reader.readline(), 5)
        return json.loads(line) if line else None

    async def until(self, accept):
        """The first message that is accepted, and those before."""
        before = []
        while not accept(message := await self.message()):
            assert message is not None, "the server hung up"
            before.append(message)
        return message, before

    async def error(self):
        return (await self.until(lambda m: m and "error" in m))[0]["error"]

    async def frame(self, accept=lambda frame: True):
        return (await self.until(lambda m: m and "tick" in m and accept(m)))[0]


@contextlib.asynccontextmanager
async def serving(simulation=None, **limits):
    """A server; yields it and a function that connects a client.

    On a busy machine it may fall behind, but leaves out no ticks unless asked to.
    """
    module = load("serving.server")
    limits = {"catch_up": 60.0} | limits
    server = module.Server(simulation or Fake(), limits=module.Limits(**limits), seed=0)
    stop, ready = asyncio.Event(), asyncio.get_running_loop().create_future()
    task = asyncio.create_task(
        server.serve("127.0.0.1", 0, stop=stop, ready=ready.set_result)
    )
    await asyncio.wait([task, ready], return_when="FIRST_COMPLETED")
    writers = []

    async def connect(**options):
        found = socket.create_connection(("127.0.0.1", ready.result()))
        for name, value in options.items():
            found.setsockopt(socket.SOL_SOCKET, getattr(socket, name), value)
        reader, writer = await asyncio.open_connection(sock=found, limit=1 << 20)
        writers.append(writer)
        return Client(reader, writer)

    try:
        yield server, connect
    finally:
        stop.set()
        await asyncio.wait_for(task, 5)
        for writer in writers:
            writer.close()


def run(coroutine):
    asyncio.run(asyncio.wait_for(coroutine, 20))


# The protocol.


@pytest.mark.parametrize(
    "line, changes",
    [
        (b"{}", {}),
        (b'{"velocity": [3, -4.5]}', {"velocity": (3.0, -4.5)}),
        (b'{"velocity": [12, 16]}', {"velocity": (12.0, 16.0)}),
        (b'{"facing": [0, -5]}\r', {"facing": (0.0, -1.0)}),
        (b'{"facing": [300, 400]}', {"facing": (0.6, 0.8)}),
        (b'{"label": "calm"}', {"label": "calm"}),
        (
            b'{"label": "calm", "velocity": [1, 0]}',
            {"label": "calm", "velocity": (1.0, 0.0)},
        ),
    ],
)
def test_a_command_changes_what_it_names(protocol, line, changes):
    last = protocol.Command(velocity=(0.5, 0.25), facing=(1.0, 0.0), label="brisk")
    wanted = {"velocity": (0.5, 0.25), "facing": (1.0, 0.0), "label": "brisk"}
    found = protocol.parse_command(line, last, LABELS)
    assert vars(found) == wanted | changes


@pytest.mark.parametrize(
    "line, words",
    [
        (b"", "not JSON"),
        (b"{velocity: 1}", "not JSON"),
        (b"{} {}", "not JSON"),
        (b"\xff{}", "not UTF-8 at byte 0"),
        (b"[1, 2]", "expected a JSON object"),
        (b"null", "expected a JSON object"),
        (
            b"[" * 4000,
            "line is n",
        ),  # "nested too deeply"; from Python 3.13 on "not JSON"
        (b'{"velocity":' * 2000, ""),
        (b'{"speed": 1}', "'speed'"),
        (b'{"velocity": 1}', "'velocity'"),
        (b'{"velocity": [1]}', "'velocity'"),
        (b'{"velocity": [1, 2, 3]}', "'velocity'"),
        (b'{"velocity": [1, "2"]}', "'velocity'"),
        (b'{"velocity": [1, true]}', "'velocity'"),
        (b'{"velocity": [1, null]}', "'velocity'"),
        (b'{"velocity": [NaN, 0]}', "'velocity'"),
        (b'{"velocity": [0, -Infinity]}', "'velocity'"),
        (b'{"velocity": [1e999, 0]}', "'velocity'"),
        (b'{"velocity": [1' + b"0" * 400 + b", 0]}", "'velocity'"),
        (b'{"velocity": [0, 20.001]}', "20.001 m/s, expected at most 20"),
        (b'{"facing": [0, 0]}', "'facing'"),
        (b'{"facing": [0, 1e-4]}', "'facing'"),
        (b'{"facing": [1e308, 1e308]}', "'facing'"),
        (b'{"label": "angry"}', "'angry', expected one of: calm, brisk"),
        (b'{"label": 0}', "'label'"),
        (b'{"label": ["calm"]}', "'label'"),
        (b'{"label": "' + b"x" * 4000 + b'"}', "xxx..., expected"),
        (b" " * 4095 + b"{}", "too long, expected at most 4096 bytes"),
        (b'{"velocity": [1, 1], "label": "angry"}', "'angry'"),
    ],
)
def test_what_is_wrong_is_named_in_few_words(protocol, line, words):
    command = protocol.Command(label="calm")
    with pytest.raises(protocol.ProtocolError) as error:
        protocol.parse_command(line, command, LABELS)
    assert words in str(error.value)
    assert len(str(error.value)) < 200


@pytest.mark.parametrize("depth", range(50, 1900, 50))
def test_no_depth_of_nesting_escapes(protocol, depth):
    """Reading it may work where quoting it in the error does not."""
    line = b'{"label":' + b"[" * depth + b"]" * depth + b"}"
    with pytest.raises(protocol.ProtocolError):
        protocol.parse_command(line, protocol.Command(), LABELS)


def test_systems_without_labels_know_none(protocol):
    simulation = load("serving.simulation")
    fake = Fake()
    assert simulation.first_command(fake).label == "calm"
    fake.labels = ()
    assert simulation.first_command(fake).label is None
    with pytest.raises(protocol.ProtocolError, match="expected one of: none"):
        protocol.parse_command(b'{"label": "calm"}', protocol.Command(), ())


@pytest.mark.parametrize("seed", range(5))
def test_lines_are_cut_wherever_the_pieces_end(protocol, seed):
    generator = np.random.default_rng(seed)
    sizes = [int(x) for x in generator.integers(0, 60, 200)]
    lines = [bytes([97 + i % 26]) * size for i, size in enumerate(sizes)]
    for at in (20, 90, 91, 199):  # too long by one, by much, twice in a row, last
        lines[at] = b"#" * (4097 if at == 20 else 30000)
    lines[50] = b"-" * 4096
    text, splitter, found = b"\n".join([*lines, b""]), protocol.LineSplitter(), []
    while text:
        size = int(generator.integers(1, 6000))
        found += splitter.feed(text[:size])
        text = text[size:]
    assert found == [line[:4097] for line in lines]


def test_a_line_without_end_is_reported_once_and_not_kept(protocol):
    splitter = protocol.LineSplitter()
    found = [splitter.feed(b"x" * 1000) for _ in range(1000)]
    assert sum(map(len, found)) == 1
    assert len(found[4][0]) == 4097
    assert max(len(x) for x in vars(splitter).values() if isinstance(x, bytes)) == 0
    assert splitter.feed(b"x\n{}\n") == [b"{}"]


def test_frames_are_short_and_finite(protocol):
    frame = {"root": np.float32([0.1, 1 / 3, -0.0]), "rotations": np.zeros((2, 6))}
    line = protocol.frame_line(7, frame, fps=30.0, late=3)
    assert line.endswith(b'"late":3}\n') and line.count(b"\n") == 1
    assert json.loads(line) == {
        "tick": 7,
        "time": 0.2333,
        "root": [0.1, 0.33333, 0.0],
        "rotations": [[0.0] * 6] * 2,
        "late": 3,
    }
    with pytest.raises(ValueError, match="not JSON compliant"):
        protocol.frame_line(0, frame | {"root": np.array([np.nan])}, fps=30.0, late=0)


# The server.


def test_a_client_is_greeted_and_gets_every_frame():
    async def visit():
        async with serving() as (_, connect):
            client = await connect()
            assert await client.message() == {
                "hello": {
                    "version": 1,
                    "fps": FPS,
                    "joints": ["hips", "head"],
                    "parents": [-1, 0],
                    "offsets": [[0.0, 0.0, 0.0], [0.0, 0.6, 0.0]],
                    "labels": ["calm", "brisk"],
                    "units": "meters, y up; rotations 6D two columns",
                }
            }
            frames = [await client.message() for _ in range(20)]
            assert [frame["tick"] for frame in frames] == list(range(20))
            for frame in frames:
                assert frame["late"] == 0
                assert frame["time"] == pytest.approx(frame["tick"] / FPS)
                assert frame["root"] == [0.0, 0.0, 0.0]
                assert np.shape(frame["rotations"]) == (2, 6)
            assert [frame["ball"][1] for frame in frames] == list(range(20))

    run(visit())


def test_each_client_steers_a_character_of_its_own():
    async def visit():
        fake = Fake()
        async with serving(fake) as (_, connect):
            one, two = await connect(), await connect()
            one.send({"velocity": [1, 2]}, {"label": "brisk"}, {"facing": [2, 0]})
            two.send({"velocity": [3, 4]})
            for client, root, facing in (
                (one, [1.0, 1.0, 2.0], 1.0),
                (two, [3.0, 0.0, 4.0], 0.0),
            ):
                frame = await client.frame(lambda f, root=root: f["root"] == root)
                assert frame["ball"][2] == facing
            assert fake.seeds == [0, 1]

    run(visit())


def test_wrong_lines_are_answered_and_change_nothing():
    async def visit():
        async with serving() as (_, connect):
            client = await connect()
            client.send({"velocity": [1, 2], "label": "brisk"})
            await client.frame(lambda f: f["root"] == [1.0, 1.0, 2.0])
            wrong = [
                b"nonsense",
                b"\xff\xff",
                b'{"velocity": [5, 5], "label": "angry"}',
                b"[" * 4000,
                b"x" * 50000,
                b'{"jump": 1}',
            ]
            client.send(*wrong, {"velocity": [0, 7]})
            last, before = await client.until(
                lambda m: m and "tick" in m and m["root"] == [0.0, 1.0, 7.0]
            )
            errors = [m["error"] for m in before if "error" in m]
            assert [
                any(word in error for word in words)
                for error, words in zip(
                    errors,
                    (
                        ["not JSON"],
                        ["UTF-8"],
                        ["'label'"],
                        ["nested", "not JSON"],
                        ["too long"],
                        ["'jump'"],
                    ),
                    strict=True,
                )
            ] == [True] * 6
            roots = {tuple(m["root"]) for m in before if "tick" in m}
            assert roots <= {(1.0, 1.0, 2.0)}

    run(visit())


@pytest.mark.slow
def test_a_flood_is_read_no_faster_than_the_limit():
    async def visit():
        async with serving(lines_per_tick=8) as (_, connect):
            begin = time.perf_counter()
            client = await connect()
            client.send(*[b"{"] * 400)
            for _ in range(400):
                await client.error()
            # 8 lines at once, then 8 a tick, of which some pieces cost one as well.
            assert time.perf_counter() - begin > 0.8 * (400 - 8) / 8 / FPS
            client.send({"velocity": [1, 2]})
            await client.frame(lambda f: f["root"] == [1.0, 0.0, 2.0])

    run(visit())


async def waiting(server):
    """Bytes that wait for each client."""
    return [c.transport.get_write_buffer_size() for c in server._clients]


@pytest.mark.slow
@pytest.mark.parametrize("flood", [b"", b"{\n" * 2000, b"x" * 4096])
def test_who_does_not_read_is_bounded_then_dropped(flood):
    """Whether it is silent, or sends nonsense all the time; others notice nothing."""

    async def visit():
        fake = Fake(size=600)  # frames of 24 kB
        limits = dict(buffer=100_000, stuck=0.3)
        async with serving(fake, **limits) as (server, connect):
            lazy, other = await connect(SO_RCVBUF=4096), await connect()
            lazy.writer.transport.pause_reading()
            most, frames = 0, []
            for _ in range(2000):
                lazy.writer.write(flood if len(server._clients) == 2 else b"")
                frames.append(await other.frame())
                most = max(most, *await waiting(server))
                if len(server._clients) == 1:
                    break
                lazy.writer.transport._buffer.clear()  # ours, not the server's
            assert len(server._clients) == 1, "it was kept"
            assert 100_000 < most < 150_000
            assert other.reader.at_eof() is False
            assert all(f["ball"][1] == i for i, f in enumerate(frames))

    run(visit())


@pytest.mark.slow
def test_who_reads_slowly_misses_frames_and_is_told():
    async def visit():
        async with serving(Fake(size=600), buffer=50_000) as (server, connect):
            client = await connect(SO_RCVBUF=65536)
            client.writer.transport.pause_reading()
            while not any(c.late > 20 for c in server._clients):
                await asyncio.sleep(0.05)
            client.writer.transport.resume_reading()
            frame = await client.frame(lambda f: f["late"] > 20)
            assert frame["tick"] == frame["ball"][1]  # it walked on meanwhile
            later = await client.frame(lambda f: f["tick"] > frame["tick"] + 30)
            gaps = later["tick"] - frame["tick"]
            assert later["late"] - frame["late"] < gaps  # served again
            assert len(server._clients) == 1

    run(visit())


def test_one_client_too_many_is_told_and_then_there_is_room():
    async def visit():
        async with serving(clients=2) as (server, connect):
            clients = [await connect() for _ in range(2)]
            for client in clients:
                await client.frame()
            third = await connect()
            assert await third.message() == {"error": "busy"}
            assert await third.message() is None
            clients[0].writer.close()
            while len(server._clients) == 2:
                await asyncio.sleep(0.01)
            await (await connect()).frame()
            await clients[1].frame()

    run(visit())


def test_clients_that_vanish_do_no_harm():
    async def visit():
        async with serving(clients=4) as (server, connect):
            other = await connect()
            for i in range(20):
                rude = await connect(SO_SNDBUF=4096)
                found = rude.writer.get_extra_info("socket")
                found.setsockopt(
                    socket.SOL_SOCKET, socket.SO_LINGER, struct.pack("ii", 1, 0)
                )
                if i % 2:
                    await rude.frame()
                    rude.send(*[b"{"] * 100, b'{"velo')
                await asyncio.sleep(0)
                rude.writer.transport.abort()
                while len(server._clients) > 3:
                    await asyncio.sleep(0.01)
            while len(server._clients) > 1:
                await asyncio.sleep(0.01)
            last = await other.frame()
            await other.frame(lambda f: f["tick"] > last["tick"] + 10)
            await (await connect()).frame()

    run(visit())


def test_half_a_line_is_no_command_and_its_end_ends_the_connection():
    async def visit():
        async with serving() as (server, connect):
            client = await connect()
            client.writer.write(b'{"velocity": [1, 2]}')
            client.writer.write_eof()
            while len(server._clients):
                await asyncio.sleep(0.01)
            _, before = await client.until(lambda m: m is None)
            assert all(m["root"] == [0.0] * 3 for m in before if "tick" in m)

    run(visit())


def test_a_simulation_that_fails_ends_its_own_client_only(capsys):
    async def visit():
        async with serving(Fake(fail_at=5)) as (server, connect):
            one, two = await connect(), await connect()
            assert await one.error() == "the simulation failed"
            assert await one.message() is None
            await two.frame(lambda f: f["tick"] > 20)
            assert len(server._clients) == 1

    run(visit())
    assert "no more plans" in capsys.readouterr().err


@pytest.mark.slow
def test_ticks_keep_to_the_clock_however_long_each_takes():
    """Absolute times: a delay of one tick does not move the next ones."""
    generator = np.random.default_rng(0)
    pauses = generator.uniform(0.0, 1.2 / FPS, 1000)

    async def visit():
        fake = Fake(pause=lambda n: pauses[n % 1000])
        async with serving(fake, catch_up=0.25) as (_, connect):
            before = time.perf_counter()
            client = await connect()
            await client.frame()
            begin = time.perf_counter()
            frame = await client.frame(lambda f: f["tick"] >= 200)
            end = time.perf_counter()
            # Behind by the catch-up at most; sleeps between ticks would give 62 %.
            assert 0.8 * (end - begin) < frame["time"] < end - before + 0.3

    run(visit())


@pytest.mark.slow
@pytest.mark.parametrize("catch_up, least, most", [(10.0, 0, 0), (0.25, 55, 1000)])
def test_a_short_delay_is_caught_up_and_a_long_one_left_out(catch_up, least, most):
    async def visit():
        fake = Fake(pause=lambda n: 0.6 if n == 10 else 0.0)  # 60 ticks
        async with serving(fake, catch_up=catch_up) as (_, connect):
            frame = await (await connect()).frame(lambda f: f["tick"] >= 70)
            assert least <= frame["late"] <= most
            assert frame["late"] == frame["tick"] - frame["ball"][1]

    run(visit())


@pytest.mark.slow
def test_the_loop_answers_while_the_simulation_works():
    async def visit():
        fake = Fake(pause=lambda n: 1.0 if n == 3 else 0.0)
        async with serving(fake) as (_, connect):
            client = await connect()
            await client.frame(lambda f: f["tick"] == 2)
            await asyncio.sleep(0.1)  # the worker is in tick 3 now
            client.send(b"nonsense")
            begin = time.perf_counter()
            await client.error()
            assert time.perf_counter() - begin < 0.7

    run(visit())


@pytest.mark.slow
def test_stopping_hangs_up_on_everyone():
    async def visit():
        async with serving(Fake(size=600), buffer=50_000) as (server, connect):
            lazy, client = await connect(SO_RCVBUF=4096), await connect()
            lazy.writer.transport.pause_reading()
            while not any(c.late for c in server._clients):
                await client.frame()
        with contextlib.suppress(ConnectionError):
            await client.until(lambda m: m is None)

    begin = time.perf_counter()
    run(visit())
    assert time.perf_counter() - begin < 15


# The command line.


@pytest.fixture
def script(monkeypatch):
    """The script, with a simulation that costs nothing; its garbage is thawed."""
    module = load("serve")
    monkeypatch.setattr(module, "load", lambda run, data: Fake())
    yield module
    gc.unfreeze()


@pytest.mark.slow
@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_signals_close_it(script, monkeypatch, capsys, number):
    seen = []

    def visitor():
        while not (found := re.search(r":(\d+)\n", "".join(printed))):
            time.sleep(0.01)
        with socket.create_connection(("127.0.0.1", int(found[1]))) as client:
            client.settimeout(5)
            lines = client.makefile("rb")
            seen.extend(json.loads(lines.readline()) for _ in range(3))
            os.kill(os.getpid(), number)
            with contextlib.suppress(ConnectionError):
                while lines.readline():
                    pass

    printed = []
    monkeypatch.setattr(
        "builtins.print", lambda *x, **_: printed.append(f"{' '.join(x)}\n")
    )
    thread = threading.Thread(target=visitor)
    thread.start()
    script.serve(script.Config(port=0))
    thread.join()
    assert "hello" in seen[0] and seen[2]["tick"] == 1
    assert printed[-1] == "closed\n"
    assert "warning" not in "".join(printed)


@pytest.mark.parametrize(
    "host, local",
    [
        ("127.0.0.1", True),
        ("127.8.0.1", True),
        ("::1", True),
        ("localhost", True),
        ("0.0.0.0", False),
        ("::", False),
        ("192.168.0.2", False),
        ("example", False),
    ],
)
def test_other_addresses_are_warned_of(script, monkeypatch, capsys, host, local):
    def stop(run, data):
        raise ValueError("here")

    monkeypatch.setattr(script, "load", stop)
    monkeypatch.setattr(script.cli.socket, "getaddrinfo", lambda *args, **options: ())
    with pytest.raises(ValueError, match="here"):
        script.serve(script.Config(host=host))
    assert ("no authentication" in capsys.readouterr().err) is not local


def test_an_address_is_tried_before_anything_is_loaded(script, monkeypatch):
    monkeypatch.setattr(script, "load", None)
    with pytest.raises(ValueError, match="--port is 70000, expected .* 65535"):
        script.serve(script.Config(port=70000))
    with socket.create_server(("127.0.0.1", 0)) as other:
        port = other.getsockname()[1]
        with pytest.raises(OSError, match=f"cannot listen on 127.0.0.1:{port}: Addr"):
            script.serve(script.Config(port=port))
    with pytest.raises(OSError, match="cannot listen on no.such.host.invalid:7777"):
        script.serve(script.Config(host="no.such.host.invalid"))


def test_what_cannot_be_served_is_named(tmp_path, script_load):
    with pytest.raises(ValueError, match="actions makes whole motions: it is sampled"):
        script_load("actions", None)
    with pytest.raises(ValueError, match="nowhere: no such file .*locomotion"):
        script_load(str(tmp_path / "nowhere"), None)
    with pytest.raises(OSError, match="none.npz"):
        script_load("locomotion", tmp_path / "none.npz")


# The scripted client.


def test_the_client_measures_from_the_schedule():
    client = load("serve_client")
    arrivals = {0: 10.0, 1: 10.1, 2: 10.2, 3: 10.35, 5: 10.5}
    frames = [{"tick": n, "arrival": at} for n, at in arrivals.items()]
    found = client.timing(frames, fps=10.0, until=10.72)
    assert found["frames received"] == 5 and found["frames expected"] == 8
    assert found["jitter p50 ms"] == pytest.approx(25)  # of 0, 0, 50, 50
    assert found["lateness p50 ms"] == pytest.approx(0, abs=1e-6)
    assert found["lateness p99 ms"] == pytest.approx(48)  # of 0, 0, 0, 50, 0
    with pytest.raises(RuntimeError, match="1 frames"):
        client.timing(frames[:1], fps=10.0, until=11.0)


def test_all_that_the_client_calls_malformed_is(protocol):
    splitter = protocol.LineSplitter()
    lines = splitter.feed(b"".join(load("serve_client").malformed(100)))
    assert len(lines) == 100
    for line in lines:
        with pytest.raises(protocol.ProtocolError):
            protocol.parse_command(line, protocol.Command(), LABELS)


# Characters.


@pytest.fixture
def script_load():
    return load("serve").load


def counting_controller(_):
    """Walks as told; a plan, made when the label changes, draws a number."""

    def plan(key, state, command):
        return state | {"label": command.label, "drawn": jax.random.normal(key)}

    def advance(state, command):
        root = state["root"] + jnp.array([1.0, 0.0, 1.0]) * command.velocity[0]
        shown = Frame(
            root_position=state["root"],
            joint_rotation=jnp.full((len(tiny.NAMES), 6), state["drawn"]),
            desired_velocity=command.velocity,
            desired_facing=command.facing,
            planned=jnp.zeros((), bool),
            extra={"ball": jnp.append(command.facing, state["label"])},
            fps=30.0,
        )
        return state | {"root": root}, shown

    return rollout.Controller(
        plan_level=lambda state, command: jnp.int32(state["label"] != command.label),
        plans=(plan,),
        advance=advance,
    )


def test_a_controller_is_told_everything_in_one_program(protocol):
    first = {"root": jnp.zeros(3), "label": jnp.int32(-1), "drawn": jnp.zeros(())}
    character = steering.Character(
        skeleton=tiny.skeleton(),
        labels=tiny.STYLES,
        fps=30.0,
        source="made in the tests",
        params=None,
        method=counting_controller,
        starts=lambda labels, seed: jax.tree.map(lambda x: x[None], first),
    )
    simulation = load("serving.simulation").Characters(character)
    assert simulation.joints == tiny.NAMES and simulation.parents == tiny.PARENTS
    np.testing.assert_array_equal(simulation.offsets, np.float32(tiny.OFFSETS))
    calm = protocol.Command(velocity=(0.5, 1.0), facing=(0.6, 0.8), label="calm")
    brisk = protocol.Command(velocity=(2.0, 1.0), facing=(0.0, 1.0), label="brisk")
    given = [calm, calm, brisk, brisk]
    one, two, drawn = simulation.start(5), simulation.start(6), {5: 0, 6: 0}
    for n, command in enumerate(given):
        one, mine = simulation.step(one, command, n)
        two, other = simulation.step(two, calm, n)
        for seed, frame, own in ((5, mine, command), (6, other, calm)):
            if n == 0 or own != calm and n == 2:
                key = jax.random.fold_in(jax.random.key(seed), n)
                drawn[seed] = float(jax.random.normal(key))
            np.testing.assert_allclose(frame["rotations"], drawn[seed], atol=1e-6)
            *facing, label = frame["ball"]
            assert label == tiny.STYLES.index(own.label)
            np.testing.assert_allclose(facing, own.facing)
            walked = sum(c.velocity[0] for c in given[:n]) if seed == 5 else 0.5 * n
            np.testing.assert_allclose(frame["root"], [walked, 0, walked])
    assert simulation._tick._cache_size() == 1
    assert np.all(np.asarray(simulation.start(7)[1]["root"]) == 0), "it was used up"


@pytest.mark.slow
def test_the_shipped_locomotion_is_served(script_load, protocol):
    simulation = script_load("locomotion", None)
    load("serving.simulation").warm(simulation)
    assert simulation.labels == ("neutral", "crouch") and simulation.fps == 30.0
    joints = len(simulation.joints)
    state, roots = simulation.start(0), []
    for n in range(20):  # plans at 0 and 15, a guided one at 10
        command = protocol.Command(
            velocity=(0.0, 1.0), label=simulation.labels[n // 10]
        )
        state, frame = simulation.step(state, command, n)
        assert sorted(frame) == ["root", "rotations"]
        columns = frame["rotations"].reshape(joints, 2, 3)
        np.testing.assert_allclose(
            columns @ columns.swapaxes(1, 2),
            np.tile(np.eye(2), (joints, 1, 1)),
            atol=1e-4,
        )
        roots.append(frame["root"])
    assert np.all(np.isfinite(roots)) and np.all(np.std(roots, axis=0) > 0)
    assert roots[-1][2] > 0.05, "it did not walk"
    assert simulation._tick._cache_size() == 1


@pytest.mark.slow
@pytest.mark.parametrize("name", mostly_slow(["locomotion", "walker"], ["walker"]))
def test_shipped_models_start_without_clips(script_load, name):
    state = script_load(name, None).start(0)[1].inner  # beside its feet
    np.testing.assert_allclose(state.past.root_position[-1, ::2], 0, atol=1e-5)
    np.testing.assert_allclose(state.facing, [0, 1], atol=1e-4)


def test_characters_start_from_clips(script_load, tmp_path):
    """An exported model, which has no poses of its own."""
    found = samples.run()
    clips_io.save_clips(tmp_path / "clips.npz", found.train)
    value = camdm_model.to_json(found.model)
    checkpoint.export_params(tmp_path / "camdm.npz", found.params, value)
    simulation = script_load(str(tmp_path / "camdm.npz"), tmp_path / "clips.npz")
    past = simulation.start(0)[1].past
    np.testing.assert_allclose(past.root_position[-1, ::2], 0, atol=1e-5)
    rotations = np.asarray(found.train.joint_rotation[:, 1:])
    shown = np.asarray(past.joint_rotation[-1, 1:])
    assert np.abs(rotations - shown[None]).max(axis=(1, 2)).min() < 1e-5
