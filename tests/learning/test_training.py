"""State, update and chunks on a model small enough to be done by hand."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import optax
import pytest

from jaxmotion.learning import training


def quadratic(params, key, batch):
    """Mean of (w x - y)^2; the key shifts nothing but is reported."""
    x, y = batch
    error = params["w"] * x - y
    return jnp.mean(error**2), {"draw": jax.random.uniform(key)}


def sample_batch(key, data):
    chosen = jax.random.randint(key, (4,), 0, data[0].shape[0])
    return data[0][chosen], data[1][chosen]


def parts(num_steps, optimizer=None, ema_decay=0.9):
    optimizer = optax.sgd(0.1) if optimizer is None else optimizer
    update = training.make_update(quadratic, optimizer, ema_decay=ema_decay)
    run = training.train_chunk(update, sample_batch, num_steps=num_steps)
    state = training.init_train_state({"w": jnp.float32(3.0)}, optimizer)
    x = jnp.linspace(0.5, 1.5, 16)
    return run, state, (x, 2.0 * x)


def test_update_is_gradient_descent_and_the_average_its_recursion():
    run, state, data = parts(30)
    key = jax.random.key(0)
    final, info = run(state, key, data)
    w, ema = 3.0, 3.0
    x, y = (np.asarray(v, np.float64) for v in data)
    for step in range(30):
        key_batch, key_loss = jax.random.split(jax.random.fold_in(key, step))
        chosen = np.asarray(jax.random.randint(key_batch, (4,), 0, 16))
        error = w * x[chosen] - y[chosen]
        gradient = np.mean(2 * error * x[chosen])
        np.testing.assert_allclose(info["loss"][step], np.mean(error**2), rtol=1e-3)
        np.testing.assert_allclose(
            info["grad_norm"][step], abs(gradient), rtol=1e-3, atol=1e-6
        )
        assert info["draw"][step] == jax.random.uniform(key_loss)
        w -= 0.1 * gradient
        decay = min(0.9, (1 + step) / (10 + step))
        ema = decay * ema + (1 - decay) * w
    assert final.step == 30
    np.testing.assert_allclose(final.params["w"], w, rtol=1e-5)
    np.testing.assert_allclose(final.ema_params["w"], ema, rtol=1e-5)


@pytest.mark.parametrize("pieces", [(12,), (4, 8), (3, 3, 6)])
def test_chunks_do_not_change_a_run(pieces):
    whole, state, data = parts(12, optax.adam(0.1))
    expected, info = whole(state, jax.random.key(1), data)
    _, state, _ = parts(1, optax.adam(0.1))
    losses = []
    for steps in pieces:
        run, _, _ = parts(steps, optax.adam(0.1))
        state, part = run(state, jax.random.key(1), data)
        losses.append(part["loss"])
    jax.tree.map(np.testing.assert_array_equal, state, expected)
    np.testing.assert_array_equal(np.concatenate(losses), info["loss"])


def test_the_state_is_donated():
    run, state, data = parts(2)
    run(state, jax.random.key(0), data)
    assert state.params["w"].is_deleted()
    assert state.ema_params["w"].is_deleted()
    assert not data[0].is_deleted()


def test_learning_rate_rises_and_falls():
    """With a constant gradient and no momentum Adam moves by the rate each step."""
    optimizer = training.make_optimizer(
        "adamw", learning_rate=0.5, num_steps=20, warmup_steps=5, final_fraction=0.2
    )
    params, moves = jnp.zeros(()), []
    state = optimizer.init(params)
    for _ in range(25):
        change, state = optimizer.update(jnp.ones(()), state, params)
        moves.append(float(-change))
    step = np.arange(25)
    fall = 0.5 * (1 + np.cos(np.pi * np.clip((step - 5) / 15, 0, 1)))
    expected = np.where(step < 5, 0.1 * step, 0.5 * (0.2 + 0.8 * fall))
    np.testing.assert_allclose(moves, expected, atol=1e-5)


def test_gradient_is_clipped_and_weights_decay():
    clipped = training.make_optimizer(
        "adamw", learning_rate=0.1, num_steps=10, max_norm=1.0
    )
    large = {"a": jnp.array([3e3, 4e3])}
    state = clipped.init(large)
    _, state = clipped.update(large, state, large)
    first_moment = optax.tree_utils.tree_get(state, "mu")["a"]
    np.testing.assert_allclose(first_moment, [0.1 * 0.6, 0.1 * 0.8], rtol=1e-5)

    decaying = training.make_optimizer(
        "adamw", learning_rate=0.1, num_steps=10, weight_decay=0.5
    )
    params = {"a": jnp.array([2.0, -2.0])}
    change, _ = decaying.update({"a": jnp.zeros(2)}, decaying.init(params), params)
    np.testing.assert_allclose(change["a"], [-0.1, 0.1], rtol=1e-6)


def matrix(rows, columns, sizes):
    """A matrix with given singular values, and its left and right vectors."""
    generator = np.random.default_rng(rows)
    left, _ = np.linalg.qr(generator.normal(size=(rows, len(sizes))))
    right, _ = np.linalg.qr(generator.normal(size=(columns, len(sizes))))
    return left * sizes @ right.T, left, right


COEFFICIENTS = np.tile([3.4445, -4.7750, 2.0315], (5, 1))


@pytest.mark.parametrize("shape", [(40, 24), (24, 40), (24, 24)])
def test_orthogonalized_matrices_are_near_those_of_the_svd_in_float64(shape):
    """As steep as gradients are: most singular values are below a tenth."""
    sizes = np.geomspace(1.0, 1e-3, 24)
    given, left, right = matrix(*shape, sizes)
    found = np.float64(
        training.orthogonalize(jnp.float32(given), jnp.float32(COEFFICIENTS))
    )
    expected = sizes / np.linalg.norm(sizes)
    for a, b, c in COEFFICIENTS:
        expected = a * expected + b * expected**3 + c * expected**5
    np.testing.assert_allclose(found, left * expected @ right.T, atol=1e-3)
    # The nearest matrix with orthonormal rows or columns has ones in their place.
    large = expected[sizes > 0.0015 * np.linalg.norm(sizes)]
    assert len(large) > 18 and large.min() > 0.67 and large.max() < 1.21


def test_orthogonalizing_many_is_orthogonalizing_each():
    each = functools.partial(
        training.orthogonalize, coefficients=jnp.float32(COEFFICIENTS)
    )
    many = jnp.float32(np.random.default_rng(0).normal(size=(3, 5, 8)))
    for one, alone in zip(jax.vmap(each)(many), many, strict=True):
        np.testing.assert_allclose(one, each(alone), atol=1e-5)
    assert not np.any(each(jnp.zeros((2, 3))))


def moves(optimizer, gradients, params):
    """Changes of each update, and the last state."""
    state, made = optimizer.init(params), []
    for gradient in gradients:
        change, state = optimizer.update(gradient, state, params)
        made.append(change)
    return made, state


def test_muon_is_optax_s_and_goes_on_from_its_states():
    params = {"w": jnp.zeros((6, 4)), "b": jnp.zeros(3)}
    generator = np.random.default_rng(0)
    gradients = [
        {k: jnp.float32(generator.normal(size=x.shape)) for k, x in params.items()}
        for _ in range(5)
    ]
    theirs = optax.chain(optax.contrib.muon(0.01, consistent_rms=0.2))
    expected, state = moves(theirs, gradients, params)
    ours = training.make_optimizer("muon", learning_rate=0.01)
    found, own = moves(ours, gradients, params)
    close = functools.partial(np.testing.assert_allclose, rtol=1e-5, atol=1e-6)
    jax.tree.map(close, (found, own), (expected, state))
    again, other = (x.update(gradients[0], state, params)[0] for x in (ours, theirs))
    jax.tree.map(close, again, other)


def test_muon_moves_matrices_orthogonally_and_vectors_as_nadam_does():
    """The first update of a matrix has equal singular values; Liu et al.'s scale."""
    optimizer = training.make_optimizer(
        "muon", learning_rate=0.01, num_steps=10, max_norm=1.0
    )
    gradient = np.random.default_rng(0).normal(size=(6, 4)).astype(np.float32)
    params = {"w": jnp.zeros((6, 4)), "b": jnp.zeros(3)}
    grads = {"w": jnp.asarray(gradient), "b": jnp.array([1.0, -2.0, 0.5])}
    change, _ = optimizer.update(grads, optimizer.init(params), params)
    sizes = np.linalg.svd(change["w"], compute_uv=False)
    # Five Newton-Schulz iterations bring singular values to 1 +- 0.3.
    np.testing.assert_allclose(sizes, 0.01 * 0.2 * np.sqrt(6), rtol=0.35)
    left, _, right = np.linalg.svd(gradient, full_matrices=False)
    along = np.diag(left.T @ np.asarray(change["w"]) @ right.T)
    np.testing.assert_allclose(-along, sizes, rtol=0.5)
    nadam = 0.01 * (0.9 * 0.1 / (1 - 0.9**2) + 1)
    np.testing.assert_allclose(change["b"], [-nadam, nadam, -nadam], rtol=1e-4)


def test_state_starts_with_its_average_at_the_parameters():
    _, state, _ = parts(1)
    assert state.step == 0
    assert state.ema_params["w"] == state.params["w"]
    assert state.ema_params["w"] is not state.params["w"]


def test_replicate_without_a_mesh_is_nothing():
    tree = {"a": jnp.ones(3)}
    assert training.replicate(tree, None) is tree
