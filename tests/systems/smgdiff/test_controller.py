"""SMGDiff's run-time: when it plans, and how plans join what is displayed."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxmotion.control import rollout
from jaxmotion.diffusion import chain
from jaxmotion.motion import trajectory
from jaxmotion.motion.skeleton import joint_positions
from jaxmotion.motion.trajectory import Command
from jaxmotion.systems.smgdiff import controller as smgdiff_controller
from jaxmotion.systems.smgdiff import guidance as smgdiff_guidance
from jaxmotion.systems.smgdiff import model as smgdiff_model
from jaxmotion.systems.smgdiff import scene as smgdiff_scene
from jaxmotion.systems.smgdiff import trajectory as smgdiff_trajectory
from tests import ball_walker, tiny

CONTROL = smgdiff_controller.Control(apply=5, reuse=4)


@pytest.fixture(scope="module")
def parts():
    """Representation, config, and a controller of random networks."""
    scenes = [ball_walker.scene(16, speed=s, start=s) for s in (0.6, 1.0, 1.4)]
    stacked = jax.tree.map(lambda *x: jnp.stack(x), *scenes)
    representation = smgdiff_scene.fit(
        tiny.skeleton(), stacked, joints=(2, 4), radius=0.11
    )
    config = smgdiff_model.Config(
        num_features=representation.normalizer.mean.size,
        num_labels=2,
        past=4,
        future=12,
        num_steps=2,
        width=16,
        depth=1,
        heads=2,
        hidden=32,
    )
    return representation, config, driver_of(representation, config, CONTROL)


def driver_of(representation, config, control):
    """A controller of random networks."""
    return smgdiff_controller.controller(
        *parts_of(representation, config),
        representation=representation,
        config=config,
        control=control,
    )


def parts_of(representation, config):
    """Random networks of both stages."""
    paths = smgdiff_trajectory.Config(
        num_labels=2,
        past=4,
        future=12,
        width=16,
        depth=1,
        hidden=32,
        frames_per_token=2,
    )
    sample = smgdiff_guidance.sampler(
        tiny.random_params(smgdiff_model.init, config, seed=3),
        config=config,
        representation=representation,
        guided=smgdiff_guidance.UNGUIDED,
    )
    generate = smgdiff_trajectory.sampler(
        tiny.random_params(smgdiff_trajectory.init, paths, seed=1), config=paths
    )
    return generate, sample


def past(frames=6):
    return ball_walker.scene(frames, speed=1.0, start=0.4)


def commands(ticks, *, change=None):
    velocity = np.tile([0.2, 1.0], (ticks, 1))
    if change is not None:
        velocity[change:] = [1.0, 0.0]
    return Command(
        velocity=jnp.asarray(velocity, jnp.float32),
        facing=jnp.tile(jnp.array([0.0, 1.0]), (ticks, 1)),
        label=jnp.zeros(ticks, jnp.int32),
    )


def played(parts, steered, number=1):
    _, config, driver = parts
    state = smgdiff_controller.init_state(tiny.skeleton(), past(), config=config)
    many = lambda tree: jax.tree.map(lambda x: jnp.stack([x] * number), tree)  # noqa: E731
    run = jax.jit(lambda *given: rollout.rollout(driver, *given)[1])
    return run(jax.random.key(1), many(state), many(steered))


@pytest.fixture(scope="module")
def frames(parts):
    return played(parts, commands(13, change=7), number=2)


def test_it_plans_at_first_when_played_out_and_when_told(frames):
    planned = np.flatnonzero(np.asarray(frames.planned[0]))
    np.testing.assert_array_equal(planned, [0, 5, 7, 12])


@pytest.mark.slow
def test_a_plan_begins_where_body_and_ball_are_displayed(parts):
    """Beside the same plan without a seam, which starts wherever the network says."""
    representation, config, driver = parts
    generate, sample = parts_of(representation, config)
    state = smgdiff_controller.init_state(tiny.skeleton(), past(), config=config)
    wanted = jax.tree.map(lambda x: x[0], commands(1))

    def plan(seam):
        control = dataclasses.replace(CONTROL, seam=seam, ball_seam=seam)
        return jax.jit(
            lambda key: (
                smgdiff_controller.replan(
                    generate,
                    sample,
                    key,
                    state,
                    wanted,
                    representation=representation,
                    config=config,
                    control=control,
                ).plan
            )
        )(jax.random.key(4))

    bare, joined = plan(0.0), plan(0.2)
    shown = state.past
    for get in (lambda x: x.ball, lambda x: x.motion.root_position):
        step = get(bare)[1] - get(bare)[0]
        expected = get(shown)[-1] + step
        off, near = (jnp.linalg.norm(get(x)[0] - expected) for x in (bare, joined))
        # A sixth of the seam later the quintic has given up a fifth of the offset;
        # the root also brings the velocity along that it had.
        assert float(near) < 0.5 * float(off)
        # From 0.2 s on the plan is the network's.
        np.testing.assert_allclose(get(joined)[6:], get(bare)[6:], atol=1e-5)


def accelerations(ball):
    """Lengths, m/s^2."""
    change = np.diff(np.asarray(ball, np.float64), n=2, axis=0)
    return 30.0**2 * np.linalg.norm(change, axis=-1)


@pytest.mark.parametrize(
    "away, near", [(0.0, True), (0.16, True), (0.21, False), (5.0, False)]
)
def test_at_a_seam_only_a_foot_pushes_the_ball(parts, away, near):
    """The next plan has the ball 15 cm aside, and 0.6 m/s slower.

    It is 11 cm from its center to its surface, and 7 cm from there to a foot's joint.
    """
    representation, _, _ = parts
    still = jax.tree.map(lambda x: jnp.repeat(x[:1], 26, axis=0), past())
    feet = representation.skeleton.feet
    places = joint_positions(representation.skeleton, still.motion)[0, list(feet)]
    begin = places[0] + jnp.array([0.0, away, 0.0])
    times = np.arange(-1.0, 25.0)[:, None] / 30.0
    rolls = np.asarray(begin) + times * [0.0, 0.0, 1.2]
    slower = np.asarray(begin) + [0.15, 0.0, 0.0] + times * [0.0, 0.0, 0.6]
    shown = dataclasses.replace(still, ball=jnp.asarray(rolls, jnp.float32))
    chunk = dataclasses.replace(still, ball=jnp.asarray(slower, jnp.float32))
    cut = lambda scene, *at: jax.tree.map(lambda x: x[slice(*at)], scene)  # noqa: E731
    joined = smgdiff_controller.join(
        cut(shown, 2), cut(chunk, 2, None), representation, control=CONTROL
    )
    found = accelerations(np.concatenate([rolls[:2], joined.ball]))
    assert (found.max() > 12.0) == near
    # After half a second the plan's own.
    np.testing.assert_allclose(joined.ball[15:], slower[17:], atol=1e-5)


@pytest.mark.slow
def test_players_draw_their_own_noise_and_one_alone_is_the_same(parts, frames):
    balls = frames.extra["ball"]
    assert float(jnp.abs(balls[0, 1] - balls[1, 1]).max()) > 1e-4
    alone = played(parts, commands(13, change=7))
    np.testing.assert_allclose(alone.extra["ball"][0, :5], balls[0, :5], atol=1e-3)


def test_urgency_is_a_matter_of_command_and_cursor(parts):
    _, config, _ = parts
    state = smgdiff_controller.init_state(tiny.skeleton(), past(), config=config)
    wanted = jax.tree.map(lambda x: x[0], commands(1))
    need = lambda s, c: int(smgdiff_controller.plan_level(s, c, control=CONTROL))  # noqa: E731
    assert need(state, wanted) == 1  # the first command
    state = dataclasses.replace(state, command=wanted)
    assert need(state, wanted) == 0
    other = dataclasses.replace(wanted, label=jnp.int32(1))
    assert need(state, other) == 1
    assert need(dataclasses.replace(state, cursor=jnp.int32(5)), wanted) == 1


@pytest.mark.parametrize(
    "turned, cursor, plans",
    [(0.1, 1, False), (0.1, 2, False), (0.1, 3, True), (0.6, 1, True), (0.0, 3, False)],
)
def test_small_changes_of_the_command_wait(parts, turned, cursor, plans):
    """Of the plan's own command, however often it changed since."""
    _, config, _ = parts
    control = dataclasses.replace(CONTROL, least=3)
    state = smgdiff_controller.init_state(tiny.skeleton(), past(), config=config)
    told = jax.tree.map(lambda x: x[0], commands(1))
    state = dataclasses.replace(state, command=told)
    for part in range(cursor):
        velocity = told.velocity + jnp.array([turned * (part + 1) / cursor, 0.0])
        wanted = dataclasses.replace(told, velocity=velocity)
        state, _ = smgdiff_controller.advance(
            state, wanted, config=config, control=control
        )
    need = smgdiff_controller.plan_level(state, wanted, control=control)
    assert int(need) == plans


