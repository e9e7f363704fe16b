"""Signals as wishes: the first is heard, what a scheduler repeats is not, Ctrl-C again is real."""

import io
import signal

import pytest
from rich.console import Console

from mabl.training.interruption import Interruption


@pytest.fixture
def heard():
    """An interruption; how often it was obeyed; and what it says."""
    obeyed, said = [], io.StringIO()
    previous = signal.getsignal(signal.SIGTERM)
    ctrl_c = signal.signal(signal.SIGINT, signal.default_int_handler)  # pytest-xdist ignores it
    with Interruption(Console(file=said), "stopping", lambda: obeyed.append(1)) as wish:
        yield wish, obeyed, said
    assert signal.getsignal(signal.SIGTERM) is previous
    assert signal.signal(signal.SIGINT, ctrl_c) is signal.default_int_handler


def test_a_process_and_its_group_may_be_told_at_once(heard):
    wish, obeyed, said = heard
    for _ in range(3):
        signal.raise_signal(signal.SIGTERM)
    assert wish.received == signal.SIGTERM and obeyed == [1]
    assert said.getvalue() == "stopping; Ctrl-C or SIGKILL stops at once\n"


@pytest.mark.parametrize("first", [signal.SIGINT, signal.SIGTERM])
def test_ctrl_c_after_a_wish_is_real(first, heard):
    signal.raise_signal(first)
    with pytest.raises(KeyboardInterrupt):
        signal.raise_signal(signal.SIGINT)
