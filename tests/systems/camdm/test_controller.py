"""CAMDM's run-time: when it plans, what it guides, what it feeds back, its seams.

Most tests put a planner in the network's place whose plans are known: it follows the
wanted path exactly, and writes into the root's height what the test asks about.
"""

import dataclasses
import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxmotion.control import rollout
from jaxmotion.motion import features, rotation, trajectory
from jaxmotion.motion.skeleton import Motion
from jaxmotion.systems.camdm import controller as camdm_controller
from jaxmotion.systems.camdm import model as camdm_model
from tests import mostly_slow, tiny

CONFIG = tiny.config(heading="facing", depth=1, num_steps=2)
CONTROL = camdm_controller.Control(apply=5, reuse=6, seam=0.0)


def obedient(height):
    """A stand-in of `camdm.sampler`: walks the wanted path at a height of its own."""

    def sampler(params, *, config, **_):
        def plan(key, condition, *, scale=None):
            facing = rotation.matrix_from_facing(condition.trajectory.facing)
            joints = jnp.broadcast_to(
                jnp.eye(3), (config.future, config.num_joints, 3, 3)
            ).at[:, 0]
            x, z = condition.trajectory.position.T
            root = jnp.stack(
                [x, jnp.broadcast_to(height(condition, scale), x.shape), z]
            )
            motion = Motion(
                root_position=root.T,
                joint_rotation=rotation.rot6d_from_matrix(joints.set(facing)),
                fps=config.fps,
            )
            return camdm_model.to_features(motion, config=config)

        return plan

    return sampler


@pytest.fixture(scope="module")
def params():
    return tiny.random_params(camdm_model.init, CONFIG, seed=7)


@pytest.fixture
def use(monkeypatch):
    def replace(height):
        monkeypatch.setattr(camdm_model, "sampler", obedient(height))

    return replace


def scale_as_height(condition, scale):
    return jnp.float32(-1.0) if scale is None else scale


def commands_of(velocity, facing, label):
    """Commands [characters, ticks, ...] from arrays."""
    return trajectory.Command(
        velocity=jnp.asarray(velocity, jnp.float32),
        facing=jnp.asarray(facing, jnp.float32),
        label=jnp.asarray(label, jnp.int32),
    )


def steady(characters, ticks):
    """Everyone walks along +z at 1 m/s in style 0."""
    ahead = np.broadcast_to([0.0, 1.0], (characters, ticks, 2)).copy()
    return ahead, ahead.copy(), np.zeros((characters, ticks), int)


def states_of(skeleton, characters, config=CONFIG, **walk):
    past = tiny.walk(config.past + 3, fps=config.fps, **walk)
    state = camdm_controller.init_state(skeleton, past, config=config)
    return jax.tree.map(lambda x: jnp.stack([x] * characters), state)


def roll(skeleton, commands, control=CONTROL, config=CONFIG, **walk):
    states = states_of(skeleton, commands.label.shape[0], config, **walk)

    def run(key, states, commands):
        made = camdm_controller.controller(
            None, skeleton, config=config, control=control
        )
        return rollout.rollout(made, key, states, commands)

    return jax.jit(run)(jax.random.key(0), states, commands)


# When it plans

MOST = 4, 25  # characters and ticks of the tests that share a program


@functools.cache
def guided_program(control):
    def run(skeleton, key, states, commands):
        made = camdm_controller.controller(
            None, skeleton, config=CONFIG, control=control
        )
        return rollout.rollout(made, key, states, commands)[1]

    return jax.jit(run)


