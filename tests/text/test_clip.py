"""The text tower from a folder: numbers by a float64 oracle, and what is refused."""

import json
from copy import deepcopy

import jax.numpy as jnp
import numpy as np
import pytest
from safetensors import flax as safetensors_flax
from safetensors.numpy import load_file, save_file

from jaxmotion.text import clip
from tests.reference import clip as reference
from tests.text import samples

TEXTS = ["a person turns left", "A  Person walks", *samples.SENTENCES, "left"]


@pytest.fixture
def written(tmp_path):
    return tmp_path, samples.folder(tmp_path)


def expected(weights, texts, **tokens):
    """With the tokenizer's own template, untouched by the reader."""
    made = samples.tokenizer(**tokens)
    made.no_truncation()
    made.no_padding()
    end = made.token_to_id(samples.END)
    rows = [made.encode(text).ids for text in texts]
    return [reference.encode(weights, row, end, samples.HEADS) for row in rows]


def rewrite(path, **changes):
    """The config's text tower with other fields."""
    config = json.loads((path / "config.json").read_text())
    config["text_config"].update(changes)
    (path / "config.json").write_text(json.dumps(config))


@pytest.mark.parametrize("nested", [True, False])
@pytest.mark.parametrize("special_last", [True, False])
def test_against_the_oracle(tmp_path, nested, special_last):
    """Also where the end-of-text token is not the largest id, as others have it."""
    weights = samples.folder(tmp_path, nested=nested, special_last=special_last)
    found = clip.encode(clip.load_clip(tmp_path), TEXTS)
    assert found.dtype == np.float32
    wanted = expected(weights, TEXTS, special_last=special_last)
    assert np.std(wanted) > 0.1
    np.testing.assert_allclose(found, wanted, atol=2e-5)
    np.testing.assert_array_equal(found[0], found[2])


def test_many_texts_are_those_one_by_one(written):
    """More than a batch, short and long ones mixed; the last batch is filled up."""
    folder, weights = written
    some = ["turns " + "left " * 18, *TEXTS, "left " * 15]
    texts = [some[i % len(some)] for i in range(70)]
    found = clip.encode(clip.load_clip(folder), texts)
    wanted = np.array(expected(weights, some))[np.arange(70) % len(some)]
    np.testing.assert_allclose(found, wanted, atol=2e-5)


@pytest.mark.parametrize("dtype", [jnp.float16, jnp.bfloat16])
def test_half_precision_weights_become_float32(written, dtype):
    folder, weights = written
    half = {key: jnp.asarray(value, dtype) for key, value in weights.items()}
    safetensors_flax.save_file(half, folder / "model.safetensors")
    model = clip.load_clip(folder)
    kernel = model.params["layers_1"]["expand"]["kernel"]
    assert kernel.dtype == jnp.float32
    stored = half["text_model.encoder.layers.1.mlp.fc1.weight"].astype(jnp.float32)
    np.testing.assert_array_equal(kernel, stored.T)


def test_missing_and_misshapen_weights_are_named_together(written):
    folder, weights = written
    weights["text_projection.weight"] = np.zeros((7, 11), np.float32)
    del weights["text_model.final_layer_norm.bias"]
    save_file(weights, folder / "model.safetensors")
    with pytest.raises(ValueError, match="model.safetensors: 2 keys do not") as caught:
        clip.load_clip(folder)
    message = str(caught.value)
    assert "text_model.final_layer_norm.bias is missing" in message
    assert "text_projection.weight has shape (7, 11), expected (7, 12)" in message
    rewrite(folder, num_hidden_layers=3)  # 16 keys more
    with pytest.raises(ValueError, match="18 keys do not fit") as caught:
        clip.load_clip(folder)
    message = str(caught.value)
    assert message.count("is missing") + message.count("has shape") == 5
    assert message.endswith("; ...")


def test_missing_files_are_named_together(written):
    folder, _ = written
    (folder / "config.json").unlink()
    (folder / "model.safetensors").unlink()
    with pytest.raises(FileNotFoundError, match="no config.json, model.safetensors"):
        clip.load_clip(folder)


