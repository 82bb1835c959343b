"""CAMDM: a transformer that steers a character in many styles, in 8 steps."""
