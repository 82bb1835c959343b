"""AAMDM's transition: from one embedded frame to the next in a few steps of two kinds.

One chain of T = drafts + polishes steps. A denoising-diffusion GAN takes its large
first steps, a diffusion model its last ones; both see the previous frame:

    x_p = reverse_chain(ancestral_step(table, draft), key, x_T, start=T, stop=p)
    x_0 = reverse_chain(ancestral_step(table, polish), key, x_p, start=p)

The frame is any vector: the learned 64-dimensional embedding of a pose, or a point of
the toy problem. At 60 frames per second a frame is nearly the one before it, so that a
network which predicts it spends itself on saying again what it was given: ours may
predict the change instead, scaled to unit variance. The chain denoises frames either
way.

Source: Li et al. 2024, "AAMDM: Accelerated Auto-regressive Motion Diffusion Model",
sections 3.2-3.5. Sizes and the schedule are ours, since the paper gives none.
"""

import dataclasses
import functools
from collections.abc import Callable
from typing import Any, Literal

import jax
import jax.numpy as jnp
from jaxtyping import Array, Float

from jaxmotion.diffusion import chain, guidance
from jaxmotion.diffusion import schedule as tables
from jaxmotion.diffusion.schedule import Schedule
from jaxmotion.networks import blocks, mlp
from jaxmotion.typing import Denoiser, Key, Objective, Params

SYSTEM = "aamdm"


@dataclasses.dataclass(frozen=True, kw_only=True)
class Config:
    """Networks and method of a transition.

    The paper gives the numbers of steps, the window and the terms of the losses; the
    rest is ours.

    Attributes:
      schedule: "cosine", or "vp" (which keeps less of the sample at each step).
      predict: What the networks predict: the "frame" (paper), or its "change" since the
        previous one in deviations of changes (ours), in which the polisher's errors are
        then measured, too.
      window: Frames that the diffusion model predicts in a row in training (paper).
      gan_window: Frames of the windows of the GAN, at least three (paper: 10).
      levels: Steps that each network learns: "all", or its "own" (ours), those that
        the chain asks it for: the first drafts, or the last polishes.
      weight_pose: Weight of the errors of the poses that the polisher's frames mean, as
        the autoencoder measures them; ours.
      weight_foot: Weight of the errors of slow toes' velocities over the ground, in the
        unit of these errors of poses, to which they are added; ours.
      previous_noise: Largest deviation of the noise that is added in training to the
        previous frames of the data, in deviations of these; ours, so that a
        rollout recovers after leaving the data. 0 for none.
      own_previous: Probability that the GAN's previous frame in training is the
        generator's own prediction of it.
    """

    features: int
    drafts: int = 3
    polishes: int = 2
    schedule: Literal["cosine", "vp"] = "cosine"
    predict: Literal["frame", "change"] = "frame"
    latent: int = 64
    width: int = 512
    depth: int = 4
    window: int = 10
    gan_window: int = 3
    levels: Literal["all", "own"] = "all"
    weight_velocity: float = 0.1
    weight_pose: float = 0.0
    weight_foot: float = 0.0
    previous_noise: float = 0.0
    own_previous: float = 0.5
    weight_r1: float = 0.05

    @property
    def num_steps(self) -> int:
        """T, the steps of the whole chain."""
        return self.drafts + self.polishes

    def steps(self, network: Literal["generator", "polisher"]) -> tuple[int, int]:
        """First and last step that a network learns."""
        if self.levels == "all":
            return 1, self.num_steps
        return (
            (1, self.polishes)
            if network == "polisher"
            else (
                self.polishes + 1,
                self.num_steps,
            )
        )

    def table(self) -> Schedule:
        """The noise schedule of the chain."""
        make = {"cosine": tables.cosine_schedule, "vp": tables.vp_schedule}
        return make[self.schedule](self.num_steps)


def network(config: Config) -> mlp.ConditionedMlp:
    """Module of the generator and of the diffusion model (which has no latent)."""
    return mlp.ConditionedMlp(
        features=config.features,
        num_steps=config.num_steps,
        width=config.width,
        depth=config.depth,
    )


def discriminator(config: Config) -> mlp.PairDiscriminator:
    """Module of the discriminator."""
    return mlp.PairDiscriminator(
        num_steps=config.num_steps, width=config.width, depth=config.depth
    )


@functools.partial(jax.jit, static_argnames="config")
def init(key: Key, config: Config) -> Params:
    """Initial parameters of "polisher", "generator" and "discriminator"."""
    key_p, key_g, key_d = jax.random.split(key, 3)
    x = jnp.zeros(config.features)
    z = jnp.zeros(config.latent)
    t = jnp.ones((), jnp.int32)
    net, second = network(config), discriminator(config)
    return {
        "polisher": net.init(key_p, x, t, x)["params"],
        "generator": net.init(key_g, x, t, x, z)["params"],
        "discriminator": second.init(key_d, x, x, t, x)["params"],
    }


def to_frame(
    found: Float[Array, "*batch features"],
    previous: Float[Array, "*batch features"],
    change: Float[Array, " features"] | None,
) -> Float[Array, "*batch features"]:
    """The frame that a network's prediction means.

    It predicts changes in their deviation `change`; None where it predicts the frame.
    """
    if change is None:
        return found
    return previous + found * change.reshape((1,) * (found.ndim - 1) + (-1,))


