"""Autoregression as one program: many characters, many ticks, one scan.

A controller is three functions for one character:

* `plan_level(state, command)` says which plan the tick needs: 0 none, 1 .. n one of the
  n planners, from the cheapest to the most expensive.
* `plans[i - 1](key, state, command)` makes a new plan (runs a network).
* `advance(state, command)` displays the next frame.

`tick` composes them for one character: live use. `rollout` scans them over time for a
batch. There a plain `vmap(tick)` would run every planner in every tick, because under
vmap a conditional computes all of its branches; so the batch asks once a tick for the
most expensive plan that any of its characters needs, and runs only that one. Characters
that need none keep theirs, and those that need a cheaper one get the more expensive
one, which must give them the same (as classifier-free guidance with scale 1 does).

Keys: character c draws from `fold_in(key, c)`, tick i of it from `fold_in(that, i)`. So
neither the number of characters nor their division into chunks changes a result.
"""

import dataclasses
from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
from jax.sharding import Mesh, NamedSharding, PartitionSpec
from jaxtyping import Array, Bool, Float, Int

from jaxmotion.typing import Exported, Key

State = Any
Commands = Any
Frame = Any


@dataclasses.dataclass(frozen=True, kw_only=True)
class Controller:
    """The three functions of the module's docstring; not a pytree.

    Attributes:
      plan_level: `(state, command) -> int32`.
      plans: Planners in the order of their cost, `(key, state, command) -> state`.
      advance: `(state, command) -> (state, frame)`.
      shown: `(state, frame) -> state` that remembers this frame as the last displayed
        one, for who changes frames on their way to the screen; None if it cannot.
    """

    plan_level: Callable[[State, Commands], Int[Array, ""]]
    plans: tuple[Callable[[Key, State, Commands], State], ...]
    advance: Callable[[State, Commands], tuple[State, Frame]]
    shown: Callable[[State, Frame], State] | None = None


def exports(controller: Controller) -> dict[str, Exported]:
    """The functions of a controller that plans now and then, for who composes them.

    They are "plan_level", "plan" ("plan_2" and so on, where there are several planners)
    and "advance"; a tick calls them as `tick` does.
    """
    takes = ("state", "command")
    plans = {
        "plan" if i == 1 else f"plan_{i}": Exported(plan, ("key", *takes), ("state",))
        for i, plan in enumerate(controller.plans, start=1)
    }
    return {
        "plan_level": Exported(controller.plan_level, takes, ("level",)),
        **plans,
        "advance": Exported(controller.advance, takes, ("state", "frame")),
    }


def is_due(
    change: Float[Array, ""], played: Int[Array, ""], *, least: int, sharp: float
) -> Bool[Array, ""]:
    """Whether a change of the command is worth a new plan.

    A plan begins as the last one goes on, so that of one in every tick nothing that is
    wished for is ever displayed: small changes wait until `least` frames were played.

    Args:
      change: How far the command is from the plan's.
      played: Frames of the plan that were displayed.
      least: Frames to play before a change of less than `sharp` counts.
      sharp: A change that counts at once.
    """
    return ((change > 1e-3) & (played >= least)) | (change >= sharp)


def tick(
    controller: Controller, key: Key, state: State, command: Commands
) -> tuple[State, Frame]:
    """One tick of one character: plan if needed, then display a frame."""
    branches = [lambda k, s, c: s, *controller.plans]
    need = controller.plan_level(state, command)
    state = jax.lax.switch(need, branches, key, state, command)
    return controller.advance(state, command)


def _select(keep: Array, old: State, new: State) -> State:
    def choose(a: Array, b: Array) -> Array:
        return jnp.where(keep.reshape(-1, *(1,) * (a.ndim - 1)), a, b)

    return jax.tree.map(choose, old, new)


def batch_tick(
    controller: Controller, keys: Array, states: State, commands: Commands
) -> tuple[State, Frame]:
    """One tick of many characters: the most expensive plan that any of them needs.

    Keys, one per character, are consumed; states have the batch axis first.
    """
    need = jax.vmap(controller.plan_level)(states, commands)
    states = _plan(controller, keys, states, commands, need)
    return jax.vmap(controller.advance)(states, commands)


def _plan(
    controller: Controller, keys: Array, states: State, commands: Commands, need: Array
) -> State:
    """The most expensive plan that any needs, for all who need one."""

    def run(plan) -> Callable:
        def planned(keys: Array, states: State, commands: Commands) -> State:
            new = jax.vmap(plan)(keys, states, commands)
            return _select(need == 0, states, new)

        return planned

    branches = [lambda k, s, c: s, *(run(plan) for plan in controller.plans)]
    return jax.lax.switch(jnp.max(need), branches, keys, states, commands)


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True, kw_only=True, eq=False)
class Crowd:
    """Characters that share a budget of plans, between two ticks; batch axis first.

    Attributes:
      told: The command that each follows; it may not yet have heard of the newest.
      waited: Ticks that each waits for a plan.
    """

    states: State
    told: Commands
    waited: Int[Array, " characters"]