def path_and_wish(state, wanted, config, control, *, soon=0):
    """Of who goes straight to where he wishes, and that wish."""
    seen = []

    def generate(key, wish):
        seen.append(wish)
        return smgdiff_trajectory.straight(
            key, wish, future=config.future, fps=config.fps
        )

    path = smgdiff_controller.wanted_trajectory(
        generate,
        jax.random.key(0),
        tiny.skeleton(),
        state,
        wanted,
        config=config,
        control=control,
        soon=soon,
    )
    return path, seen[0]


@pytest.mark.parametrize("behind, expected", [(0.0, 0.001), (0.4, 0.401), (3.0, 1.0)])
def test_who_follows_wishes_to_be_where_the_command_should_have_taken_him(
    parts, behind, expected
):
    """Half of what he is behind within `follow`; what leads him is on a leash."""
    _, config, _ = parts
    control = dataclasses.replace(CONTROL, follow=config.future / config.fps, hurry=9.0)
    stands = jax.tree.map(lambda x: jnp.repeat(x[-1:], 6, axis=0), past())
    state = smgdiff_controller.init_state(tiny.skeleton(), stands, config=config)
    here = state.anchor
    state = dataclasses.replace(state, anchor=here + jnp.array([0.0, behind]))
    wanted = jax.tree.map(lambda x: x[0], commands(1))
    slow = dataclasses.replace(wanted, velocity=jnp.array([0.0, 0.03]))
    state, _ = smgdiff_controller.advance(state, slow, config=config, control=control)
    np.testing.assert_allclose(
        state.anchor - here, [0.0, expected], rtol=1e-5, atol=1e-6
    )
    changes = ({"follow": 0.0}, {}, {"hurry": 1.1})
    seen = [
        path_and_wish(state, wanted, config, dataclasses.replace(control, **change))[
            1
        ].velocity
        for change in changes
    ]
    gained = 0.5 * expected * config.fps / config.future
    np.testing.assert_allclose(
        jnp.linalg.norm(seen[1] - seen[0]), gained, rtol=1e-4, atol=1e-6
    )
    asked, freely, bounded = (float(jnp.linalg.norm(x)) for x in seen)
    np.testing.assert_allclose(bounded, min(freely, 1.1 * asked), rtol=1e-5)


