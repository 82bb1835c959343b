"""What a server simulates: characters of a model, one state per client."""

from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from jaxmotion.control import rollout
from jaxmotion.control.frame import Frame
from jaxmotion.control.steering import Character
from jaxmotion.motion import trajectory
from serving.protocol import Command


class Characters:
    """A model's characters, whatever its system, of which each client has one.

    All clients share one compiled program, in which the parameters are constants. The
    states' buffers are donated to it.

    Attributes:
      fps: Ticks per second.
      labels: Names of the styles or skills.
      joints: Names of the joints.
      parents: Parent of each joint; -1 for the root.
      offsets: Position of each joint in its parent's frame, meters, [joints, 3].
    """

    def __init__(self, character: Character, *, clips: Any = None) -> None:
        """Compiles nothing yet.

        Args:
          character: The model.
          clips: Clips to start from; None for the model's own start.
        """
        skeleton = character.skeleton
        self.fps, self.labels = character.fps, character.labels
        self.joints, self.parents = skeleton.names, skeleton.parents
        self.offsets = np.asarray(skeleton.offsets)
        self._first = jax.tree.map(lambda x: x[0], character.start(1, clips=clips))
        controller = character.method(character.params)

        # The key is made inside: one call a tick, and no key that outlives it.
        def tick(seed, n, state, velocity, facing, label) -> tuple[Any, dict]:
            key = jax.random.fold_in(jax.random.key(seed), n)
            command = trajectory.Command(velocity=velocity, facing=facing, label=label)
            state, frame = rollout.tick(controller, key, state, command)
            return state, _shown(frame)

        self._tick = jax.jit(tick, donate_argnums=2)

    def start(self, seed: int) -> tuple[int, Any]:
        """State of a new character; they differ in their noise alone."""
        # Copies: a buffer can be donated once.
        return seed, jax.tree.map(jnp.copy, self._first)

    def step(
        self, state: tuple[int, Any], command: Command, n: int
    ) -> tuple[tuple[int, Any], dict[str, np.ndarray]]:
        """The next tick of a character, and the pose to show.

        Args:
          state: From `start` or the last `step`, which may use up its buffers.
          command: What its client wants.
          n: Number of the tick; none comes twice.

        The pose has "root" [3], "rotations" [joints, 6], perhaps "ball" [3].
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


def _shown(frame: Frame) -> dict[str, jax.Array]:
    found = {"root": frame.root_position, "rotations": frame.joint_rotation}
    ball = frame.extra.get("ball")
    return found if ball is None else found | {"ball": ball}


def first_command(simulation: Characters) -> Command:
    """What a character does before its client says anything: stand and face +z."""
    return Command(label=simulation.labels[0] if simulation.labels else None)


def warm(simulation: Characters) -> None:
    """Compiles all that a tick may need, and runs it once; before anyone waits."""
    # A first plan, none, one for another velocity, one for each change of label.
    first = first_command(simulation)
    others = [Command(velocity=(0.0, 1.0), label=label) for label in simulation.labels]
    state = simulation.start(0)
    for n, command in enumerate([first, first, *others]):
        state, _ = simulation.step(state, command, n)
