"""A character without a network that strides where it is told, for the live page."""

import jax
import jax.numpy as jnp
import numpy as np

from jaxmotion.control.frame import Frame
from jaxmotion.control.rollout import Controller
from jaxmotion.control.steering import Character, Tuning
from jaxmotion.data import walker
from jaxmotion.motion.rotation import matrix_from_facing, rot6d_from_matrix
from jaxmotion.motion.rotation_vector import to_matrix
from jaxmotion.motion.spring import facing_spring, velocity_spring

FPS = 30.0
LABELS = ("calm", "crouch")
LEGS = (14, 15, 18, 19)


def _pose(phase, swing, facing):
    """Rotations of the walker whose thighs and knees swing."""
    legs = jnp.sin(phase) * swing * jnp.array([1.0, 0.0, -1.0, 0.0])
    knees = jnp.maximum(jnp.cos(phase) * jnp.array([0.0, 1.0, 0.0, -1.0]), 0.0) * swing
    vectors = jnp.zeros((22, 3)).at[jnp.array(LEGS), 0].set(1.2 * knees - legs)
    vectors = vectors.at[jnp.array([7, 11]), 2].set(jnp.array([-1.3, 1.3]))
    return rot6d_from_matrix(to_matrix(vectors).at[0].set(matrix_from_facing(facing)))


def strider(ball=False, cost=0.0, labels=LABELS):
    """A character that plans every 15 ticks and when told; `cost` seconds a plan.

    `traces` of what is returned counts how often it was traced.
    """
    skeleton, traces = walker.walker_skeleton(), []

    def wait():
        import time

        time.sleep(cost)

    def plan_level(state, command):
        old = state["told"]
        far = jnp.abs(old["velocity"] - command.velocity).max() > 1e-3
        far |= jnp.abs(old["facing"] - command.facing).max() > 1e-3
        far |= (old["label"] != command.label) | (state["cursor"] >= 15)
        return far.astype(jnp.int32)

    def plan(key, state, command):
        if cost:
            jax.debug.callback(wait)
        return {**state, "cursor": jnp.zeros((), jnp.int32)}

    def advance(state, command):
        times = {"half_life": 0.15, "dt": 1 / FPS}
        place, velocity, rate = velocity_spring(
            state["place"], state["velocity"], state["rate"], command.velocity, **times
        )
        facing, turn = facing_spring(
            state["facing"], state["turn"], command.facing, **times
        )
        speed = jnp.linalg.norm(velocity)
        phase = state["phase"] + speed * 4.0 / FPS
        told = {
            "velocity": command.velocity,
            "facing": command.facing,
            "label": command.label,
        }
        new = dict(place=place, velocity=velocity, rate=rate, facing=facing, turn=turn)
        new |= dict(phase=phase, cursor=state["cursor"] + 1, told=told)
        low = 0.2 * (command.label == 1)
        ahead = place + 0.5 * facing
        extra = {"ball": jnp.array([ahead[0], 0.11, ahead[1]])} if ball else {}
        return new, Frame(
            root_position=jnp.array([place[0], 0.95 - low, place[1]]),
            joint_rotation=_pose(phase, 0.6 * jnp.tanh(speed), facing),
            desired_velocity=command.velocity,
            desired_facing=command.facing,
            planned=state["cursor"] == 0,
            extra=extra,
            fps=FPS,
        )

    def method(params):
        traces.append(1)
        return Controller(plan_level=plan_level, plans=(plan,), advance=advance)

    def starts(indices, seed):
        one = dict(
            place=jnp.zeros(2),
            velocity=jnp.zeros(2),
            rate=jnp.zeros(2),
            facing=jnp.array([0.0, 1.0]),
            turn=jnp.zeros(()),
            phase=jnp.zeros(()),
            cursor=jnp.zeros((), jnp.int32),
            told=dict(
                velocity=jnp.zeros(2),
                facing=jnp.array([0.0, 1.0]),
                label=jnp.full((), -1, jnp.int32),
            ),
        )
        return jax.tree.map(lambda x: jnp.stack([x] * len(indices)), one)

    tuning = Tuning(
        method=lambda num_steps, scale: method,
        num_steps=tuple(range(1, 9)),
        own_steps=8,
        scale=0.7,
        scales=(0.0, 2.0),
        patience=30,
    )
    character = Character(
        skeleton=skeleton,
        labels=labels,
        fps=FPS,
        source="tests",
        params={"none": np.zeros(1, np.float32)},
        method=method,
        starts=starts,
        tuning=tuning,
    )
    return character, traces