@pytest.mark.parametrize(
    "now, asked, expected",
    [
        (3.0, 3.0, 3.0),
        (1.0, 3.0, 3.0),
        (5.0, 3.0, 4.0),
        (3.0, 5.0, 4.5),
        (3.0, 0.0, 4.5),
    ],
)
def test_the_part_of_a_path_that_is_played_is_as_long_as_asked(now, asked, expected):
    """A path that begins at 4.5 m/s, by the speed that he has and the one he wants."""
    frames = np.arange(1.0, 31.0)[:, None]
    line = lambda speed, at: trajectory.Trajectory(  # noqa: E731
        position=jnp.asarray(speed / 30.0 * at * [0.0, 1.0], jnp.float32),
        facing=jnp.tile(jnp.array([0.0, 1.0]), (len(at), 1)),
    )
    wish = smgdiff_trajectory.Wish(
        past=line(now, frames[:5] - 5.0),
        velocity=jnp.array([0.0, float(asked)]),
        label=jnp.int32(0),
    )
    path = smgdiff_controller.in_time(line(4.5, frames), wish, num_frames=15, fps=30.0)
    np.testing.assert_allclose(
        path.position, line(expected, frames).position, rtol=1e-5
    )


@pytest.mark.parametrize("speed, turns", [(0.0, True), (0.5, False)])
def test_who_stands_turns_as_commanded(parts, speed, turns):
    """Without a wish to go; a command that turns alone then is a new one."""
    _, config, _ = parts
    control = dataclasses.replace(CONTROL, turn=0.1)
    state = smgdiff_controller.init_state(tiny.skeleton(), past(), config=config)
    old = state.command.facing
    wanted = Command(
        velocity=jnp.array([0.0, speed]),
        facing=jnp.array([old[1], -old[0]]),
        label=jnp.int32(0),
    )
    told = dataclasses.replace(wanted, facing=old)
    shown = dataclasses.replace(state, command=told)
    need = smgdiff_controller.plan_level(shown, wanted, control=control)
    assert int(need) == turns
    path, _ = path_and_wish(state, wanted, config, control)
    # A quarter turn from where he faces, which is +z of the path's frame.
    end = path.facing[-1]
    assert (abs(float(end[1])) < 0.3) == turns


