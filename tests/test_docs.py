"""What the documentation shows, works."""

import re
from pathlib import Path

import jax
from tests.tiny import tiny

from mabl.algorithms.registry import ALGORITHMS
from mabl.training.programs import build

DOCS = Path(__file__).parents[1] / "docs"


def test_a_world_model_is_one_file_and_one_line(monkeypatch):
    text = (DOCS / "adding-a-world-model.md").read_text()
    model, line = re.findall(r"```python\n(.*?)```", text, re.DOTALL)
    monkeypatch.setattr("mabl.algorithms.registry.ALGORITHMS", known := dict(ALGORITHMS))
    exec(model + line, {"__name__": "example"})
    assert set(known) - set(ALGORITHMS) == {"joint-action-dreamer"}

    training = build(tiny("joint-action-dreamer"))
    state = jax.jit(training.init)(jax.random.key(0))
    cycle = jax.jit(training.cycle)
    before = training.algorithm.policy(state.learner)
    for _ in range(2):
        state, metrics = cycle(state, 2, 1)
    after = training.algorithm.policy(state.learner)
    assert metrics["world_model/kl_agent"] > 0
    moved = jax.tree.map(lambda a, b: bool((a != b).any()), before, after)
    assert all(jax.tree.leaves(moved))
