"""The engine of rollouts on a controller that counts and draws, without a network."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest

from jaxmotion.control.rollout import (
    Controller,
    Crowd,
    crowd_tick,
    rollout,
    tick,
)

CHARACTERS, TICKS = 6, 11


def draw(key):
    return jax.random.uniform(key)


def toy(ran=None):
    """State: ticks shown, value of the plan, plans made. A command is the plan wanted.

    The second planner gives those who want the first what the first would give.
    """

    def plan(number):
        def make(key, state, command):
            if ran is not None:
                jax.debug.callback(lambda: ran.append(number))
            count, _, plans = state
            dear = (number == 2) & (command == 2)
            return count, draw(key) + 10.0 * dear, plans + 1

        return make

    def advance(state, command):
        count, value, plans = state
        frame = {"value": value, "count": count, "plans": plans, "command": command}
        return (count + 1, value, plans), frame

    return Controller(
        plan_level=lambda state, command: command,
        plans=(plan(1), plan(2)),
        advance=advance,
    )


def start(number):
    zero = jnp.zeros(number, jnp.int32)
    return zero, jnp.full(number, -1.0), zero


@pytest.fixture(scope="module")
def commands():
    chances = [0.6, 0.3, 0.1]
    drawn = np.random.default_rng(0).choice(3, (CHARACTERS, TICKS), p=chances)
    return jnp.asarray(drawn, jnp.int32)


def run(commands, seed=0, **options):
    program = jax.jit(lambda k, s, c: rollout(toy(), k, s, c, **options))
    return program(jax.random.key(seed), start(commands.shape[0]), commands)


def test_each_character_is_its_ticks_one_by_one(commands):
    """A Python loop; tick i of character c draws from fold_in(fold_in(key, c), i)."""
    states, frames = run(commands)
    for c in range(CHARACTERS):
        value, plans = -1.0, 0
        for i in range(TICKS):
            wanted = int(commands[c, i])
            if wanted:
                key = jax.random.fold_in(jax.random.fold_in(jax.random.key(0), c), i)
                value = float(draw(key)) + 10.0 * (wanted == 2)
                plans += 1
            assert frames["value"][c, i] == pytest.approx(value, abs=1e-6)
            assert frames["plans"][c, i] == plans
            assert frames["count"][c, i] == i
        assert states[2][c] == plans
    np.testing.assert_array_equal(frames["command"], commands)


def test_live_ticks_are_the_rollout(commands):
    states, frames = run(commands)
    live = jax.jit(lambda k, s, c: tick(toy(), k, s, c))
    own_key = jax.random.fold_in(jax.random.key(0), 2)
    state = jax.tree.map(lambda x: x[2], start(CHARACTERS))
    for i in range(TICKS):
        state, frame = live(jax.random.fold_in(own_key, i), state, commands[2, i])
        for name, value in frame.items():
            np.testing.assert_array_equal(value, frames[name][2, i])
    jax.tree.map(lambda a, b: np.testing.assert_array_equal(a, b[2]), state, states)


@pytest.mark.parametrize("chunk", [1, 2, 3])
def test_chunks_change_nothing(commands, chunk):
    jax.tree.map(
        np.testing.assert_array_equal, run(commands, chunk=chunk), run(commands)
    )


def test_the_number_of_characters_changes_nothing(commands):
    fewer, whole = run(commands[:2]), run(commands)
    jax.tree.map(lambda a, b: np.testing.assert_array_equal(a, b[:2]), fewer, whole)


def test_a_part_of_a_batch_is_as_in_the_whole(commands):
    part, whole = run(commands[2:], first=2), run(commands)
    jax.tree.map(lambda a, b: np.testing.assert_array_equal(a, b[2:]), part, whole)


def test_characters_and_ticks_draw_their_own_numbers():
    _, frames = run(jnp.ones((CHARACTERS, TICKS), jnp.int32))
    assert np.unique(np.asarray(frames["value"])).size == CHARACTERS * TICKS
    _, other = run(jnp.ones((CHARACTERS, TICKS), jnp.int32), seed=1)
    assert not np.any(np.isin(other["value"], frames["value"]))


def test_a_tick_runs_the_most_expensive_plan_wanted_and_no_other():
    wanted = jnp.array([[0, 1, 0, 2, 0], [0, 0, 2, 1, 1]], jnp.int32)
    ran = []
    program = jax.jit(lambda k, s, c: rollout(toy(ran), k, s, c))
    jax.block_until_ready(program(jax.random.key(0), start(2), wanted))
    jax.effects_barrier()
    assert sorted(ran) == sorted(int(x) for x in wanted.max(axis=0) if x)


@pytest.mark.parametrize("chunk", [4, 5, 7])
def test_chunks_must_divide(commands, chunk):
    with pytest.raises(ValueError, match=f"{CHARACTERS} characters.*chunks of {chunk}"):
        run(commands, chunk=chunk)


def test_commands_may_be_any_tree(commands):
    @jax.tree_util.register_dataclass
    @dataclasses.dataclass(frozen=True)
    class Both:
        number: jax.Array
        vector: jax.Array

    plain = toy()
    nested = Controller(
        plan_level=lambda s, c: plain.plan_level(s, c.number),
        plans=tuple(
            lambda k, s, c, plan=plan: plan(k, s, c.number) for plan in plain.plans
        ),
        advance=lambda s, c: (plain.advance(s, c.number)[0], c.vector),
    )
    vector = jax.random.normal(jax.random.key(5), (CHARACTERS, TICKS, 3))
    both = Both(commands, vector)
    states, frames = jax.jit(lambda k, s, c: rollout(nested, k, s, c))(
        jax.random.key(0), start(CHARACTERS), both
    )
    np.testing.assert_array_equal(frames, vector)
    jax.tree.map(np.testing.assert_array_equal, states, run(commands)[0])


def test_a_crowd_shares_its_plans(commands):
    ran = []
    controller = toy(ran)
    program = jax.jit(
        lambda key, crowd, command: crowd_tick(
            controller, key, crowd, command, at_most=2
        )
    )
    zero = jnp.zeros(CHARACTERS, jnp.int32)
    crowd = Crowd(states=start(CHARACTERS), told=zero, waited=zero)
    every = jnp.ones(CHARACTERS, jnp.int32)
    plans = []
    for i in range(4):
        crowd, frame = program(jax.random.key(i), crowd, every)
        plans.append(np.asarray(frame["plans"]))
        heard = np.asarray(frame["command"])
        # Who has not yet had a turn follows what he was told before.
        np.testing.assert_array_equal(heard, plans[-1] > 0)
    # Two in a tick: the first ones first, and then who has waited longest.
    want = [[1, 1, 0, 0, 0, 0], [1, 1, 1, 1, 0, 0], [1] * 6, [2, 2, 1, 1, 1, 1]]
    np.testing.assert_array_equal(plans, want)
    np.testing.assert_array_equal(crowd.states[0], np.full(CHARACTERS, 4))
    # The dear plan for one who asks for it, the cheap one beside it.
    values = jnp.asarray([0, 0, 2, 0, 1, 0], jnp.int32)
    crowd = Crowd(states=start(CHARACTERS), told=zero, waited=zero)
    crowd, frame = program(jax.random.key(9), crowd, values)
    value = np.asarray(frame["value"])
    assert value[2] > 10 and 0 <= value[4] < 1 and (value[[0, 1, 3, 5]] == -1).all()
    np.testing.assert_array_equal(crowd.waited, zero)


def test_a_crowd_draws_as_a_batch_and_hears_what_needs_no_plan():
    """Character c draws from fold_in(key, c), whatever its place among the chosen."""
    zero = jnp.zeros(CHARACTERS, jnp.int32)
    crowd = Crowd(states=start(CHARACTERS), told=zero, waited=zero)
    program = jax.jit(lambda k, x, c: crowd_tick(toy(), k, x, c, at_most=2))
    key = jax.random.key(3)
    crowd, frame = program(key, crowd, jnp.asarray([0, 1, 0, 0, 1, 0], jnp.int32))
    for c in (1, 4):
        own = float(draw(jax.random.fold_in(key, c)))
        assert frame["value"][c] == pytest.approx(own, abs=1e-6)
    for command in (np.full(CHARACTERS, 0), np.array([0, 0, 0, 0, 0, 1])):
        crowd, frame = program(key, crowd, jnp.asarray(command, jnp.int32))
        np.testing.assert_array_equal(frame["command"], command)
