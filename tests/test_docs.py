"""What the documentation shows, works."""

import re
from pathlib import Path

import jax
import numpy as np
from tests.tiny import tiny

from mabl.algorithms.registry import ALGORITHMS
from mabl.envs import registry
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


def test_an_environment_of_ones_own_takes_ten_lines(tmp_path, monkeypatch):
    text = (DOCS / "environments.md").read_text()
    (module,) = re.findall(r"```python\n(.*?)```", text, re.DOTALL)
    (tmp_path / "corridor.py").write_text(module)
    monkeypatch.chdir(tmp_path)
    hosted = registry.make("pettingzoo:corridor:Corridor", ("episode_limit=20",))
    env = hosted.make()
    row, steps = env.reset(0), 0
    while not row.terminated.all():
        row, steps = env.step(np.ones(2, np.int32)), steps + 1
    assert steps == 5 and row.score == 1 and not row.truncated
    env.reset(0)
    for _ in range(20):
        row = env.step(np.zeros(2, np.int32))
    assert row.truncated and row.score == 0
