"""Skeletons as JSON, for what is stored beside parameters."""

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


def skeleton_from_json(value: dict[str, Any]) -> Skeleton:
    """Inverse of `skeleton_to_json`.

    Args:
      value: The JSON object.

    Returns:
      The skeleton.

    Raises:
      KeyError, TypeError: if a field is missing or of the wrong type.
      ValueError: if the fields are not those of a skeleton; says what is wrong.
    """
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
