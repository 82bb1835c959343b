"""Small faithful versions of what AAMDM is compared with, on any vectors.

Each module has `init(key, config)`, `loss(params, key, windows, *, config)` for
`make_update`, and `stepper(params, *, config) -> step(key, previous) -> next`.
"""
