"""EMDM's released weights: files as published, and the networks that made them."""

import argparse

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxmotion.systems.emdm import model as emdm_model
from jaxmotion.systems.emdm import published as emdm_published

torch = pytest.importorskip("torch")
from tests.reference import published_torch as peers  # noqa: E402

pytestmark = pytest.mark.slow

FRAMES, STEPS = 6, 10
# Task -> (J, D), size of the condition.
TASKS = {"text": ((9, 1), 8), "action": ((3, 6), 4)}


@pytest.fixture(params=TASKS)
def task(request):
    return request.param


def networks(task):
    (joints, channels), size = TASKS[task]
    inputs = 2 * joints * channels * FRAMES + size
    return (
        peers.randomize(peers.EmdmGenerator(task, size, joints * channels), 1),
        peers.randomize(peers.EmdmDiscriminator(inputs), 2),
    )


def save(path, generator, discriminator=None):
    content = {
        "epoch": 2700,
        "netG_dict": generator.state_dict(),
        "global_step": 9,
        "args": argparse.Namespace(num_heads=4),
    }
    if discriminator is not None:
        content["netD_dict"] = discriminator.state_dict()
    torch.save(content, path)
    return path


def load(path):
    return emdm_published.load(path, frames=FRAMES, heads=4)


def inputs(task):
    generator = np.random.default_rng(0)
    shape, size = TASKS[task]
    normal = lambda *s: generator.normal(size=s).astype(np.float32)  # noqa: E731
    steps = np.array([0, 4, 9])
    if task == "text":
        condition = vector = normal(3, size)
    else:
        condition = np.array([3, 0, 2])
        vector = np.eye(size, dtype=np.float32)[condition]
    motions = normal(2, 3, *shape, FRAMES)
    return motions, steps, normal(3, 5), condition, vector


def as_ours(x):
    """[batch, J, D, frames] with frames before features."""
    return jnp.asarray(x.transpose(0, 3, 1, 2).reshape(len(x), FRAMES, -1))


def test_networks_are_pytorchs(task, tmp_path):
    generator, discriminator = networks(task)
    config, params = load(save(tmp_path / "content_9.pth", generator, discriminator))
    assert config.condition == task and config.condition_size == TASKS[task][1]
    assert (config.latent, config.depth, config.norm) == (5, 2, "post")
    like = jax.eval_shape(lambda: emdm_model.init(jax.random.key(0), config))
    shapes = lambda tree: jax.tree.map(lambda x: (x.shape, x.dtype), tree)  # noqa: E731
    assert shapes(params) == shapes(like)
    (x_t, x_prev), steps, latent, condition, vector = inputs(task)
    given = [torch.from_numpy(x) for x in (x_t, steps, latent, condition)]
    with torch.inference_mode():
        made = generator(*given).numpy()
        logit = discriminator(
            torch.from_numpy(x_prev), *given[:2], torch.from_numpy(vector)
        ).numpy()
    t = jnp.asarray(steps + 1, jnp.int32)
    keep, mask = jnp.ones(3, bool), jnp.ones((3, FRAMES), bool)
    ours = emdm_model.generator(config).apply(
        {"params": params["generator"]},
        as_ours(x_t),
        t,
        jnp.asarray(vector),
        keep,
        mask,
        jnp.asarray(latent),
    )
    assert made.std() > 0.1 and logit.std() > 0.01
    np.testing.assert_allclose(ours, as_ours(made), atol=1e-5)
    logits = emdm_model.discriminator(config).apply(
        {"params": params["discriminator"]},
        as_ours(x_prev),
        as_ours(x_t),
        t,
        jnp.asarray(vector),
    )
    np.testing.assert_allclose(logits, logit, atol=1e-5)


def test_a_checkpoint_has_the_generator_alone(tmp_path):
    config, params = load(save(tmp_path / "2700.pth", networks("text")[0]))
    assert set(params) == {"generator"}
    assert (config.weight_recon, config.weight_foot) == (100.0, 0.0)
    assert not config.mask_frames


def test_an_unconditional_discriminator_is_known_by_its_size(tmp_path):
    generator, _ = networks("action")
    blind = peers.randomize(peers.EmdmDiscriminator(2 * 18 * FRAMES), 2)
    config, _ = load(save(tmp_path / "content_9.pth", generator, blind))
    assert not config.discriminator_condition


def test_what_does_not_fit_is_named(tmp_path):
    path = tmp_path / "2700.pth"
    generator, discriminator = networks("text")
    torch.save({"netD_dict": {}, "epoch": 3}, path)
    with pytest.raises(ValueError, match="should have netG_dict, found netD_dict, epo"):
        load(path)
    with pytest.raises(ValueError, match="3 heads do not divide width 16"):
        save(path, generator)
        emdm_published.load(path, frames=FRAMES, heads=3)
    save(path, generator, discriminator)
    with pytest.raises(ValueError, match=r"fc1.weight \(64, 244\) instead of \(64, "):
        emdm_published.load(path, frames=FRAMES + 1, heads=4)
    state = generator.state_dict()
    del state["z_transform.4.bias"], state["embed_timestep.time_embed.2.weight"]
    torch.save({"netG_dict": state}, path)
    message = "missing: embed_timestep.time_embed.2.weight, z_transform.4.bias$"
    with pytest.raises(ValueError, match=message):
        load(path)
