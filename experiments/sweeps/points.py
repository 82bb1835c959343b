"""Step counts of a sweep, read from the command line."""

import dataclasses
import re


@dataclasses.dataclass(frozen=True, kw_only=True)
class Point:
    """One model of a sweep.

    Attributes:
      name: As on the command line, and in the plot: "8", or "2+3".
      row: Its row in the table.
      folder: Name for files and folders.
      parts: Steps; for AAMDM polish steps and draft steps.
    """

    name: str
    row: str
    folder: str
    parts: tuple[int, ...]

    @property
    def steps(self) -> int:
        """Network calls of one sample."""
        return sum(self.parts)


def _number(text: str, least: int) -> int:
    if not re.fullmatch(r"[0-9]+", text) or int(text) < least:
        raise ValueError(
            f"steps: {text!r} is no number of steps, expected a whole number of at "
            f"least {least}"
        )
    return int(text)


def _check_distinct(points: tuple[Point, ...]) -> tuple[Point, ...]:
    if not points:
        raise ValueError("steps: there are none, expected at least one number of steps")
    seen: set[tuple[int, ...]] = set()
    for point in points:
        if point.parts in seen:
            raise ValueError(
                f"steps: {point.row} is given twice, expected distinct ones"
            )
        seen.add(point.parts)
    return points


def plain(texts: tuple[str, ...]) -> tuple[Point, ...]:
    """Numbers of steps T.

    Args:
      texts: "2", "4", ...

    Returns:
      The points, in this order.

    Raises:
      ValueError: if one is no positive number, or given twice.
    """
    numbers = [_number(text, 1) for text in texts]
    return _check_distinct(
        tuple(
            Point(name=str(n), row=f"T = {n}", folder=f"T{n}", parts=(n,))
            for n in numbers
        )
    )


def pairs(texts: tuple[str, ...], *, drafts: int) -> tuple[Point, ...]:
    """Polish steps with draft steps before them.

    Args:
      texts: "2+3" for 2 polish steps after 3 draft steps (either may be 0), or "2" for
        2 after the usual number of draft steps.
      drafts: That number.

    Returns:
      The points, in this order.

    Raises:
      ValueError: if one is neither, has no step at all, or is given twice.
    """
    if drafts < 0:
        raise ValueError(f"drafts: {drafts} draft steps, expected 0 or more")
    points = []
    for text in texts:
        polish, plus, draft = text.partition("+")
        both = (
            (_number(polish, 0), _number(draft, 0))
            if plus
            else (_number(polish, 1), drafts)
        )
        if sum(both) < 1:
            raise ValueError(f"steps: {text!r} has no step, expected at least one")
        points.append(
            Point(
                name=f"{both[0]}+{both[1]}",
                row=f"{both[0]} polish + {both[1]} draft",
                folder=f"polish{both[0]}_draft{both[1]}",
                parts=both,
            )
        )
    return _check_distinct(tuple(points))
