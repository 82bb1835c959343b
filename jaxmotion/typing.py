"""Names for the shapes and callables that the packages share; no logic.

A key is a typed key of `jax.random.key`. `"*shape"` is one sample of any shape with
any leading batch axes.
"""

from collections.abc import Callable
from typing import Any, NamedTuple

from jaxtyping import Array, Float, Int
from jaxtyping import Key as _Key

Key = _Key[Array, ""]
Params = Any  # a nested dict of arrays, as Flax makes it


class Gaussian(NamedTuple):
    """A Gaussian with independent components: mean [*shape], variance [*#shape]."""

    mean: Float[Array, "*shape"]
    variance: Float[Array, "*#shape"]


class Exported(NamedTuple):
    """A function that can leave Python: names of what it takes, and of what it gives.

    The first that it takes is "key" if it draws; what leaves then takes "noise".
    """

    function: Callable
    takes: tuple[str, ...]
    gives: tuple[str, ...]


# Maps x_t at step t (1..T) to a prediction of x_0. It takes a key, so that a stochastic
# denoiser (a denoising-diffusion GAN that draws a latent) is no special case; a
# deterministic one ignores it.
Denoiser = Callable[[Key, Float[Array, "*shape"], Int[Array, ""]], Array]
# The same, of a condition, too (for guidance without a classifier).
ConditionalDenoiser = Callable[
    [Key, Float[Array, "*shape"], Int[Array, ""], Any], Array
]
# Maps x_t at step t (1..T) to x_{t-1}: samples, or for a step that looks back pytrees
# of a sample and its history.
Step = Callable[[Key, Any, Int[Array, ""]], Any]
# A scalar of a clean sample, which guidance makes small.
Objective = Callable[[Float[Array, "*shape"]], Float[Array, ""]]
