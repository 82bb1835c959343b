"""Float64 oracle of CLIP's text tower, with loops, on weights named as on the hub.

Written from Radford et al. 2021 and the shapes of the released weights: linear layers
are [out, in], attention is one head and one query at a time.
"""

import numpy as np


def norm(x, weight, bias):
    centered = x - x.mean()
    return centered / np.sqrt((centered**2).mean() + 1e-5) * weight + bias


def attention(x, weights, stem, heads):
    def linear(name, row):
        return weights[f"{stem}.{name}.weight"] @ row + weights[f"{stem}.{name}.bias"]

    query, key, value = (
        np.stack([linear(name, row) for row in x]).reshape(len(x), heads, -1)
        for name in ("q_proj", "k_proj", "v_proj")
    )
    rows = []
    for i in range(len(x)):
        mixed = []
        for head in range(heads):
            logits = key[: i + 1, head] @ query[i, head] / np.sqrt(query.shape[-1])
            share = np.exp(logits - logits.max())
            mixed.append(share @ value[: i + 1, head] / share.sum())
        rows.append(linear("out_proj", np.concatenate(mixed)))
    return np.stack(rows)


def encode(weights, ids, end, heads):
    """Vector of one text."""
    weights = {key: np.asarray(value, np.float64) for key, value in weights.items()}

    def norm_rows(x, stem):
        scale, shift = weights[f"{stem}.weight"], weights[f"{stem}.bias"]
        return np.stack([norm(row, scale, shift) for row in x])

    embeddings = "text_model.embeddings"
    x = np.stack(
        [
            weights[f"{embeddings}.token_embedding.weight"][token]
            + weights[f"{embeddings}.position_embedding.weight"][place]
            for place, token in enumerate(ids)
        ]
    )
    depth = 1 + max(int(k.split(".")[3]) for k in weights if ".layers." in k)
    for layer in range(depth):
        stem = f"text_model.encoder.layers.{layer}"
        normed = norm_rows(x, f"{stem}.layer_norm1")
        x = x + attention(normed, weights, f"{stem}.self_attn", heads)
        normed = norm_rows(x, f"{stem}.layer_norm2")
        fc1, fc2 = f"{stem}.mlp.fc1", f"{stem}.mlp.fc2"
        hidden = normed @ weights[f"{fc1}.weight"].T + weights[f"{fc1}.bias"]
        hidden = hidden / (1 + np.exp(-1.702 * hidden))
        x = x + hidden @ weights[f"{fc2}.weight"].T + weights[f"{fc2}.bias"]
    last = norm_rows(x, "text_model.final_layer_norm")[list(ids).index(end)]
    return weights["text_projection.weight"] @ last


def random_weights(
    rng, *, vocabulary, context, width, depth, hidden, dimensions, scale=0.4
):
    """Weights with the names of the hub."""
    shapes = {
        "text_model.embeddings.token_embedding.weight": (vocabulary, width),
        "text_model.embeddings.position_embedding.weight": (context, width),
        "text_model.final_layer_norm.weight": (width,),
        "text_model.final_layer_norm.bias": (width,),
        "text_projection.weight": (dimensions, width),
    }
    for layer in range(depth):
        stem = f"text_model.encoder.layers.{layer}"
        for name in "qkv":
            shapes[f"{stem}.self_attn.{name}_proj.weight"] = (width, width)
            shapes[f"{stem}.self_attn.{name}_proj.bias"] = (width,)
        shapes[f"{stem}.self_attn.out_proj.weight"] = (width, width)
        shapes[f"{stem}.self_attn.out_proj.bias"] = (width,)
        for name, out, inside in (("fc1", hidden, width), ("fc2", width, hidden)):
            shapes[f"{stem}.mlp.{name}.weight"] = (out, inside)
            shapes[f"{stem}.mlp.{name}.bias"] = (out,)
        for name in ("layer_norm1", "layer_norm2"):
            shapes[f"{stem}.{name}.weight"] = (width,)
            shapes[f"{stem}.{name}.bias"] = (width,)
    return {
        key: rng.normal(0.0, scale, shape).astype(np.float32)
        for key, shape in shapes.items()
    }
