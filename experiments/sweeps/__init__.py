"""Parts of experiments/step_sweep.py: what all systems share, and a module a system."""
