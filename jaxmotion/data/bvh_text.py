"""The BVH text format: parse it, read it, write it; no motion mathematics.

A file is a HIERARCHY of joints (OFFSET, CHANNELS, children, End Sites) and a MOTION
block of one row of channel values a frame. Files of the wild differ in channel order,
in which joints have position channels, in line ends and spacing, and in frame rate:
all of that is kept as it is. Units are the file's own (mostly centimeters, degrees).
"""

import dataclasses
import math
import os
import re
import warnings
from typing import NoReturn, Protocol, runtime_checkable

import numpy as np
from jaxtyping import Float

from jaxmotion import files

CHANNELS = tuple(f"{axis}{kind}" for kind in ("position", "rotation") for axis in "XYZ")
_CANONICAL = {channel.lower(): channel for channel in CHANNELS}
_TOKEN = re.compile(r"[{}]|[^\s{}]+")
_MOTION = re.compile(r"^[ \t]*MOTION[ \t]*$", re.IGNORECASE | re.MULTILINE)
_FRAMES = re.compile(r"\s*Frames\s*:?\s*(\S+)\s*", re.IGNORECASE)
_FRAME_TIME = re.compile(r"\s*Frame\s+Time\s*:?\s*(\S+)\s*", re.IGNORECASE)
_FRAME_TIMES = (1e-5, 1e3)  # seconds


class BvhError(ValueError):
    """A BVH file that cannot be used; the message names the file and the line."""


def number(word: str) -> float:
    """A number (else `ValueError`) as other readers take it: float() knows more."""
    if not word.isascii() or "_" in word:
        raise ValueError(f"no number: {word!r}")
    return float(word)


def quote(word: str) -> str:
    """A word of a file, for a message of one short line."""
    return repr(word if len(word) <= 40 else f"{word[:40]}...")


