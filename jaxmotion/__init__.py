"""Real-time motion diffusion in JAX: one functional core for several systems.

Import the module that you use: `from jaxmotion.diffusion import chain`.
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

__version__ = "0.1.0"

__all__ = [
    "control",
    "data",
    "diffusion",
    "evaluation",
    "evaluators",
    "learning",
    "motion",
    "networks",
    "systems",
]
