import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxmotion.data import rolling
from jaxmotion.motion import ball
from tests.tiny import float32

REACH, FPS = 2.0, 30.0


def weights(place, root):
    """Formula (1), on the ground (x, z)."""
    gap = (place - root)[..., [0, 2]]
    distance = np.sqrt((gap**2).sum(-1))
    return np.clip(1 - distance / REACH, 0.0, 1.0)


def features(place, velocity, root):
    weight = weights(place, root)[..., None]
    return np.concatenate([weight * (place - root), velocity, weight], axis=-1)


def decoded(encoded, root, start):
    """b' / w + h from w = 0.3 on, the velocity below 0.1, linearly from one to both.

    The same between jumps of 0.5 m and 1 m.
    """
    found, before = np.zeros_like(root), start
    for frame, (x, h) in enumerate(zip(encoded, root, strict=True)):
        before = before + x[3:6] / FPS
        if x[6] > 0.1:
            place = x[:3] / min(x[6], 1.0) + h
            jump = np.linalg.norm(place - before)
            trust = np.interp(x[6], [0.1, 0.3], [0, 1]) * np.interp(
                jump, [0.5, 1], [1, 0]
            )
            before = (1 - trust) * before + trust * place
        found[frame] = before
    return found


def scene(seed=0, frames=40, distance=1.8):
    """Roots, and balls at up to that distance on the ground at any height."""
    generator = np.random.default_rng(seed)
    root = generator.normal(size=(frames, 3))
    angle, far = generator.uniform([[0], [0]], [[2 * np.pi], [distance]], (2, frames))
    place = root + np.stack(
        [far * np.sin(angle), generator.normal(size=frames), far * np.cos(angle)], -1
    )
    velocity = generator.normal(size=(frames, 3))
    return place, velocity, root


def encode(place, velocity, root):
    return ball.encode_ball(
        float32(place), float32(velocity), float32(root), reach=REACH
    )


def test_weights_are_those_of_the_formula():
    place, _, root = scene(distance=4.0)
    found = ball.control_weight(float32(place), float32(root), reach=REACH)
    expected = weights(place, root)
    assert (expected == 0).any() and (expected > 0.5).any()
    np.testing.assert_allclose(found, expected, atol=1e-6)


def test_height_does_not_weaken_control():
    root = float32([0.3, 1.0, -0.2])
    above = root + float32([0.0, 5.0, 0.0])
    assert ball.control_weight(above, root, reach=REACH) == 1.0
    at_reach = root + float32([0.0, 5.0, 2.0])
    assert ball.control_weight(at_reach, root, reach=REACH) == 0.0


def test_features_are_those_of_the_formula():
    place, velocity, root = scene(distance=4.0)
    found = encode(place, velocity, root)
    assert found.shape == (40, ball.NUM_FEATURES)
    np.testing.assert_allclose(found, features(place, velocity, root), atol=2e-6)
    batch = encode(*(np.stack([x, x + 1]) for x in (place, velocity, root)))
    np.testing.assert_allclose(
        batch[1], features(place + 1, velocity + 1, root + 1), atol=5e-6
    )


def test_within_reach_the_ball_comes_back():
    place, velocity, root = scene()
    velocity = np.diff(place, axis=0, prepend=place[:1]) * FPS
    found = ball.decode_ball(
        encode(place, velocity, root), float32(root), float32(place[0]), FPS
    )
    # Near 1.8 m the place is divided by little more than 0.1.
    np.testing.assert_allclose(found, place, atol=2e-5)


@pytest.mark.parametrize("seed", range(3))
def test_any_features_decode_as_the_formula_says(seed):
    generator = np.random.default_rng(seed)
    root, start = 0.2 * generator.normal(size=(30, 3)), generator.normal(size=3)
    encoded = 0.3 * generator.normal(size=(30, 7))
    encoded[:, 6] = generator.uniform(-0.3, 1.5, 30)
    found = ball.decode_ball(float32(encoded), float32(root), float32(start), FPS)
    low = encoded[:, 6] < 0.1
    assert low.any() and not low.all() and (encoded[:, 6] > 1).any()
    np.testing.assert_allclose(found, decoded(encoded, root, start), atol=1e-4)


def test_a_ball_out_of_reach_moves_on_with_its_velocity():
    # Shot away from a person who stands still; known in frames 0 to 5.
    time = np.arange(30) / FPS
    place = np.stack([0.5 + 8.0 * time, 0.11 + 0 * time, -6.0 * time], axis=-1)
    root = np.tile([0.0, 0.9, 0.0], (30, 1))
    velocity = ball.ball_velocities(float32(place), FPS)
    encoded = encode(place, velocity, root)
    assert encoded[4, 6] > 0.1 and (encoded[6:, 6] < 0.1).all()
    found = ball.decode_ball(encoded, float32(root), jnp.zeros(3), FPS)
    np.testing.assert_allclose(found, place, atol=1e-4)
    # From the first frame on only `start` says where it is.
    start = float32(place[9])
    late = ball.decode_ball(encoded[10:], float32(root[10:]), start, FPS)
    np.testing.assert_allclose(late, place[10:], atol=1e-4)


GAPS = {
    "at the root": (0.0, 0.0, 0.0),
    "above the root": (0.0, 1.0, 0.0),
    "nearly at the root": (1e-7, 0.0, 0.0),
    "at the reach": (2.0, 0.0, 0.0),
    "nearly at the reach": (0.0, -0.5, 1.9999999),
    "beyond": (30.0, 1.0, -40.0),
}