class Hierarchy:
    """Reads the tokens of a HIERARCHY block into lists, one entry a joint."""

    def __init__(self, text: str, name: str):
        self.file = name
        self.tokens = [
            (match.group(), number)
            for number, line in enumerate(text.split("\n"), start=1)
            for match in _TOKEN.finditer(line)
        ]
        self.at = 0
        self.names: list[str] = []
        self.parents: list[int] = []
        self.offsets: list[tuple[float, float, float] | None] = []
        self.channels: list[tuple[str, ...]] = []
        self.end_sites: list[list[tuple[float, float, float]]] = []

    def fail(self, problem: str) -> NoReturn:
        """Raises an error at the token that was read last."""
        line = self.tokens[min(max(self.at - 1, 0), len(self.tokens) - 1)][1]
        raise BvhError(f"{self.file}, line {line}: {problem}")

    def take(self, expected: str) -> str:
        """Next token; `expected` says in words what it should be."""
        if self.at >= len(self.tokens):
            self.fail(f"the hierarchy ends where {expected} was expected (truncated?)")
        self.at += 1
        return self.tokens[self.at - 1][0]

    def want(self, word: str) -> None:
        """Next token must be that keyword."""
        found = self.take(repr(word))
        if found.upper() != word.upper():
            self.fail(f"expected {quote(word)}, found {quote(found)}")

    def numbers(self, what: str) -> tuple[float, float, float]:
        """Next three tokens as finite numbers."""
        values = []
        for _ in range(3):
            word = self.take(f"a number of {what}")
            try:
                values.append(number(word))
            except ValueError:
                self.fail(f"{what} needs three numbers, found {quote(word)}")
            if not np.isfinite(values[-1]):
                self.fail(f"{what} is not finite: {quote(word)}")
        return values[0], values[1], values[2]

    def joint_name(self) -> str:
        """Words up to the opening brace, on one line: names may contain spaces."""
        words = [self.take("a joint name")]
        line = self.tokens[self.at - 1][1]
        if words[0] in "{}":
            self.fail("a joint has no name")
        while (word := self.take("'{'")) != "{":
            if self.tokens[self.at - 1][1] != line:
                self.fail(
                    f"expected '{{' after joint {quote(words[0])}, found {quote(word)}"
                )
            words.append(word)
        name = " ".join(words)
        if name in self.names:
            self.at -= 1  # the line of the name, not of the brace
            self.fail(f"joint name {quote(name)} is used twice")
        return name

    def channel_list(self) -> tuple[str, ...]:
        """CHANNELS n name ... name, in canonical spelling."""
        word = self.take("the number of channels")
        # One ASCII digit: isdigit() takes superscripts, and int() refuses 5,000 digits.
        if word not in tuple("0123456"):
            self.fail(f"CHANNELS needs a number in 0..6, found {quote(word)}")
        found: list[str] = []
        for _ in range(int(word)):
            channel = self.take("a channel name")
            if channel.lower() not in _CANONICAL:
                known = ", ".join(CHANNELS)
                self.fail(f"unknown channel {quote(channel)}, expected one of {known}")
            if _CANONICAL[channel.lower()] in found:
                self.fail(f"channel {quote(channel)} occurs twice in one joint")
            found.append(_CANONICAL[channel.lower()])
        return tuple(found)

    def open_joint(self, parent: int) -> int:
        """Appends a joint; its brace is read, its fields are not."""
        self.names.append(self.joint_name())
        self.parents.append(parent)
        self.offsets.append(None)
        self.channels.append(())
        self.end_sites.append([])
        return len(self.names) - 1

    def end_site(self, joint: int) -> None:
        """End Site { OFFSET x y z }; the word End is read."""
        for word in ("Site", "{", "OFFSET"):
            self.want(word)
        self.end_sites[joint].append(self.numbers("OFFSET"))
        self.want("}")

    def read(self) -> None:
        """The whole block."""
        if not self.tokens:
            raise BvhError(f"{self.file}, line 1: no HIERARCHY before MOTION")
        self.want("HIERARCHY")
        self.want("ROOT")
        joint = self.open_joint(-1)
        while joint >= 0:
            word = self.take("'}' (a joint is not closed)")
            match word.upper():
                case "OFFSET":
                    self.offsets[joint] = self.numbers("OFFSET")
                case "CHANNELS":
                    self.channels[joint] = self.channel_list()
                case "JOINT":
                    joint = self.open_joint(joint)
                case "END":
                    self.end_site(joint)
                case "}":
                    if self.offsets[joint] is None:
                        self.fail(f"joint {quote(self.names[joint])} has no OFFSET")
                    joint = self.parents[joint]
                case _:
                    self.fail(
                        "expected OFFSET, CHANNELS, JOINT, End Site or '}', "
                        f"found {quote(word)}"
                    )
        if self.at < len(self.tokens):
            word = self.take("nothing")
            self.fail(f"expected MOTION after the root, found {quote(word)}")


@runtime_checkable
class Readable(Protocol):
    """An open binary file."""

    def read(self) -> bytes:
        """The rest of the file."""
        ...


@dataclasses.dataclass(frozen=True, kw_only=True, eq=False)
class Bvh:
    """What a BVH file says, in the file's own units and joint order.

    Attributes:
      parents: Parent of each joint; -1 for the root, else smaller than the joint.
      offsets: OFFSET of each joint, in its parent's frame.
      channels: For each joint its channels in file order, such as "Zrotation".
      end_sites: For each joint the offsets of its End Sites (none, one or several).
      values: Channel values, one row a frame; angles in degrees.
      frame_time: Seconds a frame.
      frame_decimals: How many decimals of it are written; None where nobody says.
      name: File name (or another name) for messages.
    """

    names: tuple[str, ...]
    parents: tuple[int, ...]
    offsets: Float[np.ndarray, "joints 3"]
    channels: tuple[tuple[str, ...], ...]
    end_sites: tuple[tuple[tuple[float, float, float], ...], ...]
    values: Float[np.ndarray, "frames channels"]
    frame_time: float
    frame_decimals: int | None = None
    name: str = "bvh"

    @property
    def num_joints(self) -> int:
        """Number of joints."""
        return len(self.names)

    @property
    def num_frames(self) -> int:
        """Number of frames."""
        return self.values.shape[0]


