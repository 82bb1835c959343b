"""CAMDM's examples, losses and sampler against float64 oracles."""

import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from scipy.ndimage import gaussian_filter1d

from jaxmotion.diffusion import chain, schedule
from jaxmotion.learning import losses
from jaxmotion.motion import features, trajectory
from jaxmotion.motion.skeleton import Motion, joint_positions
from jaxmotion.systems.camdm import loss as camdm_loss
from jaxmotion.systems.camdm import model as camdm_model
from tests import tiny
from tests.reference import camdm as reference


def window_of(walker, config, start=7):
    return Motion(
        root_position=walker.root_position[start : start + config.window],
        joint_rotation=walker.joint_rotation[start : start + config.window],
        fps=walker.fps,
    )


@functools.cache
def make_examples(config):
    """Jitted: examples of one window for many keys."""

    def run(keys, skeleton, window):
        label = jnp.ones((), jnp.int32)
        return jax.vmap(
            lambda key: camdm_loss.example(key, skeleton, window, label, config=config)
        )(keys)

    return jax.jit(run)


FACING = tiny.config(heading="facing")
RANDOM = tiny.config(heading="random")
CONFIGS = pytest.mark.parametrize("config", [FACING, RANDOM], ids=["facing", "random"])


def many(count, seed=0):
    return jax.random.split(jax.random.key(seed), count)


# Sizes


@pytest.mark.parametrize(
    "network, option",
    [
        ("mlp", {"seam_half_life": 3.0}),
        ("mlp", {"frames_per_token": 2}),
        ("mlp", {"norm": "pre"}),
        ("single_token", {"attention": "prefix"}),
        ("single_token", {"frame_kernel": 3}),
    ],
)
def test_an_option_that_a_network_does_not_have_is_named(network, option):
    """Else a configuration would tell of a network that nobody trained."""
    (name, value), config = *option.items(), tiny.config(network=network, **option)
    message = f"{name} is {value}, expected .* with the network '{network}'"
    with pytest.raises(ValueError, match=message):
        camdm_model.network(config)


def test_the_papers_network():
    config = camdm_model.Config(num_joints=25, num_labels=100)
    shapes = jax.eval_shape(
        lambda key: camdm_model.init(key, config), jax.random.key(0)
    )
    assert sum(x.size for x in jax.tree.leaves(shapes)) == 3_439_260
    assert config.num_features == 156
    assert config.window == 55


@pytest.mark.parametrize("name", ["transformer", "mlp", "single_token"])
def test_networks_by_name_have_the_configs_sizes(name):
    config = tiny.config(network=name)
    net = camdm_model.network(config)
    assert name.replace("_", "") in type(net).__name__.lower()
    assert (net.past, net.future, net.width, net.features) == (4, 12, 16, 36)
    assert net.num_labels == 2


# Smoothing


@pytest.mark.parametrize("frames", [16, 55, 200])
def test_smoothing_is_scipys_filter_with_reflecting_borders(frames):
    sigmas = (0.0, 1.0, 5.0, 10.0)
    matrices = trajectory.smoothing_matrices(frames, sigmas)
    path = np.random.default_rng(0).normal(size=(frames, 2))
    for matrix, sigma in zip(matrices, sigmas, strict=True):
        expected = path
        if sigma:
            expected = gaussian_filter1d(path, sigma, axis=0, mode="reflect")
        np.testing.assert_allclose(np.asarray(matrix) @ path, expected, atol=1e-5)


# Examples


@pytest.mark.slow
@CONFIGS
def test_the_last_past_pose_is_at_the_origin_and_heights_stay(walker, skeleton, config):
    window = window_of(walker, config)
    condition, x_0 = make_examples(config)(many(8), skeleton, window)
    poses = jnp.concatenate([condition.past, x_0], axis=1)
    motion = features.motion_from_features(poses, config.fps)
    last = motion.root_position[:, config.past - 1]
    np.testing.assert_allclose(last[:, ::2], 0.0, atol=1e-6)
    for height in motion.root_position[..., 1]:
        np.testing.assert_allclose(height, window.root_position[:, 1], atol=1e-6)
    facing = trajectory.root_trajectory(skeleton, motion).facing[:, config.past - 1]
    yaw = np.arctan2(facing[:, 0], facing[:, 1])
    if config.heading == "facing":
        np.testing.assert_allclose(yaw, 0.0, atol=1e-5)
    else:
        assert np.ptp(yaw) > 1.0


