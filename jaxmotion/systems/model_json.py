"""Skeletons as JSON, for what is stored beside parameters."""

from typing import Any

import jax.numpy as jnp
import numpy as np

from jaxmotion.motion.skeleton import Skeleton, check_parents


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
      ValueError: if the parents are not those of a skeleton.
    """
    check_parents(tuple(value["parents"]))
    return Skeleton(
        offsets=jnp.asarray(value["offsets"], jnp.float32),
        parents=tuple(value["parents"]),
        names=tuple(value["names"]),
        feet=tuple(value["feet"]),
    )
