"""EMDM: whole motions from an action or a text in ten or fewer large steps.

A denoising-diffusion GAN: a generator G(x_t, t, z, c) predicts the clean motion, and
x_{t-1} is drawn from the posterior; a discriminator that knows t and c tells such pairs
from those of the data. Sampling is the plain reverse chain with a denoiser that draws
its latent from its key:

    x_0 = reverse_chain(ancestral_step(vp_schedule(10), G), key, x_10, start=10)

What it is compared with are other settings of the same composition:

    MDM (DDPM)     latent=0, schedule="cosine", num_steps 50 or 1000
    DDIM-10        the same weights, step=chain.ddim_step, ten of the steps
    naive DDGAN    discriminator_condition=False, all weights of geometry 0

Source: Zhou et al. 2024, "EMDM: Efficient Motion Diffusion Model for Fast and
High-Quality Motion Generation"; the released code where the paper is silent.
"""

import dataclasses
import functools
from collections.abc import Callable
from typing import Literal

import jax
import jax.numpy as jnp
from jaxtyping import Array, Bool, Float, Int

from jaxmotion.diffusion import chain, guidance, schedule
from jaxmotion.diffusion.schedule import Schedule
from jaxmotion.networks import blocks
from jaxmotion.systems.emdm import network as emdm_network
from jaxmotion.typing import Denoiser, Key, Params


