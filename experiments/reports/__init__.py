"""The papers' tables and claims, and what this checkout measured of them."""
