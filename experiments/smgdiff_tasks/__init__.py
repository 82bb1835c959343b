"""Parts of experiments/smgdiff.py."""