@pytest.mark.parametrize("case", GAPS)
def test_values_and_gradients_are_finite(case):
    root = float32([[0.4, 0.9, -0.7]] * 3)
    place = root + jnp.broadcast_to(float32(GAPS[case]), (3, 3))

    def there_and_back(place, velocity, root):
        encoded = ball.encode_ball(place, velocity, root, reach=REACH)
        found = ball.decode_ball(encoded, root, place[0], FPS)
        return jnp.sum(found**2) + jnp.sum(encoded**2), (encoded, found)

    gradients, values = jax.jit(
        jax.grad(there_and_back, argnums=(0, 1, 2), has_aux=True)
    )(place, jnp.ones((3, 3)), root)
    for value in jax.tree.leaves((values, gradients)):
        assert np.isfinite(value).all()


@pytest.mark.parametrize("weight", [-3.0, 0.0, 1e-8, 0.1, 0.2, 1e6])
def test_decoding_what_a_network_may_say_is_finite(weight):
    def decode(features):
        found = ball.decode_ball(features, jnp.ones((4, 3)), jnp.ones(3), FPS)
        return jnp.sum(found**2), found

    features = jnp.full((4, 7), 2.0).at[:, 6].set(weight)
    gradient, found = jax.grad(decode, has_aux=True)(features)
    assert np.isfinite(found).all() and np.isfinite(gradient).all()
    # No place is ever divided by less than 0.1.
    assert np.abs(found).max() <= 2.0 / 0.1 + 1.0


def test_gradients_are_those_of_differences():
    place, velocity, root = (x[:4] for x in scene(seed=3, distance=1.5))
    mix = np.random.default_rng(4).normal(size=(4, 7))

    def loss(place, root):
        return jnp.sum(
            ball.encode_ball(place, float32(velocity), root, reach=REACH) * mix
        )

    found = jax.grad(loss, argnums=(0, 1))(float32(place), float32(root))
    for which in range(2):
        expected = np.zeros((4, 3))
        for index in np.ndindex(4, 3):
            values = []
            for step in (1e-6, -1e-6):
                moved = [place.copy(), root.copy()]
                moved[which][index] += step
                values.append((features(moved[0], velocity, moved[1]) * mix).sum())
            expected[index] = (values[0] - values[1]) / 2e-6
        np.testing.assert_allclose(found[which], expected, atol=1e-4)


def test_velocities_and_accelerations_of_a_parabola():
    time = np.arange(12) / FPS
    start, speed = np.array([0.5, 1.0, -2.0]), np.array([3.0, 5.0, -1.0])
    fall = np.array([0.0, -9.81, 0.0])
    place = start + time[:, None] * speed + 0.5 * time[:, None] ** 2 * fall
    place = float32(np.stack([place, 2 * place]))
    found = ball.ball_accelerations(place, FPS)
    # Float32 at 4 m and a factor of 900.
    np.testing.assert_allclose(found[0, 1:-1], np.tile(fall, (10, 1)), atol=2e-3)
    np.testing.assert_allclose(found[1], 2 * found[0], atol=1e-6)
    np.testing.assert_array_equal(found[:, [0, -1]], 0.0)
    # The mean speed of a fall between two frames is the speed half a frame before.
    found = ball.ball_velocities(place, FPS)
    expected = speed + (time - 0.5 / FPS)[:, None] * fall
    np.testing.assert_allclose(found[0, 1:], expected[1:], atol=1e-4)
    np.testing.assert_array_equal(found[:, 0], found[:, 1])


def test_too_few_frames_are_refused():
    with pytest.raises(ValueError, match="1 frames of a ball, expected at least 2"):
        ball.ball_velocities(jnp.zeros((1, 3)), FPS)
    with pytest.raises(ValueError, match="2 frames of a ball, expected at least 3"):
        ball.ball_accelerations(jnp.zeros((5, 2, 3)), FPS)


@pytest.mark.parametrize("velocity", [[0.0, 0.0], [3.0, -1.0], [-0.4, 0.2]])
def test_a_ball_that_nobody_touches_rolls_to_rest(velocity):
    """Beside float64 host code that makes the training data's balls."""
    velocity, step = np.array(velocity), 1 / FPS
    before = np.array([[0.3, 0.11, -1.0]])
    place = before + [velocity[0] * step, 0.0, velocity[1] * step]
    given = float32(np.concatenate([before, place]))
    found = ball.rolled(given, FPS, num_frames=180, deceleration=0.8)
    # What it had half a frame before the last one.
    speed = max(np.hypot(*velocity) - 0.4 * step, 0.0)
    rest = velocity / max(np.hypot(*velocity), 1e-9) * speed**2 / (2 * 0.8)
    times = np.arange(1, 181)[None] * step
    way = rolling.roll(rest[None], np.array([6.0]), 0.8, times)[0]
    np.testing.assert_allclose(found[:, ::2], place[0, ::2] + way, atol=2e-4)
    np.testing.assert_array_equal(found[:, 1], np.float32(0.11))


def test_the_velocity_of_one_frame_is_unknown():
    with pytest.raises(ValueError, match="1 frames of a ball, expected at least 2"):
        ball.rolled(jnp.zeros((1, 3)), FPS, num_frames=3, deceleration=0.8)