def crowd_tick(
    controller: Controller, key: Key, crowd: Crowd, commands: Commands, *, at_most: int
) -> tuple[Crowd, Frame]:
    """One tick of many characters, of whom at most so many plan: live use.

    The others go on with the plan and the command that they have, until it is their
    turn: who has waited longest comes first, then who has the lower number. So a
    command that all get at once reaches them in a wave, and no tick takes longer than
    its budget of plans.

    Args:
      key: Consumed; character c draws from `fold_in(key, c)`.
      at_most: Plans in a tick, in 1..characters; static.
    """
    need = jax.vmap(controller.plan_level)(crowd.states, commands)
    waited = jnp.where(need > 0, crowd.waited + 1, 0)
    _, chosen = jax.lax.top_k(waited, at_most)
    keys = jax.vmap(lambda c: jax.random.fold_in(key, c))(chosen)
    some, told = jax.tree.map(lambda x: x[chosen], (crowd.states, commands))
    planned = _plan(controller, keys, some, told, need[chosen])
    put = lambda x, new: x.at[chosen].set(new)  # noqa: E731
    states = jax.tree.map(put, crowd.states, planned)
    heard = (need == 0).at[chosen].set(True)
    told = _select(heard, commands, crowd.told)
    states, frames = jax.vmap(controller.advance)(states, told)
    waited = jnp.where(heard, 0, waited)
    return Crowd(states=states, told=told, waited=waited), frames


def rollout(
    controller: Controller,
    key: Key,
    states: State,
    commands: Commands,
    *,
    first: int | Int[Array, ""] = 0,
    chunk: int | None = None,
    mesh: Mesh | None = None,
) -> tuple[State, Frame]:
    """Displays one frame a tick for many characters; jit it as a whole.

    Args:
      states: States of the characters, batch axis first.
      commands: Commands [characters, ticks, ...].
      first: Number c of the first character: a part of a batch draws what it draws in
        the whole.
      chunk: Run so many characters at a time (it must divide their number), which
        keeps a large batch within a processor's cache; None for all at once.
      mesh: Split the characters over the mesh's first axis. A chunk is then what
        each device runs at a time, and must divide each device's share.

    Returns:
      The states after the last tick, and frames [characters, ticks, ...].

    Raises:
      ValueError: if chunk or the mesh does not divide the number of characters.
    """
    number = jax.tree.leaves(commands)[0].shape[0]
    devices = 1 if mesh is None else mesh.shape[mesh.axis_names[0]]
    size = number // devices if chunk is None else chunk
    if number % devices or (number // devices) % size:
        raise ValueError(
            f"{number} characters on {devices} devices in chunks of {size}: "
            "expected a number that both divide"
        )
    keys = jax.vmap(lambda c: jax.random.fold_in(key, c))(first + jnp.arange(number))
    run = lambda k, s, c: _scan(controller, k, s, c, size)  # noqa: E731
    if mesh is None:
        return run(keys, states, commands)
    spec = PartitionSpec(mesh.axis_names[0])
    # Automatic axes, whatever the given mesh has (jax.make_mesh makes explicit ones).
    mesh = Mesh(mesh.devices, mesh.axis_names)
    # shard_map, not a sharding constraint: each device asks only its own characters
    # whether they need a plan, and no tick waits for the others.
    split = NamedSharding(mesh, spec)
    keys, states, commands = jax.lax.with_sharding_constraint(
        (keys, states, commands), split
    )
    return jax.shard_map(
        run, mesh=mesh, in_specs=spec, out_specs=spec, check_vma=False
    )(keys, states, commands)


def _scan(
    controller: Controller, keys: Array, states: State, commands: Commands, size: int
) -> tuple[State, Frame]:
    def chunk_rollout(args: tuple) -> tuple[State, Frame]:
        keys, states, commands = args

        def body(states: State, xs: tuple) -> tuple[State, Frame]:
            i, commands = xs
            tick_keys = jax.vmap(lambda k: jax.random.fold_in(k, i))(keys)
            return batch_tick(controller, tick_keys, states, commands)

        over_time = jax.tree.map(lambda x: jnp.swapaxes(x, 0, 1), commands)
        ticks = jax.tree.leaves(over_time)[0].shape[0]
        states, frames = jax.lax.scan(body, states, (jnp.arange(ticks), over_time))
        return states, jax.tree.map(lambda x: jnp.swapaxes(x, 0, 1), frames)

    number = keys.shape[0]
    if size == number:
        return chunk_rollout((keys, states, commands))
    cut = lambda x: x.reshape(number // size, size, *x.shape[1:])  # noqa: E731
    join = lambda x: x.reshape(number, *x.shape[2:])  # noqa: E731
    done = jax.lax.map(chunk_rollout, jax.tree.map(cut, (keys, states, commands)))
    return jax.tree.map(join, done)
