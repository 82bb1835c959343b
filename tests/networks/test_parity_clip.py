"""CLIP's text tower against one made of PyTorch's own layers, with the same weights."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxmotion.networks.clip import ClipText
from tests.networks import test_clip
from tests.reference import clip as reference

torch = pytest.importorskip("torch")

pytestmark = pytest.mark.slow

SIZES = dict(vocabulary=50, context=16, width=64, depth=3, hidden=128, dimensions=24)
HEADS, END = 4, 49


class Layer(torch.nn.Module):
    def __init__(self, width, hidden):
        super().__init__()
        self.attention = torch.nn.MultiheadAttention(width, HEADS, batch_first=True)
        self.norm_1 = torch.nn.LayerNorm(width)
        self.norm_2 = torch.nn.LayerNorm(width)
        self.expand = torch.nn.Linear(width, hidden)
        self.contract = torch.nn.Linear(hidden, width)

    def forward(self, x, mask):
        y = self.norm_1(x)
        x = x + self.attention(y, y, y, attn_mask=mask, need_weights=False)[0]
        y = self.expand(self.norm_2(x))
        return x + self.contract(y * torch.sigmoid(1.702 * y))


def load(layer, weights, stem):
    """Weights named as on the hub into a layer; PyTorch stacks q, k and v."""
    get = lambda name: torch.from_numpy(weights[f"{stem}.{name}"])  # noqa: E731
    state = {}
    for kind in ("weight", "bias"):
        parts = [get(f"self_attn.{name}_proj.{kind}") for name in "qkv"]
        state[f"attention.in_proj_{kind}"] = torch.cat(parts)
        state[f"attention.out_proj.{kind}"] = get(f"self_attn.out_proj.{kind}")
        for ours, theirs in (
            ("norm_1", "layer_norm1"),
            ("norm_2", "layer_norm2"),
            ("expand", "mlp.fc1"),
            ("contract", "mlp.fc2"),
        ):
            state[f"{ours}.{kind}"] = get(f"{theirs}.{kind}")
    layer.load_state_dict(state)
    return layer.eval()


def torch_encode(weights, ids):
    """The end-of-text token is found as in the released code: the largest id."""
    get = lambda name: torch.from_numpy(weights[name])  # noqa: E731
    tokens = get("text_model.embeddings.token_embedding.weight")
    positions = get("text_model.embeddings.position_embedding.weight")
    x = tokens[ids] + positions[: ids.shape[1]]
    mask = torch.full((ids.shape[1],) * 2, float("-inf")).triu(1)
    for i in range(SIZES["depth"]):
        layer = Layer(SIZES["width"], SIZES["hidden"])
        x = load(layer, weights, f"text_model.encoder.layers.{i}")(x, mask)
    stem = "text_model.final_layer_norm"
    x = torch.nn.functional.layer_norm(
        x, x.shape[-1:], get(f"{stem}.weight"), get(f"{stem}.bias")
    )
    row = x[torch.arange(len(ids)), ids.argmax(-1)]
    return row @ get("text_projection.weight").T


def test_forward_pass():
    rng = np.random.default_rng(4)
    # Logits of attention of about 1, as in trained weights.
    weights = reference.random_weights(rng, **SIZES, scale=0.15)
    ids = rng.integers(0, END, (5, 16))
    ids[np.arange(5), [15, 3, 7, 1, 12]] = END
    ids[1, 9] = END  # only the first one ends the text
    with torch.inference_mode():
        theirs = torch_encode(weights, torch.from_numpy(ids)).numpy()
    net = ClipText(**SIZES, heads=HEADS, end_of_text=END)
    params = test_clip.as_params(weights, depth=SIZES["depth"])
    ours = jax.jit(net.apply)({"params": params}, jnp.asarray(ids))
    assert theirs.std() > 0.05
    np.testing.assert_allclose(ours, theirs, atol=1e-5)