@pytest.fixture
def guided(skeleton, use):
    """Ticks at which characters plan, and their heights: with what scale, -1 for none.

    Whatever their number, as many go for as long: the programs are the same.
    """
    use(scale_as_height)

    def find(velocity, facing, label, control=CONTROL):
        less = [(0, most - own) for most, own in zip(MOST, label.shape, strict=True)]
        given = [
            np.pad(x, [*less, (0, 0)][: x.ndim], mode="edge")
            for x in (velocity, facing, label)
        ]
        states, key = states_of(skeleton, MOST[0]), jax.random.key(0)
        frames = guided_program(control)(skeleton, key, states, commands_of(*given))
        characters, ticks = label.shape
        planned = np.asarray(frames.planned)[:characters, :ticks]
        heights = np.asarray(frames.root_position)[:characters, :ticks, 1].round(5)
        return [np.flatnonzero(x).tolist() for x in planned], heights.tolist()

    return find


@pytest.mark.slow
def test_it_plans_when_told_or_after_m_frames(guided):
    velocity, facing, label = steady(4, 17)
    velocity[1, 3:] = [0.5, 1.0]
    facing[2, 7:] = [1.0, 0.0]
    label[3, 10:] = 1
    planned, _ = guided(velocity, facing, label)
    each = [0, 5, 10, 15]
    assert planned == [each, [0, 3, 8, 13], [0, 5, 7, 12], each]
    eager = dataclasses.replace(CONTROL, replan_on_change=False)
    planned, _ = guided(velocity, facing, label, eager)
    assert planned == [each] * 4


@pytest.mark.parametrize(
    "change, cursor, plans",
    [
        (dict(velocity=(0.1, 1.0)), 2, 0),
        (dict(velocity=(0.1, 1.0)), 3, 1),
        (dict(velocity=(0.6, 1.0)), 1, 1),
        (dict(facing=(0.1, 1.0)), 2, 0),
        (dict(facing=(1.0, 0.0)), 1, 1),
        (dict(label=1), 1, 2),
        (dict(), 3, 0),
    ],
)
def test_small_changes_of_the_command_wait(skeleton, change, cursor, plans):
    """Of the plan's own command, though the last tick's was the same."""
    control = dataclasses.replace(CONTROL, least=3)
    told = jax.tree.map(lambda x: x[0, 0], commands_of(*steady(1, 1)))
    changed = {
        name: jnp.asarray(value, getattr(told, name).dtype)
        for name, value in change.items()
    }
    wanted = dataclasses.replace(told, **changed)
    state = jax.tree.map(lambda x: x[0], states_of(skeleton, 1))
    state = dataclasses.replace(state, command=told)
    for _ in range(cursor):
        state, _ = camdm_controller.advance(
            state, wanted, config=CONFIG, control=control
        )
    need = camdm_controller.plan_level(state, wanted, control=control)
    assert int(need) == plans


@pytest.mark.parametrize(
    ("guided_plans", "replan_on_change"),
    mostly_slow([(0, True), (1, True), (1, False), (2, False)], [(1, True)]),
)
def test_guidance_only_in_the_first_plans_after_a_style_change(
    guided, guided_plans, replan_on_change
):
    """Character 0 changes its style at tick 7; 1 never; 2 changes with its first plan.

    The height of a frame is the scale that its plan was made with, -1 for none.
    """
    velocity, facing, label = steady(3, 25)
    label[0, 7:] = 1
    label[2] = 1
    control = dataclasses.replace(
        CONTROL,
        guided_plans=guided_plans,
        replan_on_change=replan_on_change,
        guidance_scale=0.7,
    )
    _, heights = guided(velocity, facing, label, control)
    first = 7 if replan_on_change else 10
    ticks = range(first, first + 5 * guided_plans)
    want = [np.float32(0.7).round(5) if i in ticks else -1 for i in range(25)]
    assert heights[0] == want
    # The others plan by themselves: at most with the scale that changes nothing.
    for other in (1, 2):
        assert set(heights[other]) <= {-1.0, 1.0}


@pytest.mark.slow
def test_a_released_character_starts_with_guided_plans(guided):
    """Two of them; the first style is then no change of style without the option."""
    released = camdm_controller.RELEASED
    assert released.guide_start and released.guided_plans == 2
    for start, ticks in ((True, range(10)), (False, ())):
        control = dataclasses.replace(
            released, apply=5, reuse=6, seam=0.0, guide_start=start
        )
        _, heights = guided(*steady(1, 15), control)
        want = [np.float32(0.5) if i in ticks else -1 for i in range(15)]
        assert heights[0] == want


