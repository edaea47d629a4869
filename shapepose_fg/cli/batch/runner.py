"""Reconstruct the recordings of a batch, several at a time, each in its own coordinator process.

The coordinator (`Leader`) reads the recording, submits windows to the cluster, and writes the
results. It is a process and not a thread, so that an error, a crash or the memory of one recording
does not affect the others.
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

from shapepose_fg.cli.batch.status import Bars, BatchStatus
from shapepose_fg.cli.batch.table import LOG, Entry
from shapepose_fg.cli.reconstruct.request import OUTPUTS, Request, prepare
from shapepose_fg.cli.reconstruct.run import Ended, carry_out
from shapepose_fg.cli.stopping import Stopped, stoppable
from shapepose_fg.cli.terminal import forget_notes, note, use_any_streams
from shapepose_fg.core.errors import InputError
from shapepose_fg.core.result_files import PEOPLE
from shapepose_fg.core.storage.files import files_below, inside, open_regular
from shapepose_fg.core.storage.output_folder import prepare_output
from shapepose_fg.io.detections.reading import find_places
from shapepose_fg.io.skeleton_file import find_skeleton
from shapepose_fg.pipeline.execution import Execution
from shapepose_fg.pipeline.runs.manifest import PARTS
from shapepose_fg.pipeline.workers import Processes
from shapepose_fg.results.corrections import refuse_corrected

_LEAST, _USUAL = 0.1, 2.0
"""Bytes of results per byte of detections: minimum, for many cameras and for files with hands and
faces; and typical value."""


@dataclass(frozen=True)
class Assignment:
    """The work of one coordinator; plain data."""

    name: str
    """The name of the recording."""
    request: Request
    """Options of the recording."""
    folder: Path
    """Folder of the recording's results."""
    cluster: str
    """Address of the scheduler."""
    sharing: int = 1
    """Number of recordings that share the cluster."""
    resume: bool = False
    """Whether to continue an interrupted run."""
    restart: bool = False
    """Whether to remove an interrupted run first."""


@dataclass(frozen=True)
class BatchRunner:
    """The recordings of a batch, and how they are reconstructed."""

    entries: Sequence[Entry]
    """All recordings."""
    sizes: Mapping[str, int]
    """Size of the detections of each recording, bytes."""
    output: Path
    """Folder of all results."""
    cluster: str
    """Address of the scheduler."""
    at_once: int
    """Number of recordings that run at a time."""

    def run(self, batch_status: BatchStatus, watcher: Bars) -> None:
        """Reconstruct the unfinished recordings, and keep `batch_status` up to date.

        The largest recordings start first; those that failed are tried again after all others.
        """
        leaders: list[Leader] = []
        try:
            while True:
                while (
                    len(leaders) < self.at_once
                    and (entry := self._next(batch_status, leaders)) is not None
                ):
                    watcher.began(entry.name)
                    folder, restart = self.output / entry.name, batch_status.of[entry.name].anew
                    how = (
                        self.cluster,
                        self.at_once,
                        not restart and (folder / PARTS).exists(),
                        restart,
                    )
                    leaders.append(Leader(Assignment(entry.name, entry.request, folder, *how)))
                if len(leaders) == 0:
                    break
                for ready in wait([leader.messages for leader in leaders]):
                    leader = next(each for each in leaders if each.messages is ready)
                    if self._heard(leader, batch_status, watcher):
                        leaders.remove(leader)
        finally:
            for leader in leaders:
                leader.ask_to_stop()
            for leader in leaders:
                found = leader.end()
                if isinstance(found, Ended):  # it finished before it was asked to stop
                    self._done(leader, found, batch_status)

    def _next(self, batch_status: BatchStatus, leaders: "Sequence[Leader]") -> Entry | None:
        """The recording to start next; if the one for which a recording waits has failed, its
        status is set to failed, too.
        """
        led = {leader.assignment.name for leader in leaders}
        found: list[Entry] = []
        for entry in self.entries:
            own = batch_status.of[entry.name]
            if own.status != "waiting" or entry.name in led:
                continue
            before = None if entry.after is None else batch_status.of[entry.after].status
            if before == "failed":
                reason = (
                    f"it needs the body shapes of recording {entry.after}, which failed; correct "
                    "that one first"
                )
                batch_status.set(entry.name, own.failed(reason, 0.0, 0))
            elif before in (None, "done"):
                found.append(entry)
        turn = {
            each.name: (batch_status.of[each.name].attempts, -self.sizes[each.name])
            for each in found
        }
        return min(found, key=lambda each: turn[each.name], default=None)

    def _heard(self, leader: "Leader", batch_status: BatchStatus, watcher: Bars) -> bool:
        """Process the next message of a coordinator; returns whether it has ended."""
        name, message = leader.assignment.name, leader.next()
        if message is not None:
            if batch_status.of[name].anew:  # what is saved from now on belongs to this run
                batch_status.set(name, replace(batch_status.of[name], anew=False))
            watcher.frames(name, *message)
            return False
        found = leader.end()
        if isinstance(found, Ended):
            self._done(leader, found, batch_status)
            watcher.ended(name, failed=None, again=False)
        else:
            # Maximum number of attempts for a recording.
            now = batch_status.of[name].failed(found, time.monotonic() - leader.began, 2)
            batch_status.set(name, now)
            watcher.ended(name, failed=found, again=now.status == "waiting")
        return True

    def _done(self, leader: "Leader", found: Ended, batch_status: BatchStatus) -> None:
        """Record that a recording is done."""
        name = leader.assignment.name
        batch_status.set(name, batch_status.of[name].done(found, time.monotonic() - leader.began))


