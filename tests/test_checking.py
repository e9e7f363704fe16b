"""`check-env` finds what environments do wrong, and nothing where they do not."""

import itertools

import numpy as np
import pytest
from tests.envs.misbehaving import hosted

from mabl import cli
from mabl.checking import check
from mabl.envs import registry
from mabl.envs.host import Hosted

GOOD = registry.make("pettingzoo:tests.envs.leaving:Leaving", ("stay=1", "episode_limit=5"))
COUNTER = itertools.count()


class Flawed:
    """The good one, but for what `how` says."""

    def __init__(self, how):
        self.how, self.inner, self.spec = how, GOOD.make(), GOOD.spec
        self.number = next(COUNTER)

    def reset(self, seed):
        self.t = 0
        return self.spoil(self.inner.reset(seed))

    def step(self, action):
        self.t += 1
        return self.spoil(self.inner.step(action))

    def close(self):
        self.inner.close()

    def spoil(self, row):
        if self.how == "rewards a reset" and self.t == 0:
            return row._replace(reward=np.ones(3, np.float32))
        if self.how == "tells another action" and self.t == 1:
            return row._replace(prev_action=(row.prev_action + 1) % 3)
        if self.how == "resets itself" and self.t == 5:
            return row._replace(obs=self.inner.reset(0).obs)
        if self.how == "never ends":
            return row._replace(terminated=np.zeros(3, bool), truncated=np.bool_(False))
        if self.how == "revives" and self.t == 4:
            return row._replace(alive=np.ones(3, bool))
        if self.how == "shows the dead" and self.t == 4:
            return row._replace(obs=np.ones_like(row.obs))
        if self.how == "forbids everything" and self.t == 2:
            return row._replace(available=np.zeros((3, 3), bool))
        if self.how == "sees far":
            return row._replace(obs=1000 * row.obs)
        if self.how == "pays nothing":
            return row._replace(reward=np.zeros(3, np.float32))
        if self.how == "scores early" and self.t == 2:
            return row._replace(score=np.float32(1))
        if self.how == "is moody":
            return row._replace(state=row.state + np.float32(self.number))
        if self.how == "is never the same":
            return row._replace(state=row.state + np.float32(next(COUNTER)))
        if self.how == "is wide":
            return row._replace(obs=np.zeros((3, 9), np.float32))
        return row


@pytest.mark.parametrize(
    ("how", "verdict", "what", "message"),
    [
        ("rewards a reset", "bad", "resets", "holds an action or a reward"),
        ("tells another action", "bad", "time", "row 1 of episode 0 does not hold the action"),
        ("resets itself", "look", "time", "does the environment reset itself?"),
        ("never ends", "bad", "ends", "went on past its limit of 5 steps: give the real one"),
        ("revives", "bad", "agents", "an agent that was gone came back"),
        ("shows the dead", "bad", "agents", "an agent that is gone observes something"),
        ("forbids everything", "bad", "masks", "no action that it may take"),
        ("sees far", "look", "observations", "symlog=true"),
        ("pays nothing", "look", "rewards", "never earned anything"),
        ("scores early", "bad", "score", "not told on the last row alone"),
        ("is moody", "look", "seeds", "a new environment gave another episode"),
        ("is never the same", "look", "seeds", "the same seed and actions gave another"),
        ("is wide", "bad", "rows", "gave obs of shape (3, 9), its spec says (3, 2)"),
    ],
)
def test_each_flaw_is_found_and_named(how, verdict, what, message):
    findings = check(Hosted(GOOD.spec, lambda: Flawed(how)), 3, 0)
    (found,) = [finding for finding in findings if finding.what == what]
    assert found.verdict == verdict and message in found.message


@pytest.mark.parametrize("name", ["smax/3m", "test/coordination", "test/aiming"])
def test_compiled_environments_keep_their_promises(name):
    findings = check(registry.make(name), 3, 0)
    assert len(findings) == 11 and {finding.verdict for finding in findings} == {"good"}


def test_the_good_one_is_found_good():
    assert {finding.verdict for finding in check(GOOD, 3, 0)} == {"good"}


def test_what_raises_is_shown():
    (found,) = check(hosted("raises", at=1), 1, 0)
    assert (found.verdict, found.what) == ("bad", "raises")
    assert "misbehaving.py" in found.message and "the train left the rails" in found.message


def test_the_command_says_it_in_words_and_by_its_exit_code(capsys):
    assert cli.run(["check-env", "test/coordination"]) == 0
    assert "each row holds the action that led to it" in capsys.readouterr().out
    assert cli.run(["check-env", "test/host-counting"]) == 1  # it shows the dead
    assert "BAD" in capsys.readouterr().out
