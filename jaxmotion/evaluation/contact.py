"""Feet that slide on the ground. Heights are y above the ground at y = 0, meters."""

from typing import NamedTuple

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxmotion.motion.ground import into_frame
from jaxmotion.motion.spring import Scalar


class Slide(NamedTuple):
    """How fast low feet move, and for how long feet were low at all.

    A foot that never comes down slides nowhere: read `speed` together with `seconds`.
    """

    speed: Float[Array, "*batch"]
    seconds: Float[Array, "*batch"]


def foot_steps(
    foot_positions: Float[Array, "*batch frames feet 3"],
) -> Float[Array, "*batch frames-1 feet"]:
    """Distance, meters, on the ground from each frame to the next."""
    if foot_positions.shape[-3] < 2:
        raise ValueError("1 frame or none, expected at least 2 to have a step")
    return jnp.linalg.norm(jnp.diff(foot_positions[..., ::2], axis=-3), axis=-1)


@jax.jit
def slide_distance(
    foot_positions: Float[Array, "*batch frames feet 3"],
    fps: Scalar,
    *,
    max_height: Scalar = 0.01,
) -> Slide:
    """Meters that the toes slide for each second that they are low.

    Over all feet and all frames in which a foot is lower than `max_height`: the
    horizontal distance to the next frame, summed, divided by the time summed. To join
    clips, weight their speeds with their seconds.

    Speed in m/s (zero where no foot is ever low), and the seconds that feet were low,
    added over feet. Positions are those of toes (world, meters, ground at y = 0);
    `max_height`, exclusive, is "below, e.g., 1 cm" in the paper.

    Source: Chen et al. 2024 (CAMDM), sec. 4.1, metric 2. Differs: a second of low
      foot, so that it depends on neither length nor frame rate.
    """
    steps = foot_steps(foot_positions)
    is_low = foot_positions[..., :-1, :, 1] < max_height
    meters = jnp.sum(jnp.where(is_low, steps, 0.0), axis=(-2, -1))
    seconds = jnp.sum(is_low, axis=(-2, -1)) / fps
    speed = meters / jnp.where(seconds > 0, seconds, 1.0)
    return Slide(speed=speed, seconds=seconds)


@jax.jit
def skate_ratio(
    foot_positions: Float[Array, "*batch frames feet 3"],
    fps: Scalar,
    *,
    max_height: Scalar = 0.05,
    min_speed: Scalar = 0.5,
) -> Float[Array, "*batch"]:
    """Part of the frames, in [0, 1], in which any foot skates.

    A foot skates from one frame to the next if it is lower than `max_height` in both
    and moves faster than `min_speed` on the ground.

    World positions, meters, ground at y = 0; both bounds are exclusive. The source's
    speed is 2.5 cm a frame at 20 fps.

    Source: Karunratanakul et al. 2023 (GMD), with a threshold per second. Real data do
      not score zero (about 0.05 there).
    """
    is_fast = foot_steps(foot_positions) * fps > min_speed
    is_low = foot_positions[..., 1] < max_height
    skates = is_fast & is_low[..., 1:, :] & is_low[..., :-1, :]
    return jnp.mean(jnp.any(skates, axis=-1), axis=-1)


@jax.jit
def skating_frame_ratio(
    foot_positions: Float[Array, "*batch frames feet 3"],
    fps: Scalar,
    *,
    height: Scalar = 0.025,
    min_speed: Scalar = 0.2,
) -> Float[Array, "*batch"]:
    """Part of the frames, in [0, 1], in which any foot skates, by MANN's measure.

    A foot at height h that moves at v on the ground skates by v (2 - 2^(h / H)), with h
    / H clipped to [0, 1]: fully on the ground, not at all from H on. A frame counts if
    that exceeds `min_speed`.

    World positions, meters, ground at y = 0; `height` is H. The speed, exclusive, is
    ours, since the source sums the measure.

    Source: Zhang et al. 2018 (MANN), section 8; cited for AAMDM's "footskating frame
      ratio" by Li et al. 2024.
    """
    speed = foot_steps(foot_positions) * fps
    level = jnp.clip(foot_positions[..., :-1, :, 1] / height, 0.0, 1.0)
    skates = speed * (2.0 - 2.0**level) > min_speed
    return jnp.mean(jnp.any(skates, axis=-1), axis=-1)