def _header_number(lines: list[str], at: int, pattern, name: str, what: str):
    """The number after 'Frames:' or 'Frame Time:'; returns it and the next index."""
    while at < len(lines) and not lines[at].strip():
        at += 1
    if at >= len(lines):
        raise BvhError(f"{name}: the file ends where '{what}' was expected (truncated)")
    match = pattern.fullmatch(lines[at])
    try:
        value = number(match.group(1)) if match else np.nan
    except ValueError:
        value = np.nan
    if not (np.isfinite(value) and value > 0):
        raise BvhError(
            f"{name}, line {at + 1}: expected '{what} <positive number>', "
            f"found {quote(lines[at].strip())}"
        )
    return value, at + 1


def _rows(lines: list[str], start: int, shape: tuple[int, int], name: str):
    """Frame rows from line `start` on, each checked for width and finite values."""
    num_frames, width = shape
    values = np.empty(shape)
    row = 0
    with warnings.catch_warnings():
        # NumPy warns, and stops, at a word that is no number.
        warnings.simplefilter("error", DeprecationWarning)
        for number in range(start, len(lines)):
            line = lines[number].strip()
            if not line:
                continue
            where = f"{name}, line {number + 1}"
            if row == num_frames:
                raise BvhError(f"{where}: more rows than the {num_frames} of 'Frames:'")
            try:
                parsed = np.fromstring(line, sep=" ")
            except (DeprecationWarning, ValueError):
                raise BvhError(
                    f"{where}: frame {row} has a value that is no number"
                ) from None
            if parsed.size != width:
                raise BvhError(
                    f"{where}: frame {row} has {parsed.size} values, the channels "
                    f"need {width} (truncated or malformed)"
                )
            if not np.isfinite(parsed).all():
                raise BvhError(f"{where}: frame {row} has a NaN or infinite value")
            values[row] = parsed
            row += 1
    if row != num_frames:
        raise BvhError(
            f"{name}: 'Frames:' says {num_frames}, the file has {row} rows (truncated)"
        )
    return values


def parse_bvh(text: str, *, name: str = "bvh") -> Bvh:
    r"""What BVH text says, in its own units; line ends may be \n, \r\n or \r.

    A `BvhError` names the file (by `name`) and the line of anything malformed.

    Source: Biovision's BVH format (Meredith and Maddock 2001).
    """
    text = text.replace("\r\n", "\n").replace("\r", "\n").removeprefix("\ufeff")
    motion = _MOTION.search(text)
    hierarchy = Hierarchy(text[: motion.start()] if motion else text, name)
    hierarchy.read()
    if motion is None:
        raise BvhError(f"{name}: no MOTION block after the hierarchy (truncated)")
    lines = text.split("\n")
    start = text.count("\n", 0, motion.end()) + 1
    count, start = _header_number(lines, start, _FRAMES, name, "Frames:")
    if count != int(count):
        raise BvhError(f"{name}, line {start}: 'Frames:' is no whole number: {count}")
    frame_time, start = _header_number(lines, start, _FRAME_TIME, name, "Frame Time:")
    if not _FRAME_TIMES[0] <= frame_time <= _FRAME_TIMES[1]:
        raise BvhError(
            f"{name}, line {start}: 'Frame Time:' should be in {_FRAME_TIMES[0]:g}.."
            f"{_FRAME_TIMES[1]:g} seconds, found {frame_time:g}"
        )
    told = _FRAME_TIME.fullmatch(lines[start - 1])
    whole, _, part = told[1].partition(".") if told else ("", "", "")
    decimals = len(part) if f"{whole}{part}".isdecimal() else None
    width = sum(len(channels) for channels in hierarchy.channels)
    # The number of lines bounds the rows: a wild 'Frames:' must not allocate memory.
    if count > len(lines):
        raise BvhError(
            f"{name}: 'Frames:' says {int(count)}, the file has only "
            f"{len(lines) - start} more lines (truncated)"
        )
    return Bvh(
        names=tuple(hierarchy.names),
        parents=tuple(hierarchy.parents),
        offsets=np.array(hierarchy.offsets, np.float64),
        channels=tuple(hierarchy.channels),
        end_sites=tuple(tuple(sites) for sites in hierarchy.end_sites),
        values=_rows(lines, start, (int(count), width), name),
        frame_time=frame_time,
        frame_decimals=decimals,
        name=name,
    )