def test_a_second_change_guides_again(guided):
    velocity, facing, label = steady(1, 20)
    label[0, 4:9] = 1
    _, heights = guided(velocity, facing, label)
    assert np.flatnonzero(np.array(heights[0]) != -1).tolist() == [*range(4, 14)]


# What it is fed


@pytest.mark.slow
def test_displayed_poses_are_fed_back(skeleton, use):
    """Each plan stands 1 cm above the last displayed pose that it was given."""
    use(lambda condition, scale: condition.past[-1, -5] + 0.01)
    states, frames = roll(skeleton, commands_of(*steady(1, 12)))
    start = states_of(skeleton, 1).past.root_position[0, -1, 1]
    expected = start + 0.01 * (1 + np.arange(12) // 5)
    np.testing.assert_allclose(frames.root_position[0, :, 1], expected, atol=1e-5)
    last = slice(-CONFIG.past, None)
    np.testing.assert_array_equal(
        states.past.root_position[0], frames.root_position[0, last]
    )
    np.testing.assert_array_equal(
        states.past.joint_rotation[0], frames.joint_rotation[0, last]
    )


@pytest.mark.parametrize("heading", mostly_slow(["facing", "random"], ["facing"]))
def test_the_past_is_seen_from_the_last_pose(skeleton, use, heading):
    seen = []

    def height(condition, scale):
        jax.debug.callback(
            lambda past, label, keep: seen.append((past, label, keep)),
            condition.past,
            condition.label,
            condition.keep_past,
        )
        return jnp.float32(0.9)

    use(height)
    config = tiny.config(heading=heading)
    velocity, facing, label = steady(1, 1)
    frames = roll(
        skeleton, commands_of(velocity, facing, label + 1), config=config, start=2.0
    )
    jax.block_until_ready(frames)
    jax.effects_barrier()
    past, label, keep = seen[0]
    assert label == 1 and keep
    motion = features.motion_from_features(jnp.asarray(past), config.fps)
    np.testing.assert_allclose(motion.root_position[-1, ::2], 0.0, atol=1e-6)
    yaw = trajectory.root_trajectory(skeleton, motion).facing[-1]
    original = tiny.walk(config.past + 3, start=2.0)
    world = trajectory.root_trajectory(skeleton, original).facing[-1]
    expected = [0.0, 1.0] if heading == "facing" else world
    np.testing.assert_allclose(yaw, expected, atol=1e-5)


# Where it goes


@pytest.mark.parametrize("heading", mostly_slow(["facing", "random"], ["facing"]))
def test_a_model_that_obeys_goes_where_it_is_told(skeleton, use, heading):
    """Then it reaches the commanded velocity and facing, from any start."""
    use(lambda condition, scale: jnp.float32(0.9))
    velocity, facing, label = steady(2, 90)
    velocity[:, :] = [-1.2, 0.3]
    facing[:, :] = [0.6, -0.8]
    config = tiny.config(heading=heading)
    _, frames = roll(
        skeleton, commands_of(velocity, facing, label), config=config, start=1
    )
    ground = np.asarray(frames.root_position)[..., ::2]
    found = (ground[:, -1] - ground[:, -16]) * 2
    np.testing.assert_allclose(found, [[-1.2, 0.3]] * 2, atol=0.02)
    motion = Motion(
        root_position=frames.root_position,
        joint_rotation=frames.joint_rotation,
        fps=config.fps,
    )
    course = trajectory.root_trajectory(skeleton, motion)
    np.testing.assert_allclose(course.facing[:, -1], [[0.6, -0.8]] * 2, atol=0.02)
    np.testing.assert_allclose(frames.desired_velocity[:, -1], found, atol=0.02)
    np.testing.assert_allclose(
        frames.desired_facing[:, -1], course.facing[:, -1], atol=0.02
    )


def test_without_extension_the_users_path_alone_is_wanted(skeleton):
    state = jax.tree.map(lambda x: x[0], states_of(skeleton, 1))
    velocity, facing, label = (x[0, 0] for x in steady(1, 1))
    command = commands_of(velocity, facing, label)

    def wanted(**changes):
        return camdm_controller.wanted_trajectory(
            skeleton,
            state,
            command,
            config=CONFIG,
            control=dataclasses.replace(CONTROL, **changes),
        )

    alone, blended = wanted(extend=False), wanted()
    own = trajectory.root_trajectory(skeleton, state.plan)
    # The blend begins near the model's own path and ends on the user's.
    gap = lambda a, b, i: np.abs(a.position[i] - b.position[i]).max()  # noqa: E731
    assert gap(blended, own, 0) < gap(blended, alone, 0) + 1e-6
    np.testing.assert_allclose(blended.position[-1], alone.position[-1], atol=1e-6)
    np.testing.assert_allclose(blended.facing[-1], alone.facing[-1], atol=1e-6)


def test_however_late_a_plan_comes_it_goes_on_from_where_he_is(skeleton, use):
    """A crowd shares its plans: who waits plays on, up to the last frame of his own."""
    use(lambda condition, scale: jnp.float32(0.9))
    made = camdm_controller.controller(None, skeleton, config=CONFIG, control=CONTROL)
    command = commands_of(*(x[0, 0] for x in steady(1, 1)))
    state = jax.tree.map(lambda x: x[0], states_of(skeleton, 1))
    state = made.plans[0](jax.random.key(0), state, command)

    @jax.jit
    def play_on(state, _):
        state, _ = made.advance(state, command)
        wanted = camdm_controller.wanted_trajectory(
            skeleton, state, command, config=CONFIG, control=CONTROL
        )
        return state, wanted.position[0] - state.past.root_position[-1, ::2]

    state, steps = jax.lax.scan(play_on, state, length=CONFIG.future)
    assert state.cursor == CONFIG.future
    # He walks along +z at 1 m/s, as he is told.
    ahead = np.full(CONFIG.future, 1.0 / CONFIG.fps)
    np.testing.assert_allclose(steps[:, 1], ahead, rtol=0.25)


def test_following_returns_to_the_commanded_path(skeleton, use):
    """A model that stays behind: with `follow` it is asked for more than without."""
    use(lambda condition, scale: jnp.float32(0.9))
    state = jax.tree.map(lambda x: x[0], states_of(skeleton, 1))
    away = dataclasses.replace(state, anchor=state.anchor + jnp.array([0.5, -0.25]))
    command = commands_of(*(x[0, 0] for x in steady(1, 1)))

    def wanted(state, follow):
        return camdm_controller.wanted_trajectory(
            skeleton,
            state,
            command,
            config=CONFIG,
            control=dataclasses.replace(CONTROL, extend=False, follow=follow),
        ).position

    np.testing.assert_array_equal(wanted(away, 0.0), wanted(state, 0.0))
    pull = wanted(away, 0.2) - wanted(state, 0.2)
    time = np.arange(1, CONFIG.future + 1) / CONFIG.fps
    expected = (1 - 0.5 ** (time / 0.2))[:, None] * np.array([[0.5, -0.25]])
    np.testing.assert_allclose(pull, expected, atol=1e-6)


# Seams


@pytest.mark.slow
def test_seams_are_continuous_in_position_and_velocity(skeleton, monkeypatch):
    """A plan that jumps by 0.1 m and turns by 0.3 rad, at two rates of frames.

    With a seam the first differences at the jump shrink with the frame time, and the
    second differences with its square (both bounded by the fade's acceleration).
    """
    changes = {}
    for fps in (120.0, 240.0):
        config = tiny.config(heading="facing", fps=fps, future=60)

        def sampler(params, *, config, **_):
            def plan(key, condition, *, scale=None):
                time = jnp.arange(1, config.future + 1) / config.fps
                root = jnp.stack([0.1 + 0 * time, 0.9 + 0 * time, 0.1 + 1.5 * time], -1)
                facing = jnp.array([[jnp.sin(0.3), jnp.cos(0.3)]])
                turn = jnp.broadcast_to(rotation.matrix_from_facing(facing), (60, 3, 3))
                joints = jnp.broadcast_to(jnp.eye(3), (60, 5, 3, 3)).at[:, 0].set(turn)
                rot6d = rotation.rot6d_from_matrix(joints)
                return features.motion_features(
                    Motion(root_position=root, joint_rotation=rot6d, fps=config.fps),
                    rotation_layout=config.rotation_layout,
                )

            return plan

        monkeypatch.setattr(camdm_model, "sampler", sampler)
        commands = commands_of(*steady(1, 10))
        for seam in (0.0, 0.2) if fps == 120.0 else (0.2,):
            control = dataclasses.replace(CONTROL, apply=30, seam=seam)
            _, frames = roll(skeleton, commands, control, config)
            before = states_of(skeleton, 1, config).past
            root = jnp.concatenate([before.root_position, frames.root_position], 1)[0]
            turns = jnp.concatenate([before.joint_rotation, frames.joint_rotation], 1)
            turns = turns[0, :, 0]
            at = config.past
            for name, x in {"root": root, "turn": turns}.items():
                first = jnp.linalg.norm(x[at] - x[at - 1])
                second = jnp.linalg.norm(x[at] - 2 * x[at - 1] + x[at - 2])
                changes[fps, seam, name] = float(first), float(second)
    for name, jump in {"root": 0.1, "turn": 0.25}.items():
        assert changes[120.0, 0.0, name][0] > jump
        for fps in (120.0, 240.0):
            assert changes[fps, 0.2, name][0] < 2.5 / fps
        ratio = changes[240.0, 0.2, name][1] / changes[120.0, 0.2, name][1]
        assert ratio < 0.35


# With the network


def turning(characters, ticks):
    velocity, facing, label = steady(characters, ticks)
    velocity[1:, 4:] = [0.8, 0.2]
    facing[1:, 4:] = [1.0, 0.0]
    label[2:, 6:] = 1
    return velocity, facing, label


WITH_SEAM = dataclasses.replace(CONTROL, seam=0.2)


@functools.cache
def program(characters, chunk):
    def run(params, skeleton, key, states, commands):
        made = camdm_controller.controller(
            params, skeleton, config=CONFIG, control=WITH_SEAM
        )
        return rollout.rollout(made, key, states, commands, chunk=chunk)

    return jax.jit(run)


@pytest.fixture(scope="module")
def whole(params, skeleton):
    commands = commands_of(*turning(4, 9))
    states = states_of(skeleton, 4)
    return program(4, None)(params, skeleton, jax.random.key(0), states, commands)


@pytest.mark.slow
def test_chunks_and_batches_change_nothing(params, skeleton, whole):
    states, commands = states_of(skeleton, 4), commands_of(*turning(4, 9))
    chunked = program(4, 2)(params, skeleton, jax.random.key(0), states, commands)
    for a, b in zip(jax.tree.leaves(chunked), jax.tree.leaves(whole), strict=True):
        np.testing.assert_allclose(a, b, atol=2e-5)
    assert np.abs(whole[1].root_position[1] - whole[1].root_position[0]).max() > 1e-2
    # Same commands, other numbers: characters 2 and 3 differ.
    assert np.abs(whole[1].root_position[2] - whole[1].root_position[3]).max() > 1e-2


@pytest.mark.slow
def test_256_characters_at_a_time_are_256_alone(params, skeleton):
    """Over the first plan; later ones repeat what rounding there was."""
    number, ticks = 256, CONTROL.apply
    commands = commands_of(*turning(number, ticks))
    states = states_of(skeleton, number)
    alone, together = (
        program(number, chunk)(params, skeleton, jax.random.key(0), states, commands)[1]
        for chunk in (1, number)
    )
    assert np.asarray(alone.planned)[:, 0].all()
    for a, b in zip(jax.tree.leaves(alone), jax.tree.leaves(together), strict=True):
        np.testing.assert_allclose(a, b, atol=1e-4)
    # And they are different characters.
    assert np.asarray(alone.root_position).std(axis=0).max() > 1e-2


@pytest.mark.slow
def test_live_ticks_are_the_rollout(params, skeleton, whole):
    commands = commands_of(*turning(4, 9))

    def live(params, key, state, command):
        made = camdm_controller.controller(
            params, skeleton, config=CONFIG, control=WITH_SEAM
        )
        return rollout.tick(made, key, state, command)

    live = jax.jit(live)
    own_key = jax.random.fold_in(jax.random.key(0), 2)
    state = jax.tree.map(lambda x: x[2], states_of(skeleton, 4))
    for i in range(9):
        command = jax.tree.map(lambda x, i=i: x[2, i], commands)
        state, frame = live(params, jax.random.fold_in(own_key, i), state, command)
        expected = jax.tree.map(lambda x, i=i: x[2, i], whole[1])
        for a, b in zip(jax.tree.leaves(frame), jax.tree.leaves(expected), strict=True):
            np.testing.assert_allclose(a, b, atol=2e-5)


def test_a_turned_world_gives_the_turned_motion(params, skeleton, whole):
    """With heading "facing" the whole run-time is equivariant on the ground."""
    x, z, yaw = 3.0, -2.0, 2.0
    axes = np.array([[np.cos(yaw), np.sin(yaw)], [-np.sin(yaw), np.cos(yaw)]])
    velocity, facing, label = turning(4, 9)
    frame = trajectory.PlanarFrame(
        origin=jnp.array([x, z]),
        facing=jnp.array([np.sin(yaw), np.cos(yaw)], jnp.float32),
    )
    past = features.from_frame(tiny.walk(CONFIG.past + 3), frame)
    state = camdm_controller.init_state(skeleton, past, config=CONFIG)
    states = jax.tree.map(lambda x: jnp.stack([x] * 4), state)
    commands = commands_of(velocity @ axes.T, facing @ axes.T, label)
    _, frames = program(4, None)(params, skeleton, jax.random.key(0), states, commands)
    moved = features.from_frame(
        Motion(
            root_position=whole[1].root_position,
            joint_rotation=whole[1].joint_rotation,
            fps=CONFIG.fps,
        ),
        jax.tree.map(lambda x: jnp.broadcast_to(x, (4, 2)), frame),
    )
    np.testing.assert_allclose(frames.root_position, moved.root_position, atol=2e-4)
    np.testing.assert_allclose(frames.joint_rotation, moved.joint_rotation, atol=2e-4)


# How it starts


def test_a_character_starts_with_the_velocity_of_its_poses(skeleton):
    """Without a plan it would go on so; of more poses the last ones count."""
    walked = tiny.walk(CONFIG.past, fps=CONFIG.fps)
    places = np.array([[0.0, 0.9, 0.0], [0.01, 0.9, 0.02], [0.05, 0.9, 0.03]])
    places = np.concatenate([places, [[0.06, 0.9, 0.12]]]).astype(np.float32)
    past = dataclasses.replace(walked, root_position=jnp.asarray(places))
    longer = jax.tree.map(lambda x: jnp.concatenate([x[:2] + 1.0, x]), past)
    for one in (past, longer):
        state = camdm_controller.init_state(skeleton, one, config=CONFIG)
        velocity = np.array([0.06, 0.0, 0.12]) / 3 * CONFIG.fps
        np.testing.assert_allclose(state.velocity, velocity[::2], rtol=1e-5)
        ahead = np.arange(1, CONFIG.future + 1)[:, None] / CONFIG.fps
        plan = places[-1] + ahead * velocity
        np.testing.assert_allclose(state.plan.root_position, plan, rtol=1e-5)


@pytest.mark.parametrize("half_life, seam", [(0.0, 0.2), (3.0, 0.1)])
def test_who_ships_and_goes_on_from_the_past_has_a_short_seam(
    skeleton, half_life, seam
):
    config = tiny.config(seam_half_life=half_life)
    walked = tiny.walk(config.past, fps=config.fps)
    model = camdm_model.Model(
        config=config,
        skeleton=skeleton,
        labels=tiny.STYLES,
        source="tests",
        starts=jax.tree.map(lambda x: jnp.stack([x[None]] * 2), walked),
    )
    shipped = camdm_controller.character({}, model).method.control
    assert (shipped.seam, shipped.follow) == (seam, 1.0)
    given = camdm_controller.character({}, model, control=CONTROL)
    assert given.method.control is CONTROL


# Bad input


def test_too_short_a_past_is_named(skeleton):
    with pytest.raises(ValueError, match="past has 3 frames, expected 4"):
        camdm_controller.init_state(skeleton, tiny.walk(3), config=CONFIG)


@pytest.mark.parametrize("apply", [0, CONFIG.future + 1])
def test_more_frames_than_a_plan_has_cannot_be_played(params, skeleton, apply):
    control = dataclasses.replace(CONTROL, apply=apply)
    with pytest.raises(ValueError, match=f"apply is {apply}, expected 1..12"):
        camdm_controller.controller(params, skeleton, config=CONFIG, control=control)


@pytest.mark.slow
def test_the_mean_pose_stands_on_the_ground():
    still = (1.0, 0.0, 0.0, 0.0, 1.0, 0.0) * len(tiny.NAMES)
    config = tiny.config(heading="facing", rotation_scale=4.0, rotation_mean=still)
    model = camdm_model.Model(
        config=config, skeleton=tiny.skeleton(), labels=tiny.STYLES, source="tests"
    )
    motion = camdm_controller.mean_pose(model)
    assert motion.root_position.shape == (config.past, 3)
    feet = tiny.positions(model.skeleton, motion)[:, [2, 4], 1]
    np.testing.assert_allclose(feet, 0.0, atol=1e-6)
    np.testing.assert_allclose(motion.root_position[-1], [0, 0.9, 0], atol=1e-6)


def test_whoever_comes_to_a_stop_stays_there(skeleton):
    """Nobody is pulled back to where the stop was told; a new command leads on."""
    state = jax.tree.map(lambda x: x[0], states_of(skeleton, 1))
    state = dataclasses.replace(
        state, velocity=jnp.array([0.0, 0.1]), anchor=jnp.array([5.0, 5.0])
    )
    step = jax.jit(
        functools.partial(camdm_controller.advance, config=CONFIG, control=CONTROL)
    )
    still, ahead = (
        trajectory.Command(
            velocity=jnp.array([0.0, speed]),
            facing=jnp.array([0.0, 1.0]),
            label=jnp.zeros((), jnp.int32),
        )
        for speed in (0.0, 1.0)
    )
    anchors, roots, speeds = [], [], []
    for _ in range(40):
        state = dataclasses.replace(state, cursor=jnp.minimum(state.cursor, 5))
        state, frame = step(state, still)
        anchors.append(state.anchor)
        roots.append(frame.root_position[::2])
        speeds.append(float(jnp.linalg.norm(state.velocity)))
    stop = next(i for i, x in enumerate(speeds) if x < trajectory.STILL)
    assert 0 < stop < 30
    for anchor, root in zip(anchors[: stop + 1], roots, strict=False):
        np.testing.assert_array_equal(anchor, root)
    for anchor in anchors[stop:]:
        np.testing.assert_allclose(anchor, roots[stop], atol=0.01)
    for _ in range(30):
        state = dataclasses.replace(state, cursor=jnp.minimum(state.cursor, 5))
        state, _ = step(state, ahead)
    assert state.anchor[1] - roots[stop][1] > 0.3
