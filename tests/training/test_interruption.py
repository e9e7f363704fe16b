"""Signals as wishes: the first is heard, what a scheduler repeats is not, the second is real."""

import io
import signal

import pytest
from rich.console import Console

from mabl.training import interruption
from mabl.training.interruption import Interruption


class Real(Exception):
    pass


@pytest.fixture
def heard():
    """An interruption whose second SIGTERM raises Real; and how often it was obeyed."""
    obeyed, said = [], io.StringIO()

    def real(*_):
        raise Real

    previous = signal.signal(signal.SIGTERM, real)
    with Interruption(Console(file=said), "stopping", lambda: obeyed.append(1)) as wish:
        yield wish, obeyed, said
    assert signal.signal(signal.SIGTERM, previous) is real


def test_a_process_and_its_group_may_be_told_at_once(heard):
    wish, obeyed, said = heard
    for _ in range(3):
        signal.raise_signal(signal.SIGTERM)
    assert wish.received == signal.SIGTERM and obeyed == [1]
    assert said.getvalue() == "stopping; SIGTERM again stops at once\n"


def test_a_sigterm_later_is_real(heard, monkeypatch):
    signal.raise_signal(signal.SIGTERM)
    monkeypatch.setattr(interruption, "GRACE", -1.0)
    with pytest.raises(Real):
        signal.raise_signal(signal.SIGTERM)


def test_ctrl_c_twice_is_real_however_quick(heard):
    signal.raise_signal(signal.SIGINT)
    with pytest.raises(KeyboardInterrupt):
        signal.raise_signal(signal.SIGINT)