@jax.jit
def leg_crossings(
    foot_positions: Float[Array, "*batch frames 2 3"],
    facing: Float[Array, "*batch frames 2"],
    fps: Scalar,
    *,
    margin: Scalar = 0.02,
) -> Float[Array, "*batch"]:
    """How often per minute the left foot comes to the right of the right one.

    By more than `margin`, meters, seen along the facing (x, z; unit length). Feet are
    world positions, meters, left before right.
    """
    gap = foot_positions[..., 0, ::2] - foot_positions[..., 1, ::2]
    crossed = into_frame(gap, facing)[..., 0] < -margin
    begun = crossed[..., 1:] & ~crossed[..., :-1]
    return 60.0 * fps * jnp.mean(begun, axis=-1)


# Strides per second that are looked for, and samples of the spectrum.
_STRIDES, _SPECTRUM = (0.4, 4.0), 4096


def stride_rate(
    foot_positions: Float[Array, "*batch frames 2 3"],
    facing: Float[Array, "*batch frames 2"],
    fps: Scalar,
) -> Float[Array, "*batch"]:
    """Strides (of two steps) per second: how often one foot overtakes the other.

    The strongest frequency of .4 to 4 Hz in how far the left foot is ahead of the right
    one along the facing (x, z; unit length). Meaningless for who stands. Feet are world
    positions, meters.
    """
    gap = foot_positions[..., 0, ::2] - foot_positions[..., 1, ::2]
    ahead = into_frame(gap, facing)[..., 1]
    ahead = ahead - jnp.mean(ahead, axis=-1, keepdims=True)
    taper = jnp.broadcast_to(jnp.hanning(ahead.shape[-1]), ahead.shape)
    size = max(_SPECTRUM, ahead.shape[-1])
    power = jnp.abs(jnp.fft.rfft(ahead * taper, n=size))
    rate = jnp.arange(power.shape[-1]) * fps / size
    is_gait = (_STRIDES[0] <= rate) & (rate <= _STRIDES[1])
    gait = jnp.where(jnp.broadcast_to(is_gait, power.shape), power, 0.0)
    return rate[jnp.argmax(gait, axis=-1)]


class Swing(NamedTuple):
    """How high swinging feet are, by window.

    Attributes:
      median: Median height over the ground, meters; 0 without a swinging foot.
      low: 10th percentile of the height.
      seconds: How long feet swing, summed over feet.
    """

    median: Float[Array, "*batch"]
    low: Float[Array, "*batch"]
    seconds: Float[Array, "*batch"]


def swing_height(
    foot_positions: Float[Array, "*batch frames feet 3"],
    body_speed: Float[Array, "*batch frames"],
    fps: Scalar,
    *,
    ground: Scalar,
    least_speed: float = 0.3,
) -> Swing:
    """Height of feet (world, meters) that move faster over the ground than the body.

    Args:
      body_speed: Speed of the body without its sway, meters per second.
      ground: Height at which a foot rests, meters.
      least_speed: A foot of a body that is slower than this, m/s, must be faster than
        it: those who stand have no swing.
    """
    speed = foot_steps(foot_positions) * fps
    body = jnp.maximum(body_speed[..., 1:, None], least_speed)
    height = foot_positions[..., 1:, :, 1] - ground
    swings = speed > body
    swinging = jnp.where(swings, height, jnp.nan)
    low, median = (
        jnp.nan_to_num(jnp.nanpercentile(swinging, part, axis=(-2, -1)))
        for part in (10.0, 50.0)
    )
    return Swing(median=median, low=low, seconds=jnp.sum(swings, axis=(-2, -1)) / fps)
