"""Contact guidance: where it acts in the chain, and what it makes small.

A schedule such as "end 2" is not a flag inside the loop but a cut of the chain: each
segment is one `reverse_chain` with its own step, and since step t draws from
`fold_in(key, t)`, the unguided segments are those of the whole chain.

Source: SMGDiff, section 3.3, eq. 10-15 and table 4.
"""

import dataclasses
import functools
from collections.abc import Callable

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxmotion.diffusion import chain, guidance, schedule
from jaxmotion.motion import contact
from jaxmotion.motion.skeleton import joint_positions
from jaxmotion.networks import blocks
from jaxmotion.systems.smgdiff.model import Condition, Config, network
from jaxmotion.systems.smgdiff.scene import Representation, to_scene
from jaxmotion.typing import Key, Objective, Params

SamplePlan = Callable[[Key, Condition], Float[Array, "future features"]]


@dataclasses.dataclass(frozen=True, kw_only=True)
class Guidance:
    """How contact guidance acts; the defaults are the paper's.

    Attributes:
      start: Guided steps at the start of the chain.
      end: Guided steps at its end.
      rate: w_r of DSG, in 0..1.
      last_sigma: Length of the last step per channel, in deviations of the features;
        None for the released code's (`guidance.dsg_step`).
      min_acceleration: tau_a: a ball that accelerates more is being touched, meters
        per second squared.
      max_distance: tau_d: from here on a joint is too far from the ball's center,
        meters.
      grounded_weight: w_d: distances of feet that stand count so much.
    """

    start: int = 0
    end: int = 2
    rate: float | Float[Array, ""] = 0.5
    last_sigma: float | None = None
    min_acceleration: float = 2.0
    max_distance: float = 0.1
    grounded_weight: float = 2.0


UNGUIDED = Guidance(end=0)
# For models of a short training, chosen on windows of training clips. Their ball still
# trembles: the paper's threshold takes every frame for a touch. Joints, unlike skin,
# keep more than 11 cm from its center. The last step changes the result itself, without
# a network after it to smooth that, and is kept short.
TUNED = Guidance(rate=0.9, last_sigma=0.0005, min_acceleration=12.0, max_distance=0.18)
# Table 4 of the paper, beside no guidance at all.
SCHEDULES = {
    "none": (0, 0),
    "start 1": (1, 0),
    "end 1": (0, 1),
    "start 2": (2, 0),
    "end 2": (0, 2),
    "start 1, end 1": (1, 1),
}


def on_schedule(guided: Guidance, name: str) -> Guidance:
    """Guidance where a schedule says; a `ValueError` names those there are."""
    if name not in SCHEDULES:
        raise ValueError(
            f"unknown schedule {name!r}: expected one of {', '.join(SCHEDULES)}"
        )
    start, end = SCHEDULES[name]
    return dataclasses.replace(guided, start=start, end=end)


def segments(guided: Guidance, num_steps: int) -> tuple[tuple[bool, int, int], ...]:
    """Cuts a chain of T steps where guidance begins and ends: T down to 0.

    Of each segment: whether it is guided, its first step, and that of its result.
    `ValueError` if more steps are guided than there are.
    """
    if min(guided.start, guided.end) < 0 or guided.start + guided.end > num_steps:
        raise ValueError(
            f"guidance of the first {guided.start} and the last {guided.end} steps: "
            f"expected at most {num_steps} in all"
        )
    first, last = num_steps - guided.start, guided.end
    cuts = ((True, num_steps, first), (False, first, last), (True, last, 0))
    return tuple(cut for cut in cuts if cut[1] > cut[2])


def contact_objective(
    start: Float[Array, "3"], *, representation: Representation, guided: Guidance
) -> Objective:
    """How far feet are from the ball where the ball is pushed, meters.

    `start` is where the ball was displayed last, in the frame of the plan, meters.

    Source: SMGDiff, eq. 10-12.
    """
    skeleton, joints = representation.skeleton, representation.joints

    def objective(x_0: Float[Array, "future features"], /) -> Float[Array, ""]:
        scene, stands = to_scene(x_0, start, representation)
        places = joint_positions(skeleton, scene.motion)
        known = {foot: stands[..., i] for i, foot in enumerate(skeleton.feet)}
        grounded = [known.get(j, jnp.zeros(stands.shape[:-1])) for j in joints]
        gate = contact.ball_contact_gate(
            scene.ball, representation.fps, threshold=guided.min_acceleration
        )
        return contact.ball_contact_loss(
            places[..., jnp.array(joints), :],
            scene.ball,
            jnp.stack(grounded, axis=-1),
            gate,
            max_distance=guided.max_distance,
            grounded_weight=guided.grounded_weight,
        )

    return objective


def sampler(
    params: Params,
    *,
    config: Config,
    representation: Representation,
    guided: Guidance = Guidance(),
    step: chain.StepFactory = chain.ancestral_step,
    steps: tuple[int, ...] | None = None,
) -> SamplePlan:
    """The sampler of plans, `sample(key, condition) -> [future, features]`.

    Gradients are compiled into the guided segments only; `step` makes the others'.
    `steps` of the schedule are visited, increasing; None for all. `ValueError` if more
    are guided than there are.
    """
    number = config.num_steps if steps is None else len(steps)
    net, parts = network(config), segments(guided, number)
    shape = (config.future, config.num_features)

    def sample(key: Key, condition: Condition) -> Array:
        table = schedule.cosine_schedule(config.num_steps)
        context = blocks.apply(params, net, *condition.arguments(), method="encode")

        def denoise(key: Key, x_t: Array, t: Array) -> Array:
            del key  # deterministic
            return blocks.apply(params, net, context, x_t, t, method="denoise")

        objective = contact_objective(
            condition.ball, representation=representation, guided=guided
        )
        toward_contact = functools.partial(
            guidance.dsg_step,
            objective=objective,
            rate=guided.rate,
            last_sigma=guided.last_sigma,
        )
        moves = {
            is_guided: chain.respaced(make, steps)(table, denoise)
            for is_guided, make in ((False, step), (True, toward_contact))
        }
        key_start, key_chain = jax.random.split(key)
        x = jax.random.normal(key_start, shape)
        for is_guided, start, stop in parts:
            x = chain.sample_from(
                moves[is_guided], key_chain, x, start=start, stop=stop
            )
        return x

    return sample