class Leader:
    """A coordinator process, as seen from the process that started it."""

    def __init__(self, assignment: Assignment) -> None:
        """Start the process."""
        self.assignment = assignment
        self.began = time.monotonic()
        """Start time, by `time.monotonic`."""
        self.messages, tell = Pipe(duplex=False)
        """Messages of the process: (finished frames, all frames). It is closed at the end."""
        self._process = Processes(1, _tell_by, tell)
        tell.close()
        self._pid = self._process.submit(os.getpid)
        self._end = self._process.submit(_lead, assignment)

    def next(self) -> tuple[int, int] | None:
        """The next message; None if the process has ended."""
        try:
            return self.messages.recv()
        except (EOFError, OSError):
            return None

    def end(self) -> Ended | str:
        """Wait for the process to end, and terminate it if necessary; returns its result, or the
        reason of its failure.
        """
        # Maximum time for a coordinator to stop, s.
        wait_for([self._end], 20.0)
        self._process.shutdown()
        self.messages.close()
        try:
            return self._end.result(0)
        except (BrokenProcessPool, OSError):
            return "its process was killed; there may be too little memory"

    def ask_to_stop(self) -> None:
        """Ask the process to save finished work and to stop; `end` waits for it."""
        with suppress(BrokenProcessPool, ProcessLookupError):
            if not self._end.done():
                os.kill(self._pid.result(), signal.SIGTERM)


_tell: Connection
"""Connection of a coordinator to the process that started it."""


def _tell_by(tell: Connection) -> None:
    global _tell
    _tell = tell


def _lead(assignment: Assignment) -> Ended | str:
    """Reconstruct a recording in a coordinator process; returns the result, or the reason of a
    failure. All output is appended to the log of the recording.
    """
    use_any_streams()
    forget_notes()
    log = inside(assignment.folder, LOG)
    with log.open("ab", buffering=0) as stream:
        stream.write(f"--- {time.strftime('%Y-%m-%d %H:%M:%S')}\n".encode())
        for descriptor in (1, 2):
            os.dup2(stream.fileno(), descriptor)
    for stream in (sys.stdout, sys.stderr):
        reconfigure: Any = getattr(stream, "reconfigure", lambda **_: None)
        reconfigure(encoding="utf-8", line_buffering=True)
    execution = Execution(
        None, assignment.cluster, assignment.sharing, progress=lambda *counts: _tell.send(counts)
    )
    try:
        with stoppable():
            known = prepare(assignment.request, assignment.folder)
            again = {"resume": assignment.resume, "restart": assignment.restart, "overwrite": True}
            return carry_out(known, execution, **again)
    except Stopped as stop:
        print(f"stopped: {stop.message}", flush=True)
        return "its process was stopped"
    except InputError as error:
        print(f"error: {error}", flush=True)
        return " ".join(str(error).split())
    except Exception as error:
        traceback.print_exc()
        words = " ".join(str(error).split())[:300]
        return f"{type(error).__name__}: {words} (details in {log})"
    finally:
        _tell.close()


def look_at_all(
    table: Path, entries: Sequence[Entry], output: Path, *, continued: bool
) -> dict[str, int]:
    """Check the inputs and output folders of all recordings; returns the size of each one's
    detections, bytes.

    `continued` means that interrupted runs in the folders will be continued or removed. InputError
    if an input is missing or wrong, if existing results are in the way (it describes the first such
    recording and names others), or if the disk of `output` has too little space.
    """
    sizes, problems = {}, []
    for entry in entries:
        try:
            sizes[entry.name] = _look_at(entry, output / entry.name, continued)
        except InputError as error:
            problems.append(f"recording {entry.name}: {error}")
    if len(problems) > 0:
        others = [problem.split(":")[0].removeprefix("recording ") for problem in problems[1:]]
        listed = ", ".join(others[:5]) + (f" and {len(others) - 5} more" if len(others) > 5 else "")
        more = f" (other recordings with problems: {listed})" if len(others) > 0 else ""
        raise InputError(f"{table}: {problems[0]}{more}")
    whole, free = sum(sizes.values()), shutil.disk_usage(output).free
    if free < _LEAST * whole:
        raise InputError(
            f"{output}: {len(entries)} recordings need at least {decimal(int(_LEAST * whole))} "
            f"of disk space, and {decimal(free)} are free; free some space, give another "
            "--output, or split the table"
        )
    if free < _USUAL * whole:
        usual = decimal(int(_USUAL * whole))
        note(
            f"{output}: {decimal(free)} of disk space are free; results of recordings of this "
            f"size usually take {usual}"
        )
    return sizes


def _look_at(entry: Entry, folder: Path, continued: bool) -> int:
    """Check one recording; returns the size of its detections, bytes."""
    known = prepare(entry.request, folder, notify=lambda *_: None)
    request = known.request
    _, places, _ = find_places(known.detections, request.rig())
    find_skeleton(request.skeleton)
    source = known.settings().offsets.source
    for file in (
        request.body,
        request.timestamps,
        None if source in ("recording", "none") else Path(source),
    ):
        if file is not None:
            open_regular(file).close()
    if request.shapes is not None:
        prepare_output(request.shapes.parent, [request.shapes.name])
    prepare_output(folder, (*OUTPUTS, LOG))
    refuse_corrected(folder)
    if (folder / PARTS).exists() and not continued:
        raise InputError(
            f"{folder / PARTS}: there is an interrupted run; continue with --resume, or start "
            "again with --restart"
        )
    if (folder / PEOPLE).exists() and not continued:
        raise InputError(f"{folder}: there is a finished result; move it, or give another --output")
    files = (file for path in places for file in (files_below(path) if path.is_dir() else (path,)))
    return sum(file.stat().st_size for file in files if file.is_file())
