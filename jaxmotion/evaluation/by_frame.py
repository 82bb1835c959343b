"""Jerk and sliding of feet, split by where in a plan (or a token) a frame stands.

A mean over a rollout hides where its roughness comes from. What happens at a seam
between two plans, or at a border between two tokens of a network, stands out as soon
as the frames at that place are averaged by themselves.
"""

from typing import NamedTuple

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from jaxmotion.evaluation import contact
from jaxmotion.motion.spring import Scalar


class ByFrame(NamedTuple):
    """Means over all frames that stand at the same place; NaN where there are none.

    Jerk is in m/s^3 and slide in m/s (of low toes, 0 where none was low).
    """

    jerk: Float[Array, "places"]
    slide: Float[Array, "places"]
    frames: Int[Array, "places"]


def frames_since(planned: Bool[Array, "*batch frames"]) -> Int[Array, "*batch frames"]:
    """Frames since the last plan was made: 0 in its first, -1 before any plan."""
    place = jnp.broadcast_to(jnp.arange(planned.shape[-1]), planned.shape)
    last = jax.lax.cummax(jnp.where(planned, place, -1), axis=planned.ndim - 1)
    return jnp.where(last < 0, -1, place - last)


def by_frame(
    positions: Float[Array, "*batch frames joints 3"],
    feet: tuple[int, ...],
    place: Int[Array, "*batch frames"],
    fps: Scalar,
    *,
    num_places: int,
    contact_height: Scalar,
) -> ByFrame:
    """Jerk and slide by place.

    A difference belongs to its last frame: a jump from frame 4 to frame 5 shows in the
    jerk of frames 5, 6 and 7 (as 1 : 2 : 1) and in the slide of frame 5.

    Args:
      positions: World, meters.
      feet: Joints whose sliding counts.
      place: Place of each frame, in 0..num_places-1; others are left out.
      fps: Frames per second.
      num_places: Length of the result.
      contact_height: A foot joint below this height should not move, meters.

    Returns:
      Means over the batch and time.
    """
    toes = positions[..., jnp.array(feet), :]
    jerk = jnp.diff(positions, n=3, axis=-3) * fps**3
    jerk = jnp.mean(jnp.linalg.norm(jerk, axis=-1), axis=-1)
    low = toes[..., :-1, :, 1] < contact_height
    slide = jnp.where(low, contact.foot_steps(toes) * fps, 0.0)

    def sums(values: Array, first: int) -> Array:
        at = jax.nn.one_hot(place[..., first:], num_places)
        return jnp.einsum("...fp,...f->p", at, values)

    every = jnp.ones(place.shape)
    times = jnp.sum(low, axis=-1)
    divide = lambda a, b: jnp.where(b > 0, a / jnp.maximum(b, 1), 0.0)  # noqa: E731
    seen = sums(every[..., 3:], 3)
    return ByFrame(
        jerk=jnp.where(seen > 0, divide(sums(jerk, 3), seen), jnp.nan),
        slide=divide(sums(jnp.sum(slide, axis=-1), 1), sums(times.astype(float), 1)),
        frames=sums(every, 0).astype(jnp.int32),
    )


def to_json(rows: dict[str, ByFrame]) -> dict[str, dict[str, list[float]]]:
    return {
        name: {k: np.asarray(v).tolist() for k, v in row._asdict().items()}
        for name, row in rows.items()
    }


def to_markdown(rows: dict[str, ByFrame]) -> str:
    """One table: a line of jerk and one of slide per row, a column per place."""
    number = max(len(row.jerk) for row in rows.values())
    lines = ["| by frame | " + " | ".join(map(str, range(number))) + " |"]
    lines.append("|---" * (number + 1) + "|")
    for name, row in rows.items():
        jerk = " | ".join(f"{float(x):.0f}" for x in row.jerk)
        slide = " | ".join(f"{float(x):.2f}" for x in row.slide)
        lines.append(f"| {name}, jerk m/s³ | {jerk} |")
        lines.append(f"| {name}, slide m/s | {slide} |")
    return "\n".join(lines)
