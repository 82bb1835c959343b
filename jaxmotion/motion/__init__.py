"""Kinematics: rotations, skeletons, features, paths on the ground, contacts."""
