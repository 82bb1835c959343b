import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from jaxmotion.control import inertia
from jaxmotion.motion import rotation
from jaxmotion.motion.skeleton import Motion
from tests.reference import inertia as oracle

CASES = [(1.0, 0.0), (1.0, 3.0), (1.0, -3.0), (1.0, -80.0), (-0.5, 9.0), (0.0, 2.0)]


def columns(rotations):
    matrix = rotations.as_matrix()
    return np.concatenate([matrix[:, :, 0], matrix[:, :, 1]], -1)


def motion(position, vectors, fps):
    """Motion of joints whose rotation vectors [F, J, 3] are given."""
    frames, joints, _ = vectors.shape
    rot6d = columns(Rotation.from_rotvec(vectors.reshape(-1, 3)))
    return Motion(
        root_position=jnp.asarray(position, jnp.float32),
        joint_rotation=jnp.asarray(rot6d.reshape(frames, joints, 6), jnp.float32),
        fps=fps,
    )


def matrices(made):
    return np.asarray(rotation.matrix_from_rot6d(made.joint_rotation), np.float64)


# --- the quintic -----------------------------------------------------------------


@pytest.mark.parametrize("x, v", CASES)
def test_quintic_has_the_published_coefficients(x, v):
    t = np.linspace(0.0, 0.3, 13)
    want = [oracle.quintic(x, v, s, 0.2) for s in t]
    got = inertia.quintic(
        jnp.float32(x), jnp.float32(v), jnp.asarray(t, jnp.float32), duration=0.2
    )
    np.testing.assert_allclose(got, want, atol=2e-6)


@pytest.mark.parametrize("x, v", CASES)
def test_quintic_meets_its_end_conditions(x, v):
    end = min(0.2, -5 * x / v) if x * v < 0 else 0.2
    t = np.linspace(0.0, end, 6)
    with jax.enable_x64(True):
        got = inertia.quintic(
            jnp.float64(x), jnp.float64(v), jnp.asarray(t), duration=0.2
        )
        got = np.asarray(got)
    # Six samples determine the quintic; its scale in s makes the tolerances absolute.
    fit = np.polynomial.Polynomial.fit(t / end, got, 5).convert()
    np.testing.assert_allclose([fit(0), fit.deriv(1)(0)], [x, v * end], atol=1e-9)
    for order in range(4):
        derivative = fit.deriv(order) if order else fit
        np.testing.assert_allclose(derivative(1.0), 0.0, atol=1e-8)


def test_quintic_does_not_overshoot():
    t = jnp.linspace(0.0, 0.2, 200)
    for v in (-10.0, -30.0, -100.0):
        offset = np.asarray(
            inertia.quintic(jnp.float32(1), jnp.float32(v), t, duration=0.2)
        )
        assert offset.min() >= 0 and np.all(np.diff(offset) <= 1e-7)


def test_quintic_of_no_duration_is_the_target():
    got = inertia.quintic(
        jnp.float32(1), jnp.float32(-2), jnp.float32(0.0), duration=0.0
    )
    assert got == 0.0


def test_decay_is_the_same_in_every_coordinate_system():
    key_x, key_v, key_r = jax.random.split(jax.random.key(0), 3)
    x = jax.random.normal(key_x, (5, 3))
    v = 20 * jax.random.normal(key_v, (5, 3))
    turn = rotation.matrix_from_rot6d(jax.random.normal(key_r, (6,)))
    t = jnp.linspace(0.0, 0.2, 7)
    given = inertia.decay(x, v, t, duration=0.2)
    turned = inertia.decay(x @ turn.T, v @ turn.T, t, duration=0.2)
    assert given.shape == (5, 7, 3)
    np.testing.assert_allclose(turned, given @ turn.T, atol=1e-5)


# --- chunks ----------------------------------------------------------------------


def two_motions(fps, frames):
    """What was displayed up to t = 0, and a quite different chunk from t = dt on."""
    t_past = np.array([-2.0, -1.0, 0.0])[:, None] / fps
    t = np.arange(1, frames + 1)[:, None] / fps
    past = np.concatenate([np.sin(3 * t_past), t_past, np.cos(2 * t_past)], -1)
    chunk = np.concatenate([0.1 - t, 0.05 + np.sin(4 * t), 1 + 0.2 * t], -1)
    axes = np.array([[1.0, 0.2, 0.0], [0.0, 0.5, -0.5]])
    past_turn = axes * (0.4 + 2.0 * t_past)[..., None]
    chunk_turn = axes[::-1] * (0.7 - 1.5 * t + np.sin(3 * t))[..., None]
    return motion(past, past_turn, fps), motion(chunk, chunk_turn, fps)


def seam_rates(fps):
    """Largest linear and angular acceleration in the frames around the seam."""
    past, chunk = two_motions(fps, 8)
    shown = inertia.inertialize(past, chunk, duration=0.2)
    p = np.concatenate([past.root_position, shown.root_position]).astype(np.float64)
    linear = np.abs(np.diff(p, 2, axis=0) * fps**2)
    r = np.concatenate([matrices(past), matrices(shown)])
    steps = np.einsum("fjab,fjcb->fjac", r[1:], r[:-1])
    omega = Rotation.from_matrix(steps.reshape(-1, 3, 3)).as_rotvec() * fps
    angular = np.abs(np.diff(omega.reshape(len(r) - 1, 2, 3), axis=0) * fps)
    return linear[:5].max(), angular[:5].max()


