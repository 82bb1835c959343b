"""Losses on arrays against loops in float64."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxmotion.diffusion import schedule
from jaxmotion.learning import losses
from tests.reference import emdm as reference


@pytest.fixture
def arrays():
    generator = np.random.default_rng(0)
    prediction, target = generator.normal(size=(2, 3, 5, 4))
    mask = generator.random((3, 5)) < 0.6
    return prediction, target, mask


def test_masked_mse(arrays):
    prediction, target, mask = arrays
    kept = [
        np.mean((prediction[b, f] - target[b, f]) ** 2)
        for b, f in np.ndindex(3, 5)
        if mask[b, f]
    ]
    found = losses.masked_mse(*(jnp.asarray(x) for x in arrays))
    np.testing.assert_allclose(found, np.mean(kept), rtol=1e-6)


def test_a_mask_for_all_samples(arrays):
    prediction, target, mask = arrays
    found = losses.masked_mse(
        jnp.asarray(prediction), jnp.asarray(target), jnp.asarray(mask[:1])
    )
    square = np.mean((prediction - target) ** 2, axis=(0, 2))
    np.testing.assert_allclose(found, square[mask[0]].mean(), rtol=1e-6)


def test_frames_that_do_not_count_do_not_matter(arrays):
    prediction, target, mask = (jnp.asarray(x) for x in arrays)
    changed = jnp.where(mask[..., None], prediction, 1e6)
    for loss in (losses.masked_mse, losses.velocity_loss):
        np.testing.assert_allclose(
            loss(changed, target, mask), loss(prediction, target, mask), rtol=1e-6
        )


def test_no_frame_that_counts_gives_zero(arrays):
    prediction, target, mask = (jnp.asarray(x) for x in arrays)
    assert losses.masked_mse(prediction, target, jnp.zeros_like(mask)) == 0


def test_velocity_loss(arrays):
    prediction, target, mask = arrays
    kept = []
    for b, f in np.ndindex(3, 4):
        if mask[b, f] and mask[b, f + 1]:
            moved = prediction[b, f + 1] - prediction[b, f]
            wanted = target[b, f + 1] - target[b, f]
            kept.append(np.mean((moved - wanted) ** 2))
    found = losses.velocity_loss(*(jnp.asarray(x) for x in arrays))
    np.testing.assert_allclose(found, np.mean(kept), rtol=1e-5)


def test_velocity_loss_does_not_see_a_constant(arrays):
    _, target, mask = (jnp.asarray(x) for x in arrays)
    found = losses.velocity_loss(target + 7.0, target, mask)
    np.testing.assert_allclose(found, 0.0, atol=1e-10)


def test_foot_slide_counts_standing_feet_of_the_frames_that_count():
    generator = np.random.default_rng(1)
    feet = generator.normal(size=(2, 5, 2, 3))
    contact = generator.random((2, 5, 2)) < 0.5
    lengths = (3, 5)
    total, count = 0.0, 0
    for b, f, foot, axis in np.ndindex(2, 4, 2, 3):
        if f + 1 >= lengths[b]:
            continue
        moved = feet[b, f + 1, foot, axis] - feet[b, f, foot, axis]
        total += moved**2 if contact[b, f, foot] else 0.0
        count += 1
    mask = jnp.arange(5)[None] < jnp.array(lengths)[:, None]
    found = losses.foot_slide_loss(jnp.asarray(feet), jnp.asarray(contact), mask)
    np.testing.assert_allclose(found, total / count, rtol=1e-5)
    last = jnp.asarray(contact).at[:, -1].set(~jnp.asarray(contact)[:, -1])
    np.testing.assert_array_equal(
        losses.foot_slide_loss(jnp.asarray(feet), last, mask), found
    )


# --- samples of different lengths ------------------------------------------------

LENGTHS = (2, 10)


def unequal():
    """Features, targets and mask of samples of `LENGTHS`."""
    generator = np.random.default_rng(2)
    prediction, target = generator.normal(size=(2, 2, 10, 6))
    return prediction, target, np.arange(10)[None] < np.array(LENGTHS)[:, None]


def test_an_error_in_the_short_sample_counts_a_half_or_its_part_of_the_frames():
    target = jnp.zeros((2, 10, 3)).at[0].set(1.0)
    given = jnp.zeros_like(target), target, jnp.asarray(unequal()[2])
    np.testing.assert_allclose(losses.masked_mse(*given), 2 / 12, rtol=1e-6)
    found = losses.masked_mse(*given, average="samples")
    np.testing.assert_allclose(found, 0.5, rtol=1e-6)


def test_means_of_samples_are_those_of_the_release():
    prediction, target, mask = unequal()
    given = tuple(jnp.asarray(x) for x in (prediction, target, mask))
    found = losses.masked_mse(*given, average="samples")
    want = reference.masked_l2(prediction, target, mask)
    np.testing.assert_allclose(found, want, rtol=1e-6)
    found = losses.velocity_loss(*given, average="samples")
    steps = (np.diff(x, axis=1) for x in (prediction, target))
    np.testing.assert_allclose(
        found, reference.masked_l2(*steps, mask[:, 1:]), rtol=1e-6
    )
    feet, truth = (x.reshape(2, 10, 2, 3) for x in (prediction, target))
    stands = np.linalg.norm(np.diff(truth, axis=1), axis=-1) <= 2.5
    assert 0.2 < stands.mean() < 0.8
    contact = jnp.asarray(np.concatenate([stands, stands[:, -1:]], axis=1))
    found = losses.foot_slide_loss(
        jnp.asarray(feet), contact, given[2], average="samples"
    )
    want = reference.foot_loss(feet, truth, (0, 1), mask, speed=2.5)
    np.testing.assert_allclose(found, want, rtol=1e-6)


@pytest.mark.parametrize("average", ["frames", "samples"])
def test_padding_changes_no_loss(average):
    """Two more frames, which do not count, with any values in them."""
    prediction, target, mask = unequal()
    feet = prediction.reshape(2, 10, 2, 3)
    contact = np.random.default_rng(3).random((2, 10, 2)) < 0.5

    def terms(*arrays):
        prediction, target, feet, contact, mask = (jnp.asarray(x) for x in arrays)
        foot = losses.foot_slide_loss(feet, contact, mask, average=average)
        return [
            losses.masked_mse(prediction, target, mask, average=average),
            losses.velocity_loss(prediction, target, mask, average=average),
            foot,
        ]

    def longer(x, value):
        return np.concatenate([x, np.full_like(x[:, :2], value)], axis=1)

    given = prediction, target, feet, contact
    padded = [longer(x, value) for x, value in zip(given, (9, -9, 9, 1), strict=True)]
    np.testing.assert_allclose(
        terms(*padded, longer(mask, False)), terms(*given, mask), rtol=1e-6
    )


@pytest.mark.slow
@pytest.mark.parametrize("levels", [1, 3])
def test_samples_are_noised_at_levels_that_are_uniform_and_apart(levels):
    table, size = schedule.cosine_schedule(4), 1200
    x_0 = jnp.full((size, 2), 3.0)
    encoded = []

    def predict(show):
        def apply(*given, method, rngs):
            if method == "encode":
                return encoded.append(given)
            _, x_t, t = given
            return show(x_t, t[:, None] + 0.0 * x_t)

        return losses.predict_clean(
            jax.random.key(0),
            x_0,
            (x_0,),
            apply=apply,
            table=table,
            levels=levels,
        )

    x_t, t = predict(lambda x, t: x), predict(lambda x, t: t)[..., 0].astype(int)
    assert len(encoded) == 2  # once a call, whatever the number of levels
    assert x_t.shape == (levels, size, 2)
    for row in t:
        counts = np.bincount(row, minlength=5)
        assert counts[0] == 0
        assert np.all(np.abs(counts[1:] - size / 4) / np.sqrt(size * 3 / 16) < 4.0)
    assert all(len(set(column)) == levels for column in t.T.tolist())
    for step in range(1, 5):
        found = np.asarray(x_t, np.float64)[np.asarray(t) == step]
        mean = np.sqrt(float(table.alpha_bar[step])) * 3.0
        z = (found - mean) / np.sqrt(float(table.one_minus_alpha_bar[step]))
        assert abs(z.mean()) * np.sqrt(z.size) < 4.0
        assert abs(z.var() - 1) * np.sqrt(z.size / 2) < 4.0


def test_each_noise_level_has_its_own_noise_and_dropout():
    def apply(*given, method, rngs):
        if method == "encode":
            return given
        return given[1] + jax.random.normal(rngs["dropout"], given[1].shape)

    keys = losses.predict_clean(
        jax.random.key(0),
        jnp.zeros((5, 2)),
        (),
        apply=apply,
        table=schedule.cosine_schedule(4),
        levels=4,
    )
    assert np.unique(np.round(keys, 5)).size == keys.size


@pytest.mark.parametrize("own", [0.0, 0.3, 1.0])
def test_lower_levels_are_noise_on_predictions_as_often_as_said(own):
    """The network predicts 100 at upper levels, and shows its input at lower ones."""
    table, size = schedule.cosine_schedule(8), 2000

    def apply(*given, method, rngs):
        if method == "encode":
            return ()
        _, x_t, t = given
        return jnp.where(t[:, None] > 4, 100.0, x_t)

    found = losses.predict_clean(
        jax.random.key(0),
        jnp.zeros((size, 1)),
        (),
        apply=apply,
        table=table,
        levels=4,
        own=own,
    )
    found = np.asarray(found[..., 0])
    upper = found == 100.0
    assert np.all(upper.sum(axis=0) == 2)
    lower = np.where(upper, 0.0, found)
    assert np.abs(lower[np.abs(lower) < 40]).max() < 6.0  # noise on the sample, 0
    own_samples = (lower > 40).sum(axis=0)  # noise on 100 sqrt(alpha_bar)
    assert set(own_samples) <= {0, 2}
    deviation = np.sqrt(own * (1 - own) / size)
    assert abs(np.mean(own_samples == 2) - own) <= 4.0 * deviation


def test_no_gradient_flows_through_own_predictions():
    table = schedule.cosine_schedule(8)
    x_0 = jnp.ones((16, 3))

    def total(params):
        def apply(*given, method, rngs):
            if method == "encode":
                return ()
            _, x_t, t = given
            upper, lower = params
            return jnp.where(t[:, None] > 4, upper, lower) * x_t

        found = losses.predict_clean(
            jax.random.key(0), x_0, (), apply=apply, table=table, levels=4, own=1.0
        )
        return jnp.sum(found[2:])

    upper, lower = jax.grad(total)((jnp.asarray(2.0), jnp.asarray(3.0)))
    assert upper == 0.0 and lower != 0.0


def test_one_level_alone_has_no_predictions_to_noise():
    with pytest.raises(ValueError, match="own levels of 0.5 need two .*, found 1"):
        losses.predict_clean(
            jax.random.key(0),
            jnp.zeros((2, 1)),
            (),
            apply=lambda *given, **options: (),
            table=schedule.cosine_schedule(4),
            own=0.5,
        )
