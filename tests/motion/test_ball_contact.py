"""Contacts of feet with a ball: the gate of eq. 10 and the loss of eq. 11-12."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxmotion.motion import contact
from tests.reference import smgdiff as oracle

FPS = 30.0
# The paper's: 0.1 m, and a foot that stands counts twice.
loss_of = functools.partial(
    contact.ball_contact_loss,
    max_distance=oracle.MAX_DISTANCE,
    grounded_weight=oracle.GROUNDED_WEIGHT,
)


def as32(*arrays):
    return tuple(jnp.asarray(x, jnp.float32) for x in arrays)


def scene(seed, shape=(), frames=24, feet=4):
    """Feet around a ball that jerks about; about half of them stand."""
    rng = np.random.default_rng(seed)
    jerk = rng.normal(size=(*shape, frames, 3)) * 2.0 / FPS**2
    ball = np.cumsum(np.cumsum(jerk, -2), -2)
    around = ball[..., None, :] + 0.3 * rng.normal(size=(*shape, frames, feet, 3))
    grounded = (rng.uniform(size=(*shape, frames, feet)) < 0.5).astype(np.float32)
    gate = rng.uniform(size=(*shape, frames)) < 0.6
    feet, ball = as32(around, ball)
    return feet, ball, jnp.asarray(grounded), jnp.asarray(gate)


def in64(*arrays):
    return tuple(np.float64(x) for x in arrays)


@pytest.mark.parametrize("threshold", [1.0, 2.0, 6.0])
def test_gate_is_that_of_the_formula(threshold):
    _, ball, _, _ = scene(0, (3,), frames=60)
    found = contact.ball_contact_gate(ball, FPS, threshold=threshold)
    expected = [oracle.contact_gate(b, FPS, threshold) for b in np.float64(ball)]
    np.testing.assert_array_equal(found, expected)
    assert 0 < found.mean() < 1


def test_the_gate_opens_at_a_kick_and_in_a_curve():
    frames = np.arange(20)
    kicked = np.where(frames[:, None] < 8, 0.0, frames[:, None] - 8.0) * [0.05, 0, 0.02]
    (ball,) = as32(kicked)
    found = contact.ball_contact_gate(ball, FPS, threshold=2.0)
    np.testing.assert_array_equal(np.flatnonzero(found), [8])
    # On a circle of 1 m with 2 m/s the acceleration is 4 m/s^2, all of it sideways.
    angle = 2.0 * frames / FPS
    circle = np.stack([np.cos(angle), 0 * angle, np.sin(angle)], -1)
    (ball,) = as32(circle)
    assert contact.ball_contact_gate(ball, FPS, threshold=3.9)[1:-1].all()
    assert not contact.ball_contact_gate(ball, FPS, threshold=4.1).any()


def test_the_threshold_itself_does_not_open_the_gate():
    # A second difference of 1/16 m at 8 fps is 4 m/s^2, exactly.
    ball = jnp.zeros((3, 3)).at[2, 1].set(1 / 16)
    assert not contact.ball_contact_gate(ball, 8.0, threshold=4.0).any()
    assert contact.ball_contact_gate(ball, 8.0, threshold=3.99)[1]


@pytest.mark.parametrize("seed", range(4))
@pytest.mark.parametrize(
    ("max_distance", "weight"), [(0.1, 2.0), (0.3, 1.0), (0.2, 3.0)]
)
def test_loss_and_gradient_are_those_of_the_formula(seed, max_distance, weight):
    feet, ball, grounded, gate = scene(seed)
    options = dict(max_distance=max_distance, grounded_weight=weight)

    def loss(feet, ball):
        return loss_of(feet, ball, grounded, gate, **options)

    found, slopes = jax.value_and_grad(loss, argnums=(0, 1))(feet, ball)
    given = (*in64(feet, ball, grounded), np.asarray(gate))
    expected = oracle.contact_loss(*given, max_distance, weight)
    assert expected > 0
    np.testing.assert_allclose(found, expected, rtol=1e-5)
    wanted = oracle.contact_loss_gradient(*given, max_distance, weight)
    for a, b in zip(slopes, wanted, strict=True):
        np.testing.assert_allclose(a, b, atol=1e-5)


def one_frame(*places, grounded):
    """A ball at the origin and feet along x."""
    feet = jnp.zeros((1, len(places), 3)).at[0, :, 0].set(jnp.array(places))
    return feet, jnp.zeros((1, 3)), jnp.array([grounded]), jnp.ones(1, bool)


def test_a_lifted_foot_is_chosen_before_a_nearer_one_that_stands():
    # 0.2 m doubled is farther than 0.3 m.
    feet, ball, grounded, gate = one_frame(0.2, 0.3, grounded=[1.0, 0.0])
    loss = lambda feet: loss_of(feet, ball, grounded, gate)  # noqa: E731
    np.testing.assert_allclose(loss(feet), 0.3, rtol=1e-6)
    np.testing.assert_allclose(jax.grad(loss)(feet)[0, :, 0], [0.0, 1.0], atol=1e-6)
    feet = feet.at[0, 0, 0].set(0.14)
    np.testing.assert_allclose(loss(feet), 0.28, rtol=1e-6)
    np.testing.assert_allclose(jax.grad(loss)(feet)[0, :, 0], [2.0, 0.0], atol=1e-6)


def test_the_threshold_meets_the_penalized_distance():
    for grounded, expected in ((0.0, 0.0), (1.0, 0.12)):
        found = loss_of(*one_frame(0.06, grounded=[grounded]))
        np.testing.assert_allclose(found, expected, rtol=1e-6)


def test_frames_are_added_and_closed_gates_count_nothing():
    feet, ball, grounded, _ = scene(3)
    each = jnp.stack(
        [
            loss_of(feet, ball, grounded, jnp.arange(len(ball)) == i, max_distance=0.2)
            for i in range(len(ball))
        ]
    )
    for gate in (each > 0.3, each < jnp.inf, each < 0):
        found = loss_of(feet, ball, grounded, gate, max_distance=0.2)
        np.testing.assert_allclose(found, jnp.sum(each * gate), rtol=1e-5)


def test_labels_are_constants_of_the_gradient():
    """A model gives the labels from the same x_0 that is guided."""
    feet, ball, grounded, gate = scene(4)

    def loss(grounded):
        return loss_of(feet, ball, grounded, gate)

    np.testing.assert_array_equal(jax.grad(loss)(grounded), 0.0)
    assert float(jnp.abs(loss(grounded) - loss(1 - grounded))) > 0.1


def test_the_gate_is_a_constant_of_the_gradient():
    """The ball moves its own gate, of which the gradient knows nothing."""
    feet, ball, grounded, _ = scene(5)

    def loss(ball, gate):
        return loss_of(feet, ball, grounded, gate)

    def own(ball):
        return loss(ball, contact.ball_contact_gate(ball, FPS, threshold=2.0))

    gate = contact.ball_contact_gate(ball, FPS, threshold=2.0)
    np.testing.assert_allclose(jax.grad(own)(ball), jax.grad(loss)(ball, gate))


@pytest.mark.parametrize("max_distance", [0.1, 0.0])
def test_gradient_is_finite_where_foot_and_ball_coincide(max_distance):
    feet, ball, grounded, gate = scene(6)
    # One foot of four in some frames, all of them in another, gates open and closed.
    feet = feet.at[::3, 1].set(ball[::3])
    feet = feet.at[4].set(jnp.broadcast_to(ball[4], feet[4].shape))
    slopes = jax.grad(
        lambda f, b: loss_of(f, b, grounded, gate, max_distance=max_distance),
        argnums=(0, 1),
    )(feet, ball)
    given = (*in64(feet, ball, grounded), np.asarray(gate))
    wanted = oracle.contact_loss_gradient(*given, max_distance)
    for a, b in zip(slopes, wanted, strict=True):
        assert jnp.isfinite(a).all()
        np.testing.assert_allclose(a, b, atol=1e-5)


def test_descent_brings_the_foot_to_the_ball():
    feet, ball, grounded, gate = scene(7)
    loss = jax.jit(jax.value_and_grad(lambda feet: loss_of(feet, ball, grounded, gate)))
    before, _ = loss(feet)
    for _ in range(60):
        _, slope = loss(feet)
        feet = feet - 0.01 * slope
    after, _ = loss(feet)
    assert before > 1.0 and after == 0.0


def test_batches_and_vmap_are_a_loop():
    feet, ball, grounded, gate = scene(8, (2, 3))
    found = loss_of(feet, ball, grounded, gate)
    assert found.shape == (2, 3)
    mapped = jax.vmap(loss_of)(feet, ball, grounded, gate)
    np.testing.assert_allclose(mapped, found, rtol=1e-6)
    one = loss_of(feet[1, 2], ball[1, 2], grounded[1, 2], gate[1, 2])
    np.testing.assert_allclose(one, found[1, 2], rtol=1e-6)


def test_two_frames_have_no_gate():
    with pytest.raises(ValueError, match="2 frames of a ball, expected at least 3"):
        contact.ball_contact_gate(jnp.zeros((2, 3)), FPS, threshold=2.0)
