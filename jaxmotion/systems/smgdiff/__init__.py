"""SMGDiff: a soccer player and his ball, guided to touch each other."""
