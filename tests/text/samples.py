"""A tiny text tower in a folder, with a tokenizer made on the spot."""

import functools
import json

import numpy as np
import tokenizers
from safetensors.numpy import save_file
from tokenizers import models, normalizers, pre_tokenizers, processors, trainers

from tests.reference import clip as reference

START, END = "<|startoftext|>", "<|endoftext|>"
SENTENCES = (
    "a person turns left",
    "a person turns right and walks",
    "an elderly person walks and turns left",
)
SIZES = dict(context=24, width=12, depth=2, hidden=20, dimensions=7)
HEADS = 3


@functools.cache  # two trainings break ties in two ways
def _byte_pairs(special_last):
    """Trained vocabulary and merges, with the ends after all others or before."""
    trained = tokenizers.Tokenizer(models.BPE(end_of_word_suffix="</w>"))
    trained.pre_tokenizer = pre_tokenizers.Whitespace()
    trainer = trainers.BpeTrainer(
        vocab_size=80, end_of_word_suffix="</w>", show_progress=False
    )
    trained.train_from_iterator(SENTENCES, trainer)
    model = json.loads(trained.to_str())["model"]
    learned = sorted(model["vocab"], key=model["vocab"].get)
    tokens = [*learned, START, END] if special_last else [START, END, *learned]
    vocabulary = {token: index for index, token in enumerate(tokens)}
    return vocabulary, [tuple(merge) for merge in model["merges"]]


def tokenizer(*, special_last=True):
    """BPE with CLIP's normalizer, bytes, end of word, unknown token and template."""
    vocabulary, merges = _byte_pairs(special_last)
    made = tokenizers.Tokenizer(
        models.BPE(vocabulary, merges, unk_token=END, end_of_word_suffix="</w>")
    )
    made.normalizer = normalizers.Sequence([normalizers.NFC(), normalizers.Lowercase()])
    split = r"[\p{L}]+|[\p{N}]|[^\s\p{L}\p{N}]+"
    made.pre_tokenizer = pre_tokenizers.Sequence(
        [
            pre_tokenizers.Split(tokenizers.Regex(split), "removed", invert=True),
            pre_tokenizers.ByteLevel(add_prefix_space=False, use_regex=False),
        ]
    )
    made.add_special_tokens([START, END])
    made.post_processor = processors.TemplateProcessing(
        single=f"{START} $A {END}",
        special_tokens=[(token, vocabulary[token]) for token in (START, END)],
    )
    made.enable_truncation(5)  # to be undone by the reader
    made.enable_padding(length=9)
    return made


def folder(path, *, nested=True, eos=2, **tokens):
    """Writes the three files; returns the weights."""
    made = tokenizer(**tokens)
    made.save(str(path / "tokenizer.json"))
    vocabulary = made.get_vocab_size() + 1
    config = {
        "vocab_size": vocabulary,
        "max_position_embeddings": SIZES["context"],
        "hidden_size": SIZES["width"],
        "num_hidden_layers": SIZES["depth"],
        "num_attention_heads": HEADS,
        "intermediate_size": SIZES["hidden"],
        "projection_dim": SIZES["dimensions"],
        "hidden_act": "quick_gelu",
        "eos_token_id": eos,
    }
    if nested:
        # The tower's own projection_dim is overruled, as on the hub.
        text = config | {"projection_dim": 512}
        config = {"projection_dim": SIZES["dimensions"], "text_config": text}
    (path / "config.json").write_text(json.dumps(config))
    weights = reference.random_weights(
        np.random.default_rng(0), vocabulary=vocabulary, **SIZES
    )
    image = {"vision_model.embeddings.class_embedding": np.zeros(4, np.float32)}
    save_file(weights | image, path / "model.safetensors")
    return weights
