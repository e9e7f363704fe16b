"""Measurements that are run by hand; what they claim stands in docs/results."""
