"""What AAMDM's networks predict at each step, against errors that are known."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxmotion.systems.aamdm import levels
from jaxmotion.systems.aamdm import model as aamdm_model

FEATURES, PAIRS = 6, 400
STEPS = (
    *("generator, t = 5", "generator, t = 4", "generator, t = 3"),
    *("polisher, t = 2", "polisher, t = 1"),
)
BEFORE, MEAN = "the frame before", "the mean of all frames"


@pytest.fixture(scope="module")
def frames():
    """Frames of unit variance and those after them; each channel changes otherwise."""
    random = np.random.default_rng(3)
    previous = random.normal(size=(PAIRS, FEATURES))
    change = random.normal(size=(PAIRS, FEATURES)) * np.linspace(0.1, 0.6, FEATURES)
    return previous, previous + change


def table_of(frames, predict, params=None, **more):
    config = aamdm_model.Config(
        features=FEATURES, width=16, depth=1, latent=4, predict=predict
    )
    scale = np.std(frames[1] - frames[0], axis=0)
    params = params or aamdm_model.init(jax.random.key(0), config)
    change = jnp.asarray(scale, jnp.float32) if predict == "change" else None
    given = (jnp.asarray(x, jnp.float32) for x in frames)
    key = jax.random.key(1)
    return levels.level_table(params, key, *given, config=config, change=change, **more)


def error(frames, guess):
    """Root mean square of a guess's error, over that of the frame before; float64."""
    previous, frame = frames
    unit = np.std(frame - previous, axis=0)
    size = lambda x: np.sqrt(np.mean((x / unit) ** 2))  # noqa: E731
    return size(guess - frame) / size(previous - frame)


def silent():
    """Networks whose outputs are zero."""
    config = aamdm_model.Config(features=FEATURES, width=16, depth=1, latent=4)
    params = aamdm_model.init(jax.random.key(0), config)
    return jax.tree.map(jnp.zeros_like, params)


@pytest.mark.slow
@pytest.mark.parametrize("predict", ["frame", "change"])
def test_networks_that_say_nothing_are_at_the_mean_or_at_the_frame_before(
    frames, predict
):
    rows = table_of(frames, predict, params=silent())
    assert tuple(rows) == (*STEPS, BEFORE, MEAN)
    wanted = 1.0 if predict == "change" else error(frames, np.zeros_like(frames[1]))
    for name in STEPS:
        cells = rows[name]
        np.testing.assert_allclose(cells["frame_error"].value, wanted, rtol=1e-5)
        np.testing.assert_allclose(cells["frame_over_latents"].value, 0, atol=1e-6)
        assert cells["frame_error"].samples == PAIRS
    assert rows[BEFORE]["frame_error"].value == pytest.approx(1)
    mean = error(frames, frames[1].mean(0))
    np.testing.assert_allclose(rows[MEAN]["frame_error"].value, mean, rtol=1e-5)


def test_channels_that_never_change_are_left_out(frames):
    """As a full pose has them: the rows are of the others alone."""
    still = [np.column_stack([x[:, :-1], np.full(PAIRS, 0.5)]) for x in frames]
    rows = table_of(still, "frame", params=silent())
    assert rows[BEFORE]["frame_error"].value == pytest.approx(1)
    others = [x[:, :-1] for x in frames]
    for name, guess in ((STEPS[0], 0.0), (MEAN, others[1].mean(0))):
        wanted = error(others, np.broadcast_to(guess, others[1].shape))
        np.testing.assert_allclose(rows[name]["frame_error"].value, wanted, rtol=1e-5)


def test_drafts_spread_over_latents_and_their_mean_errs_by_what_is_left(
    frames, monkeypatch
):
    """Drafts that are the frame and noise of two changes: a closed form."""
    previous, frame = (jnp.asarray(x, jnp.float32) for x in frames)
    unit = jnp.std(frame - previous, axis=0, keepdims=True)

    def draft(params, given, *, config, change):
        del params, given, config, change

        def denoise(key, x_t, t, /):
            return frame + 2.0 * unit * jax.random.normal(key, x_t.shape)

        return denoise

    monkeypatch.setattr(levels.aamdm_model, "draft", draft)
    latents = 8
    rows = table_of(frames, "frame", latents=latents)
    one = np.sqrt(np.mean(((frames[1] - frames[0]) / np.asarray(unit)) ** 2))
    for name in STEPS[:3]:
        found = {k: cell.value for k, cell in rows[name].items()}
        left = 2 / one / np.sqrt(latents)
        assert found["frame_error"] == pytest.approx(left, rel=0.06)
        around = 2 / one * np.sqrt(1 - 1 / latents)
        assert found["frame_over_latents"] == pytest.approx(around, rel=0.03)
    assert rows["polisher, t = 1"]["frame_over_latents"].value == 0


def test_steps_that_a_held_frame_takes_have_no_row(frames):
    rows = table_of(frames, "frame", params={"polisher": silent()["polisher"]})
    assert tuple(rows) == (*STEPS[3:], BEFORE, MEAN)
