"""Environments: one interface, one adapter for each family."""
