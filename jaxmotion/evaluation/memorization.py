"""How near made motions are to those that a model was trained on.

A motion that was copied is much nearer to one training motion than to any other. So the
distance to the nearest clip is compared with that to the next: below a third of it the
motion counts as a copy. What neither copies nor strays is as far from the training
clips as these are from each other.

Source: Yoon et al. 2023, "Diffusion Probabilistic Models Generalize when They Fail to
Memorize" (a third; there of images, each its own clip).
"""

from collections.abc import Callable
from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float, Int

COPY = 1 / 3
# Windows are compared so many at a time.
_CHUNK = 256


class Nearest(NamedTuple):
    """Distances of motions to training clips, in the positions' units.

    Of joints, root mean square over frames and joints, to the clip's nearest window.

    Attributes:
      clip: To the nearest clip.
      other: To the nearest of the others; infinite if there are none. Both are infinite
        for motions with numbers that are not finite.
    """

    clip: Float[Array, " motions"]
    other: Float[Array, " motions"]


def nearest(
    positions: Float[Array, "motions frames joints 3"],
    window: Callable[[Int[Array, " chunk"]], Float[Array, "chunk frames joints 3"]],
    clip: Int[Array, " windows"],
    *,
    num_clips: int,
) -> Nearest:
    """The two clips nearest to each motion.

    Args:
      positions: World, from the origin facing +z, as those of windows.
      window: Positions of training windows by number; any of them is asked for.
      clip: Of each window.

    Squared distances are differences of squares, so small distances are right to a
    thousandth of the motions' extent, or to a few millimeters.
    """
    motions, frames, joints, _ = positions.shape
    # The last chunk is filled up with the last window.
    number = jnp.arange(-(-len(clip) // _CHUNK) * _CHUNK).reshape(-1, _CHUNK)
    number = jnp.minimum(number, len(clip) - 1)
    there = jnp.isfinite(positions)
    center = jnp.mean(positions, axis=0, keepdims=True, where=there)

    def flat(x: Array) -> tuple[Array, Array]:
        x = (x - center).reshape(len(x), -1)
        return x, jnp.sum(jnp.square(x), axis=-1)

    made, made_square = flat(positions)

    def body(least: Array, number: Array) -> tuple[Array, None]:
        given, given_square = flat(window(number))
        product = jnp.matmul(given, made.T, precision="highest")
        square = given_square[:, None] + made_square[None] - 2.0 * product
        return least.at[clip[number]].min(square), None

    start = jnp.full((num_clips, motions), jnp.inf)
    least, _ = jax.lax.scan(body, start, number)
    least = jnp.where(jnp.all(there, axis=(1, 2, 3)), least, jnp.inf)
    least = jnp.sqrt(jnp.maximum(least, 0.0) / (frames * joints))
    least = jnp.pad(least, ((0, 1), (0, 0)), constant_values=jnp.inf)
    two, _ = jax.lax.top_k(-least.T, 2)
    return Nearest(-two[:, 0], -two[:, 1])


def copied(found: Nearest) -> Float[Array, ""]:
    """Share of motions that are copies; none where there is one clip, or none near."""
    near = found.clip < COPY * found.other
    return jnp.mean(near & jnp.isfinite(found.other))
