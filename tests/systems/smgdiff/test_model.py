"""SMGDiff's motion model: features, losses, and where contact guidance acts."""

import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxmotion.motion import rotation, trajectory
from jaxmotion.motion.ball import Scene
from jaxmotion.motion.skeleton import Skeleton
from jaxmotion.systems.smgdiff import guidance as smgdiff_guidance
from jaxmotion.systems.smgdiff import loss as smgdiff_loss
from jaxmotion.systems.smgdiff import model as smgdiff_model
from jaxmotion.systems.smgdiff import scene as smgdiff_scene
from jaxmotion.systems.smgdiff.guidance import UNGUIDED, Guidance
from tests import ball_walker, tiny

FEET = (2, 4)


def as_jax(scene):
    return jax.tree.map(jnp.asarray, scene)


@pytest.fixture(scope="module")
def scenes():
    """Windows of 16 frames, seen from their fourth."""
    whole = [ball_walker.scene(16, speed=s, turn=s, start=s) for s in (0.6, 1.0, 1.4)]
    return jax.tree.map(lambda *x: jnp.stack(x), *[local(as_jax(w)) for w in whole])


def local(scene):
    past = jax.tree.map(lambda x: x[:4], scene.motion)
    return smgdiff_scene.to_frame(
        scene, smgdiff_scene.plan_frame(tiny.skeleton(), past)
    )


@pytest.fixture(scope="module")
def representation(scenes):
    return smgdiff_scene.fit(tiny.skeleton(), scenes, joints=FEET, radius=0.11)


@pytest.fixture(scope="module")
def config(representation):
    return smgdiff_model.Config(
        num_features=representation.normalizer.mean.size,
        num_labels=2,
        past=4,
        future=12,
        num_steps=4,
        width=16,
        depth=1,
        heads=2,
        hidden=32,
        dropout=0.0,
    )


@pytest.fixture(scope="module")
def params(config):
    return tiny.random_params(smgdiff_model.init, config, seed=3)


@pytest.fixture(scope="module")
def condition(scenes, representation, config):
    scene = jax.tree.map(lambda x: x[0], scenes)
    course = trajectory.root_trajectory(tiny.skeleton(), scene.motion)
    return smgdiff_loss.situation(
        scene, course, jnp.int32(1), representation=representation, config=config
    )[0]


def test_smpl_with_four_feet_has_162_channels():
    """147 of the body, 7 of the ball, 4 + 4 contacts (FACTS 4.2)."""
    skeleton = Skeleton(
        offsets=jnp.zeros((24, 3)),
        parents=(-1, *range(23)),
        names=tuple(f"j{i}" for i in range(24)),
        feet=(7, 8, 10, 11),
    )
    names = smgdiff_scene.feature_layout(skeleton, (7, 8, 10, 11))
    assert names.size == 162
    assert dict((n, (a, b)) for n, a, b in names.fields)["ball"] == (147, 154)


@pytest.mark.slow
def test_a_scene_comes_back_from_its_features(scenes, representation):
    x = smgdiff_scene.to_features(scenes, representation)
    found, stands = smgdiff_scene.to_scene(x, scenes.ball[:, 0], representation)
    np.testing.assert_allclose(found.ball, scenes.ball, atol=2e-6)
    np.testing.assert_allclose(
        found.motion.root_position, scenes.motion.root_position, atol=2e-6
    )
    np.testing.assert_allclose(
        rotation.matrix_from_rot6d(found.motion.joint_rotation),
        rotation.matrix_from_rot6d(scenes.motion.joint_rotation),
        atol=1e-5,
    )
    np.testing.assert_allclose(found.touch, scenes.touch, atol=1e-6)
    feet = tiny.positions(tiny.skeleton(), scenes.motion)[..., FEET, :]
    speed = np.linalg.norm(np.diff(np.float64(feet), axis=1), axis=-1) * 30
    inner = np.asarray(stands)[:, :-1]
    clear = np.abs(speed - 0.3) > 1e-3
    np.testing.assert_allclose(inner[clear], (speed <= 0.3)[clear], atol=1e-5)