def test_bad_input_is_named(parts):
    representation, config, _ = parts
    with pytest.raises(ValueError, match="past has 3 frames, expected 4 or more"):
        smgdiff_controller.init_state(tiny.skeleton(), past(3), config=config)
    with pytest.raises(ValueError, match="apply is 13, expected 1..12"):
        smgdiff_controller.controller(
            lambda key, wish: None,
            lambda key, condition: None,
            representation=representation,
            config=config,
            control=smgdiff_controller.Control(apply=13),
        )


def test_the_step_of_the_chain_reaches_both_samplers(parts, monkeypatch):
    seen = []

    def sampler(params, **options):
        seen.append(options["step"])
        return lambda key, given: given

    for module in (smgdiff_trajectory, smgdiff_guidance):
        monkeypatch.setattr(module, "sampler", sampler)
    method = smgdiff_controller.Method(
        config=smgdiff_model.Config(num_features=1, num_labels=1),
        paths=smgdiff_trajectory.Config(num_labels=1),
        step=chain.ddim_step,
    )
    method(({}, {}, parts[0]))
    assert seen == [chain.ddim_step] * 2


def asked(now, then=(1.4, 0.0), **control):
    """What is wished for of who has moved so, and is to move so."""
    times = jnp.arange(-3, 1) / 30.0
    wish = smgdiff_trajectory.Wish(
        past=trajectory.Trajectory(
            position=times[:, None] * jnp.asarray(now)[None],
            facing=jnp.tile(jnp.array([0.0, 1.0]), (4, 1)),
        ),
        velocity=jnp.asarray(then),
        label=jnp.int32(0),
    )
    control = dataclasses.replace(CONTROL, **control)
    return smgdiff_controller.walkable(wish, soon=6, fps=30.0, control=control)


@pytest.mark.parametrize("then", [(0.0, 0.0), (1.4, 0.0)])
def test_gradients_of_the_wish_are_finite_for_who_stands(then):
    def far(velocity):
        still = jnp.zeros(2)
        wish = asked(still, velocity, agile=2.0, answer=0.1)
        path = jax.tree.map(lambda x: jnp.tile(x[-1:], (12, 1)), wish.past)
        path = smgdiff_controller.in_time(path, wish, num_frames=6, fps=30.0)
        return jnp.sum(path.position) + jnp.sum(wish.velocity) + jnp.sum(wish.soon)

    assert np.isfinite(jax.grad(far)(jnp.asarray(then))).all()


