"""Malformed inputs by the thousand, and what must come of each.

A reader returns a value that an independent reader confirms, or raises one line that a
script prints (see `jaxmotion.cli`). Anything else is a failure: another
exception, several lines, a warning, an input that takes longer than `SECONDS`, or a
value that differs. Seeds are fixed: input n of a target is the same on every machine.
"""

import collections
import contextlib
import re
import signal
import time
import traceback
import warnings

from jaxmotion.learning.loop import TrainingDiverged

# What `script.start` makes one line of.
ONE_LINE = (OSError, ValueError, TrainingDiverged)
SECONDS = 20


class Hang(BaseException):
    """An input took too long."""


@contextlib.contextmanager
def limited(seconds=SECONDS):
    """Raises `Hang` in code that does not end by itself."""

    def stop(*_):
        raise Hang(f"no end after {seconds} s")

    before = signal.signal(signal.SIGALRM, stop)
    signal.setitimer(signal.ITIMER_REAL, seconds)
    try:
        yield
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0)
        signal.signal(signal.SIGALRM, before)


class Target:
    """Counts what came of the inputs of one reader.

    Args:
      name: For the report.
      read: Makes a value of an input.
      confirm: Compares an input with its value; raises AssertionError where they
        differ.
      names: Words of which a message must have one, such as the file's name.
    """

    def __init__(self, name, read, confirm, *, names=()):
        self.name, self.read, self.confirm, self.names = name, read, confirm, names
        self.found = collections.Counter()
        self.failures = []
        self.messages = collections.Counter()
        self.begun = time.perf_counter()

    def feed(self, label, content):
        """One input; `label` says in a failure how to make it again."""
        self.found["inputs"] += 1
        try:
            with limited(), warnings.catch_warnings():
                warnings.simplefilter("error")
                # That there is no checksum is told, not refused.
                warnings.filterwarnings("ignore", ".*no checksum")
                value = self.read(content)
        except ONE_LINE as error:
            self.found["refused"] += 1
            words = str(error)
            kind = re.sub(r"'[^']*'|[-\d.]+|\S*/\S*", "", words)
            self.messages[kind[:60]] += 1
            if "\n" in words or not words or len(words) > 1000:
                self.failures.append(f"{label}: no one line: {words[:300]!r}")
            if self.names and not any(name in words for name in self.names):
                self.failures.append(f"{label}: no name of a file: {words[:300]!r}")
            return
        except (Exception, Hang) as error:
            last = traceback.extract_tb(error.__traceback__)[-1]
            self.failures.append(
                f"{label}: {type(error).__name__}: {str(error)[:300]!r} "
                f"({last.filename}:{last.lineno})"
            )
            return
        self.found["accepted"] += 1
        try:
            with limited():
                self.confirm(content, value)
        except AssertionError as error:
            self.failures.append(f"{label}: another value: {str(error)[:600]}")

    def report(self, show, *, accepted=1, refused=1):
        """Prints the counts; fails with all failures, or where there were no inputs."""
        seconds = time.perf_counter() - self.begun
        counts = ", ".join(f"{n} {word}" for word, n in self.found.items())
        with show():
            print(
                f"\nfuzz {self.name}: {counts}, {len(self.failures)} failures, "
                f"{len(self.messages)} kinds of message, {seconds:.0f} s"
            )
        assert not self.failures, "\n".join(self.failures[:40])
        # A target that refuses or accepts all would test nothing.
        assert self.found["accepted"] >= accepted and self.found["refused"] >= refused