def test_features_do_not_know_where_in_the_world(representation):
    scene = as_jax(ball_walker.scene(16, speed=1.0, turn=0.5))
    frame = trajectory.PlanarFrame(
        origin=jnp.array([3.0, -8.0]), facing=jnp.array([0.6, -0.8])
    )
    moved = smgdiff_scene.from_frame(scene, frame)
    assert float(jnp.abs(moved.ball - scene.ball).max()) > 3.0
    found, expected = (
        smgdiff_scene.to_features(local(x), representation) for x in (moved, scene)
    )
    np.testing.assert_allclose(found, expected, atol=2e-4)


def test_a_scene_goes_into_a_frame_and_back():
    scene = as_jax(ball_walker.scene(16, speed=1.0))
    frame = trajectory.PlanarFrame(
        origin=jnp.array([3.0, -8.0]), facing=jnp.array([0.6, -0.8])
    )
    there = smgdiff_scene.to_frame(scene, frame)
    back = smgdiff_scene.from_frame(there, frame)
    np.testing.assert_allclose(back.ball, scene.ball, atol=2e-6)
    gap = lambda x: jnp.linalg.norm(x.ball - x.motion.root_position, axis=-1)  # noqa: E731
    np.testing.assert_allclose(gap(there), gap(scene), atol=2e-6)


def test_features_are_standardized_by_kind(scenes, representation):
    x = np.float64(smgdiff_scene.to_features(scenes, representation))
    rotations = x[..., 3:33].reshape(-1, 30)
    np.testing.assert_allclose(np.mean(x.reshape(-1, x.shape[-1]), 0), 0, atol=1e-5)
    std = np.asarray(representation.normalizer.std)
    unit = max((rotations * std[3:33]).std(0).mean(), 0.05)
    np.testing.assert_allclose(std[3:33], unit, rtol=1e-4)
    assert std[0] == std[2] and np.unique(std[3:33]).size == 1
    assert (std >= 0.05).all()


@pytest.mark.parametrize(
    ("start", "end", "expected"),
    [
        (0, 0, [(False, 8, 0)]),
        (0, 2, [(False, 8, 2), (True, 2, 0)]),
        (1, 0, [(True, 8, 7), (False, 7, 0)]),
        (1, 1, [(True, 8, 7), (False, 7, 1), (True, 1, 0)]),
        (4, 4, [(True, 8, 4), (True, 4, 0)]),
    ],
)
def test_schedules_cut_the_chain(start, end, expected):
    guided = Guidance(start=start, end=end)
    assert list(smgdiff_guidance.segments(guided, 8)) == expected


@pytest.mark.parametrize(("start", "end"), [(5, 4), (-1, 2), (9, 0)])
def test_more_guided_steps_than_steps_are_refused(start, end):
    with pytest.raises(ValueError, match="expected at most 8 in all"):
        smgdiff_guidance.segments(Guidance(start=start, end=end), 8)


def plans(params, config, representation, condition, guided):
    plan = smgdiff_guidance.sampler(
        params, config=config, representation=representation, guided=guided
    )
    keys = jax.random.split(jax.random.key(5), 6)
    return plan, jax.jit(jax.vmap(plan, (0, None)))(keys, condition)


@pytest.fixture(scope="module")
def plain(params, config, representation, condition):
    """Plans that nothing guides."""
    return plans(params, config, representation, condition, UNGUIDED)[1]


@pytest.mark.slow
def test_nothing_to_guide_is_the_plain_chain(
    params, config, representation, condition, plain
):
    """No ball accelerates that much: the objective is zero everywhere."""
    idle = Guidance(end=2, min_acceleration=1e9)
    found = plans(params, config, representation, condition, idle)[1]
    np.testing.assert_allclose(found, plain, atol=1e-5)


@pytest.mark.slow
def test_guidance_pulls_foot_and_ball_together(
    params, config, representation, condition, plain
):
    """Against the unguided plans of the same noise, one by one."""
    on = Guidance(end=2, last_sigma=0.02, min_acceleration=2.0)
    objective = jax.vmap(
        smgdiff_guidance.contact_objective(
            condition.ball, representation=representation, guided=on
        )
    )
    given = (params, config, representation, condition)
    guided = np.asarray(objective(plans(*given, on)[1]))
    free = np.asarray(objective(plain))
    assert (free > 0).all()
    assert (guided < free).sum() >= 5


