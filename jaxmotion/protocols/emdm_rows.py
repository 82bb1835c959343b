"""Rows of EMDM's tables: what changes from one to the next, and how each samples.

A row is a change of the base configuration; DDIM-10 is no row of its own but another
way to sample "ddpm_1000".
"""

import dataclasses
from typing import Any

from jaxmotion.systems.emdm import Config

_FLAT = dict(weight_position=0.0, weight_velocity=0.0, weight_foot=0.0)
_DDPM = dict(latent=0, schedule="cosine", weight_recon=1.0)
# Changes of the base configuration, by row.
ROWS: dict[str, dict[str, Any]] = {
    "emdm": {},
    "emdm_5": dict(num_steps=5),
    "emdm_2": dict(num_steps=2),
    "emdm_1": dict(num_steps=1),
    "naive": dict(discriminator_condition=False, weight_recon=0.0, **_FLAT),
    "ddpm_50": dict(num_steps=50, **_DDPM),
    "ddpm_1000": dict(num_steps=1000, **_DDPM),
    "recon_0": dict(weight_recon=0.0, **_FLAT),
    "recon_1": dict(weight_recon=1.0, **_FLAT),
    "recon_10": dict(weight_recon=10.0, **_FLAT),
    "recon_100": dict(weight_recon=100.0, **_FLAT),
    "no_r1": dict(weight_r1=0.0),
}
# Ways to sample that need no training of their own: row, steps to visit.
SAMPLERS: dict[str, tuple[str, int]] = {"ddim_10": ("ddpm_1000", 10)}


def check_rows(names: tuple[str, ...]) -> None:
    """Raises unless all are rows or samplers.

    Args:
      names: Names.

    Raises:
      ValueError: names the first unknown one and those there are.
    """
    known = (*ROWS, *SAMPLERS)
    for name in names:
        if name not in known:
            raise ValueError(
                f"unknown row {name!r}: expected one of {', '.join(known)}"
            )


def row_config(base: Config, row: str) -> Config:
    """Configuration of a row.

    Args:
      base: Of the row "emdm".
      row: Its name, or a sampler's.

    Returns:
      The configuration.

    Raises:
      ValueError: if there is no such row.
    """
    check_rows((row,))
    trained = SAMPLERS[row][0] if row in SAMPLERS else row
    return dataclasses.replace(base, **ROWS[trained])


def ddim_steps(num_steps: int, count: int) -> tuple[int, ...]:
    """Steps that "ddimN" of guided-diffusion visits: 1, 1 + T/N, ..., never T itself.

    Args:
      num_steps: T.
      count: N, which divides T.

    Returns:
      The steps, increasing.

    Raises:
      ValueError: if N does not divide T.

    Source: released code of MDM (there counted from 0).
    """
    if count < 1 or num_steps % count:
        raise ValueError(f"{count} steps do not divide the {num_steps} of the model")
    return tuple(range(1, num_steps + 1, num_steps // count))