def check_change(config: Config, change: Array | None) -> None:
    """Raises `ValueError` unless the deviation of changes is there if it is needed."""
    if (change is None) != (config.predict == "frame"):
        found = "none" if change is None else f"shape {change.shape}"
        raise ValueError(
            f"predict is {config.predict!r}, but the scale of changes is {found}: "
            "expected one for 'change' and none for 'frame'"
        )


def draft(
    params: Params,
    previous: Float[Array, "*batch features"],
    *,
    config: Config,
    change: Float[Array, " features"] | None = None,
) -> Denoiser:
    """The generator as a denoiser; its latent comes from its key.

    `change` is as in `to_frame`.
    """

    def denoise(key: Key, x_t: Array, t: Array, /) -> Array:
        latent = jax.random.normal(key, (*x_t.shape[:-1], config.latent), x_t.dtype)
        found = blocks.apply(params, network(config), x_t, t, previous, latent)
        return to_frame(found, previous, change)

    return denoise


def polish(
    params: Params,
    previous: Float[Array, "*batch features"],
    *,
    config: Config,
    change: Float[Array, " features"] | None = None,
) -> Denoiser:
    """The diffusion model as a denoiser; `change` is as in `to_frame`."""

    def denoise(key: Key, x_t: Array, t: Array, /) -> Array:
        del key  # deterministic
        found = blocks.apply(params, network(config), x_t, t, previous)
        return to_frame(found, previous, change)

    return denoise


def _denoiser(
    weights: mlp.MlpWeights,
    previous: Float[Array, "*batch features"],
    config: Config,
    change: Float[Array, " features"] | None,
    latent: int,
) -> Denoiser:
    """`draft` or, without channels of a latent, `polish`, of weights laid out."""
    net = network(config)
    context = net.encode(weights, previous)

    def denoise(key: Key, x_t: Array, t: Array, /) -> Array:
        given: tuple[Array, ...] = ()
        if latent:
            given = (jax.random.normal(key, (*x_t.shape[:-1], latent), x_t.dtype),)
        found = net.denoise(weights, context, x_t, t, *given)
        return to_frame(found, previous, change)

    return denoise


Sample = Callable[..., Float[Array, "*batch features"]]


def sampler(
    params: Params,
    *,
    config: Config,
    change: Float[Array, " features"] | None = None,
    step: chain.StepFactory = chain.ancestral_step,
    held: bool = False,
) -> Sample:
    """The sampler of the next frame.

    Of the parameters the discriminator's are not used, and those of a network that
    takes no steps may be missing; `change` is as in `to_frame`. A step that looks back
    forgets where the polisher takes over. Where the previous frame is `held` it stands
    for the draft of the next one, and the generator takes no steps (ours); it is a
    `ValueError` where nobody polishes.

    `sample(key, previous, *, objective=None, scale=0.0, guided_steps=None, noise=None)
    -> next`: with an objective of the predicted frame so many steps at the chain's end
    are guided down its gradient, by default all (eq. 13). `noise` is that of the
    posteriors, [T, features], for steps that take one.
    """
    check_change(config, change)
    table, net = config.table(), network(config)
    if held and not config.polishes:
        raise ValueError("held: a chain of drafts alone, expected polishes")
    drafts = 0 if held else config.drafts
    number = {"generator": drafts, "polisher": config.polishes}
    # Here, so that a rollout does it once.
    weights = {
        name: net.layout(params[name], config.features)
        for name, steps in number.items()
        if steps
    }

    def sample(
        key: Key,
        previous: Float[Array, "*batch features"],
        *,
        objective: Objective | None = None,
        scale: float | Float[Array, ""] = 0.0,
        guided_steps: int | None = None,
        noise: Float[Array, "steps *batch features"] | None = None,
    ) -> Float[Array, "*batch features"]:
        # Only a step that remembers takes noise from outside.
        given: dict[str, Any] = {} if noise is None else {"noise": noise}
        make = functools.partial(step, **given)
        guided = config.num_steps if guided_steps is None else guided_steps
        if objective is None:
            guided = 0

        def part(denoise: Denoiser, x: Array, start: int, stop: int) -> Array:
            border = min(max(guided, stop), start)
            if start > border:
                move = make(table, denoise)
                x = chain.sample_from(move, key_chain, x, start=start, stop=border)
            if objective is not None and border > stop:
                denoise = guidance.gradient_guidance(
                    table, denoise, objective, scale=scale
                )
                move = make(table, denoise)
                x = chain.sample_from(move, key_chain, x, start=border, stop=stop)
            return x

        key_start, key_chain = jax.random.split(key)
        x = jax.random.normal(key_start, previous.shape, previous.dtype)
        if held:
            x = tables.q_sample(table, previous, jnp.array(config.polishes), x)
        if drafts:
            drafter = _denoiser(
                weights["generator"], previous, config, change, config.latent
            )
            x = part(drafter, x, config.num_steps, config.polishes)
        if config.polishes:
            polisher = _denoiser(weights["polisher"], previous, config, change, 0)
            x = part(polisher, x, config.polishes, 0)
        return x

    return sample
