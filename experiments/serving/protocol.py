r"""The protocol between a game engine and the server: lines of JSON over TCP, in UTF-8.

World axes: y up, right-handed; ground vectors are [x, z]; each connection steers a
character of its own. The engine sends any subset, at any time (what is left out keeps
its value; of several commands between two frames the last counts):
  {"velocity": [0.0, 1.2], "facing": [0.0, 1.0], "label": "elderly"}
  - velocity: wanted, m/s, at most 20 m/s long; at first [0, 0].
  - facing: wanted direction, of a length from 0.001 to 1000; at first [0, 1].
  - label: one of those in the hello; at first their first.

The server sends one line at the start, with each joint's offset in its parent's frame:
  {"hello": {"version": 1, "fps": 30.0, "joints": [names], "parents": [-1, 0, ...],
             "offsets": [[x, y, z], ...], "labels": [names],
             "units": "meters, y up; rotations 6D two columns"}}

and then one line a tick, fps times per second:
  {"tick": 7, "time": 0.233, "root": [x, y, z], "rotations": [[6], ...], "late": 0}
  - tick: from 0. time: tick / fps, seconds. root: world position of joint 0.
  - rotations: of each joint relative to its parent (joint 0: to the world), the first
    column of the matrix, then the second.
  - ball: [x, y, z], in systems with a ball.
  - late: ticks so far without a frame: the client read or the server computed too
    slowly (then the character paused).

A line that is no JSON object of these fields in range, or longer than 4096 bytes, is
answered by {"error": "field 'velocity' is ..., expected ..."} and changes nothing. A
client that does not read gets nothing, and after 10 s no connection; one that sends too
much is read more slowly; one client too many gets {"error": "busy"}.
"""

import dataclasses
import json
import math
from typing import Any

import numpy as np

VERSION = 1
MAX_LINE = 4096
MAX_SPEED = 20.0
FACING_LENGTHS = (1e-3, 1e3)
UNITS = "meters, y up; rotations 6D two columns"
# Characters of a client's own text that an error repeats.
_QUOTED = 40


class ProtocolError(ValueError):
    """A line that is not a command; the message names the field."""


@dataclasses.dataclass(frozen=True, kw_only=True)
class Command:
    """What a client asks of its character.

    Attributes:
      velocity: Wanted velocity (x, z), meters per second, world.
      facing: Wanted facing (x, z), unit length, world.
      label: Name of the style or skill; None in systems without any.
    """

    velocity: tuple[float, float] = (0.0, 0.0)
    facing: tuple[float, float] = (0.0, 1.0)
    label: str | None = None


def _quote(value: Any) -> str:
    text = repr(value)
    return text if len(text) <= _QUOTED else f"{text[:_QUOTED]}..."


def _vector(name: str, value: Any) -> tuple[float, float]:
    expected = f"field {name!r} is {_quote(value)}, expected two finite numbers [x, z]"
    if not isinstance(value, list) or len(value) != 2:
        raise ProtocolError(expected)
    # A bool is an int to Python, not to JSON.
    if any(isinstance(x, bool) or not isinstance(x, int | float) for x in value):
        raise ProtocolError(expected)
    try:
        x, z = (float(number) for number in value)
    except OverflowError:
        raise ProtocolError(expected) from None
    if not (math.isfinite(x) and math.isfinite(z)):
        raise ProtocolError(expected)
    return x, z


def _velocity(value: Any) -> tuple[float, float]:
    x, z = _vector("velocity", value)
    speed = math.hypot(x, z)
    if speed > MAX_SPEED:
        raise ProtocolError(
            f"field 'velocity' is {speed:g} m/s, expected at most {MAX_SPEED:g}"
        )
    return x, z


def _facing(value: Any) -> tuple[float, float]:
    x, z = _vector("facing", value)
    length, (least, most) = math.hypot(x, z), FACING_LENGTHS
    if not least <= length <= most:
        raise ProtocolError(
            f"field 'facing' is {length:g} long, expected {least:g} to {most:g}"
        )
    return x / length, z / length