@CONFIGS
def test_an_example_is_the_window_moved_as_a_whole(walker, skeleton, config):
    """Distances between all joints of all frames are those of the window."""
    window = window_of(walker, config)
    condition, x_0 = make_examples(config)(many(8), skeleton, window)
    poses = np.concatenate([condition.past[3], x_0[3]])
    places = reference.joint_positions(
        skeleton.offsets, skeleton.parents, poses, config.rotation_layout
    ).reshape(-1, 3)
    original = np.asarray(joint_positions(skeleton, window)).reshape(-1, 3)
    distances = lambda x: np.linalg.norm(x[:, None] - x[None], axis=-1)  # noqa: E731
    np.testing.assert_allclose(distances(places), distances(original), atol=1e-5)


def test_random_yaws_are_uniform(walker, skeleton):
    condition, x_0 = make_examples(RANDOM)(
        many(512), skeleton, window_of(walker, RANDOM)
    )
    yaw = np.arctan2(x_0[:, -1, -6], x_0[:, -1, -4])
    for k in (1, 2):
        # The mean of n unit vectors of random direction has variance 1 / n.
        assert abs(np.exp(1j * k * yaw).mean()) * np.sqrt(512) < 4.0


def test_a_facing_example_does_not_see_where_the_world_is(walker, skeleton):
    window = window_of(walker, FACING)
    for seed in range(3):
        x, z, yaw = np.random.default_rng(seed).normal(size=3) * 5
        frame = trajectory.PlanarFrame(
            origin=jnp.array([x, z], jnp.float32),
            facing=jnp.array([np.sin(yaw), np.cos(yaw)], jnp.float32),
        )
        moved = features.from_frame(window, frame)
        expected = make_examples(FACING)(many(8), skeleton, window)
        found = make_examples(FACING)(many(8), skeleton, moved)
        for a, b in zip(jax.tree.leaves(found), jax.tree.leaves(expected), strict=True):
            np.testing.assert_allclose(a, b, atol=3e-5)


def test_paths_and_facings_are_smoothed_as_often_as_they_should(walker, skeleton):
    """Each of 512 examples is one of the six; how often is binomial."""
    count = 512
    window = window_of(walker, FACING, start=200)
    condition, _ = make_examples(FACING)(many(count), skeleton, window)
    course = trajectory.root_trajectory(skeleton, window)
    last = FACING.past - 1
    position, facing = (
        np.asarray(x, np.float64) for x in (course.position, course.facing)
    )
    z = facing[last]
    axes = np.stack([[z[1], -z[0]], z])  # the frame's +x and +z

    def smoothed(x, sigma):
        return gaussian_filter1d(x, sigma, axis=0, mode="reflect") if sigma else x

    paths = [smoothed(position, sigma) for sigma in (0, 5, 10)]
    paths = [(path - path[last])[FACING.past :] @ axes.T for path in paths]
    facings = [smoothed(facing, sigma)[FACING.past :] for sigma in (5, 10)]
    facings = [
        (f / np.linalg.norm(f, axis=-1, keepdims=True)) @ axes.T for f in facings
    ]

    def which(found, options):
        gaps = np.stack([np.abs(found - x).max(axis=(1, 2)) for x in options])
        assert gaps.min(axis=0).max() < 1e-5
        return np.bincount(gaps.argmin(axis=0), minlength=len(options))

    chances = [(0.5, 0.25, 0.25), (0.5, 0.5)]
    found = [
        which(np.asarray(condition.trajectory.position), paths),
        which(np.asarray(condition.trajectory.facing), facings),
    ]
    for counts, chance in zip(found, chances, strict=True):
        for n, p in zip(counts, chance, strict=True):
            assert abs(n - count * p) / np.sqrt(count * p * (1 - p)) < 4.0
    kept = int(np.sum(condition.keep_past))
    assert abs(kept - 0.85 * count) / np.sqrt(count * 0.85 * 0.15) < 4.0
    assert np.all(np.asarray(condition.label) == 1)


