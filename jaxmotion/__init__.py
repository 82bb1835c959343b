"""Real-time motion diffusion in JAX: four published systems on one functional core.

The face is a handful of functions: `load` a model, `start` characters, give them
`commands`, or a `path` or `place` to go to, `rollout`, or `sample` whole motions, and
`save` or `show` what they do.
Everything they are made of is public: `from jaxmotion.diffusion import chain`.
"""

from jaxmotion import (
    control,
    data,
    diffusion,
    evaluation,
    evaluators,
    learning,
    motion,
    networks,
    systems,
)
from jaxmotion.face import (
    commands,
    load,
    path,
    place,
    retarget,
    rollout,
    sample,
    save,
    show,
)

__version__ = "0.1.0"

__all__ = [
    "commands",
    "control",
    "data",
    "diffusion",
    "evaluation",
    "evaluators",
    "learning",
    "load",
    "motion",
    "networks",
    "path",
    "place",
    "retarget",
    "rollout",
    "sample",
    "save",
    "show",
    "systems",
]
