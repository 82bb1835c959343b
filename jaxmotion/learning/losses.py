"""Losses on arrays: data, velocity, position and foot sliding.

All are means over the frames that a mask keeps, so padding has no part in them. Two
means differ where the samples of a batch have different lengths:

    average="frames"    every kept frame of the batch counts the same
    average="samples"   every sample counts the same: the mean over its own frames
                        first, then over the batch (released code of MDM, CAMDM, EMDM)

"Displacement" is the difference of neighboring frames, in the unit of the input per
frame: the losses of MDM and CAMDM are written so, with weight 1.
"""

import functools
import operator
from collections.abc import Callable
from typing import Any, Literal

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float

from jaxmotion.diffusion import schedule
from jaxmotion.typing import Key

Average = Literal["frames", "samples"]

# Past frames that losses see where predictions go on from the past: an acceleration
# needs two beside one of its own.
OVER_SEAM = 2


@functools.partial(jax.jit, static_argnames=("average",))
def masked_mse(
    prediction: Float[Array, "*batch frames features"],
    target: Float[Array, "*batch frames features"],
    mask: Bool[Array, "*#batch frames"],
    *,
    average: Average = "frames",
) -> Float[Array, ""]:
    """Mean squared error over kept frames (or samples) and all features.

    Without a frame that counts a batch gives 0; so does a sample, which still counts as
    one (the released code divides by zero). For averages see the module.

    Source: MDM's masked L2; Chen et al. 2024 (CAMDM), eq. 2.
    """
    weight = jnp.broadcast_to(mask, prediction.shape[:-1]).astype(prediction.dtype)
    square = jnp.mean((prediction - target) ** 2, axis=-1) * weight
    if average == "frames":
        return jnp.sum(square) / jnp.maximum(jnp.sum(weight), 1.0)
    count = jnp.maximum(jnp.sum(weight, axis=-1), 1.0)
    return jnp.mean(jnp.sum(square, axis=-1) / count)


def displacement(x: Float[Array, "*batch frames n"]) -> Array:
    """Difference of neighboring frames, per frame; one frame less."""
    return x[..., 1:, :] - x[..., :-1, :]


@functools.partial(jax.jit, static_argnames=("average",))
def velocity_loss(
    prediction: Float[Array, "*batch frames features"],
    target: Float[Array, "*batch frames features"],
    mask: Bool[Array, "*#batch frames"],
    *,
    average: Average = "frames",
) -> Float[Array, ""]:
    """Mean squared error of displacements; both frames of a pair must count.

    Over kept pairs (or samples; see the module) and all features, per frame squared.

    Source: MDM (Tevet et al. 2023), eq. 5.
    """
    pairs = mask[..., 1:] & mask[..., :-1]
    return masked_mse(
        displacement(prediction), displacement(target), pairs, average=average
    )


def foot_slide_loss(
    foot_positions: Float[Array, "*batch frames feet 3"],
    contact: Bool[Array, "*batch frames feet"],
    mask: Bool[Array, "*#batch frames"],
    *,
    average: Average = "frames",
) -> Float[Array, ""]:
    """Squared displacement of feet that stand, square meters per frame squared.

    The mean runs over all frames that count and all feet, standing or not, as in the
    released code of CAMDM: so a moving character's loss is not dominated by its few
    stances. Both frames of a pair must count; for averages see the module.

    Args:
      contact: Whether the foot stands between this frame and the next (the last frame's
        value is unused).

    Source: MDM, eq. 4; released code of CAMDM.
    """
    flat = foot_positions.reshape(*foot_positions.shape[:-2], -1)
    stands = jnp.repeat(contact[..., :-1, :], 3, axis=-1)
    moved = jnp.where(stands, displacement(flat), 0.0)
    pairs = mask[..., 1:] & mask[..., :-1]
    return masked_mse(moved, jnp.zeros_like(moved), pairs, average=average)


