"""The systems' networks and samplers in plain PyTorch: what we compare with.

The published networks of `torch.nn` parts: a stack of `TransformerEncoderLayer` (CAMDM,
whose network is SMGDiff's, too, and EMDM), or a conditioned MLP (AAMDM). Every token
runs in every step, as in the released code. `make` builds a system's sampler with our
parameters, so that both predict the same, and `sample` walks its steps.

Sources: Chen et al. 2024 (CAMDM), section 3.2; Zhou et al. 2024 (EMDM), section 3.1;
sizes of the released code. Li et al. 2024 (AAMDM) give no sizes; they are ours.
"""

import dataclasses
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np
import torch
from torch import nn
from torch.nn import functional

from jaxmotion.diffusion import schedule
from jaxmotion.networks import blocks
from jaxmotion.systems.aamdm import model as aamdm_model
from jaxmotion.systems.camdm import model as camdm_model
from jaxmotion.systems.emdm import model as emdm_model
from jaxmotion.systems.smgdiff import model as smgdiff_model

State = dict[str, Any]
# Builds for other processors have no packed products; the names are PyTorch's own.
HAS_ONEDNN = torch.backends.mkldnn.is_available() and all(
    hasattr(torch.ops.mkldnn, name)
    for name in ("_reorder_linear_weight", "_linear_pointwise")
)


def _time_embedding(width: int) -> nn.Sequential:
    return nn.Sequential(nn.Linear(width, width), nn.SiLU(), nn.Linear(width, width))


def _codes(number: int, width: int) -> torch.Tensor:
    return torch.from_numpy(np.array(blocks.sinusoidal_positions(number, width)))


def _expect(config: Any, **expected: Any) -> None:
    """Raises unless fields of a config that has them are as the peer is built."""
    for name, value in expected.items():
        found = getattr(config, name, value)
        if found != value:
            raise ValueError(f"{name} is {found!r}: the peer has {value!r}")


class TorchCamdm(nn.Module):
    """CAMDM's denoiser, for a batch: `forward(x_t, t, past, path, facing, label)`."""

    def __init__(
        self,
        config: camdm_model.Config | smgdiff_model.Config,
        *,
        batch_first: bool = False,
    ):
        """Makes it with random weights.

        Args:
          config: Sizes; one frame a token.
          batch_first: Layout of the encoder. False is the released code's; True lets
            PyTorch use its fused inference path.

        Raises:
          ValueError: if the config has another network or several frames a token.
        """
        super().__init__()
        _expect(config, network="transformer", frames_per_token=1, token_margin=0)
        _expect(config, norm="post", attention="full", frame_kernel=0)
        width, features = config.width, config.num_features
        self.future, self.batch_first = config.future, batch_first
        self.embed_label = nn.Embedding(config.num_labels, width)
        self.embed_path = nn.Linear(2, width)
        self.embed_facing = nn.Linear(6, width)
        self.embed_past = nn.Linear(features, width)
        self.embed_noisy = nn.Linear(features, width)
        self.embed_time = _time_embedding(width)
        layer = nn.TransformerEncoderLayer(
            width,
            config.heads,
            config.hidden,
            config.dropout,
            activation="gelu",
            batch_first=batch_first,
        )
        self.encoder = nn.TransformerEncoder(
            layer, config.depth, enable_nested_tensor=False
        )
        self.out = nn.Linear(width, features)
        tokens = 2 + 3 * config.future + config.past
        self.register_buffer("codes", _codes(max(tokens, config.num_steps), width))

    def forward(
        self,
        x_t: torch.Tensor,
        t: torch.Tensor,
        past: torch.Tensor,
        path: torch.Tensor,
        facing: torch.Tensor,
        label: torch.Tensor,
    ) -> torch.Tensor:
        """Prediction of the clean sample; step t in 1..T reads row t - 1.

        Args:
          x_t: Noisy features, [batch, future, features].
          t: Steps, [batch].
          past: Features of the past, [batch, past, features].
          path: Ground positions, [batch, future, 2].
          facing: Rotations, [batch, future, 6].
          label: Styles, [batch].

        Returns:
          Predicted features.
        """
        tokens = torch.cat(
            [
                self.embed_time(self.codes[t - 1])[:, None],
                self.embed_label(label)[:, None],
                self.embed_path(path),
                self.embed_facing(facing),
                self.embed_past(past),
                self.embed_noisy(x_t),
            ],
            dim=1,
        )
        tokens = tokens + self.codes[: tokens.shape[1]]
        if self.batch_first:
            y = self.encoder(tokens)[:, -self.future :]
        else:
            y = self.encoder(tokens.transpose(0, 1))[-self.future :].transpose(0, 1)
        return self.out(y)

    def state_of(self, params: Mapping) -> State:
        """Our parameters by PyTorch's names."""
        state = {"embed_label.weight": params["embed_label"]["embedding"]}
        for name in ("embed_path", "embed_facing", "embed_past", "embed_noisy", "out"):
            state |= _linear(name, params[name])
        state |= _time(params["embed_time"])
        return state | _encoder(params, len(self.encoder.layers))