def test_damaged_files_are_named(written):
    folder, _ = written
    (folder / "model.safetensors").write_bytes(b"not weights at all")
    with pytest.raises(ValueError, match="model.safetensors: no safetensors"):
        clip.load_clip(folder)
    (folder / "config.json").write_text("{")
    with pytest.raises(ValueError, match="config.json: not JSON"):
        clip.load_clip(folder)
    for content in ("[1]", '{"text_config": 3}'):
        (folder / "config.json").write_text(content)
        with pytest.raises(ValueError, match="config.json: .* JSON object"):
            clip.load_clip(folder)


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"hidden_size": "12"}, "hidden_size should be a positive integer.*'12'"),
        ({"num_hidden_layers": 0}, "num_hidden_layers should be a positive integer"),
        ({"hidden_act": "gelu"}, "hidden_act should be 'quick_gelu', found 'gelu'"),
        ({"layer_norm_eps": 1e-6}, "layer_norm_eps should be 1e-05, found 1e-06"),
        ({"num_attention_heads": 5}, "5 heads do not divide hidden_size 12"),
        ({"eos_token_id": 7}, r"eos_token_id is 7, but <\|endoftext\|> is 53"),
        ({"vocab_size": 50}, "tokenizer.json: token id 53 is beyond vocab_size 50"),
    ],
)
def test_configs_that_do_not_fit_are_refused(written, changes, message):
    rewrite(written[0], **changes)
    with pytest.raises(ValueError, match=message):
        clip.load_clip(written[0])


def test_sizes_that_a_config_leaves_out_are_those_of_vit_b_32(written):
    rewrite(written[0])
    config = json.loads((written[0] / "config.json").read_text())
    del config["text_config"]["intermediate_size"]
    (written[0] / "config.json").write_text(json.dumps(config))
    match = r"layers.0.mlp.fc1.weight has shape \(20, 12\), expected \(2048, 12\)"
    with pytest.raises(ValueError, match=match):
        clip.load_clip(written[0])


def test_another_kind_of_tokenizer_is_refused(written):
    text = (written[0] / "tokenizer.json").read_text()
    (written[0] / "tokenizer.json").write_text(text.replace("startoftext", "begin"))
    with pytest.raises(ValueError, match=r"knows no token <\|startoftext\|>"):
        clip.load_clip(written[0])


def test_tokens_are_lower_case_with_start_and_end_and_filled_up(written):
    model = clip.load_clip(written[0])
    ids = clip.tokenize(model, ["A person turns LEFT", "left"])
    vocabulary = model.tokenizer.get_vocab()
    words = [vocabulary[f"{word}</w>"] for word in ("a", "person", "turns", "left")]
    start, end = vocabulary[samples.START], vocabulary[samples.END]
    assert ids.tolist() == [[start, *words, end], [start, words[-1], *[end] * 4]]


def test_long_texts_are_refused_or_cut_where_asked(written):
    folder, weights = written
    model = clip.load_clip(folder)
    longest = " ".join(["left"] * 22)
    assert clip.tokenize(model, [longest]).shape == (1, 24)
    texts = ["left", longest + " turns"]
    with pytest.raises(ValueError, match="text 1 has 25 tokens.* limit is 24.*turns"):
        clip.encode(model, texts)
    cut = clip.tokenize(model, texts, max_tokens=6)
    assert cut.shape == (2, 6)
    assert cut[1, -1] == model.network.end_of_text
    found = clip.encode(model, texts, max_tokens=6)
    wanted = expected(weights, ["left", "left left left left"])
    np.testing.assert_allclose(found, wanted, atol=2e-5)
    for limit in (2, 25):
        with pytest.raises(ValueError, match=f"in 3..24, found {limit}"):
            clip.tokenize(model, texts, max_tokens=limit)


@pytest.mark.parametrize("text", ["turns <|endoftext|> left", "zz"])
def test_ends_and_unknown_tokens_within_a_text_are_refused(written, text):
    """The tokenizer writes what it does not know as end of text."""
    with pytest.raises(ValueError, match="text 1, .* contains"):
        clip.tokenize(clip.load_clip(written[0]), ["left", text])


