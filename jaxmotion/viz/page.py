"""Serves a session to browsers: a page over HTTP, frames and inputs over a WebSocket.

The page's sources are plain modules in the folder `web`, served as they are. The server
sends text (JSON: `state` whenever it changes, `body`, a number, whenever what is drawn
does, for /body/<number> as `packed` has it, `error` for input that was wrong) and a
frame a tick as little-endian float32:

    engine, tick, milliseconds, plans, characters, joints, balls, fps,
    told velocity (x, z), told facing (x, z), ticks of the shown plan,
    roots [characters, 3], rotations [characters, joints, 6], balls [balls, 3],
    the plan's path (x, z), root (3) and rotations [joints, 6] at its end

The browser sends JSON: {"held": [...], "azimuth": radians, "target": [x, z] or null},
where "path" may be waypoints [[x, z], ...], "stick" and "face" [right, ahead] of
somebody's sticks, {"set": {name: value}}, {"do": "reset" | "step" | "record"} or
{"save": ".bvh"}.

A browser that reads slowly gets fewer frames, the newest ones, and holds up nobody.
Only pages from this very server may connect, so no other web site steers. Where only
this machine is served, a name that someone points at it is not answered.
"""

import asyncio
import dataclasses
import json
import math
import threading
from collections.abc import Callable
from http import HTTPStatus
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit

import numpy as np

from jaxmotion.control import waypoints
from jaxmotion.control.steering import MOVES, Inputs
from jaxmotion.viz import packed
from jaxmotion.viz.viewer import Session, Shown

MOST_PEOPLE = 32
SUFFIXES = (".bvh", ".glb", ".npz")
_LARGEST_MESSAGE = 4096
_STICKS = ("stick", "face")
_WEB = Path(__file__).with_name("web")
# What the page is made of; `local.js` and what it needs are the static page's.
_FILES = (
    *("body.js", "camera.js", "figures.js", "gltf.js", "input.js", "linear.js"),
    *("page.js", "panel.js", "person.js", "rig.js", "save.js", "scene.js", "shape.js"),
    *("socket.js", "steer.js", "transfer.js", "waypoints.js"),
)

# Writes a take: (path, skeleton, motion).
Save = Callable[[Path, Any, Any], None]


def websockets() -> Any:
    """The package, which the extra [viewer] brings.

    Raises:
      ValueError: if it is missing; says how to get it.
    """
    try:
        import websockets.asyncio.server
    except ImportError:
        raise ValueError(
            'the live page needs the package websockets: pip install -e ".[viewer]"'
        ) from None
    return websockets


def frame_bytes(shown: Shown, fps: float) -> bytes:
    """A tick as the page reads it; see the module's text."""
    balls = np.zeros((0, 3)) if shown.ball is None else shown.ball
    characters, joints = shown.rotations.shape[:2]
    path, end = np.zeros((0, 3)), ()
    if shown.plan is not None:
        path, ghost = shown.plan
        end = (path[-1], ghost)
    head = (
        *(shown.engine, shown.tick, shown.milliseconds, shown.planned),
        *(characters, joints, len(balls), fps),
        *shown.told.velocity,
        *shown.told.facing,
        len(path),
    )
    parts = (head, shown.roots, shown.rotations, balls, path[:, ::2], *end)
    return np.concatenate([np.ravel(x) for x in parts]).astype("<f4").tobytes()


def read_message(text: str | bytes) -> dict[str, Any]:
    """What a browser says, checked; `held` and what comes with it become `inputs`.

    Raises:
      ValueError: names what is wrong.
    """
    try:
        value = json.loads(text)
    except (ValueError, RecursionError):
        raise ValueError("message is no JSON") from None
    if not isinstance(value, dict):
        raise ValueError("message is no JSON object")
    if "held" not in value:
        return value
    held, target, path = value["held"], value.get("target"), value.get("path", [])
    azimuth = value.get("azimuth", math.nan)
    if not isinstance(held, list) or not all(x in MOVES for x in held):
        raise ValueError(f"held is wrong, expected some of {', '.join(MOVES)}")
    is_point = lambda x: isinstance(x, list) and len(x) == 2  # noqa: E731
    if target is not None and not is_point(target):
        raise ValueError("target is wrong, expected [x, z] or null")
    if not isinstance(path, list) or not all(map(is_point, path)):
        raise ValueError("path is wrong, expected a list of [x, z]")
    if len(path) > waypoints.MOST:
        raise ValueError(
            f"path has {len(path)} points, expected at most {waypoints.MOST}"
        )
    numbers = [azimuth, *(target or ()), *(x for point in path for x in point)]
    if not all(type(x) in (int, float) and abs(x) < 1e5 for x in numbers):
        raise ValueError("azimuth, target or path is no finite number")
    place = lambda x: (float(x[0]), float(x[1]))  # noqa: E731
    inputs = Inputs(
        held=frozenset(held),
        azimuth=float(azimuth),
        target=None if target is None else place(target),
        path=tuple(map(place, path)),
    )
    sticks = {name: _stick(name, value[name]) for name in _STICKS if name in value}
    return {"inputs": dataclasses.replace(inputs, **sticks)}