@pytest.mark.slow
def test_guided_plans_are_finite_and_the_same_alone(
    params, config, representation, condition
):
    given = (params, config, representation, condition)
    plan, batch = plans(*given, Guidance(start=1, end=2))
    assert bool(jnp.isfinite(batch).all())
    key = jax.random.split(jax.random.key(5), 6)[2]
    np.testing.assert_allclose(jax.jit(plan)(key, condition), batch[2], atol=2e-4)


@pytest.mark.slow
def test_a_guided_plan_can_be_differentiated(params, config, representation, condition):
    plan = smgdiff_guidance.sampler(
        params, config=config, representation=representation, guided=Guidance(end=1)
    )

    def far(ball):
        changed = dataclasses.replace(condition, ball=ball)
        return jnp.sum(plan(jax.random.key(2), changed) ** 2)

    gradient = jax.jit(jax.grad(far))(condition.ball)
    assert bool(jnp.isfinite(gradient).all())


@pytest.mark.slow
def test_the_truth_costs_nothing_but_its_own_slide(scenes, representation):
    x = smgdiff_scene.to_features(scenes, representation)
    terms = smgdiff_loss.loss_terms(x, x, representation=representation)
    assert set(terms) == {
        *("data", "velocity", "position", "position_velocity", "acceleration"),
        *("foot", "ball", "ball_acceleration"),
    }
    for name in set(terms) - {"foot"}:
        assert float(terms[name]) == pytest.approx(0.0, abs=1e-9)


@pytest.fixture(scope="module")
def loss_terms(representation):
    """One program of a prediction and its target."""
    terms = functools.partial(smgdiff_loss.loss_terms, representation=representation)
    return jax.jit(terms)


@pytest.fixture(scope="module")
def to_features(representation):
    """One program of scenes."""
    return jax.jit(
        functools.partial(smgdiff_scene.to_features, representation=representation)
    )


