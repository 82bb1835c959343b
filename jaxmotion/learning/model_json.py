"""JSON of models: written from configurations and skeletons, checked when read back.

What is read may be damaged or of another version: every field is checked before a
network is made of it, and what is wrong is named in one line.
"""

import dataclasses
import json
import math
import typing
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import jax
import numpy as np
from jaxtyping import Array

from jaxmotion.motion.features import Normalizer
from jaxmotion.motion.skeleton import MAX_METERS, Skeleton, check_skeleton


def check_system(value: dict[str, Any], system: str, *, where: str) -> None:
    """Raises a `ValueError` unless the JSON of the file `where` is of a system."""
    if value.get("system") != system:
        raise ValueError(
            f"{where}: field 'system' is {value.get('system')!r}, expected {system!r}"
        )


def decode(
    value: dict[str, Any], where: str, parts: Mapping[str, Callable[[Any], Any]]
) -> dict[str, Any]:
    """Fields of a JSON object, each made into what it stands for.

    The file `where` is for messages; of each field one part makes it, others are left
    out.

    Raises:
      ValueError: names the file and the field that is missing or wrong.
    """
    made = {}
    for field, make in parts.items():
        if field not in value:
            raise ValueError(f"{where}: field {field!r} is missing")
        try:
            made[field] = make(value[field])
        except KeyError as error:
            raise ValueError(f"{where}: field {field!r}: {error} is missing") from error
        except (TypeError, ValueError, IndexError) as error:
            raise ValueError(f"{where}: field {field!r}: {error}") from error
    return made


def skeleton_to_json(skeleton: Skeleton) -> dict[str, Any]:
    """JSON of a skeleton."""
    return {
        "offsets": np.asarray(skeleton.offsets, np.float64).tolist(),
        "parents": list(skeleton.parents),
        "names": list(skeleton.names),
        "feet": list(skeleton.feet),
    }


def skeleton_from_json(value: Any) -> Skeleton:
    """Inverse of `skeleton_to_json`.

    Raises `KeyError` for a missing field, `ValueError` for one that is wrong.
    """
    if not isinstance(value, dict):
        raise ValueError(f"a JSON {type(value).__name__}, expected an object")
    fields = {name: value[name] for name in ("offsets", "parents", "names", "feet")}
    for name, found in fields.items():
        if not isinstance(found, list):
            raise ValueError(f"{name} should be a list, found {found!r:.100}")
    check_skeleton(**fields)
    return Skeleton(
        offsets=jax.device_put(np.asarray(fields["offsets"], np.float32)),
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
    **dict.fromkeys(("latent", "condition_size"), (0, 2**16)),
    **dict.fromkeys(("token_margin", "frame_kernel"), (0, 2**16)),
    **dict.fromkeys(("seam_features", "soon"), (0, 2**16)),
    **dict.fromkeys(("drafts", "polishes"), (0, 1000)),
    **dict.fromkeys(("drop_past", "drop_condition"), (0, 1)),
    **dict.fromkeys(("own_previous", "own_levels"), (0, 1)),
    "dropout": (0, math.nextafter(1, 0)),
    "fps": (1e-3, 1000),
    **dict.fromkeys(("rotation_scale", "meters", "contact_speed"), (1e-6, 1e6)),
    # In features of any scale.
    "rotation_mean": (-1e6, 1e6),
}


