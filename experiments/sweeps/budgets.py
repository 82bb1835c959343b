"""The numbers that a budget stands for."""

import dataclasses
from typing import Literal

Name = Literal["quick", "full"]
NAMES: tuple[Name, ...] = ("quick", "full")


@dataclasses.dataclass(frozen=True, kw_only=True)
class Amount:
    """One number of a budget.

    Attributes:
      quick: For half an hour of two cores, training of five models included.
      full: As long as the figures of the README, or longer.
      meaning: What it is.
      training: Whether trained models depend on it; otherwise only their evaluation.
    """

    quick: float
    full: float
    meaning: str
    training: bool = True


Amounts = dict[str, Amount]


def resolve(
    amounts: Amounts, name: str, changes: tuple[str, ...] = ()
) -> dict[str, float]:
    """The numbers of a budget, some of them changed.

    Args:
      amounts: Of the system.
      name: "quick" or "full".
      changes: "number=value", for numbers of the budget.

    Returns:
      Whole numbers where the budget's are whole.

    Raises:
      ValueError: names the field that is wrong.
    """
    if name not in NAMES:
        raise ValueError(
            f"budget: unknown budget {name!r}, expected {' or '.join(NAMES)}"
        )
    found = {key: getattr(amount, name) for key, amount in amounts.items()}
    for change in changes:
        key, equals, text = change.partition("=")
        if not equals or key not in found:
            raise ValueError(
                f"change: {change!r} changes no number of the budget, expected "
                f"name=value with a name of {', '.join(found)}"
            )
        kind = type(found[key])
        try:
            value = kind(text)
        except ValueError:
            what = "a whole number" if kind is int else "a number"
            raise ValueError(f"change: {change!r}, expected {what}") from None
        if not 0 < value < float("inf"):
            raise ValueError(f"change: {change!r}, expected a positive number")
        found[key] = value
    return found


def training_part(amounts: Amounts, budget: dict[str, float]) -> dict[str, float]:
    """The numbers that trained models depend on.

    Args:
      amounts: Of the system.
      budget: From `resolve`.

    Returns:
      These.
    """
    return {key: budget[key] for key, amount in amounts.items() if amount.training}


def describe(system: str, amounts: Amounts) -> str:
    """The numbers of a system's budgets, for the help.

    Args:
      system: Its name.
      amounts: Its numbers.

    Returns:
      A line each.
    """
    lines = [f"Budgets of {system}, quick / full:"]
    for key, amount in amounts.items():
        lines.append(f"  {key} {amount.quick:g} / {amount.full:g}: {amount.meaning}")
    return "\n".join(lines)
