"""The update of two players."""

import jax
import jax.numpy as jnp
import numpy as np
import optax

from jaxmotion.learning import adversarial, training


def players():
    """Discriminator d wants d = g; generator g wants g = 2 d."""
    discriminate = lambda d, g, key, batch: (0.5 * (d - g) ** 2, {"gap": d - g})  # noqa: E731
    make = lambda g, d, key, batch: (0.5 * (g - 2 * d) ** 2, {})  # noqa: E731
    rates = optax.sgd(0.5), optax.sgd(0.25)
    update = adversarial.make_gan_update(discriminate, make, rates, ema_decay=0.9)
    g, d = jnp.array(1.0), jnp.array(3.0)
    return update, adversarial.GanState(
        generator=training.init_train_state(g, rates[0]),
        discriminator=training.init_train_state(d, rates[1]),
    )


def test_the_discriminator_moves_first_and_the_generator_sees_it():
    update, state = players()
    state, info = jax.jit(update)(state, jax.random.key(0), None)
    d = 3.0 - 0.25 * (3.0 - 1.0)
    g = 1.0 - 0.5 * (1.0 - 2 * d)
    np.testing.assert_allclose(state.discriminator.params, d)
    np.testing.assert_allclose(state.generator.params, g)
    np.testing.assert_allclose(info["discriminator/gap"], 2.0)
    np.testing.assert_allclose(info["loss"], 0.5 * (1.0 - 2 * d) ** 2)
    assert info["loss"] == info["generator/loss"]
    assert state.step == state.generator.step == state.discriminator.step == 1


def test_only_the_generator_is_averaged():
    update, state = players()
    state, _ = update(state, jax.random.key(0), None)
    # The average warms up: its first decay is 1 / 10.
    expected = 0.1 * 1.0 + 0.9 * float(state.generator.params)
    np.testing.assert_allclose(state.generator.ema_params, expected, rtol=1e-6)
    np.testing.assert_allclose(
        state.discriminator.ema_params, state.discriminator.params
    )


def test_it_runs_in_a_chunk():
    update, state = players()
    alone = state
    for i in range(3):
        alone, _ = update(alone, jax.random.key(i), None)
    run = training.train_chunk(update, lambda key, data: None, num_steps=3)
    state, info = run(state, jax.random.key(0), None)
    np.testing.assert_allclose(state.generator.params, alone.generator.params)
    assert info["loss"].shape == (3,)
