"""A `simulation.Simulation` made of a controller: one jitted tick for one character."""

from collections.abc import Callable
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from jaxmotion.control import rollout
from jaxmotion.motion import trajectory
from jaxmotion.motion.skeleton import Skeleton
from serving.protocol import Command

# A character between two ticks: seed of its noise, and the controller's state.
State = tuple[int, Any]


class ControlledSimulation:
    """Characters under a controller; see `simulation.Simulation` for its fields.

    All clients share one compiled program. The states' buffers are donated to it.
    """

    def __init__(
        self,
        controller: rollout.Controller,
        skeleton: Skeleton,
        first: Any,
        arrays: Callable[[Any], dict[str, jax.Array]],
        *,
        labels: tuple[str, ...],
        fps: float,
    ) -> None:
        """Compiles nothing yet.

        Args:
          controller: Of one character, with commands `trajectory.Command`.
          skeleton: The skeleton.
          first: State of the controller that every character begins with.
          arrays: Picks what to show of a controller's frame, by name.
          labels: Names of the styles or skills.
          fps: Ticks per second.
        """
        self.fps, self.labels = fps, labels
        self.joints, self.parents = skeleton.names, skeleton.parents
        self.offsets = np.asarray(skeleton.offsets)
        self._first = first

        # The key is made inside: one call a tick, and no key that outlives it.
        def tick(seed, n, state, velocity, facing, label) -> tuple[Any, dict]:
            key = jax.random.fold_in(jax.random.key(seed), n)
            command = trajectory.Command(velocity=velocity, facing=facing, label=label)
            state, frame = rollout.tick(controller, key, state, command)
            return state, arrays(frame)

        self._tick = jax.jit(tick, donate_argnums=2)

    def start(self, seed: int) -> State:
        """State of a new character; they differ in their noise alone.

        Args:
          seed: Of the noise.

        Returns:
          The state.
        """
        # Copies: a buffer can be donated once.
        return seed, jax.tree.map(jnp.copy, self._first)

    def step(
        self, state: State, command: Command, n: int
    ) -> tuple[State, dict[str, np.ndarray]]:
        """The next tick of a character.

        Args:
          state: From `start` or the last `step`; used up.
          command: What its client wants.
          n: Number of the tick.

        Returns:
          The next state, and the pose to show.
        """
        seed, inner = state
        label = self.labels.index(command.label) if self.labels else 0
        inner, frame = self._tick(
            np.uint32(seed),
            np.uint32(n),
            inner,
            np.asarray(command.velocity, np.float32),
            np.asarray(command.facing, np.float32),
            np.int32(label),
        )
        return (seed, inner), {name: np.asarray(x) for name, x in frame.items()}
