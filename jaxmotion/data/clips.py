"""Ragged clips of one skeleton as flat arrays.

All frames of all clips lie behind each other; clip c is frames
`offsets[c]:offsets[c + 1]`. That is one array to put on a device, from which windows
are gathered inside jit.
"""

import dataclasses

import jax
from jaxtyping import Array, Float, Int

from jaxmotion.motion.skeleton import Skeleton


@jax.tree_util.register_dataclass
@dataclasses.dataclass(frozen=True, kw_only=True, eq=False)
class Clips:
    """Ragged clips with labels.

    Attributes:
      root_position: World position of the root in every frame, metres, y up.
      joint_rotation: Parent-local rotations, two columns each.
      offsets: First frame of each clip, and the number of frames at the end.
      labels: One integer a clip for each label field ("style", "content", ...).
      skeleton: The bones all clips share.
      fps: Frames a second of all clips.
      label_names: For each label field, the name of each integer.
      clip_names: One name a clip.
      source: Where the data came from and its licence, for tables and cards.
    """

    root_position: Float[Array, "frames 3"]
    joint_rotation: Float[Array, "frames joints 6"]
    offsets: Int[Array, "clips+1"]
    labels: dict[str, Int[Array, "clips"]]
    skeleton: Skeleton
    fps: float = jax.tree.static(default=30.0)
    label_names: tuple[tuple[str, tuple[str, ...]], ...] = jax.tree.static(default=())
    clip_names: tuple[str, ...] = jax.tree.static(default=())
    source: str = jax.tree.static(default="")

    @property
    def num_clips(self) -> int:
        """Number of clips."""
        return self.offsets.shape[0] - 1

    @property
    def num_frames(self) -> int:
        """Number of frames of all clips together."""
        return self.root_position.shape[0]

    def names(self, field: str) -> tuple[str, ...]:
        """Names of a label field.

        Args:
          field: For example "style".

        Returns:
          The name of each integer.

        Raises:
          ValueError: if the clips have no such field; names those they have.
        """
        fields = dict(self.label_names)
        if field not in fields:
            raise ValueError(
                f"unknown label field {field!r}: the clips have {', '.join(fields)}"
            )
        return fields[field]
