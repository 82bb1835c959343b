"""AAMDM's run-time: the wanted path, the guided step, and where the bone goes."""

import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

import jaxmotion as jm
from jaxmotion.control import rollout
from jaxmotion.diffusion import chain
from jaxmotion.motion import features
from jaxmotion.motion.trajectory import Command
from jaxmotion.systems.aamdm import controller as aamdm_controller
from jaxmotion.systems.aamdm import model as aamdm_model
from jaxmotion.systems.aamdm import space as aamdm_space
from tests import mostly_slow, person, tiny
from tests.reference import pose as reference

FPS = 60.0
JOINTS = 6
SIZE = 15 * JOINTS + 8
CONFIG = aamdm_model.Config(features=12 + SIZE, latent=2, width=16, depth=2)
MOVE, SPIN = np.array([0.3, 0.0, 1.2]), np.array([0.0, 0.8, 0.0])


def normal(*shape, seed=0):
    return person.float32(np.random.default_rng(seed).normal(size=shape))


def vector():
    """An upright pose that moves its bone forward, to the side, and round."""
    parts = [person.OFFSETS + [[0.0, 1.0, 0.0], *5 * [[0.0] * 3]]]
    parts += [np.tile([1.0, 0, 0, 0, 1.0, 0], JOINTS), np.zeros(2 * 3 * JOINTS)]
    return person.float32(np.concatenate([np.ravel(x) for x in parts + [MOVE, SPIN]]))


@functools.cache
def pose():
    return jnp.concatenate([vector(), jnp.zeros(2)])


@functools.cache
def space():
    """Full poses in units of their own."""
    own = np.random.default_rng(3)
    mean, std = own.normal(size=12 + SIZE), own.uniform(0.5, 2.0, 12 + SIZE)
    normalizer = features.Normalizer(mean=person.float32(mean), std=person.float32(std))
    one = jnp.ones(12 + SIZE)
    return aamdm_space.Space(
        normalizer=normalizer,
        change=one,
        low=-30 * one,
        high=30 * one,
        autoencoder=None,
    )


def start(path_seed=4):
    return aamdm_controller.init_state(
        space(), pose(), normal(12, seed=path_seed), num_joints=JOINTS
    )


def character(velocity, yaw, turn_rate=0.0, origin=(3.0, -2.0)):
    """A state that stands and moves as told."""
    return dataclasses.replace(
        start(),
        bone=person.frames(np.array(origin), yaw),
        velocity=person.float32(velocity),
        turn_rate=person.float32(turn_rate),
    )


def command(velocity, yaw):
    return Command(
        velocity=person.float32(velocity),
        facing=person.float32(person.directions(yaw)),
        label=jnp.int32(0),
    )


def driver(step, **options):
    if not isinstance(step, aamdm_controller.Stepper):
        step = aamdm_controller.Stepper(step)
    return aamdm_controller.controller(
        step, space(), num_joints=JOINTS, fps=FPS, **options
    )


def wanted_path(state, command, fps=FPS, half_life=0.27):
    return aamdm_controller.wanted_path(state, command, fps=fps, half_life=half_life)


# --- the wanted path ---------------------------------------------------------------


@pytest.mark.parametrize("fps", mostly_slow([30.0, 60.0], [60.0]))
@pytest.mark.parametrize("yaw", mostly_slow([0.0, 2.2], [2.2]))
def test_whoever_goes_on_as_before_wants_a_straight_line(fps, yaw):
    velocity = 1.3 * person.directions(yaw + 0.5)
    state = character(velocity, yaw)
    found = wanted_path(state, command(velocity, yaw), fps=fps)
    ahead = np.multiply.outer([1 / 3, 2 / 3, 1.0], 1.3 * person.directions(0.5))
    expected = [*ahead.ravel(), 0, 1, 0, 1, 0, 1]
    np.testing.assert_allclose(found, expected, atol=5e-6)


def test_stiff_springs_obey_at_once():
    state = character([0.5, 0.0], 0.3, turn_rate=2.0)
    found = wanted_path(state, command([0.0, 0.0], 0.3 + 1.1), half_life=1e-3)
    np.testing.assert_allclose(found[:6], 0.0, atol=5e-3)
    np.testing.assert_allclose(found[6:], np.tile(person.directions(1.1), 3), atol=1e-4)