@pytest.mark.parametrize("half_life", [0.05, 0.1, 0.3])
def test_the_second_target_is_on_the_way_to_what_is_commanded(half_life):
    now, then = np.array([1.2, 0.5]), np.array([1.4, 0.0])
    wish = asked(now, then, answer=half_life)
    # A critically damped spring of velocities, integrated in small steps.
    decay, velocity, rate, moved = 2 * np.log(2) / half_life, now.copy(), 0.0, 0.0
    for _ in range(20_000):
        moved = moved + velocity * (0.2 / 20_000)
        pull = decay**2 * (then - velocity) - 2 * decay * rate
        velocity = velocity + rate * (0.2 / 20_000)
        rate = rate + pull * (0.2 / 20_000)
    np.testing.assert_allclose(wish.soon, moved / 0.2, rtol=2e-3)
    np.testing.assert_array_equal(wish.velocity, np.float32(then))


@pytest.mark.parametrize("now", [[0.0, 0.0], [0.0, 2.0], [-2.4, 0.7]])
@pytest.mark.parametrize("then", [[0.0, 0.3], [3.5, 0.0], [0.0, -2.0]])
def test_nobody_is_asked_to_slow_down_or_turn_faster_than_people_do(now, then):
    wish = asked(now, then, agile=1.0)
    for found, wanted, part in (
        (wish.velocity, np.array(then), 1.0),
        (wish.soon, np.asarray(asked(now, wish.velocity).soon), 0.43),
    ):
        onward = now + 0.25 * wanted
        onward /= np.hypot(*onward)
        change = wanted - now
        faster = max(change @ onward, 0.0) * onward
        turn = change - faster
        most = part * (1.0 + np.hypot(*now))
        turn *= min(1.0, most / max(np.hypot(*turn), 1e-9))
        np.testing.assert_allclose(found, now + faster + turn, atol=2e-5)


def test_a_start_is_not_limited_and_a_turn_is():
    start = asked([0.0, 0.0], [0.0, 3.5], agile=0.5)
    np.testing.assert_allclose(start.velocity, [0.0, 3.5], atol=1e-5)
    back = asked([0.0, 2.0], [0.0, -2.0], agile=0.5)
    np.testing.assert_allclose(back.velocity, [0.0, 0.5], atol=1e-5)


def test_without_a_limit_a_wish_is_the_command():
    wish = asked([2.0, 0.0], [-3.0, 1.0])
    np.testing.assert_array_equal(wish.velocity, [-3.0, 1.0])


def test_paths_are_made_for_the_second_target(parts):
    _, config, _ = parts
    state = smgdiff_controller.init_state(tiny.skeleton(), past(), config=config)
    one = jax.tree.map(lambda x: x[0], commands(1))
    wished = [path_and_wish(state, one, config, CONTROL, soon=n)[1] for n in (0, 5)]
    assert wished[0].soon is None
    assert wished[1].soon.shape == (2,)


FETCHES = dataclasses.replace(CONTROL, fetch=1.0, fetches_as=1)


def after_a_kick(config, place, velocity=(0.0, 0.0), *, label=0):
    """A state whose plan was made for a label, and how far he is from `place`."""
    state = smgdiff_controller.init_state(tiny.skeleton(), past(), config=config)
    here = state.past.motion.root_position[-1, ::2]
    state = smgdiff_controller.kicked(
        state, here + jnp.asarray(place), jnp.asarray(velocity)
    )
    told = dataclasses.replace(state.command, label=jnp.int32(label))
    return dataclasses.replace(state, command=told)


@pytest.mark.parametrize(
    "away, before, speed, label, expected",
    [
        (0.9, 0, 1.0, 0, False),
        (1.1, 0, 1.0, 0, True),
        (0.65, 1, 1.0, 0, True),
        (0.55, 1, 1.0, 0, False),
        (3.0, 0, 0.0, 0, False),
        (3.0, 1, 1.0, 1, False),
    ],
    ids=["at hand", "lost", "not yet back", "back", "stands", "wants no ball"],
)
def test_who_has_lost_the_ball_runs_to_it(parts, away, before, speed, label, expected):
    _, config, _ = parts
    state = after_a_kick(config, [away, 0.0], label=before)
    command = Command(
        velocity=jnp.array([0.0, speed]),
        facing=jnp.array([0.0, 1.0]),
        label=jnp.int32(label),
    )
    found = smgdiff_controller.fetching(state, command, control=FETCHES)
    if expected:
        np.testing.assert_allclose(found.velocity, [min(3.0, away / 0.7), 0], atol=1e-5)
        np.testing.assert_allclose(found.facing, [1.0, 0.0], atol=1e-5)
        assert int(found.label) == 1
    else:
        for a, b in zip(*map(jax.tree.leaves, (found, command)), strict=True):
            np.testing.assert_array_equal(a, b)
    paper = smgdiff_controller.fetching(state, command, control=CONTROL)
    assert paper is command


