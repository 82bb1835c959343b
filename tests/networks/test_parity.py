"""The network and its sampler against PyTorch's own encoder, with the same weights."""

import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxmotion.diffusion import noise
from jaxmotion.motion import trajectory
from jaxmotion.networks import blocks
from jaxmotion.systems.aamdm import model as aamdm_model
from jaxmotion.systems.camdm import model as camdm_model
from jaxmotion.systems.emdm import model as emdm_model
from tests import tiny

torch = pytest.importorskip("torch")
from benchmarks import torch_peers  # noqa: E402

pytestmark = pytest.mark.slow

BATCH = 3
CONFIG = camdm_model.Config(num_joints=25, num_labels=100)  # the paper's


@functools.cache
def parameters():
    return tiny.random_params(camdm_model.init, CONFIG, seed=5)


@functools.cache
def peer(batch_first=False):
    return torch_peers.make("camdm", CONFIG, parameters(), batch_first=batch_first)


def conditions(config=CONFIG):
    rng = np.random.default_rng(0)
    normal = lambda *shape: jnp.asarray(  # noqa: E731
        rng.normal(size=(BATCH, *shape)), jnp.float32
    )
    angle = rng.uniform(0, 2 * np.pi, (BATCH, config.future))
    facing = np.stack([np.sin(angle), np.cos(angle)], axis=-1)
    return camdm_model.Condition(
        past=normal(config.past, config.num_features),
        trajectory=trajectory.Trajectory(
            position=normal(config.future, 2), facing=jnp.asarray(facing, jnp.float32)
        ),
        label=jnp.array([0, 7, 99]) % config.num_labels,
        keep_past=jnp.ones(BATCH, bool),
    )


def as_torch(arguments):
    past, path, facing, label, _ = (np.array(x) for x in arguments)
    return *map(torch.from_numpy, (past, path, facing)), torch.from_numpy(label).long()


def test_as_many_parameters():
    ours = sum(x.size for x in jax.tree.leaves(parameters()))
    theirs = sum(x.numel() for x in peer().nets[0].parameters())
    assert ours == theirs == 3_439_260


@pytest.mark.parametrize("batch_first", [False, True])
def test_forward_pass(batch_first):
    """Steps 1, 4 and 8; a past of zeros is the null condition."""
    arguments = conditions().arguments(CONFIG)
    t = np.array([1, 4, 8])
    x_t = np.random.default_rng(1).normal(size=(BATCH, 45, 156)).astype(np.float32)
    ours = jax.jit(camdm_model.network(CONFIG).apply)(
        {"params": parameters()}, x_t, jnp.asarray(t), *arguments
    )
    with torch.inference_mode():
        theirs = (
            peer(batch_first)
            .nets[0](torch.from_numpy(x_t), torch.from_numpy(t), *as_torch(arguments))
            .numpy()
        )
    assert theirs.std() > 0.1
    np.testing.assert_allclose(ours, theirs, atol=1e-5)


def test_sampler():
    """All steps, fed with the noise that the sampler draws from its keys."""
    condition = conditions()
    plan = camdm_model.sampler(parameters(), config=CONFIG)
    keys = jax.random.split(jax.random.key(2), BATCH)
    draw = functools.partial(noise.draw_noise, plan)
    tapes = jax.vmap(draw)(keys, condition)
    ours = jax.jit(jax.vmap(noise.with_noise(plan)))(tapes, condition)
    with torch.inference_mode():
        given = torch_peers.given_of("camdm", CONFIG, condition)
        theirs = torch_peers.sample(peer(), *torch_peers.from_tape(tapes), given)
    np.testing.assert_allclose(ours, theirs.numpy(), atol=2e-5)


TINY_EMDM = dict(
    features=6,
    frames=8,
    condition_size=3,
    latent=4,
    width=16,
    depth=2,
    heads=2,
    hidden=24,
)
TINY = {
    "camdm": tiny.config(num_steps=3),
    "emdm": emdm_model.Config(num_steps=3, **TINY_EMDM),
    "emdm, ours": emdm_model.Config(
        num_steps=3, norm="pre", frames_per_token=4, **TINY_EMDM
    ),
    "emdm, texts": emdm_model.Config(num_steps=3, condition="text", **TINY_EMDM),
    "aamdm": aamdm_model.Config(features=5, latent=4, width=32, depth=3),
}