def read_bvh(
    source: str | os.PathLike | bytes | Readable, *, name: str | None = None
) -> Bvh:
    """What a BVH file says, in its own units.

    The source is a path, the bytes of a file, or an open binary file (such as a zip
    member). A `BvhError` names the file (by default the path) and the line of anything
    malformed.
    """
    if isinstance(source, bytes):
        data, default = source, "bvh"
    elif isinstance(source, str | os.PathLike):
        data, default = files.read_bytes(source), os.fspath(source)
    else:
        data, default = source.read(), str(getattr(source, "name", "bvh"))
    name = default if name is None else name
    try:
        text = data.decode("utf-8")
    except UnicodeDecodeError as error:
        raise BvhError(f"{name}: not a text file (byte {error.start})") from None
    return parse_bvh(text, name=name)


def _joint_lines(bvh: Bvh) -> tuple[list[str], list[int]]:
    """Lines of all joints, depth first, and the joints in that order."""
    children: list[list[int]] = [[] for _ in bvh.names]
    for joint, parent in enumerate(bvh.parents[1:], start=1):
        children[parent].append(joint)
    lines, order = [], []
    # A joint to open, or lines that close one; a stack, since chains may be long.
    todo: list[tuple[int, int] | list[str]] = [(0, 0)]
    while todo:
        if isinstance(item := todo.pop(), list):
            lines += item
            continue
        joint, depth = item
        order.append(joint)
        # Indents of a chain would otherwise grow with the square of its length.
        indent = "\t" * min(depth, 64)
        kind = "ROOT" if bvh.parents[joint] < 0 else "JOINT"
        channels = bvh.channels[joint]
        title = re.sub(r"[{}\r\n]+", "_", bvh.names[joint])  # what ends a name
        lines += [
            f"{indent}{kind} {title}",
            f"{indent}{{",
            f"{indent}\tOFFSET {_numbers(bvh.offsets[joint])}",
            " ".join([f"{indent}\tCHANNELS", str(len(channels)), *channels]),
        ]
        end = []
        for site in bvh.end_sites[joint]:
            inner = ["End Site", "{", f"\tOFFSET {_numbers(site)}", "}"]
            end += [f"{indent}\t{line}" for line in inner]
        todo.append([*end, f"{indent}}}"])
        todo += [(child, depth + 1) for child in reversed(children[joint])]
    return lines, order


def _numbers(values) -> str:
    """Numbers with up to nine decimals and no negative zeros."""
    # Positional, because some readers know no exponents.
    return " ".join(
        np.format_float_positional(round(float(value), 9) + 0.0, precision=9, trim="-")
        for value in values
    )


def format_bvh(bvh: Bvh, *, decimals: int = 6) -> str:
    """BVH text of a file's content, with Unix line ends and so many decimals.

    Joints are written depth first, so the channels of a skeleton that is ordered
    otherwise are permuted with them.
    """
    joints, order = _joint_lines(bvh)
    lines = ["HIERARCHY", *joints, "MOTION"]
    # As many decimals as were read, for they say how far the number is rounded; else
    # nine digits.
    most = bvh.frame_decimals
    if most is None:
        most = max(0, 8 - math.floor(math.log10(bvh.frame_time)))
    lines += [f"Frames: {bvh.num_frames}", f"Frame Time: {bvh.frame_time:.{most}f}"]
    first = np.cumsum([0] + [len(channels) for channels in bvh.channels])
    columns = [c for joint in order for c in range(first[joint], first[joint + 1])]
    # Adding zero after rounding turns -0.0 into 0.0, which some readers reject.
    rows = np.round(bvh.values[:, columns], decimals) + 0.0
    form = " ".join([f"%.{decimals}f"] * len(columns))
    lines += [form % tuple(row) for row in rows.tolist()]
    return "\n".join(lines) + "\n"


def write_bvh(path: str | os.PathLike, bvh: Bvh, *, decimals: int = 6) -> None:
    """Writes a BVH file with so many decimals, whole or not at all."""
    text = format_bvh(bvh, decimals=decimals)
    with files.replacing(path) as file:
        file.write(text.encode("utf-8"))
