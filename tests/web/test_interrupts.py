"""How signals end a live session: not in the middle of its start, and not of its end."""

from __future__ import annotations

import signal
import threading

import pytest

from annotator.web.live.interrupts import Interrupts

SIGNALS = (signal.SIGINT, signal.SIGTERM)


@pytest.mark.parametrize("number", SIGNALS)
def test_a_signal_interrupts_once_what_was_held_is_done(number: signal.Signals) -> None:
    before = [signal.getsignal(n) for n in SIGNALS]
    done = []
    with Interrupts() as interrupts:
        with pytest.raises(KeyboardInterrupt), interrupts.held():
            signal.raise_signal(number)
            done.append("started")
        assert done == ["started"]
        signal.raise_signal(signal.SIGTERM)  # it is ending
        with pytest.raises(KeyboardInterrupt):
            signal.raise_signal(signal.SIGINT)
    assert [signal.getsignal(n) for n in SIGNALS] == before


def test_a_session_that_ends_by_itself_is_not_killed_by_the_way() -> None:
    with Interrupts() as interrupts:
        with interrupts.ended_by(), interrupts.held():
            pass
        signal.raise_signal(signal.SIGTERM)
        with pytest.raises(KeyboardInterrupt):
            signal.raise_signal(signal.SIGINT)


def test_other_threads_leave_signals_as_they_are() -> None:
    seen = []

    def enter() -> None:
        with Interrupts():
            seen.append(signal.getsignal(signal.SIGTERM))

    thread = threading.Thread(target=enter)
    thread.start()
    thread.join()
    assert seen == [signal.getsignal(signal.SIGTERM)]
