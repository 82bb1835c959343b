"""One compilation serves all values: planner, rollout, samplers, chunks of training."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxmotion.control import rollout
from jaxmotion.learning import adversarial, training
from jaxmotion.motion.trajectory import Command, Trajectory
from jaxmotion.systems.camdm import controller as camdm_controller
from jaxmotion.systems.camdm import loss as camdm_loss
from jaxmotion.systems.camdm import model as camdm_model
from jaxmotion.systems.emdm import loss as emdm_loss
from jaxmotion.systems.emdm import model as emdm_model
from jaxmotion.systems.emdm import training as emdm_training
from tests import mostly_slow, tiny

chex = pytest.importorskip("chex")
CONFIG = tiny.config(depth=1, heading="facing")


@pytest.fixture(autouse=True)
def fresh_counters():
    chex.clear_trace_counter()


def condition(seed):
    generator = np.random.default_rng(seed)
    yaw = generator.normal(size=CONFIG.future)
    return camdm_model.Condition(
        past=jnp.asarray(
            generator.normal(size=(CONFIG.past, CONFIG.num_features)), jnp.float32
        ),
        trajectory=Trajectory(
            position=jnp.asarray(
                generator.normal(size=(CONFIG.future, 2)), jnp.float32
            ),
            facing=jnp.asarray(np.stack([np.sin(yaw), np.cos(yaw)], -1), jnp.float32),
        ),
        label=jnp.int32(seed % 2),
        keep_past=jnp.bool_(seed % 2),
    )


def test_a_planner_is_traced_once():
    """Other parameters, keys, conditions, styles and guidance scales."""

    @jax.jit
    @chex.assert_max_traces(n=1)
    def plan(params, key, condition, scale):
        return camdm_model.sampler(params, config=CONFIG)(key, condition, scale=scale)

    results = [
        plan(
            tiny.random_params(camdm_model.init, CONFIG, seed=seed),
            jax.random.key(seed),
            condition(seed),
            jnp.float32(0.5 + seed),
        )
        for seed in range(3)
    ]
    assert np.abs(results[1] - results[0]).max() > 1e-3


@pytest.mark.slow
def test_a_rollout_is_traced_once(skeleton):
    """Other states, commands and moments at which plans are made."""
    control = camdm_controller.Control(apply=5, reuse=6)

    @jax.jit
    @chex.assert_max_traces(n=1)
    def run(params, key, states, commands):
        made = camdm_controller.controller(
            params, skeleton, config=CONFIG, control=control
        )
        return rollout.rollout(made, key, states, commands)

    planned = []
    for seed in range(2):
        state = camdm_controller.init_state(
            skeleton, tiny.walk(CONFIG.past, start=float(seed)), config=CONFIG
        )
        states = jax.tree.map(lambda x: jnp.stack([x] * 2), state)
        later = np.arange(6) > 2 + seed
        ahead = jnp.asarray(
            np.broadcast_to(np.stack([later, ~later], -1), (2, 6, 2)), jnp.float32
        )
        label = jnp.broadcast_to(jnp.asarray(later, jnp.int32), (2, 6))
        commands = Command(velocity=ahead, facing=ahead, label=label)
        params = tiny.random_params(camdm_model.init, CONFIG, seed=seed)
        states, frames = run(params, jax.random.key(seed), states, commands)
        # What a rollout returns continues it, without another trace.
        run(params, jax.random.key(9), states, commands)
        planned.append(np.flatnonzero(frames.planned[0]).tolist())
    assert planned[0] != planned[1]


@pytest.mark.slow
def test_a_chunk_of_training_is_traced_once(monkeypatch):
    """Both for a first state and for the state that it returns."""
    counted = chex.assert_max_traces(camdm_loss.loss, n=1)
    monkeypatch.setattr(camdm_loss, "loss", counted)
    run, state, key, data = tiny.training_parts(CONFIG, num_steps=2)
    losses = []
    for _ in range(3):
        state, info = run(state, key, data)
        losses.append(float(info["loss"][0]))
    assert len(set(losses)) == 3


EMDM = emdm_model.Config(
    features=3,
    frames=4,
    condition_size=2,
    num_steps=2,
    latent=2,
    width=8,
    depth=1,
    heads=2,
    hidden=8,
    discriminator_width=64,
    r1_every=2,
)


@pytest.mark.slow
@pytest.mark.parametrize("guided", mostly_slow([True, False], [True]))
def test_a_sampler_of_whole_motions_is_traced_once(guided):
    """Other parameters, keys, conditions, lengths and guidance scales."""

    @jax.jit
    @chex.assert_max_traces(n=1)
    def run(params, key, conditions, scale):
        sample = emdm_model.sampler(params, config=EMDM)
        return emdm_training.sample_many(sample, chunk=2)(key, conditions, scale)

    results = []
    for seed in range(3):
        vector = jnp.eye(2)[jnp.array([seed % 2, 1, 0])]
        lengths = (4, 1 + seed, 2)
        results.append(
            run(
                tiny.random_params(emdm_model.init, EMDM, seed=seed)["generator"],
                jax.random.key(seed),
                emdm_model.make_condition(vector, lengths, config=EMDM),
                jnp.float32(0.5 + seed) if guided else None,
            )
        )
    assert np.abs(results[1] - results[0]).max() > 1e-3


@pytest.mark.slow
def test_a_chunk_of_two_players_is_traced_once(monkeypatch):
    """With and without the penalty, for a first and for a returned state."""
    for name in ("generator_loss", "discriminator_loss"):
        counted = chex.assert_max_traces(getattr(emdm_loss, name), n=1)
        monkeypatch.setattr(emdm_loss, name, counted)
    optimizers = (training.make_optimizer("adam", learning_rate=1e-4),) * 2
    update = emdm_training.gan_update(optimizers, config=EMDM, geometry=None, ema=0.5)
    params = tiny.random_params(emdm_model.init, EMDM)
    state = adversarial.GanState(
        **{n: training.init_train_state(params[n], optimizers[0]) for n in params}
    )

    def draw(key, data):
        return emdm_loss.Batch(
            x_0=data + jax.random.normal(key, data.shape),
            vector=jnp.eye(2),
            mask=jnp.ones((2, 4), bool),
        )

    run = training.train_chunk(update, draw, num_steps=1)
    infos = []
    for seed in range(3):
        data = jnp.full((2, 4, 3), float(seed), jnp.float32)
        state, info = run(state, jax.random.key(seed), data)
        infos.append(info)
    assert len({float(info["loss"][0]) for info in infos}) == 3
    due = [bool(info["discriminator/r1"][0] > 0) for info in infos]
    assert due == [True, False, True]
