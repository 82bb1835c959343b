"""Published motion sets as tensorflow-datasets builders: a module and a line here each.

A module is imported when its set is read, for tensorflow-datasets is slow to import.
"""

import dataclasses
import importlib
from typing import Any, Literal


@dataclasses.dataclass(frozen=True, kw_only=True)
class DataSet:
    """How a published set is read.

    Attributes:
      module: Module of this package.
      builder: Class in it.
      kind: What it holds: "clips", "ball" for clips with a ball, or "texts" for
        feature vectors with captions.
      variant: Configuration of the builder; None for its only one.
      mirrored: Its configuration with mirror images, where it publishes them itself.
      fps: Frames per second of the file that `prepare_data.py` writes; None for the
        set's own.
    """

    module: str
    builder: str
    kind: Literal["clips", "ball", "texts"] = "clips"
    variant: str | None = None
    mirrored: str | None = None
    fps: float | None = 30.0

    def make(self, data_dir: str, *, mirror: bool = False) -> Any:
        """The builder, with its files in a folder."""
        kind = getattr(
            importlib.import_module(f"{__name__}.{self.module}"), self.builder
        )
        variant = self.mirrored if mirror and self.mirrored else self.variant
        return kind(config=variant, data_dir=data_dir, file_format="array_record")


REGISTRY = {
    "bandai_namco/1": DataSet(
        module="bandai_namco", builder="BandaiNamco", variant="1"
    ),
    "bandai_namco/2": DataSet(
        module="bandai_namco", builder="BandaiNamco", variant="2"
    ),
    "lafan1": DataSet(module="lafan1", builder="Lafan1"),
    "o3de_motion_matching": DataSet(module="o3de", builder="O3deMotionMatching"),
    "style100": DataSet(
        module="style100", builder="Style100", variant="original", mirrored="mirror"
    ),
    "humanact12": DataSet(module="humanact12", builder="Humanact12", fps=None),
    "humanml3d": DataSet(
        module="humanml3d", builder="HumanML3D", kind="texts", variant="humanml3d"
    ),
    "kit_ml": DataSet(
        module="humanml3d", builder="HumanML3D", kind="texts", variant="kit_ml"
    ),
    "ballplay": DataSet(module="ballplay", builder="Ballplay", kind="ball"),
    "soccer_x": DataSet(module="soccer_x", builder="SoccerX", kind="ball"),
}
