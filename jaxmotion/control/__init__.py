"""Autoregression at run-time: rollouts, seams, fixed sequences of commands."""