@dataclasses.dataclass(frozen=True, kw_only=True)
class Config:
    """Architecture and method; the defaults are the paper's for HumanAct12.

    Attributes:
      features: Channels of a frame.
      frames: Longest motion (HumanAct12 60, HumanML3D and KIT 196).
      condition: What motions are made from.
      condition_size: Actions, or channels of a text vector; 0 for "none".
      schedule: "vp" (EMDM's), or MDM's "cosine".
      num_steps: T.
      alpha_bar: Share of x_0's variance left at each step, falling (ours); empty for
        the schedule's own.
      latent: Channels of z; 0 for a deterministic denoiser, that is a diffusion model.
      frames_per_token, token_margin, token_window, norm: Of the `SequenceGenerator`;
        the paper's by default.
      mask_frames: What of the zeros that follow a motion's end is seen. True (ours):
        nothing; every frame of a batch counts the same in the losses. False, as
        released: attention and the discriminator see them, the losses do not; every
        motion of a batch counts the same, whatever its length.
      discriminator_width: Channels of the discriminator's first layers.
      discriminator_condition: Whether the discriminator sees the condition.
      discriminator_network: "mlp", of whole motions (published), or "temporal", which
        shares its weights over frames (ours).
      discriminator_loss: "non_saturating" (published), or "relativistic" (ours), whose
        gradient penalty is at generated pairs, too.
      discriminator_from: Least step whose pairs it judges (ours; 1, all, as published):
        below, where hardly anything is open, the errors alone count.
      drop_condition: Probability that the condition is dropped in training.
      weight_adversarial: Weight of the discriminator's verdict; 0 (ours): none is
        trained, to see what the geometric losses do alone.
      weight_recon: R, of the mean squared error of features (100 for texts).
      weight_position: Weight of joint positions (0 for texts).
      weight_velocity: Weight of frame differences of features (0 for texts).
      weight_position_velocity: Weight of the displacements of joint positions (ours).
      weight_acceleration: Weight of their second differences (ours).
      weight_foot: Weight of sliding feet (0 for texts).
      geometry: Joint positions of those losses relative to the "root" (released code)
        or in the "world" (ours: else a standing foot seems to slide under a moving
        root).
      fade_geometry: Whether those losses count alpha_bar_t times as much at step t
        (ours): at noisy steps, where x_0 can only be guessed, they outweigh the
        features' error and bend its mean.
      weigh_levels: How much the errors (all but the discriminator's verdict) count at
        each step: "alike" (published), or as much as x_{t-1} moves with the prediction
        ("posterior", ours), by which the verdict's gradient is weighted, too: 1 at t =
        1, 0.01 at t = 10. Else the mean wins where a latent could choose.
      weight_r1: gamma of the gradient penalty gamma / 2 |grad D|^2.
      r1_every: Updates from one penalty to the next; it is not scaled up by them.
    """

    features: int
    frames: int = 60
    condition: Literal["action", "text", "none"] = "action"
    condition_size: int = 12
    schedule: Literal["vp", "cosine"] = "vp"
    num_steps: int = 10
    alpha_bar: tuple[float, ...] = ()
    latent: int = 64
    width: int = 1024
    depth: int = 12
    heads: int = 32
    hidden: int = 1024
    dropout: float = 0.1
    frames_per_token: int = 1
    token_margin: int = 0
    token_window: Literal["hann", "trapezoid"] = "hann"
    norm: Literal["post", "pre"] = "post"
    mask_frames: bool = True
    discriminator_width: int = 1024
    discriminator_condition: bool = True
    discriminator_network: Literal["mlp", "temporal"] = "mlp"
    discriminator_loss: Literal["non_saturating", "relativistic"] = "non_saturating"
    discriminator_from: int = 1
    drop_condition: float = 0.1
    weight_adversarial: float = 1.0
    weight_recon: float = 1.0
    weight_position: float = 1.0
    weight_velocity: float = 1.0
    weight_position_velocity: float = 0.0
    weight_acceleration: float = 0.0
    weight_foot: float = 1.0
    geometry: Literal["root", "world"] = "root"
    fade_geometry: bool = False
    weigh_levels: Literal["alike", "posterior"] = "alike"
    weight_r1: float = 0.02
    r1_every: int = 15

    def __post_init__(self):
        """Raises a `ValueError`, with the field, for what would fail late or never."""
        if (self.condition == "none") != (self.condition_size == 0):
            raise ValueError(
                f"condition_size is {self.condition_size}, expected "
                f"{'0' if self.condition == 'none' else 'at least 1'} for condition "
                f"{self.condition!r}"
            )
        if self.frames % self.frames_per_token:
            raise ValueError(
                f"frames is {self.frames}, expected a multiple of frames_per_token "
                f"({self.frames_per_token})"
            )
        if self.discriminator_network == "mlp" and self.discriminator_width % 64:
            raise ValueError(
                f"discriminator_width is {self.discriminator_width}, expected a "
                'multiple of 64 with the discriminator_network "mlp"'
            )
        if self.discriminator_network == "temporal" and self.frames < 8:
            raise ValueError(
                f"frames is {self.frames}, a temporal discriminator expects 8 or more"
            )
        if not self.discriminator_from <= self.num_steps:
            raise ValueError(
                f"discriminator_from is {self.discriminator_from}, expected at most "
                f"num_steps ({self.num_steps})"
            )
        ends = (1.0, *self.alpha_bar, 0.0)
        falls = all(a > b for a, b in zip(ends, ends[1:], strict=False))
        if self.alpha_bar and (len(self.alpha_bar) != self.num_steps or not falls):
            raise ValueError(
                f"alpha_bar is {self.alpha_bar}, expected {self.num_steps} falling "
                "numbers between 1 and 0"
            )

    @property
    def adversarial(self) -> bool:
        """Whether it is trained with a discriminator."""
        return bool(self.latent and self.weight_adversarial)

    def table(self) -> Schedule:
        """The schedule."""
        if self.alpha_bar:
            left = jnp.asarray((1.0, *self.alpha_bar))
            return schedule.schedule_from_betas(1.0 - left[1:] / left[:-1])
        make = {"vp": schedule.vp_schedule, "cosine": schedule.cosine_schedule}
        return make[self.schedule](self.num_steps)


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True, kw_only=True, eq=False)
class Condition:
    """What a motion is made from.

    Attributes:
      vector: One-hot action or text vector; of width 0 for "none".
      keep: False for the null condition of classifier-free guidance.
      mask: Frames that the motion has.
    """

    vector: Float[Array, "*batch condition"]
    keep: Bool[Array, "*batch"]
    mask: Bool[Array, "*batch frames"]


def action_vectors(
    actions: Int[Array, "*batch"], number: int
) -> Float[Array, "*batch {number}"]:
    """One-hot vectors of actions; see `blocks.known_labels` for unknown ones."""
    if number:
        actions = blocks.known_labels(actions, number, what="actions")
    return jax.nn.one_hot(actions, number)


