"""MABL: sample-efficient multi-agent reinforcement learning with bi-level world models."""