class TorchEmdm(nn.Module):
    """EMDM's generator, for a batch: `forward(x_t, t, vector, latent)`.

    Of motions with all frames, by actions or texts; without a mask, as released.
    """

    def __init__(self, config: emdm_model.Config):
        """Makes it with random weights.

        Args:
          config: Sizes; the paper's, or ours with several frames a token in pre-norm.

        Raises:
          ValueError: if the config has no latent, no condition, or shared frames.
        """
        super().__init__()
        _expect(config, token_margin=0)
        if config.condition == "none" or not config.latent:
            raise ValueError(
                f"condition {config.condition!r} with {config.latent} channels of a "
                "latent: the peer has both"
            )
        width, channels = config.width, config.features * config.frames_per_token
        self.features, self.tokens = (
            config.features,
            config.frames // config.frames_per_token,
        )
        self.embed_time = _time_embedding(width)
        self.embed_condition = nn.Linear(
            config.condition_size, width, bias=config.condition == "text"
        )
        layers: list[nn.Module] = []
        for i in range(5):
            layers += [nn.Linear(width if i else config.latent, width)]
            layers += [nn.LeakyReLU(0.2)]
        self.embed_latent = nn.Sequential(*layers)
        self.embed_noisy = nn.Linear(channels, width)
        pre = config.norm == "pre"
        layer = nn.TransformerEncoderLayer(
            width,
            config.heads,
            config.hidden,
            config.dropout,
            activation=nn.functional.selu,
            norm_first=pre,
        )
        self.encoder = nn.TransformerEncoder(
            layer,
            config.depth,
            norm=nn.LayerNorm(width) if pre else None,
            enable_nested_tensor=False,
        )
        self.out = nn.Linear(width, channels)
        number = max(3 + self.tokens, config.num_steps)
        self.register_buffer("codes", _codes(number, width))

    def forward(
        self,
        x_t: torch.Tensor,
        t: torch.Tensor,
        vector: torch.Tensor,
        latent: torch.Tensor,
    ) -> torch.Tensor:
        """Prediction of the clean motion.

        Args:
          x_t: Noisy features, [batch, frames, features].
          t: Steps, [batch].
          vector: Actions or texts, [batch, condition].
          latent: Normal, [batch, latent].

        Returns:
          Predicted features.
        """
        own = [self.embed_time(self.codes[t - 1]), self.embed_condition(vector)]
        own = torch.stack([*own, self.embed_latent(latent)], dim=1)
        frames = self.embed_noisy(x_t.reshape(x_t.shape[0], self.tokens, -1))
        tokens = torch.cat([own, frames], dim=1)
        tokens = tokens + self.codes[: tokens.shape[1]]
        y = self.encoder(tokens.transpose(0, 1))[-self.tokens :].transpose(0, 1)
        return self.out(y).reshape(x_t.shape)

    def state_of(self, params: Mapping) -> State:
        """Our parameters by PyTorch's names."""
        state = _time(params["embed_time"])
        for name in ("embed_condition", "embed_noisy", "out"):
            state |= _linear(name, params[name])
        for i in range(5):
            state |= _linear(
                f"embed_latent.{2 * i}", params["embed_latent"][f"layers_{i}"]
            )
        if self.encoder.norm is not None:
            state |= _norm("encoder.norm", params["norm_out"])
        return state | _encoder(params, len(self.encoder.layers))