def _label(value: Any, labels: tuple[str, ...]) -> str:
    if not isinstance(value, str) or value not in labels:
        known = ", ".join(labels) or "none"
        raise ProtocolError(
            f"field 'label' is {_quote(value)}, expected one of: {known}"
        )
    return value


def _json_object(line: bytes) -> dict[str, Any]:
    try:
        value = json.loads(line.decode("utf-8"))
    except UnicodeDecodeError as error:
        raise ProtocolError(f"line is not UTF-8 at byte {error.start}") from None
    except ValueError as error:
        raise ProtocolError(f"line is not JSON: {error}") from None
    if not isinstance(value, dict):
        raise ProtocolError(f"line is {_quote(value)}, expected a JSON object")
    return value


def parse_command(line: bytes, last: Command, labels: tuple[str, ...]) -> Command:
    """The command that a line makes of the last one.

    Args:
      line: What the client sent, without its newline.
      last: The command until now; keeps what the line leaves out.
      labels: Names that the system knows.

    Returns:
      The new command.

    Raises:
      ProtocolError: if anything about the line is wrong; nothing of it counts then.
    """
    if len(line) > MAX_LINE:
        raise ProtocolError(f"line is too long, expected at most {MAX_LINE} bytes")
    parsers = {
        "velocity": _velocity,
        "facing": _facing,
        "label": lambda value: _label(value, labels),
    }
    changes = {}
    try:
        for name, value in _json_object(line).items():
            if name not in parsers:
                raise ProtocolError(
                    f"unknown field {_quote(name)}, expected {', '.join(parsers)}"
                )
            changes[name] = parsers[name](value)
    except RecursionError:  # from reading the line, or from quoting it
        raise ProtocolError("line is nested too deeply") from None
    return dataclasses.replace(last, **changes)


class LineSplitter:
    """Cuts a stream of bytes into lines, and keeps no more of it than one line."""

    def __init__(self) -> None:
        self._rest = b""
        self._skipping = False

    def feed(self, data: bytes) -> list[bytes]:
        """The lines that some more bytes complete.

        Args:
          data: The next bytes of the stream.

        Returns:
          Whole lines without newlines. Of one that is too long only the beginning, as
          soon as it is longer than `MAX_LINE`; the rest of it is dropped.
        """
        *whole, self._rest = (self._rest + data).split(b"\n")
        if whole and self._skipping:
            del whole[0]  # the end of the long line
            self._skipping = False
        if self._skipping:
            self._rest = b""
        elif len(self._rest) > MAX_LINE:
            whole.append(self._rest)
            self._rest, self._skipping = b"", True
        return [line[: MAX_LINE + 1] for line in whole]


def _encode(value: dict[str, Any]) -> bytes:
    return json.dumps(value, allow_nan=False, separators=(",", ":")).encode() + b"\n"


def error_line(message: str) -> bytes:
    """The answer to a line that was wrong.

    Args:
      message: What was wrong.

    Returns:
      One line.
    """
    return _encode({"error": message})


def hello_line(simulation: Any) -> bytes:
    """The first line of a connection.

    Args:
      simulation: A `simulation.Characters`.

    Returns:
      One line.
    """
    hello = {
        "version": VERSION,
        "fps": simulation.fps,
        "joints": list(simulation.joints),
        "parents": list(simulation.parents),
        "offsets": np.round(simulation.offsets.astype(float), 6).tolist(),
        "labels": list(simulation.labels),
        "units": UNITS,
    }
    return _encode({"hello": hello})


def frame_line(
    tick: int, frame: dict[str, np.ndarray], *, fps: float, late: int
) -> bytes:
    """One pose.

    Args:
      tick: Its number.
      frame: Its arrays by name; at least "root" and "rotations".
      fps: Ticks per second.
      late: Ticks so far without a frame.

    Returns:
      One line; meters to a hundredth of a millimeter.

    Raises:
      ValueError: if a number is not finite.
    """
    # Rounded: twice as short, and still finer than the eye or a network's output.
    arrays = {k: np.round(x.astype(float), 5).tolist() for k, x in frame.items()}
    head = {"tick": tick, "time": round(tick / fps, 4)}
    return _encode(head | arrays | {"late": late})