def test_slow_springs_carry_on_for_now():
    state = character([0.0, 0.6], 0.0, turn_rate=0.5)
    found = wanted_path(state, command([0.0, -9.0], 3.0), half_life=1e3)
    np.testing.assert_allclose(found[:6], [0, 0.2, 0, 0.4, 0, 0.6], atol=0.02)
    turned = person.directions(0.5 * np.array([1 / 3, 2 / 3, 1.0]))
    np.testing.assert_allclose(found[6:], turned.ravel(), atol=0.02)


def test_a_later_point_is_nearer_to_the_command():
    state = character([0.0, 0.0], 0.0)
    found = np.asarray(wanted_path(state, command([0.0, 1.0], 1.0)))
    speed = np.diff([0.0, *found[1:6:2]]) * 3
    assert np.all(np.diff(speed) > 0) and 0 < speed[0] and speed[-1] < 1
    yaw = np.arctan2(found[6::2], found[7::2])
    assert np.all(np.diff(yaw) > 0) and 0 < yaw[0] and yaw[-1] < 1


@pytest.mark.parametrize("told, walk", [(1.2, 1.2), (0.4, 0.9)])
@pytest.mark.parametrize(
    "part, more", [(0.0, 0.5), (0.25, 0.5), (0.375, 0.25), (0.5, 0.0), (1.0, 0.0)]
)
def test_who_stands_is_asked_to_go_faster(told, walk, part, more):
    """Parts of the commanded speed, or of .9 m/s: nothing more from a half of it on."""
    ahead = person.directions(0.4)
    state = character(part * walk * ahead, 0.4)
    found = aamdm_controller.wanted_path(
        state, command(told * ahead, 0.4), fps=FPS, half_life=0.27, start=0.5
    )
    # Both begin no faster than told.
    begins = character(min(part * walk, told) * ahead, 0.4)
    expected = wanted_path(begins, command((told + more) * ahead, 0.4))
    np.testing.assert_allclose(found, expected, atol=2e-5)


@pytest.mark.parametrize("angle, more", [(np.pi / 3, 0.25), (2.5, 0.0)])
def test_who_has_yet_to_turn_is_asked_for_less(angle, more):
    way = person.directions(0.4 + angle)
    state = character([0.0, 0.0], 0.4)
    found = aamdm_controller.wanted_path(
        state, command(1.2 * way, 0.4), fps=FPS, half_life=0.27, start=0.5
    )
    expected = wanted_path(state, command((1.2 + more) * way, 0.4))
    np.testing.assert_allclose(found, expected, atol=2e-5)


@pytest.mark.parametrize("told", [0.0, 0.01])
def test_who_is_to_stand_is_asked_for_nothing(told):
    state = character([0.0, 0.0], 0.4)
    told = command([told, 0.0], 0.4)
    found = aamdm_controller.wanted_path(
        state, told, fps=FPS, half_life=0.27, start=0.5
    )
    np.testing.assert_array_less(np.abs(found[:6]), 0.011)


def test_who_is_too_fast_wants_no_more_than_told():
    told = command(1.5 * person.directions(0.2), 0.0)
    expected = wanted_path(character(1.5 * person.directions(0.9), 0.0), told)
    for speed in (1.6, 3.0, 40.0):
        found = wanted_path(character(speed * person.directions(0.9), 0.0), told)
        np.testing.assert_allclose(found, expected, atol=1e-5)
    slower = wanted_path(character(0.7 * person.directions(0.9), 0.0), told)
    assert np.linalg.norm(slower[:2]) < np.linalg.norm(expected[:2]) - 0.02


@pytest.mark.parametrize(
    "faster, less", [(0.5, 0.0), (1.0, 0.0), (1.04, 0.12), (1.1, 0.3), (4.0, 0.3)]
)
def test_who_is_too_fast_is_asked_to_go_slower(faster, less):
    """Three times the share by which he is faster, at most .3; begun as told.

    Springs are linear: who asks for less gets that much less of a start from rest.
    """
    ahead = person.directions(0.2)
    told = command(2.5 * ahead, 0.2)
    found = aamdm_controller.wanted_path(
        character(faster * 2.5 * ahead, 0.2), told, fps=FPS, half_life=0.27, gain=3.0
    )
    begins = character(min(faster, 1.0) * 2.5 * ahead, 0.2)
    expected = np.array(wanted_path(begins, told))
    expected[:6] -= less * wanted_path(character([0.0, 0.0], 0.2), told)[:6]
    np.testing.assert_allclose(found, expected, atol=2e-5)