def make_condition(
    vector: Float[Array, "batch condition"],
    lengths: tuple[int, ...] | None = None,
    *,
    config: Config,
) -> Condition:
    """Conditions of motions of given lengths, frames; None for the model's longest.

    A `ValueError` names the vector or length that does not fit the model.
    """
    if vector.shape[-1] != config.condition_size:
        raise ValueError(
            f"condition vectors have {vector.shape[-1]} channels, the model expects "
            f"{config.condition_size} ({config.condition})"
        )
    number = vector.shape[0]
    lengths = (config.frames,) * number if lengths is None else lengths
    for length in lengths:
        if not 1 <= length <= config.frames:
            raise ValueError(f"{length} frames, the model makes 1 to {config.frames}")
    if len(lengths) != number:
        raise ValueError(f"{len(lengths)} lengths for {number} conditions")
    mask = jnp.arange(config.frames)[None] < jnp.asarray(lengths)[:, None]
    return Condition(vector=vector, keep=jnp.ones(number, bool), mask=mask)


def generator(config: Config) -> emdm_network.SequenceGenerator:
    """The generator's Flax module."""
    return blocks.sized(emdm_network.SequenceGenerator, config)


def discriminator(
    config: Config,
) -> emdm_network.SequenceDiscriminator | emdm_network.TemporalDiscriminator:
    """The discriminator's Flax module."""
    make = {
        "mlp": emdm_network.SequenceDiscriminator,
        "temporal": emdm_network.TemporalDiscriminator,
    }[config.discriminator_network]
    return make(num_steps=config.num_steps, width=config.discriminator_width)


def discriminator_condition(
    vector: Float[Array, "*batch condition"], *, config: Config
) -> Float[Array, "*batch seen"]:
    """What of the condition the discriminator sees: all, or nothing (width 0)."""
    return vector if config.discriminator_condition else vector[..., :0]


@functools.partial(jax.jit, static_argnames="config")
def init(key: Key, config: Config) -> dict[str, Params]:
    """Initial parameters: "generator" and, if there is a latent, "discriminator"."""
    key_generator, key_discriminator = jax.random.split(key)
    x = jnp.zeros((1, config.frames, config.features))
    vector = jnp.zeros((1, config.condition_size))
    t, keep, mask = jnp.ones(1, int), jnp.ones(1, bool), jnp.ones(x.shape[:2], bool)
    latent = jnp.zeros((1, config.latent)) if config.latent else None
    make = generator(config).init(key_generator, x, t, vector, keep, mask, latent)
    found = {"generator": make["params"]}
    if config.latent:
        seen = discriminator_condition(vector, config=config)
        second = discriminator(config).init(key_discriminator, x, x, t, seen)
        found["discriminator"] = second["params"]
    return found


Sample = Callable[..., Float[Array, "frames features"]]


def sampler(
    params: Params,
    *,
    config: Config,
    step: chain.StepFactory = chain.ancestral_step,
    steps: tuple[int, ...] | None = None,
) -> Sample:
    """The sampler of one motion, with what the steps share computed once.

    Inside a jitted function that closes over concrete parameters they are constants,
    which the compiler lays out once: fastest at batch 1, one program a model.

    The parameters are the generator's; `steps` of the schedule are visited, increasing,
    None for all.

    Returns:
      `sample(key, condition, *, scale=None) -> [frames, features]`. With a scale, the
      prediction is null + scale (full - null), both with the same latent; without, the
      network is called once a step.
    """
    net = generator(config)

    def denoise(key: Key, x_t: Array, t: Array, context) -> Array:
        latent = jax.random.normal(key, (config.latent,)) if config.latent else None
        arguments = context, x_t, t, latent
        return blocks.apply(params, net, *arguments, method="denoise")

    def encode(condition: Condition):
        mask = condition.mask | (not config.mask_frames)
        arguments = condition.vector, condition.keep, mask
        return blocks.apply(params, net, *arguments, method="encode")

    def sample(key: Key, condition: Condition, *, scale=None) -> Array:
        table = config.table()
        denoiser: Denoiser = lambda k, x, t: denoise(k, x, t, context)  # noqa: E731
        context = encode(condition)
        if scale is not None:
            off = jnp.zeros_like(condition.keep)
            null = encode(dataclasses.replace(condition, keep=off))
            denoiser = guidance.classifier_free(denoise, context, null, scale)
        shape = (config.frames, config.features)
        number = table.num_steps if steps is None else len(steps)
        walk = chain.respaced(step, steps)(table, denoiser)
        return chain.sample(walk, key, shape, num_steps=number)

    return sample
