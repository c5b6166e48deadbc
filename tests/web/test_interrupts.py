"""Signals end a live session, but interrupt neither its start nor its end."""

from __future__ import annotations

import signal
import threading

import pytest

from annotator.web.live import Interrupts

SIGNALS = (signal.SIGINT, signal.SIGTERM)


@pytest.mark.parametrize("number", SIGNALS)
def test_a_deferred_signal_interrupts_at_the_end_of_the_block(number: signal.Signals) -> None:
    before = [signal.getsignal(n) for n in SIGNALS]
    done = []
    with Interrupts() as interrupts:
        with pytest.raises(KeyboardInterrupt), interrupts.deferred():
            signal.raise_signal(number)
            done.append("started")
        assert done == ["started"]
        signal.raise_signal(signal.SIGTERM)  # ignored, since the session is ending
        with pytest.raises(KeyboardInterrupt):
            signal.raise_signal(signal.SIGINT)
    assert [signal.getsignal(n) for n in SIGNALS] == before


def test_a_sigterm_after_the_end_of_a_session_is_ignored() -> None:
    with Interrupts() as interrupts:
        with interrupts.session(), interrupts.deferred():
            pass
        signal.raise_signal(signal.SIGTERM)
        with pytest.raises(KeyboardInterrupt):
            signal.raise_signal(signal.SIGINT)


def test_other_threads_do_not_change_signal_handlers() -> None:
    seen = []

    def enter() -> None:
        with Interrupts():
            seen.append(signal.getsignal(signal.SIGTERM))

    thread = threading.Thread(target=enter)
    thread.start()
    thread.join()
    assert seen == [signal.getsignal(signal.SIGTERM)]
