"""Flax modules: the only package that knows flax."""
