"""Graphs: names, shapes and meanings of arrays, and the player's BVH."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from jaxtyping import Array, Float

from jaxmotion.data import bvh, bvh_text
from jaxmotion.diffusion import noise
from jaxmotion.export import graph
from jaxmotion.learning import model_json
from jaxmotion.motion.skeleton import joint_positions
from jaxmotion.typing import Exported
from tests import tiny


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True, kw_only=True, eq=False)
class State:
    """A ball.

    Attributes:
      place: Where it is,
        meters.
      parts: What else.
    """

    place: Float[Array, "2"]
    parts: dict[str, Array]


def move(key, state, speed):
    """A step that trembles; also the number of steps."""
    shaken = state.place + speed + jax.random.normal(key, (2,))
    count = state.parts["count"] + 1
    return dataclasses.replace(state, place=shaken, parts={"count": count}), count


STATE = State(place=jnp.zeros(2), parts={"count": jnp.int32(3)})
MOVE = Exported(move, ("key", "state", "speed"), ("state", "count"))


def test_a_graph_names_its_arrays_and_says_what_they_are():
    made = graph.make("move", MOVE, {"state": STATE, "speed": jnp.ones(2)})
    found = [(x.name, x.shape, x.dtype, x.text) for x in made.inputs + made.outputs]
    assert found == [
        ("noise.0", (2,), "float32", "Standard normal."),
        ("state.place", (2,), "float32", "Where it is, meters."),
        ("state.parts.count", (), "int32", "What else."),
        ("speed", (2,), "float32", ""),
        ("out.state.place", (2,), "float32", "Where it is, meters."),
        ("out.state.parts.count", (), "int32", "What else."),
        ("out.count", (), "int32", ""),
    ]
    value = graph.to_json(made, "move.onnx", batch=graph.ANY)
    assert value["file"] == "move.onnx"
    assert value["inputs"][1]["shape"] == [graph.ANY, 2]


@pytest.mark.slow
def test_a_graph_is_its_function():
    """Arrays in the order of the ports; the noise is the one the key would draw."""
    made = graph.make("move", MOVE, {"state": STATE, "speed": jnp.ones(2)})
    key, again = jax.random.key(0), jax.random.clone(jax.random.key(0))
    (drawn,) = noise.draw_noise(move, key, STATE, jnp.ones(2))
    place, count, same = made.run(drawn, STATE.place, jnp.int32(3), jnp.ones(2))
    expected, _ = move(again, STATE, jnp.ones(2))
    np.testing.assert_allclose(place, expected.place, atol=1e-6)
    assert count == same == 4


@pytest.mark.slow
def test_the_players_bvh_is_the_motion():
    """Read by the library, whose forward kinematics gives the same joints."""
    pytest.importorskip("onnxruntime")
    from jaxmotion.export import player

    skeleton = model_json.skeleton_to_json(tiny.skeleton())
    for motion in (tiny.walk(4, turn=1.0), tiny.upturned(tiny.walk(40))):
        parts = (np.asarray(motion.root_position), np.asarray(motion.joint_rotation))
        text = player.bvh(skeleton, motion.fps, *parts)
        read, found = bvh.motion_from_bvh(bvh_text.parse_bvh(text))
        assert read.names == tiny.NAMES and found.fps == motion.fps
        expected = joint_positions(tiny.skeleton(), motion)
        np.testing.assert_allclose(joint_positions(read, found), expected, atol=1e-4)
