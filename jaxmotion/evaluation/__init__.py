"""Metrics as pure functions on arrays; each docstring holds its definition."""
