"""Recordings, some at a time, each led by a process of its own: it reads, hands out work, and writes the results.

A process and not a thread, so that one recording's error, memory or crash is no other's, and none waits for
Python's lock.
"""

import os
import shutil
import signal
import sys
import time
import traceback
from collections.abc import Mapping, Sequence
from concurrent.futures import wait as wait_for
from concurrent.futures.process import BrokenProcessPool
from contextlib import suppress
from dataclasses import dataclass, replace
from multiprocessing import Pipe
from multiprocessing.connection import Connection, wait
from pathlib import Path
from typing import Any

from rich.filesize import decimal

from shapepose_fg.cli.batch.standing import Bars, Standings
from shapepose_fg.cli.batch.table import LOG, Entry
from shapepose_fg.cli.reconstruct.request import OUTPUTS, Request, prepare
from shapepose_fg.cli.reconstruct.run import Ended, carry_out
from shapepose_fg.cli.stopping import Stopped, stoppable
from shapepose_fg.cli.terminal import note, use_any_streams
from shapepose_fg.core.errors import InputError
from shapepose_fg.core.result_files import PEOPLE
from shapepose_fg.core.storage.files import inside, open_regular
from shapepose_fg.core.storage.output_folder import prepare_output
from shapepose_fg.io.corrections import refuse_corrected
from shapepose_fg.io.detections.reading import find_places
from shapepose_fg.io.skeleton_file import find_skeleton
from shapepose_fg.pipeline.execution import Execution
from shapepose_fg.pipeline.runs.manifest import PARTS
from shapepose_fg.pipeline.workers import Processes

ATTEMPTS = 2
"""A recording that has failed so often is left, and the others go on."""
_PATIENCE_S = 20.0
"""Time that a leader may take to end its work, s."""
_LEAST, _USUAL = 0.1, 2.0
"""Bytes of results for each byte of detections: many cameras whose files hold hands and faces, and others."""


@dataclass(frozen=True)
class Assignment:
    """What a leader is to do; plain data."""

    name: str
    """The recording's."""
    request: Request
    """What is wanted."""
    folder: Path
    """Folder of the recording's results."""
    cluster: str
    """Address of the scheduler."""
    sharing: int = 1
    """How many recordings are led at a time."""
    resume: bool = False
    """Go on with what a run that was stopped left."""
    restart: bool = False
    """Remove it."""


@dataclass(frozen=True)
class Campaign:
    """What is to be done, and with what."""

    entries: Sequence[Entry]
    """All recordings."""
    sizes: Mapping[str, int]
    """Bytes of each one's detections."""
    output: Path
    """The folder of all results."""
    cluster: str
    """Address of the scheduler."""
    at_once: int
    """Number of recordings that are led at a time."""

    def run(self, standings: Standings, watcher: Bars) -> None:
        """Do what is not done; `standings` has how each ended.

        The largest come first, so that none is left over at the end; those that failed come again after all
        others.
        """
        leaders: list[Leader] = []
        try:
            while True:
                while len(leaders) < self.at_once and (entry := self._next(standings, leaders)) is not None:
                    watcher.began(entry.name)
                    folder, restart = self.output / entry.name, standings.of[entry.name].anew
                    how = self.cluster, self.at_once, not restart and (folder / PARTS).exists(), restart
                    leaders.append(Leader(Assignment(entry.name, entry.request, folder, *how)))
                if len(leaders) == 0:
                    break
                for ready in wait([leader.told for leader in leaders]):
                    leader = next(each for each in leaders if each.told is ready)
                    if self._heard(leader, standings, watcher):
                        leaders.remove(leader)
        finally:
            for leader in leaders:
                leader.ask_to_stop()
            for leader in leaders:
                found = leader.end()
                if found is not None:  # it was done when it was asked to stop
                    self._done(leader, found, standings)

    def _next(self, standings: Standings, leaders: "Sequence[Leader]") -> Entry | None:
        """The recording that is begun next; those whose turn cannot come are given up."""
        led = {leader.assignment.name for leader in leaders}
        found: list[Entry] = []
        for entry in self.entries:
            own = standings.of[entry.name]
            if own.status != "waiting" or entry.name in led:
                continue
            before = None if entry.after is None else standings.of[entry.after].status
            if before == "failed":
                reason = f"it begins with the shapes that {entry.after} leaves, which failed; see there"
                standings.set(entry.name, own.failed(reason, 0.0, 0))
            elif before in (None, "done"):
                found.append(entry)
        turn = {each.name: (standings.of[each.name].attempts, -self.sizes[each.name]) for each in found}
        return min(found, key=lambda each: turn[each.name], default=None)

    def _heard(self, leader: "Leader", standings: Standings, watcher: Bars) -> bool:
        """Take in what a leader tells; whether it has ended."""
        name, told = leader.assignment.name, leader.next()
        if isinstance(told, tuple):
            if standings.of[name].anew:  # what is kept now is this run's own
                standings.set(name, replace(standings.of[name], anew=False))
            watcher.frames(name, *told)
            return False
        leader.end()
        if isinstance(told, Ended):
            self._done(leader, told, standings)
            watcher.ended(name, failed=None, again=False)
        else:
            now = standings.of[name].failed(told, time.monotonic() - leader.began, ATTEMPTS)
            standings.set(name, now)
            watcher.ended(name, failed=told, again=now.status == "waiting")
        return True

    def _done(self, leader: "Leader", found: Ended, standings: Standings) -> None:
        """Note down that a recording is done."""
        name = leader.assignment.name
        standings.set(name, standings.of[name].done(found, time.monotonic() - leader.began))