@pytest.mark.parametrize("layout", ["rows", "columns"])
def test_facings_reach_the_network_as_rotations_about_y(layout):
    config = tiny.config(rotation_layout=layout)
    yaw = np.linspace(-3, 3, config.future)
    condition = camdm_model.Condition(
        past=jnp.zeros((config.past, config.num_features)),
        trajectory=trajectory.Trajectory(
            position=jnp.zeros((config.future, 2)),
            facing=jnp.asarray(np.stack([np.sin(yaw), np.cos(yaw)], -1), jnp.float32),
        ),
        label=jnp.zeros((), jnp.int32),
        keep_past=jnp.ones((), bool),
    )
    rot6d = np.asarray(condition.arguments(config)[2])
    for angle, six in zip(yaw, rot6d, strict=True):
        c, s = np.cos(angle), np.sin(angle)
        matrix = np.array([[c, 0, s], [0, 1, 0], [-s, 0, c]])
        expected = matrix[:2] if layout == "rows" else matrix[:, :2].T
        np.testing.assert_allclose(six.reshape(2, 3), expected, atol=1e-6)


# Losses


@functools.cache
def terms(config):
    return jax.jit(functools.partial(camdm_loss.loss_terms, config=config))


def batch_features(skeleton, walker, config):
    starts = (3, 30, 200, 250)
    poses = [
        features.motion_features(
            window_of(walker, config, start), rotation_layout=config.rotation_layout
        )
        for start in starts
    ]
    return jnp.stack(poses)


@pytest.mark.parametrize(
    ("layout", "scale"), [("rows", 1.0), ("columns", 1.0), ("rows", 4.0)]
)
def test_loss_terms_are_the_oracles(walker, skeleton, layout, scale):
    """Whatever the factor on the rotations, losses are of the rotations themselves."""
    config = tiny.config(rotation_layout=layout, contact_speed=1.2)
    target = batch_features(skeleton, walker, config)
    noise = np.random.default_rng(0).normal(0, 0.2, target.shape)
    prediction = target + jnp.asarray(noise, jnp.float32)
    scaled = dataclasses.replace(config, rotation_scale=scale)
    enlarge = lambda x: x.at[..., :-6].multiply(scale)  # noqa: E731
    found = terms(scaled)(skeleton, enlarge(prediction), enlarge(target))
    expected = reference.loss_terms(
        np.asarray(skeleton.offsets, np.float64),
        skeleton.parents,
        skeleton.feet,
        np.asarray(prediction, np.float64),
        np.asarray(target, np.float64),
        layout=layout,
        fps=config.fps,
        speed=config.contact_speed,
    )
    assert found.keys() == expected.keys()
    for name, value in expected.items():
        assert value > 1e-5, name
        np.testing.assert_allclose(found[name], value, rtol=1e-4, err_msg=name)


def camdm_turned(skeleton, window, frame, layout):
    """Rotations of one pose, turned so that it faces +z."""
    pose = jax.tree.map(lambda x: x[frame : frame + 1], window)
    facing = trajectory.root_trajectory(skeleton, pose).facing[0]
    here = trajectory.PlanarFrame(origin=jnp.zeros(2), facing=facing)
    local = features.to_frame(pose, here)
    return features.motion_features(local, rotation_layout=layout)[0, :-6]