def test_velocity_is_continuous_at_the_seam():
    # A jump of velocity would make the acceleration grow with the frame rate.
    coarse, fine = seam_rates(240.0), seam_rates(1920.0)
    for low, high in zip(coarse, fine, strict=True):
        assert high < 1.5 * low, (coarse, fine)
    past, chunk = two_motions(1920.0, 8)
    cut = np.concatenate([past.root_position, chunk.root_position])
    assert np.abs(np.diff(cut, 2, axis=0) * 1920.0**2)[:3].max() > 10 * fine[0]


def test_chunk_is_untouched_after_the_duration():
    past, chunk = two_motions(30.0, 12)
    shown = inertia.inertialize(past, chunk, duration=0.2)
    # Frame i is at (i + 1) / 30 s, so frame 5 is the first at 0.2 s.
    np.testing.assert_array_equal(shown.root_position[6:], chunk.root_position[6:])
    np.testing.assert_array_equal(shown.joint_rotation[6:], chunk.joint_rotation[6:])
    np.testing.assert_allclose(
        shown.root_position[5], chunk.root_position[5], atol=1e-6
    )
    moved = np.abs(shown.root_position[:3] - chunk.root_position[:3]).max(-1)
    assert moved.min() > 1e-3


def test_steady_motion_passes_unchanged():
    t = np.arange(12)[:, None] / 30.0
    turn = np.array([[0.0, 1.0, 0.0], [0.6, 0.0, 0.8]]) * (0.2 + 2.0 * t)[..., None]
    whole = motion(np.array([[1.0, 0.5, -2.0]]) * t, turn, 30.0)
    past, chunk = (
        jax.tree.map(lambda x: x[:2], whole),
        jax.tree.map(lambda x: x[2:], whole),
    )
    shown = inertia.inertialize(past, chunk)
    np.testing.assert_allclose(shown.root_position, chunk.root_position, atol=1e-5)
    np.testing.assert_allclose(shown.joint_rotation, chunk.joint_rotation, atol=1e-5)


def test_fade_across_a_half_turn_keeps_its_side():
    # The offset crosses pi between the two displayed frames.
    still = np.zeros((8, 1, 3))
    angles = np.array([np.pi - 0.05, np.pi + 0.05])[:, None, None]
    past = motion(np.zeros((2, 3)), angles * np.array([[[0, 1.0, 0]]]), 30.0)
    chunk = motion(np.zeros((8, 3)), still, 30.0)
    shown = matrices(inertia.inertialize(past, chunk, duration=1.0))[:, 0]
    yaw = np.arctan2(shown[:, 0, 2], shown[:, 0, 0])
    # It was turning up through pi, 0.1 a frame, and goes on that way round.
    want = [
        oracle.quintic(-np.pi + 0.05, 0.1 * 30, (i + 1) / 30, 1.0) for i in range(8)
    ]
    np.testing.assert_allclose(yaw, want, atol=1e-4)


@pytest.mark.slow
def test_batches_and_zero_offsets_are_finite():
    same = motion(np.zeros((4, 3)), np.zeros((4, 2, 3)), 30.0)
    batch = jax.tree.map(lambda x: jnp.stack([x, x]), same)
    shown = inertia.inertialize(batch, batch)
    np.testing.assert_allclose(shown.joint_rotation, batch.joint_rotation, atol=1e-6)

    def total(past, chunk):
        out = inertia.inertialize(past, chunk)
        return jnp.sum(out.root_position) + jnp.sum(out.joint_rotation**2)

    grads = jax.tree.leaves(jax.grad(total, (0, 1))(batch, batch))
    assert all(np.isfinite(g).all() for g in grads)


@pytest.mark.slow
def test_batch_is_each_of_its_motions():
    pairs = [two_motions(30.0, 6) for _ in range(2)]
    other = jax.tree.map(lambda x: x[::-1], pairs[1][1])
    past = jax.tree.map(lambda x: jnp.stack([x, x]), pairs[0][0])
    chunk = jax.tree.map(lambda *x: jnp.stack(x), pairs[0][1], other)
    got = inertia.inertialize(past, chunk)
    want = [inertia.inertialize(pairs[0][0], c) for c in (pairs[0][1], other)]
    for b in range(2):
        np.testing.assert_allclose(
            got.joint_rotation[b], want[b].joint_rotation, atol=1e-5
        )


def test_short_or_foreign_motions_are_refused():
    made = motion(np.zeros((4, 3)), np.zeros((4, 1, 3)), 30.0)
    one = jax.tree.map(lambda x: x[:1], made)
    with pytest.raises(ValueError, match="past has 1 frame"):
        inertia.inertialize(one, made)
    with pytest.raises(ValueError, match="past has 60.0 fps, the chunk 30.0"):
        inertia.inertialize(motion(np.zeros((4, 3)), np.zeros((4, 1, 3)), 60.0), made)
