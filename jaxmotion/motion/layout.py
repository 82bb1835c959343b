"""Names of the slices of a feature vector, so that no code holds a number such as 150.

Users reach these through `jaxmotion.motion.features`.
"""

import dataclasses
from collections.abc import Mapping

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True, kw_only=True)
class FeatureLayout:
    """Names of the slices of a feature vector; hashable, and static under jit.

    Attributes:
      fields: (name, start, stop) of each slice, in order and without gaps.
    """

    fields: tuple[tuple[str, int, int], ...] = jax.tree.static()

    def __post_init__(self) -> None:
        expected, names = 0, set()
        for name, start, stop in self.fields:
            if name in names:
                raise ValueError(f"field {name!r} occurs twice")
            if start != expected or stop <= start:
                raise ValueError(
                    f"field {name!r} is {start}..{stop}, expected to start at "
                    f"{expected} and to hold at least one number"
                )
            names.add(name)
            expected = stop

    @property
    def size(self) -> int:
        """Length of the feature vector."""
        return self.fields[-1][2] if self.fields else 0


def feature_layout(**sizes: int) -> FeatureLayout:
    """Layout of fields that lie behind each other.

    Args:
      **sizes: For each field, in order, how many numbers it has.

    Returns:
      The layout.

    Raises:
      ValueError: if a size is not positive.

    Source: own.
    """
    fields, start = [], 0
    for name, size in sizes.items():
        fields.append((name, start, start + size))
        start += size
    return FeatureLayout(fields=tuple(fields))


def pack(
    layout: FeatureLayout, parts: Mapping[str, Float[Array, "*batch _"]]
) -> Float[Array, "*batch features"]:
    """Joins named parts into feature vectors.

    Args:
      layout: Names, order and sizes.
      parts: One array for each field, of its size along the last axis.

    Returns:
      Feature vectors.

    Raises:
      ValueError: if names or sizes are not those of the layout.

    Source: own.
    """
    names = [name for name, _, _ in layout.fields]
    if set(parts) != set(names):
        raise ValueError(f"parts are {sorted(parts)}, expected {sorted(names)}")
    for name, start, stop in layout.fields:
        if parts[name].shape[-1] != stop - start:
            raise ValueError(
                f"field {name!r} has {parts[name].shape[-1]} numbers, "
                f"expected {stop - start}"
            )
    return jnp.concatenate([parts[name] for name in names], axis=-1)


def unpack(
    layout: FeatureLayout, features: Float[Array, "*batch features"]
) -> dict[str, Float[Array, "*batch _"]]:
    """Inverse of `pack`.

    Args:
      layout: Names, order and sizes.
      features: Feature vectors.

    Returns:
      One array for each field.

    Raises:
      ValueError: if the vectors are not of the layout's size.

    Source: own.
    """
    if features.shape[-1] != layout.size:
        raise ValueError(
            f"features have {features.shape[-1]} numbers, expected {layout.size}"
        )
    return {name: features[..., start:stop] for name, start, stop in layout.fields}