@pytest.mark.parametrize("layout", ["rows", "columns"])
@pytest.mark.parametrize("centered", [True, False])
def test_features_and_back(walker, skeleton, layout, centered):
    config = tiny.config(rotation_layout=layout, rotation_scale=3.0, heading="facing")
    window, mean = window_of(walker, config), np.zeros(30)
    if centered:
        found = camdm_loss.mean_rotations(skeleton, window, config=config)
        config = dataclasses.replace(config, rotation_mean=found)
        mean = np.mean(
            [
                np.asarray(camdm_turned(skeleton, window, frame, layout))
                for frame in range(config.window)
            ],
            axis=0,
        )
        np.testing.assert_allclose(found, mean, atol=2e-5)
    poses = camdm_model.to_features(window, config=config)
    plain = features.motion_features(window, rotation_layout=layout)
    expected = 3.0 * (plain[:, :-6] - jnp.broadcast_to(mean, (config.window, 30)))
    np.testing.assert_allclose(poses[:, :-6], expected, atol=1e-4)
    np.testing.assert_array_equal(poses[:, -6:], plain[:, -6:])
    found = camdm_model.to_motion(poses, config=config)
    for field in ("root_position", "joint_rotation"):
        np.testing.assert_allclose(
            getattr(found, field), getattr(window, field), atol=1e-6
        )
    assert found.fps == config.fps


def test_losses_are_zero_at_the_target(walker, skeleton):
    target = batch_features(skeleton, walker, FACING)
    found = terms(FACING)(skeleton, target, target)
    for name in ("data", "velocity", "position", "position_velocity"):
        assert found[name] == 0, name
    still = jnp.repeat(target[:, :1], target.shape[1], axis=1)
    assert all(value == 0 for value in terms(FACING)(skeleton, still, still).values())


def test_gradients_at_the_target_are_finite(walker, skeleton):
    """Where a norm or a Gram-Schmidt of nothing could give NaN."""
    target = batch_features(skeleton, walker, FACING)
    total = jax.jit(
        jax.grad(
            lambda p: sum(
                camdm_loss.loss_terms(skeleton, p, target, config=FACING).values()
            )
        )
    )
    for prediction in (target, jnp.zeros_like(target)):
        assert np.isfinite(total(prediction)).all()


class Recorder:
    """In the network's place: predicts zero, remembers what it was asked."""

    def apply(self, variables, *args, method, train, rngs):
        self.train = train
        if method == "encode":
            self.condition = args
            return ()
        context, x_t, t = args
        assert context == () and t.shape == x_t.shape[:1]
        return jnp.zeros_like(x_t)


def test_the_loss_weighs_its_terms(walker, skeleton, monkeypatch):
    recorder = Recorder()
    monkeypatch.setattr(camdm_loss, "network", lambda config: recorder)
    weights = dict(
        data=2, velocity=3, position=5, position_velocity=7, acceleration=13, foot=11
    )
    config = tiny.config(**{f"weight_{k}": float(v) for k, v in weights.items()})
    windows = jax.tree.map(lambda x: x[None], window_of(walker, config))
    batch = (windows, jnp.zeros(1, jnp.int32))

    def run(key):
        value, parts = camdm_loss.loss({}, key, batch, skeleton=skeleton, config=config)
        return value, parts, recorder.condition

    value, parts, condition = jax.jit(run)(jax.random.key(0))
    expected = sum(weights[name] * float(part) for name, part in parts.items())
    np.testing.assert_allclose(value, expected, rtol=1e-5)
    assert recorder.train is False
    assert len(condition) == 5


