"""What a server simulates, whatever the system behind it."""

from typing import Any, Protocol

import numpy as np

from serving.protocol import Command


class Simulation(Protocol):
    """One kind of character, of which each client has its own state.

    Attributes:
      fps: Ticks per second.
      joints: Names of the joints.
      parents: Parent of each joint; -1 for the root.
      offsets: Position of each joint in its parent's frame, meters, [joints, 3].
      labels: Names of the styles or skills.
    """

    fps: float
    joints: tuple[str, ...]
    parents: tuple[int, ...]
    offsets: np.ndarray
    labels: tuple[str, ...]

    def start(self, seed: int) -> Any:
        """State of a new character.

        Args:
          seed: Of all that is random about it.

        Returns:
          The state.
        """

    def step(
        self, state: Any, command: Command, n: int
    ) -> tuple[Any, dict[str, np.ndarray]]:
        """The next tick of a character.

        Args:
          state: From `start` or the last `step`, which may use up its buffers.
          command: What its client wants.
          n: Number of the tick; none comes twice.

        Returns:
          The next state, and the pose to show: "root" [3], "rotations" [joints, 6],
          perhaps more, such as "ball" [3].
        """


def first_command(simulation: Simulation) -> Command:
    """What a character does before its client says anything.

    Args:
      simulation: The simulation.

    Returns:
      To stand and face +z, with the first label.
    """
    return Command(label=simulation.labels[0] if simulation.labels else None)


def warm(simulation: Simulation) -> None:
    """Compiles all that a tick may need, and runs it once; before anyone waits for it.

    Args:
      simulation: The simulation.
    """
    # A first plan, none, one for another velocity, one for each change of label.
    first = first_command(simulation)
    others = [Command(velocity=(0.0, 1.0), label=label) for label in simulation.labels]
    state = simulation.start(0)
    for n, command in enumerate([first, first, *others]):
        state, _ = simulation.step(state, command, n)
