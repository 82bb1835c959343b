"""Jerk and sliding of feet, split by where in a plan (or a token) a frame stands.

A mean over a rollout hides where its roughness comes from. What happens at a seam
between two plans, or at a border between two tokens of a network, stands out as soon
as the frames at that place are averaged by themselves.
"""

import functools
import math
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Bool, Float, Int

from jaxmotion.evaluation import columns, contact
from jaxmotion.motion.spring import Scalar

# By column: sums over frames at each place of weighted values, and of their weights.
# Those of parts of the frames add up.
Sums = dict[str, Float[Array | np.ndarray, "2 places"]]
# By column: means over all frames at each place; NaN where there are none.
ByFrame = dict[str, Float[np.ndarray, "places"]]


def frames_since(planned: Bool[Array, "*batch frames"]) -> Int[Array, "*batch frames"]:
    """Frames since the last plan was made: 0 in its first, -1 before any plan."""
    place = jnp.broadcast_to(jnp.arange(planned.shape[-1]), planned.shape)
    last = jax.lax.cummax(jnp.where(planned, place, -1), axis=planned.ndim - 1)
    return jnp.where(last < 0, -1, place - last)


def place_sums(
    values: Float[Array, "*batch frames"],
    place: Int[Array, "*batch frames"],
    *,
    num_places: int,
    weights: Float[Array, "*batch frames"] | None = None,
) -> Float[Array, "2 places"]:
    """Sums of values (one per frame) and of their weights by place.

    Places beyond 0..num_places-1 are left out; without weights all are equal.
    """
    at = jax.nn.one_hot(place, num_places)
    weights = jnp.ones(values.shape) if weights is None else weights
    # What is left out may be no number.
    counted = jnp.where((place >= 0) & (place < num_places), values * weights, 0.0)
    sums = functools.partial(jnp.einsum, "...fp,...f->p", at, precision="highest")
    return jnp.stack([sums(counted), sums(weights)])


@functools.partial(jax.jit, static_argnames=("feet", "num_places"))
def rough_sums(
    positions: Float[Array, "*batch frames joints 3"],
    feet: tuple[int, ...],
    place: Int[Array, "*batch frames"],
    fps: Scalar,
    *,
    num_places: int,
    contact_height: Scalar,
) -> Sums:
    """Sums of jerk and slide; arguments and units as in `by_frame`."""
    toes = positions[..., jnp.array(feet), :]
    jerk = jnp.diff(positions, n=3, axis=-3) * fps**3
    jerk = jnp.mean(jnp.linalg.norm(jerk, axis=-1), axis=-1)
    low = toes[..., :-1, :, 1] < contact_height
    slide = jnp.sum(jnp.where(low, contact.foot_steps(toes) * fps, 0.0), axis=-1)
    times = jnp.sum(low, axis=-1).astype(float)
    mean = slide / jnp.maximum(times, 1.0)
    at: dict[str, Any] = {"num_places": num_places}
    return {
        "jerk": place_sums(jerk, place[..., 3:], **at),
        "foot_slide": place_sums(mean, place[..., 1:], weights=times, **at),
    }


def means(sums: Sums) -> ByFrame:
    """Means of sums."""
    found = {}
    for name, (total, weight) in sums.items():
        total, weight = np.asarray(total, float), np.asarray(weight, float)
        mean = total / np.maximum(weight, 1e-9)
        found[name] = np.where(weight > 0, mean, np.nan)
    return found


def by_frame(
    positions: Float[Array, "*batch frames joints 3"],
    feet: tuple[int, ...],
    place: Int[Array, "*batch frames"],
    fps: Scalar,
    *,
    num_places: int,
    contact_height: Scalar,
) -> ByFrame:
    """Jerk (m/s^3) and slide of low toes (m/s) by place, over the batch and time.

    A difference belongs to its last frame: a jump from frame 4 to frame 5 shows in the
    jerk of frames 5, 6 and 7 (as 1 : 2 : 1) and in the slide of frame 5.

    Positions are in the world; a foot below `contact_height` should not move; meters.
    Places out of 0..num_places-1 are left out.
    """
    return means(
        rough_sums(
            positions,
            feet,
            place,
            fps,
            num_places=num_places,
            contact_height=contact_height,
        )
    )


def to_json(rows: dict[str, ByFrame]) -> dict[str, dict[str, list[float | None]]]:
    """Rows as a JSON object; null where no frame stands."""
    return {
        name: {
            column: [float(x) if math.isfinite(x) else None for x in values]
            for column, values in row.items()
        }
        for name, row in rows.items()
    }


def to_markdown(rows: dict[str, ByFrame], *, places: str = "by frame") -> str:
    """One table of `by_frame`: a line per row and column, a column per place.

    `places` names these; one without frames (NaN) is a dash.
    """

    def text(x: float) -> str:
        if not math.isfinite(x):
            return "–"
        return f"{x:.0f}" if abs(x) >= 10 else f"{x:.2f}"

    number = max(len(values) for row in rows.values() for values in row.values())
    lines = [f"| {places} | " + " | ".join(map(str, range(number))) + " |"]
    lines.append("|---" * (number + 1) + "|")
    for name, row in rows.items():
        for column, values in row.items():
            texts = " | ".join(map(text, values))
            lines.append(f"| {name}, {columns.header(column)} | {texts} |")
    return "\n".join(lines)
