"""Memory of long commands: what a window leaves behind is freed while the next is solved."""

import gc
import signal
import weakref

from shapepose_fg import __main__ as entry
from shapepose_fg.cli import main as command_line


class Window:
    """An object in a cycle, as people and the graph that couples them are."""

    def __init__(self) -> None:
        self.itself = self


def test_windows_are_freed_while_a_command_runs(monkeypatch):
    alive: weakref.WeakSet[Window] = weakref.WeakSet()
    most = 0

    def command() -> None:
        nonlocal most
        for _ in range(20_000):
            alive.add(Window())
            most = max(most, len(alive))

    monkeypatch.setattr(command_line, "main", command)
    before = signal.getsignal(signal.SIGINT)
    try:
        entry.main()
    finally:
        gc.unfreeze()
        signal.signal(signal.SIGINT, before)
    assert gc.isenabled()
    assert most < 5_000
