"""CAMDM's network and sampler from torch.nn.TransformerEncoder: what we compare with.

The published network in plain PyTorch: embeddings, positions, a stack of
`torch.nn.TransformerEncoderLayer` in post-norm with GELU, an output layer. All of it
runs in every step, as in the released code. `load` copies our parameters into it, so
that both predict the same.

Source: Chen et al. 2024 (CAMDM), section 3.2; sizes of the released code.
"""

from collections.abc import Callable, Mapping

import numpy as np
import torch
from torch import nn

from jaxmotion.diffusion import schedule
from jaxmotion.networks import blocks
from jaxmotion.systems.camdm import model as camdm_model


class TorchCamdm(nn.Module):
    """The denoiser, for a batch: `forward(x_t, t, past, path, facing, label)`."""

    def __init__(self, config: camdm_model.Config, *, batch_first: bool = False):
        """Makes it with random weights.

        Args:
          config: Sizes; one frame a token.
          batch_first: Layout of the encoder. False is the released code's; True lets
            PyTorch use its fused inference path.

        Raises:
          ValueError: if the config has another network or several frames a token.
        """
        super().__init__()
        if config.network != "transformer" or config.frames_per_token != 1:
            raise ValueError(
                f"network {config.network!r} with {config.frames_per_token} frames a "
                "token: expected 'transformer' with 1"
            )
        width, features = config.width, config.num_features
        self.future, self.batch_first = config.future, batch_first
        self.embed_label = nn.Embedding(config.num_labels, width)
        self.embed_path = nn.Linear(2, width)
        self.embed_facing = nn.Linear(6, width)
        self.embed_past = nn.Linear(features, width)
        self.embed_noisy = nn.Linear(features, width)
        self.embed_time = nn.Sequential(
            nn.Linear(width, width), nn.SiLU(), nn.Linear(width, width)
        )
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
        codes = blocks.sinusoidal_positions(max(tokens, config.num_steps), width)
        self.register_buffer("codes", torch.from_numpy(np.array(codes)))

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


def load(net: TorchCamdm, params: Mapping) -> TorchCamdm:
    """Copies our parameters into the PyTorch network and puts it in eval mode.

    PyTorch's one input projection is our query and key_value side by side, and its
    weights are our kernels transposed.

    Args:
      net: Changed in place.
      params: Parameters of `camdm.network(config)` with the same sizes.

    Returns:
      The network.
    """
    state = {"codes": net.codes}

    def put(name: str, value: np.ndarray) -> None:
        state[name] = torch.from_numpy(np.array(value))

    def linear(name: str, dense: Mapping) -> None:
        put(f"{name}.weight", np.asarray(dense["kernel"]).T)
        put(f"{name}.bias", dense["bias"])

    put("embed_label.weight", params["embed_label"]["embedding"])
    for name in ("embed_path", "embed_facing", "embed_past", "embed_noisy", "out"):
        linear(name, params[name])
    linear("embed_time.0", params["embed_time"]["hidden"])
    linear("embed_time.2", params["embed_time"]["out"])
    for i in range(len(net.encoder.layers)):
        ours, theirs = params[f"layers_{i}"], f"encoder.layers.{i}"
        parts = [ours["query"], ours["key_value"]]
        kernel = np.concatenate([np.asarray(x["kernel"]).T for x in parts])
        put(f"{theirs}.self_attn.in_proj_weight", kernel)
        put(
            f"{theirs}.self_attn.in_proj_bias",
            np.concatenate([np.asarray(x["bias"]) for x in parts]),
        )
        linear(f"{theirs}.self_attn.out_proj", ours["out"])
        linear(f"{theirs}.linear1", ours["expand"])
        linear(f"{theirs}.linear2", ours["contract"])
        for j in (1, 2):
            put(f"{theirs}.norm{j}.weight", ours[f"norm_{j}"]["scale"])
            put(f"{theirs}.norm{j}.bias", ours[f"norm_{j}"]["bias"])
    net.load_state_dict(state)
    return net.eval()


def sample(
    net: TorchCamdm,
    table: Mapping[str, np.ndarray],
    noise: torch.Tensor,
    condition: tuple[torch.Tensor, ...],
) -> torch.Tensor:
    """Ancestral sampling as the released code does it, from given noise.

    Args:
      net: The denoiser.
      table: "from_x_0", "from_x_t" and "deviation" of the posterior, entry t for
        step t (entry 0 unused); `posterior_table` makes it.
      noise: Normal, [T + 1, batch, future, features]: entry 0 is x_T, entry t is
        added in step t.
      condition: Arguments of the network after t.

    Returns:
      Clean features.
    """
    x = noise[0]
    for t in range(len(table["deviation"]) - 1, 0, -1):
        steps = torch.full((x.shape[0],), t, dtype=torch.long)
        x_0 = net(x, steps, *condition)
        mean = float(table["from_x_0"][t]) * x_0 + float(table["from_x_t"][t]) * x
        x = mean + float(table["deviation"][t]) * noise[t]
    return x


def posterior_table(beta: np.ndarray) -> dict[str, np.ndarray]:
    """Coefficients of the posterior from a schedule's betas, in float64.

    Args:
      beta: T + 1 entries; the first, of clean data, is 0.

    Returns:
      The three columns of `sample`.

    Source: Ho et al. 2020, eq. 7.
    """
    beta = np.asarray(beta, np.float64)
    alpha_bar = np.cumprod(1.0 - beta)
    before = np.concatenate([[1.0], alpha_bar[:-1]])
    total = np.where(np.arange(beta.size) > 0, 1.0 - alpha_bar, 1.0)
    return {
        "from_x_0": beta * np.sqrt(before) / total,
        "from_x_t": (1.0 - before) * np.sqrt(1.0 - beta) / total,
        "deviation": np.sqrt(beta * (1.0 - before) / total),
    }


def plan_call(
    net: Callable, config: camdm_model.Config, condition: camdm_model.Condition
) -> Callable[[], torch.Tensor]:
    """One plan in PyTorch, with its own noise drawn in the call as ours is.

    Args:
      net: The network, or what torch.compile made of it.
      config: The method.
      condition: Condition of one character.

    Returns:
      A call without arguments.
    """
    table = posterior_table(np.asarray(schedule.cosine_schedule(config.num_steps).beta))
    arrays = [np.array(x)[None] for x in condition.arguments(config)[:4]]
    given = [torch.from_numpy(x) for x in arrays]
    given[3] = given[3].long()
    shape = (config.num_steps + 1, 1, config.future, config.num_features)

    def call() -> torch.Tensor:
        with torch.inference_mode():
            return sample(net, table, torch.randn(shape), tuple(given))

    return call