def test_a_ball_that_trembles_costs_its_second_differences(
    scenes, loss_terms, to_features
):
    """Every other frame a centimeter higher: differences of 2 cm in each triple."""
    near = dataclasses.replace(
        scenes, ball=scenes.motion.root_position + jnp.array([[[0.3, -0.7, 0.4]]])
    )
    up = jnp.zeros_like(near.ball).at[:, 1::2, 1].set(0.01)
    trembling = dataclasses.replace(near, ball=near.ball + up)
    x, y = map(to_features, (near, trembling))
    terms = loss_terms(y, x)
    frames = near.ball.shape[-2]
    part_up = (frames // 2) / frames
    assert float(terms["ball"]) == pytest.approx(part_up * 1e-4 / 3, rel=1e-2)
    assert float(terms["ball_acceleration"]) == pytest.approx(4e-4 / 3, rel=1e-2)


def test_a_ball_that_is_far_away_costs_nothing_of_its_own(
    scenes, loss_terms, to_features
):
    far = dataclasses.replace(
        scenes, ball=scenes.motion.root_position + jnp.array([[[1.7, 0.0, 0.0]]])
    )
    x = to_features(far)
    terms = loss_terms(1.1 * x, x)
    assert float(terms["ball"]) == float(terms["ball_acceleration"]) == 0.0


def test_the_data_say_which_balls_are_near_and_which_feet_stand(
    scenes, representation, loss_terms, to_features
):
    """Who predicts a ball beyond the reach, or no contact, pays for it all the same."""

    def beside(places):
        moved = scenes.motion.root_position + jnp.asarray([places], jnp.float32)
        return to_features(dataclasses.replace(scenes, ball=moved))

    frames = scenes.ball.shape[1]
    near, far = [[0.3, -0.7, 0.4]] * frames, [[1.7, 0.0, 0.0]] * frames
    x = beside(near)
    # A control weight of .15, which counts as .2.
    error = np.array([1.7 * 0.15 / 0.2 - 0.3, 0.7, -0.4])
    found = float(loss_terms(beside(far), x)["ball"])
    assert found == pytest.approx(np.mean(error**2), rel=1e-3)
    # Nothing of a far ball counts, also not beside a near one.
    comes = far[:6] + near[6:]
    strays = far[:5] + [[1.9, 0.3, 0.0]] + near[6:]
    terms = loss_terms(beside(strays), beside(comes))
    assert float(terms["ball"]) == pytest.approx(0.0, abs=1e-9)
    assert float(terms["ball_acceleration"]) == pytest.approx(0.0, abs=1e-9)
    layout = smgdiff_scene.feature_layout(
        representation.skeleton, representation.joints
    )
    ((start, stop),) = [(a, b) for name, a, b in layout.fields if name == "ground"]
    own, lifted = (
        float(loss_terms(guess, x)["foot"])
        for guess in (x, x.at[..., start:stop].set(-9.0))
    )
    assert own > 1e-9 and lifted == pytest.approx(own, rel=1e-6)


def test_a_shifted_person_costs_its_shift(
    scenes, representation, loss_terms, to_features
):
    """Ten centimeters along x: a third of 0.01 square meters in every joint."""
    x = to_features(scenes)
    std = representation.normalizer.std[0]
    shifted = x.at[..., 0].add(0.1 / std)
    terms = loss_terms(shifted, x)
    assert float(terms["position"]) == pytest.approx(0.01 / 3, rel=1e-3)
    assert float(terms["data"]) == pytest.approx(
        (0.1 / float(std)) ** 2 / x.shape[-1], rel=1e-3
    )
    assert float(terms["velocity"]) == pytest.approx(0.0, abs=1e-9)


def test_errors_of_rotations_may_count_less(representation, to_features, scenes):
    x = np.asarray(to_features(scenes))
    error = np.random.default_rng(0).normal(size=x.shape) / 10
    terms = jax.jit(
        functools.partial(
            smgdiff_loss.loss_terms, representation=representation, rotation=0.25
        )
    )
    found = terms(jnp.asarray(x + error, jnp.float32), jnp.asarray(x))
    share = np.repeat([1.0, 0.25, 1.0], [3, 30, x.shape[-1] - 33])
    for name, off in (("data", error), ("velocity", np.diff(error, axis=1))):
        assert float(found[name]) == pytest.approx(np.mean(share * off**2), rel=1e-4)


def test_a_person_who_trembles_costs_second_differences(
    scenes, representation, loss_terms, to_features
):
    """Every other frame a centimeter aside: differences of 2 cm in each triple."""
    x = to_features(scenes)
    std = representation.normalizer.std[0]
    terms = loss_terms(x.at[:, 1::2, 0].add(0.01 / std), x)
    assert float(terms["acceleration"]) == pytest.approx(4e-4 / 3, rel=1e-3)
    assert float(terms["position_velocity"]) == pytest.approx(1e-4 / 3, rel=1e-3)


def test_losses_reach_over_the_seam(scenes, representation, config, monkeypatch):
    """Beside the last two past frames, a prediction of zeros is as wrong as it is.

    They stand in the past, and leave from its last frame on.
    """
    stood = lambda x: x.at[:, :4].set(x[:, 3:4])  # noqa: E731
    motion = dataclasses.replace(
        scenes.motion,
        root_position=stood(scenes.motion.root_position).at[:, 4:, 0].add(0.05),
        joint_rotation=stood(scenes.motion.joint_rotation),
    )
    scenes = dataclasses.replace(scenes, motion=motion)

    class Zeros:
        def apply(self, variables, *args, method, train, rngs):
            return () if method == "encode" else jnp.zeros_like(args[1])

    monkeypatch.setattr(smgdiff_loss, "network", lambda config: Zeros())
    config = dataclasses.replace(config, seam_half_life=3.0)
    labels = jnp.array([0, 1, 0])
    loss = functools.partial(
        smgdiff_loss.loss, {}, representation=representation, config=config
    )
    _, found = jax.jit(loss)(jax.random.key(0), (scenes, labels))

    @jax.jit
    def beside_zeros(scenes):
        frame = jax.vmap(
            lambda scene: smgdiff_scene.plan_frame(
                representation.skeleton, jax.tree.map(lambda x: x[:4], scene.motion)
            )
        )(scenes)
        seen = jax.vmap(smgdiff_scene.to_frame)(scenes, frame)
        x = smgdiff_scene.to_features(seen, representation)[:, 2:]
        return smgdiff_loss.loss_terms(
            x.at[:, 2:].set(0.0), x, representation=representation
        )

    for name, value in beside_zeros(scenes).items():
        np.testing.assert_allclose(found[name], value, rtol=1e-3, err_msg=name)


def test_only_the_pose_goes_on_from_the_past(condition, config, params):
    plain = smgdiff_model.network(config)
    seamed = dataclasses.replace(config, seam_half_life=3.0, seam_features=33)
    x_t = jax.random.normal(jax.random.key(0), (12, config.num_features))
    free, found = (
        jax.jit(net.apply)(
            {"params": params}, x_t, jnp.int32(2), *condition.arguments()
        )
        for net in (plain, smgdiff_model.network(seamed))
    )
    np.testing.assert_array_equal(found[:, 33:], free[:, 33:])
    before = 2 * free[0, :33] - free[1, :33]
    moved = (found - free)[:, :33] / (condition.past[-1, :33] - before)[None]
    fade = 0.5 ** (np.arange(1, 13) / 3.0)
    np.testing.assert_allclose(moved, np.repeat(fade[:, None], 33, 1), atol=2e-3)


@pytest.mark.slow
def test_training_lowers_the_loss(scenes, representation, config, params):
    data = (scenes, jnp.array([0, 1, 0]))
    loss = functools.partial(
        smgdiff_loss.loss, representation=representation, config=config
    )
    step = jax.jit(
        lambda p, key: (
            lambda value, grad: (
                value,
                jax.tree.map(lambda a, g: a - 0.02 * g, p, grad),
            )
        )(*jax.value_and_grad(lambda q: loss(q, key, data)[0])(p))
    )
    values = []
    for i in range(40):
        value, params = step(params, jax.random.key(i))
        values.append(float(value))
    assert np.mean(values[-10:]) < 0.8 * np.mean(values[:10])


def test_an_example_is_the_window_itself(scenes, representation, config):
    """Past and future of the features; the last past frame is the origin."""
    scene: Scene = jax.tree.map(lambda x: x[1], scenes)
    condition, found = smgdiff_loss.example(
        jax.random.key(0),
        scene,
        jnp.int32(1),
        representation=representation,
        config=config,
    )
    whole = smgdiff_scene.to_features(scene, representation)
    np.testing.assert_allclose(found, whole, atol=1e-4)
    # All but the contacts, which for the last past frame need the next one.
    np.testing.assert_allclose(condition.past[:, :38], whole[:4, :38], atol=1e-4)
    np.testing.assert_allclose(condition.ball, scene.ball[3], atol=1e-5)
    assert int(condition.label) == 1
    assert condition.trajectory.position.shape == (12, 2)


def test_wanted_paths_may_be_cubics(scenes, representation, config):
    """NumPy's fit to the recorded path, through the last past place."""
    scene: Scene = jax.tree.map(lambda x: x[2], scenes)
    sway = 0.05 * (np.sin(np.arange(16.0)) - np.sin(3.0))
    sway = jnp.pad(jnp.asarray(sway, jnp.float32)[:, None], ((0, 0), (0, 2)))
    motion = dataclasses.replace(
        scene.motion, root_position=scene.motion.root_position + sway
    )
    scene = dataclasses.replace(scene, motion=motion)
    condition, _ = smgdiff_loss.example(
        jax.random.key(0),
        scene,
        jnp.int32(1),
        representation=representation,
        config=dataclasses.replace(config, cubic_wishes=1.0),
    )
    course = trajectory.root_trajectory(tiny.skeleton(), scene.motion)
    path, t = np.float64(course.position), np.arange(16.0)
    cubic = np.stack([np.polyval(np.polyfit(t, x, 3), t) for x in path.T], -1)
    cubic += path[3] - cubic[3]
    np.testing.assert_allclose(condition.trajectory.position, cubic[4:], atol=1e-5)
    assert np.abs(cubic - path).max() > 0.02