@pytest.mark.slow
def test_fingerprint_changes_with_weights_and_tokenizer(written):
    folder, _ = written
    prints = {clip.load_clip(folder).fingerprint}
    assert clip.load_clip(folder).fingerprint in prints
    stored = load_file(folder / "model.safetensors")
    stored["text_model.encoder.layers.0.mlp.fc2.bias"][3] += 1
    save_file(stored, folder / "model.safetensors")
    prints.add(clip.load_clip(folder).fingerprint)
    with open(folder / "tokenizer.json", "a") as file:
        file.write("\n")
    prints.add(clip.load_clip(folder).fingerprint)
    assert len(prints) == 3
    # Of as many heads as the arrays allow, others make other vectors.
    heads = {}
    for number in (1, 2, 4):
        rewrite(folder, num_attention_heads=number)
        model = clip.load_clip(folder)
        heads[model.fingerprint] = clip.encode(model, TEXTS[:1])
    assert len(heads) == 3
    assert np.ptp(np.stack(list(heads.values())), axis=0).max() > 1e-3


def test_layers_that_a_config_does_not_have_are_told(written):
    folder, _ = written
    rewrite(folder, num_hidden_layers=1)
    with pytest.raises(ValueError, match="layers, expected 1"):
        clip.load_clip(folder)


def test_few_programs_encode_few_texts(written):
    model = clip.load_clip(written[0])
    before = clip._forward._cache_size()
    for number in range(2, 9):
        clip.encode(model, ["turns left"] * number)
    assert clip._forward._cache_size() - before <= 1


SIZES = dict(width=64, depth=2, context=24, dimensions=7)


@pytest.fixture(scope="module")
def openai():
    torch = pytest.importorskip("torch")
    from tests.reference import published_torch as peers

    vocabulary = samples.tokenizer().get_vocab_size()
    return torch, peers.randomize(peers.ClipText(vocabulary, **SIZES), 2)


def archive(openai, folder, precision="float32"):
    """As OpenAI publishes it: code and weights in one, which PyTorch would run."""
    torch, peer = openai
    samples.tokenizer().save(str(folder / "tokenizer.json"))
    ids = torch.tensor([[0, 1, samples.tokenizer().token_to_id(samples.END)]])
    copy = deepcopy(peer).to(getattr(torch, precision))
    traced = torch.jit.trace(copy.eval(), (ids,), check_trace=False)
    traced.save(str(folder / "ViT-tiny.pt"))


@pytest.mark.filterwarnings("ignore")
@pytest.mark.parametrize("precision", ["float32", "float16"])
def test_openais_archive_encodes_as_pytorch_does(openai, tmp_path, precision):
    archive(openai, tmp_path, precision)
    model = clip.load_clip(tmp_path)
    found = clip.encode(model, TEXTS)
    torch, peer = openai
    if precision == "float16":  # computed in float32, as ours are
        peer = deepcopy(peer).half().float()
    wanted = []
    for text in TEXTS:
        ids = clip.tokenize(model, [text])
        with torch.inference_mode():
            wanted.append(peer(torch.from_numpy(np.array(ids)).long()).numpy()[0])
    assert np.std(wanted) > 0.1
    np.testing.assert_allclose(found, wanted, atol=1e-5)


@pytest.mark.filterwarnings("ignore")
def test_damaged_archives_are_named(openai, tmp_path):
    archive(openai, tmp_path)
    path = tmp_path / "ViT-tiny.pt"
    whole = path.read_bytes()
    for stop in (0, 100, len(whole) // 2, len(whole) - 30):
        path.write_bytes(whole[:stop])
        with pytest.raises(ValueError, match="ViT-tiny.pt: no PyTorch's file"):
            clip.load_clip(tmp_path)
    torch, peer = openai
    torch.save({"positional_embedding": torch.zeros(3, 4)}, path)
    with pytest.raises(ValueError, match="token_embedding.weight .* found nothing"):
        clip.load_clip(tmp_path)
