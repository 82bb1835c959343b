"""Diffusion on arrays of any kind: schedules, the reverse chain, guidance."""
