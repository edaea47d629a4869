"""One recording, led by a process of its own: it reads, hands out work to the cluster, and writes the results.

A process and not a thread, so that one recording's error, memory or crash is no other's, and none waits for
Python's lock.
"""

import os
import signal
import sys
import threading
import time
import traceback
from collections.abc import Callable
from dataclasses import dataclass
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any

from shapepose_fg.cli.batch.check import LOG
from shapepose_fg.cli.reconstruct.command import carry_out
from shapepose_fg.cli.reconstruct.request import Ended, Request
from shapepose_fg.cli.stopping import Stopped, stoppable
from shapepose_fg.cli.terminal import use_any_streams
from shapepose_fg.core.errors import InputError
from shapepose_fg.pipeline.execution import Execution
from shapepose_fg.pipeline.workers import end_with, processes, what_workers_inherit

_CARRIED_OUT_BY = "shapepose_fg.cli.reconstruct.run"
"""The module that has loaded what a leader needs."""
_PATIENCE_S = 20.0
"""So long a leader may take to let go of its work."""


@dataclass(frozen=True)
class Assignment:
    """What a leader is to do; plain data."""

    name: str
    """The recording's."""
    request: Request
    """What is wanted."""
    folder: Path
    """Of its results."""
    cluster: str
    """Address of the scheduler."""
    sharing: int = 1
    """How many recordings are led at a time."""
    resume: bool = False
    """Go on with what a run that was stopped left."""
    restart: bool = False
    """Remove it."""


@dataclass(frozen=True)
class Failed:
    """A recording is not."""

    reason: str
    """In a sentence."""


class Leader:
    """The process that leads a recording, seen from the one that started it."""

    def __init__(self, assignment: Assignment) -> None:
        """Start it."""
        context = processes(_CARRIED_OUT_BY)
        self.assignment = assignment
        self.began = time.monotonic()
        """When it was started, by the clock of `time.monotonic`."""
        self.told, tell = context.Pipe(duplex=False)
        """What it tells: (frames done, all frames), in the end `Ended` or `Failed`."""
        held, self._lifeline = context.Pipe(duplex=False)
        self._process = context.Process(target=_lead, args=(assignment, tell, held), name=assignment.name)
        with what_workers_inherit():
            self._process.start()
        tell.close()
        held.close()

    def next(self) -> tuple[int, int] | Ended | Failed:
        """What it tells next; `Failed` too where it has died."""
        try:
            return self.told.recv()
        except (EOFError, OSError):
            self._process.join(_PATIENCE_S)
            code = self._process.exitcode
            how = f"was killed by signal {-code}" if code is not None and code < 0 else f"ended with code {code}"
            return Failed(f"its process {how}; there may be too little memory")

    def end(self) -> Ended | None:
        """Wait for its end, or bring it about where it does not come; whether it was `Ended` after all."""
        self._process.join(_PATIENCE_S)
        if self._process.is_alive():
            self._process.kill()
            self._process.join()
        found = None
        try:
            while self.told.poll():
                told = self.told.recv()
                found = told if isinstance(told, Ended) else found
        except (EOFError, OSError):
            pass
        self.told.close()
        self._lifeline.close()
        return found

    def ask_to_stop(self) -> None:
        """Have it keep what is done and end; `end` waits for it."""
        if self._process.is_alive():
            self._process.terminate()


def _lead(assignment: Assignment, tell: Connection, lifeline: Connection) -> None:
    """All that the process does."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    threading.Thread(target=end_with, args=(lifeline,), daemon=True).start()
    _write_into(assignment.folder / LOG)
    try:
        with stoppable():
            tell.send(_carried_out(assignment, lambda done, count: tell.send((done, count))))
    except Stopped as stop:
        print(f"stopped: {stop.message}", flush=True)


def _carried_out(assignment: Assignment, tell: Callable[[int, int], None]) -> Ended | Failed:
    """The recording, reconstructed, or why it is not."""
    try:
        return carry_out(
            assignment.request,
            assignment.folder,
            Execution(None, assignment.cluster, assignment.sharing, progress=tell),
            resume=assignment.resume,
            restart=assignment.restart,
        )
    except InputError as error:
        print(f"error: {error}", flush=True)
        return Failed(" ".join(str(error).split()))
    except Exception as error:
        traceback.print_exc()
        words = " ".join(str(error).split())[:300]
        return Failed(f"{type(error).__name__}: {words} (all of it in {assignment.folder / LOG})")


def _write_into(log: Path) -> None:
    """Let all that is said from now on, by libraries too, be added to a file."""
    use_any_streams()
    with log.open("ab", buffering=0) as stream:
        stream.write(f"--- {time.strftime('%Y-%m-%d %H:%M:%S')}\n".encode())
        for descriptor in (1, 2):
            os.dup2(stream.fileno(), descriptor)
    for stream in (sys.stdout, sys.stderr):
        reconfigure: Any = getattr(stream, "reconfigure", None)
        if reconfigure is not None:
            reconfigure(encoding="utf-8", line_buffering=True)