class Leader:
    """The process that leads a recording, seen from the one that started it."""

    def __init__(self, assignment: Assignment) -> None:
        """Start it."""
        self.assignment = assignment
        self.began = time.monotonic()
        """When it was started, by the clock of `time.monotonic`."""
        self.told, tell = Pipe(duplex=False)
        """What it tells: (frames done, all frames), in the end `Ended`, or why it failed."""
        self._process = Processes(1, _tell_by, tell)
        tell.close()
        self._pid = self._process.submit(os.getpid)
        self._end = self._process.submit(_lead, assignment)

    def next(self) -> tuple[int, int] | Ended | str:
        """What it tells next; where it has died, that."""
        try:
            return self.told.recv()
        except (EOFError, OSError):
            return "its process was ended from outside; there may be too little memory"

    def end(self) -> Ended | None:
        """Wait for its end, or bring it about where it does not come; what it `Ended` with after all."""
        wait_for([self._end], _PATIENCE_S)
        self._process.shutdown()
        found = None
        try:
            while self.told.poll():
                told = self.told.recv()
                found = told if isinstance(told, Ended) else found
        except (EOFError, OSError):
            pass
        self.told.close()
        return found

    def ask_to_stop(self) -> None:
        """Have it keep what is done and end; `end` waits for it."""
        with suppress(BrokenProcessPool, ProcessLookupError):
            if not self._end.done():
                os.kill(self._pid.result(), signal.SIGTERM)


_tell: Connection
"""In a leader: the way to the one that started it."""


def _tell_by(tell: Connection) -> None:
    global _tell
    _tell = tell


def _lead(assignment: Assignment) -> None:
    """All that the process does; what is said, by libraries too, is added to a log."""
    use_any_streams()
    log = inside(assignment.folder, LOG)
    with log.open("ab", buffering=0) as stream:
        stream.write(f"--- {time.strftime('%Y-%m-%d %H:%M:%S')}\n".encode())
        for descriptor in (1, 2):
            os.dup2(stream.fileno(), descriptor)
    for stream in (sys.stdout, sys.stderr):
        reconfigure: Any = getattr(stream, "reconfigure", lambda **_: None)
        reconfigure(encoding="utf-8", line_buffering=True)
    execution = Execution(None, assignment.cluster, assignment.sharing, progress=lambda *told: _tell.send(told))
    try:
        with stoppable():
            known = prepare(assignment.request, assignment.folder)
            again = {"resume": assignment.resume, "restart": assignment.restart, "overwrite": True}
            _tell.send(carry_out(known, execution, **again))
    except Stopped as stop:
        print(f"stopped: {stop.message}", flush=True)
    except InputError as error:
        print(f"error: {error}", flush=True)
        _tell.send(" ".join(str(error).split()))
    except Exception as error:
        traceback.print_exc()
        words = " ".join(str(error).split())[:300]
        _tell.send(f"{type(error).__name__}: {words} (all of it in {log})")
    finally:
        _tell.close()


def look_at_all(table: Path, entries: Sequence[Entry], output: Path, *, begun: bool) -> dict[str, int]:
    """Bytes of each recording's detections, whose cameras, settings and places are all there.

    `begun` says that runs which were stopped in their folders are meant to go on, or begin anew.
    InputError where something is missing, wrong or in the way, for the first such recording, and how many others
    there are; or where the disk of `output` has no room for what all of them will leave.
    """
    sizes, problems = {}, []
    for entry in entries:
        try:
            sizes[entry.name] = _look_at(entry, output / entry.name, begun)
        except InputError as error:
            problems.append(f"recording {entry.name}: {error}")
    if len(problems) > 0:
        others = [problem.split(":")[0].removeprefix("recording ") for problem in problems[1:]]
        listed = ", ".join(others[:5]) + (f" and {len(others) - 5} more" if len(others) > 5 else "")
        more = f" (and something is wrong with {listed}, too)" if len(others) > 0 else ""
        raise InputError(f"{table}: {problems[0]}{more}")
    whole, free = sum(sizes.values()), shutil.disk_usage(output).free
    if free < _LEAST * whole:
        raise InputError(
            f"{output}: at least {decimal(int(_LEAST * whole))} are needed for {len(entries)} recordings, and"
            f" {decimal(free)} are free; make room, give another --output, or split the table"
        )
    if free < _USUAL * whole:
        usual = decimal(int(_USUAL * whole))
        note(f"{output}: {decimal(free)} are free, and results of so much footage mostly take {usual}")
    return sizes


def _look_at(entry: Entry, folder: Path, begun: bool) -> int:
    """Bytes of a recording's detections."""
    known = prepare(entry.request, folder, tell=lambda *_: None)
    asked = known.request
    _, places, _ = find_places(known.detections, asked.rig())
    find_skeleton(asked.skeleton)
    source = known.settings().offsets.source
    for file in (asked.body, asked.timestamps, None if source in ("recording", "none") else Path(source)):
        if file is not None:
            open_regular(file).close()
    if asked.shapes is not None:
        prepare_output(asked.shapes.parent, [asked.shapes.name])
    prepare_output(folder, (*OUTPUTS, LOG))
    refuse_corrected(folder)
    if (folder / PARTS).exists() and not begun:
        raise InputError(f"{folder / PARTS}: a run was stopped here; go on with --resume, or anew with --restart")
    if (folder / PEOPLE).exists() and not begun:
        raise InputError(f"{folder}: a finished result is here; move it away, or give another --output")
    files = (file for path in places for file in (path.rglob("*") if path.is_dir() else (path,)))
    return sum(file.stat().st_size for file in files if file.is_file())