def _stick(name: str, value: Any) -> tuple[float, float]:
    right = isinstance(value, list) and len(value) == 2
    if not right or not all(type(x) in (int, float) and abs(x) <= 1 for x in value):
        raise ValueError(f"{name} is wrong, expected [right, ahead] in -1..1")
    return float(value[0]), float(value[1])


class Page:
    """The session behind an address, until it is told to stop."""

    def __init__(
        self,
        session: Session,
        *,
        out: Path,
        save: Save,
        is_local: Callable[[str | None], bool],
    ) -> None:
        """Opens nothing yet.

        Args:
          session: What is steered; its `on_frame` and `on_change` become this page's.
          out: Folder for takes.
          save: Writes them.
          is_local: Whether only this machine reaches a host.
        """
        self.session, self._out, self._save = session, out, save
        self._writing = threading.Lock()
        self._is_local = is_local
        html = (_WEB / "index.html").read_text(encoding="utf-8")
        # Its own entry, in the place of the one that the static page is bundled to.
        html = html.replace('src="page.js"', 'src="socket.js"')
        self._files = {f"/{name}": (_WEB / name).read_bytes() for name in _FILES}
        self._html = html.encode()
        self._loop: asyncio.AbstractEventLoop | None = None
        self._clients: set[_Client] = set()
        self._local = True
        # Number of the engine and its body's file.
        self._body = (-1, b"")
        session.on_frame, session.on_change = self._on_frame, self._on_change

    async def serve(
        self, host: str, port: int, *, stop: asyncio.Event, ready: Callable[[int], None]
    ) -> None:
        """Serves until `stop` is set.

        Args:
          ready: Called with the port as soon as browsers can come.

        Raises:
          OSError: if the address cannot be listened on.
          ValueError: if the package websockets is missing.
        """
        package = websockets()
        self._loop, self._local = asyncio.get_running_loop(), self._is_local(host)
        thread = threading.Thread(target=self.session.run, daemon=True)
        async with package.asyncio.server.serve(
            self._person,
            host,
            port,
            process_request=self._request,
            compression=None,
            max_size=_LARGEST_MESSAGE,
            server_header=None,
            close_timeout=1,
        ) as server:
            thread.start()
            ready(server.sockets[0].getsockname()[1])
            await stop.wait()
        self.session.close()
        await asyncio.to_thread(thread.join, 5.0)

    # From the session's threads.

    def _on_frame(self, shown: Shown) -> None:
        data = frame_bytes(shown, self.session.fps)
        self._soon(self._publish, data)

    def _on_change(self) -> None:
        self._soon(self._publish, None)

    def _soon(self, function: Callable, *arguments: Any) -> None:
        if self._loop is not None and not self._loop.is_closed():
            self._loop.call_soon_threadsafe(function, *arguments)

    # In the event loop.

    def _publish(self, frame: bytes | None) -> None:
        for client in self._clients:
            if frame is None:
                client.state_due = True
            else:
                client.frame = frame
            client.news.set()

    def _request(self, connection: Any, request: Any) -> Any:
        """Answers all but the WebSocket's own request, or refuses it."""
        host, origin = (request.headers.get(x) for x in ("Host", "Origin"))
        host = host or ""
        try:
            name = urlsplit(f"//{host}").hostname
            asked = None if origin is None else urlsplit(origin).netloc
        except ValueError:  # half a bracket
            return connection.respond(HTTPStatus.BAD_REQUEST, "no such host\n")
        if self._local and not self._is_local(name):
            return connection.respond(HTTPStatus.FORBIDDEN, "not this host\n")
        path = urlsplit(request.path).path
        if path == "/live":
            if origin is not None and asked != host:
                return connection.respond(HTTPStatus.FORBIDDEN, "not this origin\n")
            return None
        if path == "/":
            return self._answer(connection, self._html, "text/html; charset=utf-8")
        if path in self._files:
            kind = "text/javascript; charset=utf-8"
            return self._answer(connection, self._files[path], kind)
        if path == f"/body/{self._body[0]}":
            return self._answer(connection, self._body[1], "application/octet-stream")
        name = path.removeprefix("/takes/")
        if path != name and name == Path(name).name and (self._out / name).is_file():
            data = (self._out / name).read_bytes()
            return self._answer(connection, data, "application/octet-stream", name)
        return connection.respond(HTTPStatus.NOT_FOUND, "no such page\n")

    def _answer(self, connection: Any, data: bytes, kind: str, name: str = "") -> Any:
        response = connection.respond(HTTPStatus.OK, "")
        response.body = data
        headers = response.headers
        for key in ("Content-Type", "Content-Length"):
            del headers[key]
        headers["Content-Type"], headers["Content-Length"] = kind, str(len(data))
        headers["Cache-Control"] = "no-store"
        if name:
            headers["Content-Disposition"] = f'attachment; filename="{name}"'
        return response

    async def _person(self, socket: Any) -> None:
        """Life of a browser's connection."""
        package = websockets()
        if len(self._clients) >= MOST_PEOPLE:
            await socket.close(1013, "busy")
            return
        client = _Client()
        self._clients.add(client)
        self.session.join(client)
        sender = asyncio.create_task(self._send(socket, client))
        try:
            async for text in socket:
                try:
                    self._obey(client, text)
                except (ValueError, OSError) as error:
                    client.tell(error)
        except package.exceptions.ConnectionClosed:
            pass
        finally:
            sender.cancel()
            self._clients.discard(client)
            self.session.leave(client)

    async def _send(self, socket: Any, client: "_Client") -> None:
        """Sends what is new, and of frames the newest, as fast as they are read."""
        body = -1
        package = websockets()
        try:
            while True:
                await client.news.wait()
                client.news.clear()
                if client.state_due:
                    client.state_due = False
                    state = self.session.state()
                    if state["engine"] != body and self.session.skeleton is not None:
                        body = state["engine"]
                        try:
                            await asyncio.to_thread(self._pack, body)
                            await socket.send(json.dumps({"body": body}))
                        except ValueError as error:  # a body that cannot be drawn
                            client.errors.append(str(error))
                    await socket.send(json.dumps({"state": state}))
                while client.errors:
                    await socket.send(json.dumps({"error": client.errors.pop(0)}))
                if client.saved:
                    await socket.send(json.dumps({"saved": client.saved}))
                    client.saved = ""
                frame, client.frame = client.frame, b""
                if frame:
                    await socket.send(frame)
        except package.exceptions.ConnectionClosed:
            pass

    def _pack(self, engine: int) -> None:
        """Makes the file of an engine's body, if it is not made yet."""
        skeleton, poses = self.session.skeleton, self.session.poses
        if self._body[0] == engine:
            return
        dress = self.session.dress
        if dress is not None:
            made = dress.packed
        elif skeleton is not None:
            about = {"skeleton": packed.skeleton_json(skeleton)}
            made = packed.pack(about, packed.body_arrays(skeleton, poses))
        else:
            return
        if engine > self._body[0]:  # not that of an engine which is gone by now
            self._body = engine, made

    def _obey(self, client: "_Client", text: str | bytes) -> None:
        message, session = read_message(text), self.session
        if "inputs" in message:
            session.steer(client, message["inputs"])
        elif isinstance(message.get("set"), dict):
            for name, value in message["set"].items():
                session.change(name, value)
        elif message.get("do") in ("reset", "step", "record"):
            getattr(session, message["do"])()
        elif message.get("save") in SUFFIXES:
            if client.saving is not None and not client.saving.done():
                raise ValueError("the take before is still being saved")
            client.saving = asyncio.create_task(self._keep(client, message["save"]))
        else:
            raise ValueError("unknown message, expected held, set, do or save")

    async def _keep(self, client: "_Client", suffix: str) -> None:
        """Saves the take, which may take seconds; inputs are obeyed meanwhile."""
        try:
            client.saved = (await asyncio.to_thread(self._write, suffix)).name
            client.news.set()
        except (ValueError, OSError) as error:
            client.tell(error)

    def _write(self, suffix: str) -> Path:
        """Saves the take under the next free name."""
        if (take := self.session.take) is None:
            raise ValueError("nothing is recorded yet")
        with self._writing:  # people may save at the same time
            number = 1
            while (path := self._out / f"take_{number:03d}{suffix}").exists():
                number += 1
            self._save(path, *take)
        return path


class _Client:
    """What a browser is yet to be sent."""

    def __init__(self) -> None:
        self.news, self.state_due = asyncio.Event(), True
        self.frame, self.saved = b"", ""
        self.errors: list[str] = []
        self.saving: asyncio.Task | None = None
        self.news.set()

    def tell(self, error: Exception) -> None:
        """Sends what was wrong, in one line."""
        self.errors = [" ".join(str(error).split())]
        self.news.set()