def test_who_is_told_to_stand_wants_to_stand_where_he_is():
    found = wanted_path(character([0.4, 2.0], 0.0), command([0.0, 0.0], 0.0))
    np.testing.assert_allclose(found[:6], 0.0, atol=1e-5)


def test_gradients_of_the_wish_are_finite_for_who_stands():
    def far(velocity):
        state = dataclasses.replace(character([0.0, 0.0], 0.0), velocity=velocity)
        return jnp.sum(wanted_path(state, command([0.0, 0.0], 0.0)))

    assert np.isfinite(jax.grad(far)(jnp.zeros(2))).all()


# --- guidance ----------------------------------------------------------------------


def test_objective_is_half_the_squared_distance_of_the_path():
    frame, goal = normal(20), normal(12, seed=1)
    objective = aamdm_controller.path_objective(goal)
    gap = np.float64(frame)[:12] - np.float64(goal)
    np.testing.assert_allclose(objective(frame), gap @ gap / 2, rtol=1e-5)
    found = jax.grad(objective)(frame)
    np.testing.assert_allclose(found, [*gap, *np.zeros(8)], rtol=1e-5, atol=1e-6)


@pytest.mark.slow
def test_without_a_goal_the_step_is_the_transition():
    transition = aamdm_model.sampler(
        tiny.random_params(aamdm_model.init, CONFIG), config=CONFIG
    )
    step = aamdm_controller.guided(transition, scale=0.5)
    frame = normal(12 + SIZE)
    found = jax.jit(lambda k, x: step(k, x, None))(jax.random.key(1), frame)
    plain = jax.jit(transition)(jax.random.key(1), frame)
    np.testing.assert_array_equal(found, plain)
    steered = jax.jit(step)(jax.random.key(1), frame, normal(12, seed=1))
    assert np.abs(steered - plain).max() > 1e-3


def test_a_goal_becomes_the_objective_of_the_transition():
    seen = {}

    def transition(key, previous, **options):
        seen.update(options)
        return previous

    goal = normal(12, seed=1)
    step = aamdm_controller.guided(transition, scale=0.7, guided_steps=2)
    step(jax.random.key(0), normal(20), goal)
    assert (seen["scale"], seen["guided_steps"]) == (0.7, 2)
    at_goal = jnp.concatenate([goal, jnp.ones(8)])
    assert seen["objective"](at_goal) == 0.0 < seen["objective"](at_goal + 1.0)


# --- the controller ----------------------------------------------------------------


def test_a_character_starts_at_the_origin_as_its_pose_moves():
    state = start()
    np.testing.assert_array_equal(state.bone.origin, [0, 0])
    np.testing.assert_array_equal(state.bone.facing, [0, 1])
    np.testing.assert_allclose(state.velocity, MOVE[[0, 2]], rtol=1e-5)
    np.testing.assert_allclose(state.turn_rate, SPIN[1], rtol=1e-5)
    poses = aamdm_space.to_poses(space(), state.frame)
    np.testing.assert_allclose(poses, pose(), atol=1e-5)


