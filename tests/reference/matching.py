"""Float64 oracles of the text-motion evaluator and its measures, with loops.

Layers are written row by row from the formulas of PyTorch's manual (nn.Conv1d, nn.GRU,
nn.LayerNorm), on the parameters as Flax names them.
"""

import itertools

import numpy as np


def _f64(tree):
    if isinstance(tree, dict):
        return {name: _f64(value) for name, value in tree.items()}
    return np.asarray(tree, np.float64)


def _linear(p, x):
    return x @ p["kernel"] + p.get("bias", 0.0)


def _leaky(x):
    return np.where(x > 0, x, 0.2 * x)


def _sigmoid(x):
    return 1 / (1 + np.exp(-x))


def convolution(p, x):
    """Width 4, stride 2, one row of zeros on each side."""
    rows = np.concatenate([0 * x[:1], x, 0 * x[:1]])
    out = []
    for first in range(0, len(rows) - 3, 2):
        taps = [rows[first + k] @ p["kernel"][k] for k in range(4)]
        out.append(sum(taps) + p["bias"])
    return np.array(out)


def movements(params, x):
    p = _f64(params)
    for name in ("convolution_1", "convolution_2"):
        x = _leaky(convolution(p[name], x))
    return _linear(p["out"], x)


def gru_last_state(p, rows, state):
    for x in rows:
        r = _sigmoid(_linear(p["ir"], x) + _linear(p["hr"], state))
        z = _sigmoid(_linear(p["iz"], x) + _linear(p["hz"], state))
        n = np.tanh(_linear(p["in"], x) + r * _linear(p["hn"], state))
        state = (1 - z) * n + z * state
    return state


def sequence(params, x):
    """Embedding of one sequence without padding."""
    p = _f64(params)
    rows = _linear(p["input"], np.asarray(x, np.float64))
    states = [
        gru_last_state(p["forward"]["cell"], rows, p["start"][0]),
        gru_last_state(p["backward"]["cell"], rows[::-1], p["start"][1]),
    ]
    x = _linear(p["hidden"], np.concatenate(states))
    x = (x - x.mean()) / np.sqrt(x.var() + 1e-5)
    return _linear(p["out"], _leaky(x * p["norm"]["scale"] + p["norm"]["bias"]))


def motion(params, features, frames):
    """Embedding of one motion, zeros after its last whole movement."""
    x = np.array(features, np.float64)
    x[frames // 4 * 4 :] = 0.0
    return sequence(params["motion"], movements(params["movement"], x)[: frames // 4])


def text(params, vectors, tags, words):
    """Embedding of one sentence."""
    p = _f64(params["text"]["tags"])
    x = np.asarray(vectors, np.float64) + _linear(p, np.asarray(tags, np.float64))
    return sequence(params["text"]["sequence"], x[:words])


def read_sentence(tokens, vectors, words, row, special):
    """Rows of words and numbers of classes as the release reads a sentence.

    Args: vectors and words are those of its two files, row that of its third; special
    maps words to the number of their class.
    """
    classes = "VERB NOUN DET ADP NUM AUX PRON ADJ ADV".split()
    rows, tags = [], []
    for token in ["sos/OTHER", *tokens[:20], "eos/OTHER"]:
        word, part = token.split("/")
        known = word in words
        rows.append(vectors[row[word if known else "unk"]])
        number = classes.index(part) if part in classes else 14
        tags.append(special.get(word, number) if known else 14)
    return np.array(rows), np.array(tags)


def contrastive_loss(text, motion, shift, margin=10.0):
    """Terms of matched pairs and of pairs some rows apart."""
    matched, mismatched = [], []
    for i, row in enumerate(text):
        other = motion[(i + shift) % len(text)]
        matched.append(np.linalg.norm(row - motion[i]) ** 2)
        mismatched.append(max(0.0, margin - np.linalg.norm(row - other)) ** 2)
    return np.mean(matched), np.mean(mismatched)


def r_precision(text, motion, top, pool):
    """Mean over all orders of ties, by listing the orders of each pool's motions."""
    hits = np.zeros(top)
    count = 0
    for first in range(0, len(text) - pool + 1, pool):
        for i in range(pool):
            far = [
                np.linalg.norm(text[first + i] - motion[first + j]) for j in range(pool)
            ]
            orders = list(itertools.permutations(range(pool)))
            for order in orders:
                ranked = sorted(
                    order, key=lambda j: far[j]
                )  # stable: order breaks ties
                hits[ranked.index(i) :] += 1 / len(orders)
            count += 1
    return hits / count


def matching_distance(text, motion):
    pairs = zip(text, motion, strict=True)
    return np.mean([np.linalg.norm(a - b) for a, b in pairs])
