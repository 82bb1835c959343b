"""Learned evaluators of motions: networks, training, frozen files."""