@pytest.mark.parametrize("steered", [False, True])
def test_a_fixed_frame_moves_the_bone_by_its_velocity(steered):
    frame = start(path_seed=9).frame
    made = driver(lambda key, previous, goal: frame, steered=steered)
    ticks = 30
    given = jax.tree.map(
        lambda x: jnp.broadcast_to(x, (1, ticks, *x.shape)), command([1.0, 0.5], 0.4)
    )
    states = jax.tree.map(lambda x: x[None], character([9.0, 9.0], 0.7, origin=(1, 2)))
    roll = jax.jit(functools.partial(rollout.rollout, made))
    states, frames = roll(jax.random.key(0), states, given)

    shown = frames.extra
    position, facing = np.array([1.0, 2.0]), person.directions(0.7)
    for i in range(ticks):
        position, facing = reference.advance(position, facing, MOVE, SPIN, FPS)
        np.testing.assert_allclose(
            frames.extra["bone_origin"][0, i], position, atol=1e-4
        )
        np.testing.assert_allclose(shown["bone_facing"][0, i], facing, atol=1e-4)
        world = (reference.turn(facing) @ MOVE)[[0, 2]]
        np.testing.assert_allclose(
            frames.extra["bone_velocity"][0, i], world, atol=1e-4
        )
    np.testing.assert_allclose(states.bone.origin[0], position, atol=1e-4)
    np.testing.assert_allclose(states.turn_rate, SPIN[1], atol=1e-4)
    np.testing.assert_allclose(
        frames.extra["path"][0, -1], normal(12, seed=9), atol=1e-4
    )
    np.testing.assert_array_equal(frames.desired_velocity, given.velocity)
    np.testing.assert_array_equal(frames.desired_facing, given.facing)
    # Joint 0 stands over the bone, in its direction.
    np.testing.assert_allclose(frames.root_position[0, -1, 1], 1.0, atol=1e-4)
    np.testing.assert_allclose(frames.root_position[0, -1, ::2], position, atol=1e-4)
    six = np.asarray(frames.joint_rotation[0, -1, 0])
    turned = reference.turn(facing)
    np.testing.assert_allclose(six, turned[:, :2].T.ravel(), atol=1e-4)


@pytest.mark.parametrize("steered", [False, True])
def test_only_steered_characters_have_a_goal(steered):
    goals = []

    def step(key, previous, goal):
        goals.append(goal)
        return previous

    state, given = character([0.0, 1.0], 0.5), command([1.0, 0.0], 1.5)
    made = driver(step, steered=steered, half_life=0.4)
    found, shown = rollout.tick(made, jax.random.key(0), state, given)
    if not steered:
        assert goals and all(goal is None for goal in goals)
        np.testing.assert_array_equal(shown.extra["wanted_path"], shown.extra["path"])
        return
    wanted = wanted_path(state, given, half_life=0.4)
    np.testing.assert_allclose(shown.extra["wanted_path"], wanted, atol=1e-5)
    planned = made.plans[0](jax.random.key(0), state, given)
    own = space().normalizer
    expected = (wanted - own.mean[:12]) / own.std[:12]
    np.testing.assert_allclose(goals[-1], expected, atol=1e-5)
    np.testing.assert_array_equal(planned.frame, state.frame)


def test_frames_stay_within_the_bounds_of_the_data():
    far = jnp.linspace(-99.0, 99.0, 12 + SIZE)
    state, given = character([0.0, 1.0], 0.5), command([1.0, 0.0], 1.5)
    for options, bound in ((dict(), 30.0), (dict(bounded=False), 99.0)):
        made = driver(lambda key, previous, goal: far, steered=False, **options)
        found = rollout.tick(made, jax.random.key(0), state, given)[0].frame
        np.testing.assert_allclose(found, np.clip(far, -bound, bound))


def test_an_unsteered_character_ignores_its_commands():
    step = aamdm_controller.guided(
        aamdm_model.sampler(
            tiny.random_params(aamdm_model.init, CONFIG), config=CONFIG
        ),
        scale=1.0,
    )
    made = driver(step, steered=False)
    tick = jax.jit(lambda s, c: rollout.tick(made, jax.random.key(0), s, c)[0])
    found = [tick(start(), command([x, 0.0], x)) for x in (0.0, 2.0)]
    np.testing.assert_array_equal(found[0].frame, found[1].frame)


@pytest.mark.parametrize("half_life", [0.05, np.inf])
def test_remembered_noise_is_normal_and_forgotten_by_half_in_its_half_life(half_life):
    memory = aamdm_controller.Memory(num_steps=2, half_life=half_life)
    first = normal(2, 20_000, seed=8)

    def tick(noise, key):
        noise = memory(key, noise, fps=FPS)
        return noise, noise

    keys = jax.random.split(jax.random.key(0), 6)
    noise = np.float64(jax.jit(lambda: jax.lax.scan(tick, first, keys)[1])())
    np.testing.assert_allclose(noise.std(axis=(1, 2)), 1.0, atol=0.02)
    for lag in (1, 3, 6):
        found = np.mean(noise[lag - 1] * first)
        np.testing.assert_allclose(found, 0.5 ** (lag / FPS / half_life), atol=0.02)