class TorchMlp(nn.Module):
    """AAMDM's networks, for a batch: `forward(x_t, t, previous, *latent)`."""

    def __init__(self, config: aamdm_model.Config, *, latent: int = 0):
        """Makes it with random weights.

        Args:
          config: Sizes.
          latent: Channels of the generator's latent; 0 for the polisher.
        """
        super().__init__()
        ours = aamdm_model.network(config)
        self.embed_time = _time_embedding(ours.time_width)
        given = 2 * config.features + ours.time_width + latent
        inputs = [given, *[config.width + given] * (ours.depth - 1)]
        self.layers = nn.ModuleList(nn.Linear(n, config.width) for n in inputs)
        self.norms = nn.ModuleList(
            nn.GroupNorm(ours.groups, config.width, eps=1e-6) for _ in inputs[1:]
        )
        self.out = nn.Linear(config.width + given, config.features)
        self.register_buffer("codes", _codes(config.num_steps, ours.time_width))

    def forward(
        self,
        x_t: torch.Tensor,
        t: torch.Tensor,
        previous: torch.Tensor,
        *latent: torch.Tensor,
    ) -> torch.Tensor:
        """Prediction of the clean frame.

        Args:
          x_t: Noisy frame, [batch, features].
          t: Steps, [batch].
          previous: The frame before, [batch, features].
          *latent: Normal, [batch, latent]; of the generator.

        Returns:
          Predicted frame.
        """
        step = self.embed_time(self.codes[t - 1])
        given = torch.cat([x_t, previous, step, *latent], dim=-1)
        h = nn.functional.silu(self.layers[0](given))
        for layer, norm in zip(self.layers[1:], self.norms, strict=True):
            h = nn.functional.silu(norm(layer(torch.cat([h, given], dim=-1))))
        return self.out(torch.cat([h, given], dim=-1))

    def state_of(self, params: Mapping) -> State:
        """Our parameters by PyTorch's names."""
        state, depth = _time(params["TimeEmbedding_0"]), len(self.layers)
        for i in range(depth):
            state |= _linear(f"layers.{i}", params[f"Dense_{i}"])
        for i in range(depth - 1):
            state |= _norm(f"norms.{i}", params[f"GroupNorm_{i}"])
        return state | _linear("out", params[f"Dense_{depth}"])


Net = TorchCamdm | TorchEmdm | TorchMlp


def _linear(name: str, dense: Mapping) -> State:
    """PyTorch's weights are our kernels transposed."""
    state = {f"{name}.weight": np.asarray(dense["kernel"]).T}
    return state | ({f"{name}.bias": dense["bias"]} if "bias" in dense else {})


def _norm(name: str, norm: Mapping) -> State:
    return {f"{name}.weight": norm["scale"], f"{name}.bias": norm["bias"]}


def _time(params: Mapping) -> State:
    state = _linear("embed_time.0", params["hidden"])
    return state | _linear("embed_time.2", params["out"])


def _encoder(params: Mapping, depth: int) -> State:
    """PyTorch's one input projection is our query and key_value side by side."""
    state: State = {}
    for i in range(depth):
        ours, theirs = params[f"layers_{i}"], f"encoder.layers.{i}"
        both = {
            kind: np.concatenate(
                [np.asarray(ours[part][kind]) for part in ("query", "key_value")], -1
            )
            for kind in ("kernel", "bias")
        }
        state[f"{theirs}.self_attn.in_proj_weight"] = both["kernel"].T
        state[f"{theirs}.self_attn.in_proj_bias"] = both["bias"]
        state |= _linear(f"{theirs}.self_attn.out_proj", ours["out"])
        state |= _linear(f"{theirs}.linear1", ours["expand"])
        state |= _linear(f"{theirs}.linear2", ours["contract"])
        for j in (1, 2):
            state |= _norm(f"{theirs}.norm{j}", ours[f"norm_{j}"])
    return state


