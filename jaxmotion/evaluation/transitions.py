"""How long a change of style takes, and whether it comes at all.

An evaluator decides on windows of a rollout in which another style was commanded. A
window that starts s seconds after the command holds no frame from before, so the
change is done at the latest at the start of the first window that shows the new style.

Source: Chen et al. 2024 (CAMDM), section 4.1 and tables 2 and 4, where people judged
the success within 4 s, that is 120 frames. No code was released.
"""

import functools
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from jaxmotion.motion.spring import Scalar


class Transition(NamedTuple):
    """How long a change took, the limit where it failed; and whether it succeeded."""

    seconds: Float[Array, "*batch"]
    succeeded: Bool[Array, "*batch"]


@functools.partial(jax.jit, static_argnames=("hold",))
def transition(
    recognized: Bool[Array, "*batch windows"],
    starts: Float[Array, " windows"],
    *,
    limit: Scalar = 4.0,
    hold: int = 1,
) -> Transition:
    """Duration and success of changes of style, by an evaluator's decisions.

    A change is done with the first of `hold` neighboring windows that are all
    recognized. One that is not done by the limit has failed, and lasts the limit: means
    over rollouts would otherwise be of the easy changes alone. The paper does not say
    which of both its means are.

    Starts are seconds since the command, ascending, not negative; the limit is that of
    the first window that shows the style, seconds; `hold`, in 1..windows (else
    `ValueError`), is more than 1 if styles flicker.

    Source: Chen et al. 2024 (CAMDM), tables 2 and 4, where people judged.
    """
    windows = recognized.shape[-1]
    if not 1 <= hold <= windows:
        raise ValueError(f"hold is {hold}, expected 1..{windows}, the windows")
    first = jnp.arange(windows - hold + 1)
    runs = first[:, None] + jnp.arange(hold)[None]
    held = jnp.all(recognized[..., runs], axis=-1)
    times = starts[: windows - hold + 1]
    done = held & jnp.broadcast_to(times <= limit, held.shape)
    succeeded = jnp.any(done, axis=-1)
    seconds = jnp.where(succeeded, times[jnp.argmax(done, axis=-1)], limit)
    return Transition(seconds=seconds, succeeded=succeeded)