def test_who_fetches_a_ball_aims_at_where_it_rolls(parts):
    """It is 2 m ahead and rolls aside at 2 m/s; he would be there in 2/3 s."""
    _, config, _ = parts
    state = after_a_kick(config, [0.0, 2.0], [2.0, 0.0])
    command = jax.tree.map(lambda x: x[0], commands(1))
    found = smgdiff_controller.fetching(state, command, control=FETCHES)
    now, seconds = 2.0 - 0.4 / 30, 2.0 / 3.0
    aim = np.array([now * seconds - 0.4 * seconds**2, 2.0])
    np.testing.assert_allclose(
        found.velocity, 2.0 / 0.7 * aim / np.hypot(*aim), rtol=1e-3
    )


def test_after_a_kick_he_plans_from_where_he_is(parts):
    """The plan that he displays says where that is, so nobody skips a part of it."""
    _, config, _ = parts
    told = jax.tree.map(lambda x: x[0], commands(1))
    state = smgdiff_controller.init_state(tiny.skeleton(), past(), config=config)
    state = dataclasses.replace(state, command=told, cursor=jnp.int32(2))
    level = lambda s: int(smgdiff_controller.plan_level(s, told, control=CONTROL))  # noqa: E731
    assert level(state) == 0
    after = smgdiff_controller.kicked(state, jnp.array([1.0, 2.0]), jnp.zeros(2))
    assert level(after) == 1 and after.cursor == state.cursor
    np.testing.assert_array_equal(after.past.ball[-1, ::2], [1.0, 2.0])


@pytest.mark.slow
def test_a_lost_ball_rolls_and_is_not_planned(parts):
    representation, config, _ = parts
    driver = driver_of(representation, config, FETCHES)
    state = after_a_kick(config, [0.0, 5.0], [1.5, 0.0])
    place = np.asarray(state.past.ball[-1])
    state = jax.tree.map(lambda x: x[None], state)
    told = jax.tree.map(lambda x: x[None], commands(12))
    run = jax.jit(lambda *given: rollout.rollout(driver, *given)[1])
    frames = run(jax.random.key(0), state, told)
    times = np.arange(1, 13) / 30
    way = (1.5 - 0.4 / 30) * times - 0.4 * times**2
    rolls = place + np.stack([way, 0 * times, 0 * times], 1)
    # Plans of five frames join, as if they were one.
    np.testing.assert_allclose(frames.extra["ball"][0], rolls, atol=1e-4)
    assert frames.planned[0, 0]


@pytest.mark.slow
def test_a_lost_ball_of_who_is_told_to_stand_is_planned(parts):
    representation, config, _ = parts
    state = after_a_kick(config, [0.0, 5.0], [1.5, 0.0])
    stand = dataclasses.replace(
        jax.tree.map(lambda x: x[0], commands(1)), velocity=jnp.zeros(2)
    )
    plain, fetching = (
        jax.jit(driver_of(representation, config, control).plans[0])(
            jax.random.key(0), state, stand
        )
        for control in (CONTROL, FETCHES)
    )
    np.testing.assert_allclose(fetching.plan.ball, plain.plan.ball, atol=1e-5)


def test_nobody_fetches_as_a_skill_that_is_not_there(parts):
    representation, config, _ = parts
    with pytest.raises(ValueError, match=r"fetches_as is 2, expected 0\.\.1"):
        driver_of(representation, config, dataclasses.replace(FETCHES, fetches_as=2))