def load(net: Net, params: Mapping) -> Net:
    """Copies our parameters into a network and puts it in eval mode.

    Args:
      net: Changed in place.
      params: Parameters of our network with the same sizes.

    Returns:
      The network.
    """
    found = {
        name: torch.from_numpy(np.array(value))
        for name, value in net.state_of(params).items()
    }
    net.load_state_dict({"codes": net.codes} | found)
    return net.eval()


@dataclasses.dataclass(frozen=True, kw_only=True)
class Peer:
    """A system's sampler; what belongs to a step t stands at index t - 1.

    Attributes:
      nets: The network of each step, or what torch.compile made of it.
      latents: Channels of the latent that each step draws; 0 for none.
      table: Of each step, the factors of x_0, x_t and the noise.
      shape: Shape of a sample.
    """

    nets: tuple[Callable[..., torch.Tensor], ...]
    latents: tuple[int, ...]
    table: tuple[tuple[float, float, float], ...]
    shape: tuple[int, ...]


def make(
    system: str, config: Any, params: Mapping, *, batch_first: bool = False
) -> Peer:
    """A system's sampler with our parameters.

    Args:
      system: Its name.
      config: The method.
      params: Parameters of its sampler.
      batch_first: Layout of CAMDM's and SMGDiff's encoder.

    Raises:
      ValueError: if the peer has not what the config asks for.
    """
    number = config.num_steps
    if system == "aamdm":
        _expect(config, predict="frame")
        polisher = load(TorchMlp(config), params["polisher"])
        drafter = load(TorchMlp(config, latent=config.latent), params["generator"])
        nets = (polisher,) * config.polishes + (drafter,) * config.drafts
        latents = (0,) * config.polishes + (config.latent,) * config.drafts
        beta, shape = config.table().beta, (config.features,)
    elif system == "emdm":
        nets = (load(TorchEmdm(config), params),) * number
        latents = (config.latent,) * number
        beta, shape = config.table().beta, (config.frames, config.features)
    else:
        nets = (load(TorchCamdm(config, batch_first=batch_first), params),) * number
        latents = (0,) * number
        beta = schedule.cosine_schedule(number).beta
        shape = (config.future, config.num_features)
    table = posterior_table(np.asarray(beta))
    return Peer(nets=nets, latents=latents, table=table, shape=shape)


def given_of(system: str, config: Any, conditions: Any) -> tuple[torch.Tensor, ...]:
    """What the networks take of conditions, batch axis first."""
    if system == "aamdm":
        arrays = (conditions,)
    elif system == "emdm":
        arrays = (conditions.vector,)
    elif system == "smgdiff":
        arrays = conditions.arguments()[:4]
    else:
        arrays = conditions.arguments(config)[:4]
    given = [torch.from_numpy(np.array(x)) for x in arrays]
    return tuple(x if x.is_floating_point() else x.long() for x in given)


def sample(
    peer: Peer,
    noise: torch.Tensor,
    latents: tuple[torch.Tensor | None, ...],
    given: tuple[torch.Tensor, ...],
) -> torch.Tensor:
    """Ancestral sampling as the released code does it, from given noise.

    Args:
      peer: The sampler.
      noise: Normal, [T + 1, batch, *shape]: entry 0 is x_T, entry t is added in step t.
      latents: Normal, [batch, channels] at index t - 1; None where a step draws none.
      given: What the networks take after t.

    Returns:
      Clean samples.
    """
    x = noise[0]
    for t in range(len(peer.nets), 0, -1):
        steps = torch.full((x.shape[0],), t, dtype=torch.long)
        latent = latents[t - 1]
        own = () if latent is None else (latent,)
        x_0 = peer.nets[t - 1](x, steps, *given, *own)
        from_x_0, from_x_t, deviation = peer.table[t - 1]
        x = from_x_0 * x_0 + from_x_t * x + deviation * noise[t]
    return x