@pytest.mark.parametrize("name", TINY)
def test_whole_loop_of_every_peer(name):
    """Random parameters, biases too; latents and noise are those of our sampler."""
    config, system = TINY[name], name.partition(",")[0]
    model = {"camdm": camdm_model, "emdm": emdm_model, "aamdm": aamdm_model}[system]
    params = tiny.random_params(model.init, config, seed=1)
    params = params["generator"] if system == "emdm" else params
    rng = np.random.default_rng(0)
    if system == "camdm":
        condition = conditions(config)
    elif system == "emdm":
        vectors = jnp.asarray(rng.normal(size=(BATCH, 3)), jnp.float32)
        condition = emdm_model.make_condition(vectors, config=config)
    else:
        condition = jnp.asarray(rng.normal(size=(BATCH, 5)), jnp.float32)
    sample = model.sampler(params, config=config)
    keys = jax.random.split(jax.random.key(2), BATCH)
    tapes = jax.vmap(functools.partial(noise.draw_noise, sample))(keys, condition)
    ours = jax.jit(jax.vmap(noise.with_noise(sample)))(tapes, condition)
    peer = torch_peers.make(system, config, params)
    with torch.inference_mode():
        given = torch_peers.given_of(system, config, condition)
        theirs = torch_peers.sample(peer, *torch_peers.from_tape(tapes), given)
    assert theirs.std() > 0.1
    np.testing.assert_allclose(ours, theirs.numpy(), atol=1e-5)


def test_peer_refuses_what_it_has_not():
    config = dataclasses.replace(TINY["emdm"], token_margin=1)
    with pytest.raises(ValueError, match="token_margin is 1: the peer has 0"):
        torch_peers.make("emdm", config, {})


def test_gelu_is_that_of_float64():
    x = np.linspace(-12.0, 12.0, 2001)
    exact = torch.nn.functional.gelu(torch.from_numpy(x)).numpy()
    found = blocks.gelu(jnp.asarray(x, jnp.float32))
    np.testing.assert_allclose(found, exact, atol=1e-6)


def test_pre_norm_layer():
    """Against PyTorch's own layer with norm_first, with its random weights."""
    theirs = torch.nn.TransformerEncoderLayer(
        16, 2, 24, dropout=0.0, activation="gelu", norm_first=True, batch_first=True
    ).eval()
    generator = torch.Generator().manual_seed(0)
    with torch.no_grad():
        for parameter in theirs.parameters():
            parameter.normal_(std=0.5, generator=generator)
    get = lambda name: np.array(theirs.get_parameter(name).detach())  # noqa: E731
    dense = lambda weight, bias: {"kernel": weight.T, "bias": bias}  # noqa: E731
    weight, bias = get("self_attn.in_proj_weight"), get("self_attn.in_proj_bias")
    params = {
        "query": dense(weight[:16], bias[:16]),
        "key_value": dense(weight[16:], bias[16:]),
    }
    names = {"out": "self_attn.out_proj", "expand": "linear1", "contract": "linear2"}
    for ours, name in names.items():
        params[ours] = dense(get(f"{name}.weight"), get(f"{name}.bias"))
    for i in (1, 2):
        scale, bias = get(f"norm{i}.weight"), get(f"norm{i}.bias")
        params[f"norm_{i}"] = {"scale": scale, "bias": bias}
    x = np.random.default_rng(0).normal(size=(3, 7, 16)).astype(np.float32)
    layer = blocks.EncoderLayer(16, 2, 24, 0.0, "pre")
    ours = layer.apply({"params": params}, jnp.asarray(x), train=False)
    with torch.no_grad():
        expected = theirs(torch.from_numpy(x)).numpy()
    np.testing.assert_allclose(ours, expected, atol=2e-5)
