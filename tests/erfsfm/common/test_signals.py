"""Signals to terminate raise once, unless they are handled or ignored."""

from __future__ import annotations

import os
import signal

import pytest

from erfsfm.common.signals import Terminated, raising_on_termination


@pytest.mark.parametrize("name", ["SIGTERM", "SIGHUP"])
def test_a_signal_raises_with_its_name_and_code_until_it_is_ignored(name: str):
    number = getattr(signal, name)
    with (
        pytest.raises(Terminated, match=f"ended by {name}") as raised,
        raising_on_termination() as ignore,
    ):
        try:
            os.kill(os.getpid(), number)
        finally:
            ignore()
            os.kill(
                os.getpid(), number
            )  # sent twice: the second one must not stop the writing of what there is
    assert raised.value.code == 128 + number
    assert signal.getsignal(number) is signal.SIG_DFL


def test_a_signal_that_is_ignored_or_handled_stays_so():
    before = signal.signal(signal.SIGHUP, signal.SIG_IGN)  # as nohup does
    try:
        with raising_on_termination():
            os.kill(os.getpid(), signal.SIGHUP)
            assert signal.getsignal(signal.SIGHUP) is signal.SIG_IGN
        assert signal.getsignal(signal.SIGHUP) is signal.SIG_IGN
    finally:
        signal.signal(signal.SIGHUP, before)
