"""Names for the shapes and callables that the packages share; no logic.

A key is a typed key of `jax.random.key`. `"*shape"` is one sample of any shape with
any leading batch axes. Callables are protocols, so that a plain function or a closure
fits without inheriting from anything.
"""

from collections.abc import Callable
from typing import Any, NamedTuple, Protocol, runtime_checkable

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


@runtime_checkable
class Denoiser(Protocol):
    """Predicts the clean sample from a noisy one.

    It takes a key, so that a stochastic denoiser (a denoising-diffusion GAN that draws
    a latent) is no special case. A deterministic one ignores it.
    """

    def __call__(
        self, key: Key, x_t: Float[Array, "*shape"], t: Int[Array, ""], /
    ) -> Float[Array, "*shape"]:
        """Maps x_t at step t (1..T) to a prediction of x_0."""
        ...


@runtime_checkable
class ConditionalDenoiser(Protocol):
    """A denoiser that takes its condition as an argument (for classifier-free use)."""

    def __call__(
        self, key: Key, x_t: Float[Array, "*shape"], t: Int[Array, ""], cond: Any, /
    ) -> Float[Array, "*shape"]:
        """Maps x_t at step t (1..T), given cond, to a prediction of x_0."""
        ...


@runtime_checkable
class Step(Protocol):
    """One step of the reverse chain: x_t -> x_{t-1}.

    x is a sample, or for a step that looks back a pytree of the sample and its history.
    """

    def __call__(self, key: Key, x_t: Any, t: Int[Array, ""], /) -> Any:
        """Maps x_t at step t (1..T) to x_{t-1}."""
        ...


@runtime_checkable
class Objective(Protocol):
    """A scalar that guidance makes small."""

    def __call__(self, x_0: Float[Array, "*shape"], /) -> Float[Array, ""]:
        """Maps a clean sample to the objective's value."""
        ...