@pytest.mark.slow
@pytest.mark.parametrize("keep", [True, False])
def test_losses_reach_over_the_seam_as_far_as_the_past_is_kept(walker, skeleton, keep):
    """Displacements and feet are the oracle's, of two past frames and the future."""
    config = tiny.config(seam_half_life=3.0, contact_speed=1.2)
    whole = batch_features(skeleton, walker, config)
    past, target = whole[:, : config.past], whole[:, config.past :]
    noise = np.random.default_rng(0).normal(0, 0.2, (3, *target.shape))
    predictions = target[None] + jnp.asarray(noise, jnp.float32)
    condition = camdm_model.Condition(
        past=past,
        trajectory=trajectory.Trajectory(
            position=jnp.zeros((*target.shape[:-1], 2)),
            facing=jnp.zeros((*target.shape[:-1], 2)),
        ),
        label=jnp.zeros(len(past), jnp.int32),
        keep_past=jnp.full(len(past), keep),
    )
    found = jax.jit(functools.partial(camdm_loss.seam_terms, config=config))(
        skeleton, predictions, target, condition
    )
    joined = [
        np.concatenate([past[:, -2:], x], axis=1) if keep else np.asarray(x)
        for x in (*predictions, target)
    ]
    for level in range(3):
        expected = reference.loss_terms(
            np.asarray(skeleton.offsets, np.float64),
            skeleton.parents,
            skeleton.feet,
            joined[level].astype(np.float64),
            joined[-1].astype(np.float64),
            layout=config.rotation_layout,
            fps=config.fps,
            speed=config.contact_speed,
        )
        for name, value in expected.items():
            np.testing.assert_allclose(found[name][level], value, rtol=2e-4)


def test_dropout_is_on_in_training(walker, skeleton, monkeypatch):
    recorder = Recorder()
    monkeypatch.setattr(camdm_loss, "network", lambda config: recorder)
    config = tiny.config(dropout=0.1)
    windows = jax.tree.map(lambda x: x[None], window_of(walker, config))
    batch = (windows, jnp.zeros(1, jnp.int32))
    jax.eval_shape(
        lambda key: camdm_loss.loss({}, key, batch, skeleton=skeleton, config=config)[
            0
        ],
        jax.random.key(0),
    )
    assert recorder.train is True


def test_the_position_term_is_a_mean_over_xyz(walker, skeleton):
    """A root 0.5 m too high is wrong in one coordinate of three, at every joint."""
    target = batch_features(skeleton, walker, FACING)
    lifted = target.at[..., -5].add(0.5)
    found = terms(FACING)(skeleton, lifted, target)
    np.testing.assert_allclose(found["position"], 0.25 / 3, rtol=1e-4)
    every = jnp.ones(target.shape[:-1], bool)
    np.testing.assert_allclose(
        found["data"], losses.masked_mse(lifted, target, every), rtol=1e-6
    )


# Sampler


def condition_of(walker, skeleton, config, key=0):
    condition, _ = jax.jit(functools.partial(camdm_loss.example, config=config))(
        jax.random.key(key),
        skeleton,
        window_of(walker, config),
        jnp.ones((), jnp.int32),
    )
    return dataclasses.replace(condition, keep_past=jnp.ones((), bool))


@functools.cache
def plan_of(config, step=chain.ancestral_step, guided=False):
    def run(params, key, condition, scale):
        plan = camdm_model.sampler(params, config=config, step=step)
        return plan(key, condition, scale=scale if guided else None)

    return jax.jit(run)


@pytest.fixture(scope="module")
def situation(walker, skeleton):
    return condition_of(walker, skeleton, FACING)


@pytest.mark.parametrize("scale", [None, 0.7])
def test_a_plan_is_the_oracles_chain(params, situation, scale):
    """Posterior coefficients in float64, one plain call of the network a step."""
    config = FACING
    net = camdm_model.network(config)
    past, path, facing, label, _ = situation.arguments(config)
    call = jax.jit(
        lambda params, x, t, keep: net.apply(
            {"params": params}, x, t, past, path, facing, label, keep
        )
    )

    def predict(x, t, keep):
        x = jnp.asarray(x, jnp.float32)
        return np.asarray(call(params, x, jnp.int32(t), jnp.bool_(keep)), np.float64)

    key_start, key_chain = jax.random.split(jax.random.key(5))
    shape = (config.future, config.num_features)
    noise = {}
    for t in range(1, config.num_steps + 1):
        _, key_noise = jax.random.split(jax.random.fold_in(key_chain, t))
        noise[t] = np.asarray(jax.random.normal(key_noise, shape), np.float64)
    start = np.asarray(jax.random.normal(key_start, shape), np.float64)
    expected = reference.sample(predict, start, noise, config.num_steps, scale)
    found = plan_of(config, guided=scale is not None)(
        params, jax.random.key(5), situation, 0.0 if scale is None else scale
    )
    np.testing.assert_allclose(found, expected, atol=2e-5)