def posterior_table(beta: np.ndarray) -> tuple[tuple[float, float, float], ...]:
    """Coefficients of the posterior from a schedule's betas, in float64.

    Args:
      beta: T + 1 entries; the first, of clean data, is 0.

    Returns:
      The `table` of a `Peer`.

    Source: Ho et al. 2020, eq. 7.
    """
    beta = np.asarray(beta, np.float64)
    alpha_bar = np.cumprod(1.0 - beta)
    beta, before, total = beta[1:], alpha_bar[:-1], 1.0 - alpha_bar[1:]
    columns = (
        beta * np.sqrt(before) / total,
        (1.0 - before) * np.sqrt(1.0 - beta) / total,
        np.sqrt(beta * (1.0 - before) / total),
    )
    return tuple(tuple(map(float, row)) for row in zip(*columns, strict=True))


def from_tape(tape: tuple) -> tuple[torch.Tensor, tuple[torch.Tensor | None, ...]]:
    """Noise and latents of `sample` from tapes of our samplers, batch axis first.

    Args:
      tape: x_T, and for each loop (noise) or (latents, noise) of its steps, T to 1.
    """
    start, *loops = tape
    noise, latents = [], []
    for loop in loops:
        for i in range(loop[-1].shape[1]):
            noise.append(loop[-1][:, i])
            latents.append(loop[0][:, i] if len(loop) == 2 else None)
    put = lambda x: torch.from_numpy(np.array(x))  # noqa: E731
    own = tuple(None if x is None else put(x) for x in reversed(latents))
    return torch.stack([put(x) for x in (start, *reversed(noise))]), own


def compiled(peer: Peer) -> Peer:
    """The sampler with its networks through torch.compile, for one batch size."""
    made = {net: torch.compile(net, dynamic=False) for net in set(peer.nets)}
    return dataclasses.replace(peer, nets=tuple(made[net] for net in peer.nets))


def forward(peer: Peer, batch: int, given: tuple[torch.Tensor, ...]) -> None:
    """Calls every network once: what compiles and allocates does so now."""
    steps = torch.ones(batch, dtype=torch.long)
    with torch.inference_mode():
        for net, latent in set(zip(peer.nets, peer.latents, strict=True)):
            own = (torch.zeros(batch, latent),) if latent else ()
            net(torch.zeros(batch, *peer.shape), steps, *given, *own)


def with_onednn(call: Callable[[], torch.Tensor]) -> Callable[[], torch.Tensor]:
    """A call whose linear layers are multiplied by PyTorch's own oneDNN.

    PyTorch's wheels multiply float32 by MKL, which on AMD's processors leaves half of
    the vector unit unused; torch.compile knows oneDNN's packed products, eager mode has
    no switch for them.
    """
    plain, packed = functional.linear, {}
    reorder = torch.ops.mkldnn._reorder_linear_weight
    multiply = torch.ops.mkldnn._linear_pointwise

    def linear(
        x: torch.Tensor, weight: torch.Tensor, bias: torch.Tensor | None = None
    ) -> torch.Tensor:
        if x.dim() < 2:
            return plain(x, weight, bias)
        key = weight.data_ptr(), *weight.shape
        if key not in packed:
            packed[key] = reorder(weight.detach(), x.shape[:-1].numel())
        return multiply(x, packed[key], bias, "none", [], "")

    def run() -> torch.Tensor:
        functional.linear = linear
        try:
            return call()
        finally:
            functional.linear = plain

    return run


def plan_call(
    peer: Peer, batch: int, given: tuple[torch.Tensor, ...]
) -> Callable[[], torch.Tensor]:
    """A batch of samples, with its own noise drawn in the call as ours is.

    Args:
      peer: The sampler.
      batch: Samples.
      given: What its networks take after t.

    Returns:
      A call without arguments.
    """

    def call() -> torch.Tensor:
        with torch.inference_mode():
            noise = torch.randn(len(peer.nets) + 1, batch, *peer.shape)
            latents = tuple(torch.randn(batch, n) if n else None for n in peer.latents)
            return sample(peer, noise, latents, given)

    return call
