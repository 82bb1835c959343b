"""Skeletons and configurations as JSON, for what is stored beside parameters."""

import dataclasses
import math
import typing
from typing import Any

import jax.numpy as jnp
import numpy as np

from jaxmotion.motion.skeleton import Skeleton, check_skeleton


def skeleton_to_json(bones: Skeleton) -> dict[str, Any]:
    """JSON of a skeleton.

    Args:
      bones: The skeleton.

    Returns:
      A JSON object.
    """
    return {
        "offsets": np.asarray(bones.offsets, np.float64).tolist(),
        "parents": list(bones.parents),
        "names": list(bones.names),
        "feet": list(bones.feet),
    }


def skeleton_from_json(value: Any) -> Skeleton:
    """Inverse of `skeleton_to_json`.

    Args:
      value: The JSON object.

    Returns:
      The skeleton.

    Raises:
      KeyError: if a field is missing.
      ValueError: if the fields are not those of a skeleton; says what is wrong.
    """
    if not isinstance(value, dict):
        raise ValueError(f"a JSON {type(value).__name__}, expected an object")
    fields = {name: value[name] for name in ("offsets", "parents", "names", "feet")}
    for name, found in fields.items():
        if not isinstance(found, list):
            raise ValueError(f"{name} should be a list, found {found!r:.100}")
    check_skeleton(**fields)
    return Skeleton(
        offsets=jnp.asarray(np.asarray(fields["offsets"], np.float32)),
        parents=tuple(fields["parents"]),
        names=tuple(fields["names"]),
        feet=tuple(fields["feet"]),
    )


# Least and largest of numbers in configurations, by name, which keep a damaged file
# from asking for networks that no machine holds. Others: whole ones 1 to 65,536, the
# rest 0 to 1e6.
_LIMITS: dict[str, tuple[float | int, float | int]] = {
    "features": (1, 10**6),
    "num_features": (1, 10**6),
    "num_labels": (1, 10**5),
    "num_steps": (1, 10**4),
    "depth": (1, 256),
    **dict.fromkeys(("latent", "condition_size", "token_margin"), (0, 2**16)),
    **dict.fromkeys(("drafts", "polishes"), (0, 1000)),
    **dict.fromkeys(("drop_past", "drop_condition", "own_previous"), (0, 1)),
    "dropout": (0, math.nextafter(1, 0)),
    "fps": (1e-3, 1000),
    **dict.fromkeys(("rotation_scale", "metres", "contact_speed"), (1e-6, 1e6)),
    # In features of any scale.
    "rotation_mean": (-1e6, 1e6),
}


def _check_field(name: str, kind: Any, value: Any) -> Any:
    """The value as a configuration has it; raises unless it is of its kind."""
    choices = typing.get_args(kind)
    if typing.get_origin(kind) is typing.Literal:
        right = isinstance(value, str) and value in choices
        expected = f"one of {', '.join(map(repr, choices))}"
    elif kind is bool:
        right, expected = isinstance(value, bool), "true or false"
    elif typing.get_origin(kind) is tuple:
        if not isinstance(value, list | tuple):
            raise ValueError(f"{name} is {value!r:.60}, expected a list")
        return tuple(_check_field(name, choices[0], x) for x in value)
    elif kind in (int, float):
        low, high = _LIMITS.get(name, (1, 2**16) if kind is int else (0, 1e6))
        number = (int,) if kind is int else (int, float)
        right = isinstance(value, number) and not isinstance(value, bool)
        right = right and low <= value <= high
        what = "a whole number" if kind is int else "a number"
        expected = f"{what} from {low:g} to {high:g}"
    else:
        raise TypeError(f"{name}: no rule for {kind}")
    if not right:
        raise ValueError(f"{name} is {value!r:.60}, expected {expected}")
    return float(value) if kind is float else value


def config_from_json(kind: type, value: Any) -> Any:
    """A configuration from its JSON, of which every field is checked.

    Args:
      kind: Its dataclass, of whole numbers, numbers, truth values, choices and lists.
      value: What `dataclasses.asdict` gave, read back.

    Returns:
      The configuration.

    Raises:
      ValueError: names the field that is missing, unknown, of another kind or out of
        range.
    """
    if not isinstance(value, dict):
        raise ValueError(f"a JSON {type(value).__name__}, expected an object")
    kinds = typing.get_type_hints(kind)
    unknown = sorted(set(value) - set(kinds))
    if unknown:
        raise ValueError(f"has unknown {unknown}")
    needed = {
        field.name
        for field in dataclasses.fields(kind)
        if field.default is dataclasses.MISSING
    }
    if needed - set(value):
        raise ValueError(f"{', '.join(sorted(needed - set(value)))} is missing")
    config = kind(**{k: _check_field(k, kinds[k], x) for k, x in value.items()})
    width, heads = (getattr(config, name, 0) for name in ("width", "heads"))
    if heads and width % heads:
        raise ValueError(f"width is {width}, expected a multiple of heads ({heads})")
    return config


def names_from_json(value: Any) -> tuple[str, ...]:
    """A list of different names.

    Raises:
      ValueError: if it is none.
    """
    right = isinstance(value, list) and all(isinstance(x, str) for x in value)
    if not right or len(set(value)) < len(value):
        raise ValueError(f"{value!r:.60}, expected a list of different names")
    return tuple(value)
