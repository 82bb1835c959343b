"""Convolution over time as one product of matrices.

In a loop (`jax.lax.scan`, so a chunk of training) XLA's compiler for CPUs has no fast
convolution: an update of the evaluator of styles takes six to seven times as long as
with the same sums written as a product. Outside of loops both are equally fast.
"""

from collections.abc import Sequence
from typing import Any

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float


def convolve(
    frames: Float[Array, "batch frames channels_in"],
    kernel: Float[Array, "width group channels"],
    window_strides: Sequence[int],
    padding: str | Sequence[tuple[int, int]],
    *,
    lhs_dilation: Sequence[int] = (1,),
    rhs_dilation: Sequence[int] = (1,),
    dimension_numbers: Any = None,
    feature_group_count: int = 1,
    precision: Any = None,
) -> Float[Array, "batch steps channels"]:
    """What `jax.lax.conv_general_dilated` makes of frames, for `nn.Conv`.

    Sums over the width of the kernel of frames in the order batch, time, channels.
    Dilations and `feature_group_count` are 1; padding is "SAME", "VALID", or zeros
    before and after.
    """
    del dimension_numbers
    if {*lhs_dilation, *rhs_dilation, feature_group_count} != {1}:
        raise ValueError("convolve: dilation and groups are not here, expected 1")
    width, _, channels = kernel.shape
    (stride,) = window_strides
    if isinstance(padding, str):
        padding = jax.lax.padtype_to_pads(
            frames.shape[1:2], (width,), (stride,), padding
        )
    padded = jnp.pad(frames, ((0, 0), tuple(padding[0]), (0, 0)))
    steps = (padded.shape[1] - width) // stride + 1
    seen = [padded[:, i : i + stride * (steps - 1) + 1 : stride] for i in range(width)]
    return jnp.matmul(
        jnp.concatenate(seen, axis=-1),
        kernel.reshape(-1, channels),
        precision=precision,
    )
