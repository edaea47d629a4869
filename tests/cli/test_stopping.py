"""Requests to end: they are obeyed wherever the program is at that moment."""

import signal
import sys
import threading
import time

import pytest

from shapepose_fg.cli.stopping import Stopped, stoppable
from shapepose_fg.core.errors import InputError


class SignalsAsItGoes:
    """An object in whose finaliser the signal arrives."""

    def __del__(self) -> None:
        signal.raise_signal(signal.SIGTERM)


class Breaks:
    """An object whose finaliser is wrong."""

    def __del__(self) -> None:
        raise ValueError("of a finaliser")


@pytest.mark.parametrize("times", [1, 2])
def test_a_signal_in_a_finaliser_is_obeyed(times, capsys):
    with pytest.raises(Stopped) as stopped, stoppable():
        for _ in range(times):
            SignalsAsItGoes()
        time.sleep(10)
        pytest.fail("the signal was lost")
    assert stopped.value.exit_code == 128 + signal.SIGTERM
    assert capsys.readouterr().err == "", "nothing is printed of it"


def test_a_signal_that_is_sent_again_at_once_is_obeyed(monkeypatch):
    """On a busy machine the timer may be over before `start` returns."""

    class Timer(threading.Timer):
        at_once = True

        def start(self) -> None:
            sent, Timer.at_once = Timer.at_once, False
            if sent:
                self.function(*self.args)
            super().start()
            if sent:
                self.cancel()

    monkeypatch.setattr(threading, "Timer", Timer)
    with pytest.raises(Stopped), stoppable():
        SignalsAsItGoes()
        time.sleep(10)
        pytest.fail("the signal was lost")


def test_a_signal_in_the_last_finaliser_is_obeyed():
    with pytest.raises(Stopped), stoppable():
        SignalsAsItGoes()


def test_a_second_signal_does_not_disturb_the_clean_up():
    cleaned = False
    with pytest.raises(Stopped), stoppable():
        try:
            signal.raise_signal(signal.SIGINT)
        finally:
            signal.raise_signal(signal.SIGINT)
            cleaned = True
    assert cleaned


def test_other_errors_of_finalisers_are_reported_as_before(monkeypatch):
    reported = []
    monkeypatch.setattr(
        sys, "unraisablehook", lambda unraisable: reported.append(unraisable.exc_type)
    )
    with stoppable():
        Breaks()
    assert reported == [ValueError]


def importing() -> None:
    """As pybind11 does where a compiled module is stopped while it begins."""
    try:
        signal.raise_signal(signal.SIGTERM)
    except BaseException as stop:
        raise ImportError("initialization failed") from stop


def asking_for_a_package() -> None:
    """And as a command does that misses the package of an extra."""
    try:
        importing()
    except ImportError:
        raise InputError("the package is missing; install it") from None


@pytest.mark.parametrize("work", [importing, asking_for_a_package])
def test_a_signal_that_a_library_makes_another_error_of_is_obeyed(work):
    with pytest.raises(Stopped) as stopped, stoppable():
        work()
    assert stopped.value.exit_code == 128 + signal.SIGTERM


def test_errors_after_a_signal_that_was_obeyed_stay_as_they_are():
    with pytest.raises(ImportError, match="another"), stoppable():
        raise ImportError("another")