def test_the_noise_of_a_character_reaches_its_chain_and_stays_with_it():
    given = []

    def step(key, previous, goal, noise):
        given.append(noise)
        return previous

    memory = aamdm_controller.Memory(num_steps=3, half_life=np.inf)
    made = driver(aamdm_controller.Stepper(step, memory), steered=False)
    state = dataclasses.replace(start(), noise=normal(3, 12 + SIZE, seed=2))
    after = made.plans[0](jax.random.key(0), state, command([1.0, 0.0], 1.5))
    np.testing.assert_array_equal(given[0], state.noise)
    np.testing.assert_array_equal(after.noise, state.noise)


@pytest.mark.slow
def test_characters_together_are_what_each_is_alone():
    params = tiny.random_params(aamdm_model.init, CONFIG)
    transition = aamdm_model.sampler(params, config=CONFIG)
    made = driver(aamdm_controller.guided(transition, scale=0.1))
    key, characters, ticks = jax.random.key(5), 3, 3
    states = [character([0.1 * c, 1.0], 0.5 * c) for c in range(characters)]
    given = [
        [command([np.sin(c + i), 1.0], 0.3 * i - c) for i in range(ticks)]
        for c in range(characters)
    ]
    stack = lambda rows: jax.tree.map(lambda *x: jnp.stack(x), *rows)  # noqa: E731
    together = jax.jit(functools.partial(rollout.rollout, made))(
        jax.random.clone(key), stack(states), stack([stack(row) for row in given])
    )[1]
    tick = jax.jit(functools.partial(rollout.tick, made))
    for c in range(characters):
        own, state = jax.random.fold_in(key, c), states[c]
        for i in range(ticks):
            state, alone = tick(jax.random.fold_in(own, i), state, given[c][i])
            both = zip(jax.tree.leaves(together), jax.tree.leaves(alone), strict=True)
            for a, b in both:
                np.testing.assert_allclose(a[c, i], b, rtol=2e-3, atol=2e-3)


def test_the_step_of_the_chain_reaches_the_sampler(monkeypatch):
    seen = []

    def sampler(networks, **options):
        seen.append(options["step"])
        return lambda key, previous: previous

    monkeypatch.setattr(aamdm_model, "sampler", sampler)
    method = aamdm_controller.Method(config=CONFIG, num_joints=JOINTS, fps=FPS)
    other = dataclasses.replace(method, step=chain.ddim_step)
    method(({}, space())), other(({}, space()))
    assert seen == [chain.ancestral_step, chain.ddim_step]
    assert hash(method) != hash(other)


@pytest.mark.slow
@pytest.mark.parametrize("step", [chain.ddim_step, chain.dpm_solver_step])
def test_whoever_ships_takes_steps_that_draw_their_own_noise(step):
    """Its file remembers noise; what cannot take it from outside goes without."""
    model = jm.load("locomotion_fast", step=step)
    told = jm.commands("straight", model, 2, seconds=0.2, speed=1.0)
    frames = jm.rollout(model, jax.random.key(0), model.start(2), told)
    assert np.isfinite(np.asarray(frames.root_position)).all()
    with pytest.raises(
        ValueError, match=r"noise_half_life is 0\.1, but the step draws"
    ):
        jm.load("locomotion_fast", step=step, noise_half_life=0.1)


@pytest.mark.slow
def test_whoever_ships_starts_to_walk():
    """Told to go at 0.8 m/s, all of 16 walk a meter in the third and fourth second."""
    model = jm.load("locomotion_fast")
    told = jm.commands("straight", model, 16, seconds=4.0, speed=0.8)
    frames = jm.rollout(model, jax.random.key(0), model.start(16, seed=0), told)
    place = np.asarray(frames.root_position)[..., ::2]
    moved = np.linalg.norm(place[:, -1] - place[:, 119], axis=-1)
    assert moved.min() > 1.0, moved


@pytest.mark.slow
@pytest.mark.parametrize("told", [1.4, 2.5])
def test_whoever_ships_goes_as_fast_as_told(told):
    model = jm.load("locomotion_fast")
    given = jm.commands("straight", model, 8, seconds=8.0, speed=told)
    frames = jm.rollout(model, jax.random.key(0), model.start(8, seed=0), given)
    place = np.asarray(frames.root_position)[..., ::2]
    speed = np.linalg.norm(place[:, -1] - place[:, 239], axis=-1) / 4.0
    np.testing.assert_allclose(speed, told, rtol=0.12)
