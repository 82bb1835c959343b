"""Pictures: animated bodies, plots; the only package with matplotlib."""