def test_guidance_with_scale_one_is_none_and_with_zero_forgets_the_past(
    params, situation
):
    free = plan_of(FACING)(params, jax.random.key(1), situation, 0.0)
    guided = plan_of(FACING, guided=True)
    np.testing.assert_allclose(
        guided(params, jax.random.key(1), situation, 1.0), free, atol=1e-5
    )
    without = dataclasses.replace(situation, keep_past=jnp.zeros((), bool))
    null = plan_of(FACING)(params, jax.random.key(1), without, 0.0)
    np.testing.assert_allclose(
        guided(params, jax.random.key(1), situation, 0.0), null, atol=1e-5
    )
    assert np.abs(null - free).max() > 1e-3
    assert np.abs(guided(params, jax.random.key(1), situation, 0.7) - free).max() > 1e-3


def test_a_batch_of_plans_is_its_plans(params, situation):
    keys = jax.vmap(jax.random.key)(jnp.arange(3))
    other = dataclasses.replace(situation, label=jnp.zeros((), jnp.int32))
    batch = jax.tree.map(lambda *x: jnp.stack(x), situation, other, situation)

    def run(params, keys, batch):
        return jax.vmap(camdm_model.sampler(params, config=FACING))(keys, batch)

    plans = jax.jit(run)(params, keys, batch)
    for i, condition in enumerate((situation, other)):
        alone = plan_of(FACING)(params, jax.random.key(i), condition, 0.0)
        np.testing.assert_allclose(plans[i], alone, atol=1e-5)
    assert np.abs(plans[0] - plans[2]).max() > 1e-2


def test_ddim_draws_no_noise_after_the_start(params, situation):
    found = plan_of(FACING, step=chain.ddim_step)(
        params, jax.random.key(1), situation, 0.0
    )
    other = plan_of(FACING)(params, jax.random.key(1), situation, 0.0)
    assert np.isfinite(found).all()
    assert np.abs(found - other).max() > 1e-3


def test_a_table_sets_the_number_of_steps(params, situation):
    calls = []

    def run(params, key, condition):
        table = schedule.cosine_schedule(2)
        plan = camdm_model.sampler(params, config=FACING, table=table)
        calls.append(jax.make_jaxpr(plan)(key, condition))
        return plan(key, condition)

    jax.eval_shape(run, params, jax.random.key(0), situation)
    lengths = {
        equation.params["length"]
        for equation in calls[0].jaxpr.eqns
        if equation.primitive.name == "scan"
    }
    assert lengths == {2}


@pytest.mark.slow
def test_steps_of_the_table_are_visited_and_told(params, situation):
    keys = jax.random.key(1)
    steps = tuple(range(1, FACING.num_steps + 1))
    sample = lambda **more: jax.jit(  # noqa: E731
        camdm_model.sampler(params, config=FACING, **more)
    )
    # The checker of keys cannot follow constants into nested calls (jax 0.10).
    with jax.debug_key_reuse(False):
        whole = sample()(keys, situation)
        np.testing.assert_allclose(
            sample(steps=steps)(keys, situation), whole, atol=1e-4
        )
        short = sample(steps=steps[-1:])(keys, situation)
    assert np.isfinite(short).all() and np.abs(short - whole).max() > 1e-3


def test_parameters_as_constants_give_the_same_plan(params, situation):
    expected = plan_of(FACING)(params, jax.random.key(1), situation, 0.0)
    # The checker of keys cannot follow constants into nested calls (jax 0.10).
    with jax.debug_key_reuse(False):
        constant = jax.jit(camdm_model.sampler(params, config=FACING))
        np.testing.assert_allclose(
            constant(jax.random.key(1), situation), expected, atol=1e-5
        )
