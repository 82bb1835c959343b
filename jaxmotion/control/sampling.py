"""Whole motions of many characters at once, whatever system makes them.

What `steering` is for characters that are steered tick by tick, this is for systems
that make a motion at a time: a system hands over a `Sampler`, and `sample_motions` is
one compiled program per method and shape over all calls.
"""

import dataclasses
import functools
from collections.abc import Callable

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Int

from jaxmotion.control.steering import label_array, label_indices
from jaxmotion.motion.skeleton import Motion, Skeleton
from jaxmotion.typing import Key, Params

# Makes `(key, label) -> motion` of arrays. Hashable, and equal to another of equal
# settings: it is a static argument of the compiled program.
Method = Callable[[Params], Callable[[Key, Array], Motion]]


@dataclasses.dataclass(frozen=True, kw_only=True, eq=False)
class Sampler:
    """What a system hands over to be sampled.

    Attributes:
      labels: Names of the actions; none where motions have no label.
      source: The data that it was trained on, and their license.
      license: License of the weights; None where nobody gave one.
      params: All arrays that `method` needs.
      method: Makes the motions of one character.
    """

    skeleton: Skeleton = dataclasses.field(repr=False)
    labels: tuple[str, ...]
    fps: float
    frames: int
    source: str
    license: str | None = None
    params: Params = dataclasses.field(repr=False)
    method: Method = dataclasses.field(repr=False)

    def label(self, name: str) -> int:
        """Index of a label; raises `ValueError` that names those there are."""
        return int(label_indices(self.labels, name)[0])


def sample_motions(
    model: Sampler, key: Key, labels: Int[Array | np.ndarray, " motions"], *, chunk: int
) -> Motion:
    """Motions [motions, frames, ...] from the origin, facing +z; one compiled program.

    Motion i draws from `fold_in(key, i)`, however many there are; at most `chunk` of
    them are made at a time.

    Raises:
      ValueError: if a label is none of the model's.
    """
    found = label_array(model.labels, labels)
    return _motions(
        model.params,
        key,
        found,
        method=model.method,
        chunk=min(chunk, len(found)),
    )


@functools.partial(jax.jit, static_argnames=("method", "chunk"))
def _motions(
    params: Params, key: Key, labels: Array, *, method: Method, chunk: int
) -> Motion:
    make = method(params)
    keys = jax.vmap(jax.random.fold_in, (None, 0))(key, jnp.arange(len(labels)))
    one = lambda given: make(*given)  # noqa: E731
    return jax.lax.map(one, (keys, labels), batch_size=chunk)
