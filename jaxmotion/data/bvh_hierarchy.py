"""The HIERARCHY block of a BVH file: a token reader that knows its line."""

import re
from typing import NoReturn

import numpy as np

CHANNELS = tuple(f"{axis}{kind}" for kind in ("position", "rotation") for axis in "XYZ")
_CANONICAL = {channel.lower(): channel for channel in CHANNELS}
_TOKEN = re.compile(r"[{}]|[^\s{}]+")


class BvhError(ValueError):
    """A BVH file that cannot be used; the message names the file and the line."""


def number(word: str) -> float:
    """A number as other readers take it: Python's float() knows more spellings.

    Raises:
      ValueError: if it is none.
    """
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