def pose_terms(
    predicted: Float[Array, "*batch frames joints 3"],
    wanted: Float[Array, "*batch frames joints 3"],
    stands: Bool[Array, "*batch frames feet"],
    mask: Bool[Array, "*#batch frames"],
    *,
    feet: tuple[int, ...],
    average: Average = "frames",
) -> dict[str, Float[Array, ""]]:
    """Of positions in the world: position, position_velocity, acceleration, foot.

    As in MDM, the means run over x, y and z as well. `stands` is as `foot_slide_loss`
    takes it.
    """
    flat = lambda x: x.reshape(*x.shape[:-2], -1)  # noqa: E731
    guess, truth = flat(predicted), flat(wanted)
    feet_at = predicted[..., jnp.array(feet), :]
    return {
        "position": masked_mse(guess, truth, mask, average=average),
        "position_velocity": velocity_loss(guess, truth, mask, average=average),
        "acceleration": velocity_loss(
            displacement(guess),
            displacement(truth),
            mask[..., 1:] & mask[..., :-1],
            average=average,
        ),
        "foot": foot_slide_loss(feet_at, stands, mask, average=average),
    }


def weighted(
    terms: dict[str, Array], config: Any
) -> tuple[Float[Array, ""], dict[str, Array]]:
    """The sum of the terms' means, each times `config.weight_<name>`, and the means."""
    terms = jax.tree.map(jnp.mean, terms)
    parts = [getattr(config, f"weight_{name}") * x for name, x in terms.items()]
    return functools.reduce(operator.add, parts), terms


def predict_clean(
    key: Key,
    x_0: Float[Array, "batch *shape"],
    condition: tuple[Array, ...],
    *,
    apply: Callable[..., Any],
    table: schedule.Schedule,
    levels: int = 1,
    own: float = 0.0,
) -> Float[Array, "levels batch *shape"]:
    """A denoiser's predictions of samples after noise; each condition is encoded once.

    Args:
      condition: What the network's method `encode` takes, batch axis first.
      apply: The network with its parameters: `(*arguments, method=, rngs=)`.
      levels: Noise levels of each sample: evenly spread over 1..T after a random
        first, so that every one of them is uniform by itself.
      own: Probability of a sample that the lower half of its levels is noise on the
        predictions from the upper half, through which no gradient flows. A chain sees
        its own predictions; a network that has seen only clean samples flattens them
        a little more at every step.

    Raises:
      ValueError: if predictions should be noised, and there is one level alone.
    """
    if own and levels < 2:
        raise ValueError(f"own levels of {own:g} need two noise levels, found {levels}")
    key_t, key_encode, key_denoise, key_own = jax.random.split(key, 4)
    first = jax.random.randint(key_t, x_0.shape[:1], 0, table.num_steps)
    apart = jnp.arange(levels) * table.num_steps // levels
    t = 1 + (first[None] + apart[:, None]) % table.num_steps
    context = apply(*condition, method="encode", rngs={"dropout": key_encode})

    def predict(key: Key, t: Array, clean: Array) -> Array:
        key_noise, key_drop = jax.random.split(key)
        noise = jax.random.normal(key_noise, x_0.shape)
        x_t = jax.vmap(schedule.q_sample, (None, 0, 0, 0))(table, clean, t, noise)
        return apply(context, x_t, t, method="denoise", rngs={"dropout": key_drop})

    keys = jax.random.split(key_denoise, levels)
    clean = jnp.broadcast_to(x_0, (levels, *x_0.shape))
    if not own:
        return jax.vmap(predict)(keys, t, clean)
    t, half = jnp.sort(t, axis=0, descending=True), levels // 2
    upper = jax.vmap(predict)(keys[:-half], t[:-half], clean[:-half])
    is_own = jax.random.bernoulli(key_own, own, x_0.shape[:1])
    is_own = is_own.reshape(-1, *(1 for _ in x_0.shape[1:]))
    source = jnp.where(is_own, jax.lax.stop_gradient(upper[:half]), x_0)
    return jnp.concatenate([upper, jax.vmap(predict)(keys[-half:], t[-half:], source)])