def _check_field(name: str, kind: Any, value: Any) -> Any:
    """The value as a configuration has it; raises unless it is of its kind."""
    choices = typing.get_args(kind)
    if dataclasses.is_dataclass(kind):
        return config_from_json(typing.cast(type, kind), value)
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
    """A configuration from the JSON of `dataclasses.asdict`, with every field checked.

    Fields are whole numbers, numbers, truth values, choices, lists, such dataclasses; a
    `ValueError` names one that is missing, unknown, of another kind or out of range.
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
    """A list of different names; raises `ValueError` if it is none."""
    right = isinstance(value, list) and all(isinstance(x, str) for x in value)
    if not right or len(set(value)) < len(value):
        raise ValueError(f"{value!r:.60}, expected a list of different names")
    return tuple(value)


def numbers_from_json(
    name: str, value: Any, *, least: float, size: int | None = None
) -> list[int | float]:
    """A list of finite numbers.

    A `ValueError` names it if it is none, a number is below `least` or above 1e6, or
    there are not `size` of them.
    """
    if not isinstance(value, list):
        raise ValueError(f"{name} is {value!r:.60}, expected a list of numbers")
    for x in value:
        right = isinstance(x, int | float) and not isinstance(x, bool)
        if not (right and least <= x <= 1e6):
            raise ValueError(f"{name} has {x!r:.60}, expected {least:g} to 1e+06")
    if size is not None and len(value) != size:
        raise ValueError(f"{name} has {len(value)} numbers, expected {size}")
    return value


def normalizer_to_json(normalizer: Normalizer) -> dict[str, Any]:
    """JSON of a normalizer: its "mean" and "std"."""
    return {
        name: np.asarray(getattr(normalizer, name), np.float64).tolist()
        for name in ("mean", "std")
    }


def normalizer_from_json(value: Any, *, size: int) -> Normalizer:
    """Inverse of `normalizer_to_json`; other fields are left out.

    Raises `KeyError` for a missing field, `ValueError` for one of other numbers.
    """
    # A feature that never varies has a tiny deviation, but not none.
    made = {
        name: numbers_from_json(name, value[name], least=least, size=size)
        for name, least in (("mean", -1e6), ("std", 1e-12))
    }
    return Normalizer(
        **{k: jax.device_put(np.array(x, np.float32)) for k, x in made.items()}
    )


def arrays_to_json(arrays: Mapping[str, Any]) -> dict[str, Any]:
    """JSON of named arrays, to five places: poses to start from."""
    return {
        name: np.asarray(array, np.float64).round(5).tolist()
        for name, array in arrays.items()
    }


def arrays_from_json(
    value: Any, *, lead: tuple[int, ...], shapes: Mapping[str, tuple[int, ...]]
) -> dict[str, Array]:
    """Inverse of `arrays_to_json` for poses to start from.

    Args:
      lead: Leading axes of all arrays; the next axis is the number of poses, one or
        more, the same for all.
      shapes: The axes after that, by name.

    Raises:
      ValueError: if an array is missing, of another shape or not of finite numbers.
    """
    try:
        found = {name: np.asarray(value[name], np.float64) for name in shapes}
    except (KeyError, TypeError, ValueError, OverflowError) as error:
        raise ValueError(f"is wrong: {error}") from None
    first = next(iter(found.values()))
    number = first.shape[len(lead)] if first.ndim > len(lead) else 0
    expected = {name: (*lead, number, *shape) for name, shape in shapes.items()}
    if number < 1 or {k: x.shape for k, x in found.items()} != expected:
        raise ValueError(
            f"has shapes {' and '.join(str(x.shape) for x in found.values())}, "
            f"expected {' and '.join(map(str, expected.values()))} of at least one "
            "start per label"
        )
    if not all((np.abs(x) <= MAX_METERS).all() for x in found.values()):
        raise ValueError(f"has numbers that are not within {MAX_METERS:g}")
    return {name: jax.device_put(np.array(x, np.float32)) for name, x in found.items()}


def starts_from_json(
    value: Any,
    *,
    labels: int,
    past: int,
    frames: Mapping[str, tuple[int, ...]],
    where: str,
) -> dict[str, Array] | None:
    """A model's `starts`, arrays [labels, number, past, ...]; None for none.

    Args:
      frames: Shape of a frame of each array, by name.
      where: Its file, for messages.

    Raises:
      ValueError: names the file and the array that is missing or wrong.
    """
    if value is None:
        return None
    shapes = {name: (past, *shape) for name, shape in frames.items()}
    try:
        return arrays_from_json(value, lead=(labels,), shapes=shapes)
    except ValueError as error:
        raise ValueError(f"{where}: field 'starts' {error}") from None


def toe_height_from_json(value: Any, *, where: str) -> float | None:
    """A model's `toe_height`, meters; None for none.

    A `ValueError` names the file (`where`) and the field.
    """
    number = isinstance(value, int | float) and not isinstance(value, bool)
    if value is not None and not (number and abs(value) <= MAX_METERS):
        raise ValueError(
            f"{where}: field 'toe_height' is {value!r:.60}, expected meters"
        )
    return None if value is None else float(value)


def differences(
    found: dict[str, Any], given: dict[str, Any], *, prefix: str = ""
) -> str:
    """Fields of a JSON object that another does not agree with, in one line.

    Such as "seed is 0, given 7; config.width is 64, given 16"; empty for none. Fields
    that `given` lacks do not count, fields within fields are compared on their own, and
    the prefix precedes their names.
    """
    lines = []
    found, given = json.loads(json.dumps([found, given]))  # tuples to lists
    for name, value in given.items():
        old = found.get(name, "not recorded")
        if isinstance(value, dict) and isinstance(old, dict):
            lines.append(differences(old, value, prefix=f"{prefix}{name}."))
        elif old != value:
            lines.append(f"{prefix}{name} is {_short(old)}, given {_short(value)}")
    return "; ".join(filter(None, lines))


def _short(value: Any) -> str:
    text = value if value == "not recorded" else repr(value)
    return text if len(text) <= 60 else f"{text[:57]}..."


def _like(found: Any, wanted: Any) -> Any:
    """`found`, but for lists of numbers that are `wanted`'s up to rounding.

    Statistics of the same data differ by machine in float32's last digits.
    """
    if isinstance(found, dict) and isinstance(wanted, dict):
        return {k: _like(x, wanted.get(k)) for k, x in found.items()}
    try:
        pair = np.array(found, np.float64), np.array(wanted, np.float64)
    except (TypeError, ValueError):
        return found
    is_list = pair[0].ndim > 0 and pair[0].shape == pair[1].shape
    return wanted if is_list and np.allclose(*pair, rtol=1e-5, atol=1e-6) else found


def check_start(
    path: Path, found: dict[str, Any], wanted: dict[str, Any], *, free: tuple[str, ...]
) -> None:
    """Raises a `ValueError`, with what differs, unless one model can go on as another.

    Both are JSON, `found` that of the file `path`. In "config" and "paths" what begins
    with a weight's name or a `free` one may differ, since it has no parameters.
    """
    loose = ("weight_", *free)

    def part(value: dict[str, Any]) -> dict[str, Any]:
        kept = dict(value)
        for name in {"config", "paths"} & value.keys():
            fields = value[name].items()
            kept[name] = {k: x for k, x in fields if not k.startswith(loose)}
        return kept

    differ = differences(_like(part(found), part(wanted)), part(wanted))
    if differ:
        raise ValueError(f"{path}: expected a model like the one to train: {differ}")
