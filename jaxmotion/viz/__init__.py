"""Pictures: stick figures, animations, plots; the only package with matplotlib."""
