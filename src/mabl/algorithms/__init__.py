"""Algorithms: compositions of a world model and a way to learn behaviour."""
