"""Online outputs of people: lines of JSON, a socket, MCAP, or rerun for display.

`-` or nothing is standard output; `tcp://:5000` listens on this machine only, `tcp://0.0.0.0:5000`
for everybody; a name that ends in `.mcap` or `.rrd` is such a file, `rerun` a viewer that is
started, `rerun+http://...` a running one; any other is a file or a pipe of lines.
"""

import json
import selectors
import socket
import sys
import threading
import time
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from contextlib import AbstractContextManager, ExitStack, contextmanager
from pathlib import Path
from typing import IO, Any, cast

import numpy as np

from shapepose_fg.body.model.result_body import body_of
from shapepose_fg.core.camera import Rig
from shapepose_fg.core.reconstruction import BODY, Reconstruction
from shapepose_fg.core.storage.files import naming_file
from shapepose_fg.io.ros.mcap_files import McapWriter
from shapepose_fg.io.ros.messages import COVARIANCES
from shapepose_fg.live.sockets import MOST_CLIENTS, accept, listen

Publish = Callable[[str, Reconstruction, Sequence[float]], None]
"""Function that takes the kind of the rows, `now` or `settled`, the rows, and the times of the
frames to be written as empty if there are no rows, s."""


@contextmanager
def published(
    where: Sequence[str], rig: Rig, note: Callable[[str], None], covariances: str = "joints"
) -> Iterator[Publish]:
    """Yield a function that writes people, frame by frame, to all of `where`; by default to
    standard output. `covariances` is a level of `COVARIANCES`.
    """
    with ExitStack() as files:
        targets = [
            files.enter_context(_target(each, rig, note, covariances)) for each in where or ["-"]
        ]

        def publish(kind: str, people: Reconstruction, empty_s: Sequence[float] = ()) -> None:
            for target in targets:
                target(kind, people, empty_s)

        yield publish


class _OutputFile(AbstractContextManager["_OutputFile"]):
    """A file that is written while people arrive; its OSErrors name it."""

    def __init__(self, path: Path) -> None:
        self._path, self._stream = path, path.open("wb")

    def write(self, data: bytes) -> int:
        with naming_file(self._path):
            return self._stream.write(data)

    def flush(self) -> None:
        with naming_file(self._path):
            self._stream.flush()

    def tell(self) -> int:
        return self._stream.tell()

    def __exit__(self, *_error: object) -> None:
        with naming_file(self._path):
            self._stream.close()


@contextmanager
def _target(
    where: str, rig: Rig, note: Callable[[str], None], covariances: str
) -> Iterator[Publish]:
    with ExitStack() as files:
        if where.endswith(".mcap"):
            stream = files.enter_context(_OutputFile(Path(where)))
            written = files.enter_context(McapWriter(cast("IO[bytes]", stream), rig, covariances))
            yield lambda kind, people, empty_s: _by_time(
                people, empty_s, lambda rows, time_s: written.frame(rows, time_s, kind)
            )
            return
        if where == "rerun" or where.startswith("rerun+") or where.endswith(".rrd"):
            from shapepose_fg.io.export import (
                rerun_app,
                rerun_log,
            )  # with scipy.stats: half a second

            first = rerun_app.layout(rig.up, rig, rig.centres, ["world/people/**"])
            if where.endswith(".rrd"):
                stream = files.enter_context(rerun_app.written(Path(where), first))
            else:
                if where == "rerun":
                    for each in rerun_app.quiet_viewer():
                        note(each)
                stream = files.enter_context(
                    rerun_app.shown(first, None if where == "rerun" else where)
                )
            log = rerun_log.LiveLog(stream, rig, body_of({}, None))
            yield lambda kind, people, _: log.moment(people) if kind == "now" else None
            return
        if where.startswith("tcp:"):
            send = files.enter_context(_Listeners(listen(where), note)).send
        else:
            sink = None if where == "-" else files.enter_context(_OutputFile(Path(where)))

            def send(line: str) -> None:
                if sink is None:
                    sys.stdout.write(line)
                    sys.stdout.flush()
                else:
                    sink.write(line.encode())
                    sink.flush()

        yield lambda kind, people, empty_s: _by_time(
            people, empty_s, lambda rows, time_s: send(line_of(kind, rows, time_s, covariances))
        )


def line_of(kind: str, people: Reconstruction, time_s: float, covariances: str = "joints") -> str:
    """The people of a frame as a line of JSON: metres, m², m/s, seconds to 1e-6; null where
    unknown. Covariances that a level of `COVARIANCES` leaves out are missing.
    """
    columns = ("joints", "velocity", *COVARIANCES[covariances])
    rows = [
        {
            "person": int(people.person[n]),
            "known": people.known[n].tolist(),
            "status": str(people.status[n]),
            "body": {name: _plain(getattr(people, name)[n]) for name in BODY},
        }
        | {name: _plain(getattr(people, name)[n], "covariance" in name) for name in columns}
        for n in range(len(people))
    ]
    line = {"kind": kind, "time_s": round(time_s, 6), "people": rows}
    return json.dumps(line, allow_nan=False, separators=(",", ":")) + "\n"


def _by_time(
    people: Reconstruction, empty_s: Sequence[float], take: Callable[[Reconstruction, float], None]
) -> None:
    for time_s in np.unique(people.time_s).tolist() or empty_s:
        take(people.rows(people.time_s == time_s), time_s)


def _plain(values: np.ndarray, is_covariance: bool = False) -> Any:
    """Nested lists of numbers; null for an innermost list with an unknown number. Covariances have
    6 digits, so that they stay positive definite; others are rounded to 1e-4.
    """
    if values.ndim > 1:
        return [_plain(each, is_covariance) for each in values]
    if not np.isfinite(values).all():
        return None
    return [float(f"{x:.6g}") if is_covariance else round(x, 4) for x in values.tolist()]


class _Listeners:
    """Sends lines to all connected clients; clients that read too slowly are disconnected, and none
    blocks.
    """

    def __init__(self, listening: socket.socket, note: Callable[[str], None]) -> None:
        self._listening, self._note = listening, note
        self._waiting: dict[socket.socket, deque[memoryview]] = {}
        """By client: data still to be sent. The memory of a line is shared by all clients."""
        self._lock = threading.Lock()
        self._ended = threading.Event()
        self._thread = threading.Thread(target=self._wait_for_readers, daemon=True)

    def __enter__(self) -> "_Listeners":
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._ended.set()
        self._thread.join()
        self._listening.close()
        # Longest wait for all clients together, when the output ends, s.
        until_s = time.monotonic() + 2.0
        for client, waiting in self._waiting.items():
            with client:
                try:
                    for each in waiting:
                        client.settimeout(max(until_s - time.monotonic(), 0.01))
                        client.sendall(each)
                except OSError:
                    continue

    def send(self, line: str) -> None:
        """Send the backlog and a line to each client, as far as it accepts data without
        blocking.
        """
        self._welcome()
        data = memoryview(line.encode())
        for client, waiting in list(self._waiting.items()):
            waiting.append(data)
            try:
                while waiting:
                    sent = client.send(waiting[0])
                    rest = waiting.popleft()[sent:]
                    if len(rest) > 0:
                        waiting.appendleft(rest)
            except BlockingIOError:
                pass
            except OSError:
                self._part(client, "a reader disconnected")
                continue
            # Maximum backlog of a client, bytes; a slower one is disconnected.
            if sum(map(len, waiting)) > 2**23:
                self._part(client, "a reader is too slow; its connection is closed")

    def _wait_for_readers(self) -> None:
        """Accept clients in a thread, also while there is nothing to send: the system's queue is
        short.
        """
        with selectors.DefaultSelector() as ready:
            ready.register(self._listening, selectors.EVENT_READ)
            while not self._ended.is_set():
                # Longest wait for the thread that accepts clients, when the
                # output ends, s.
                if ready.select(0.2) and not self._welcome():
                    self._ended.wait(1.0)

    def _welcome(self) -> bool:
        """Accept waiting clients; returns False if the system has no resources for them."""
        try:
            with self._lock:
                for _ in range(MOST_CLIENTS):  # bounded, to return to sending
                    if (found := accept(self._listening)) is None:
                        break
                    client, name = found
                    if len(self._waiting) < MOST_CLIENTS:
                        self._waiting[client] = deque()
                    else:
                        client.close()
                        self._note(
                            f"{name} is rejected, because {MOST_CLIENTS} readers are connected "
                            "already"
                        )
        except OSError as error:
            self._note(f"no further reader can be served ({error.strerror})")
            return False
        return True

    def _part(self, client: socket.socket, why: str) -> None:
        self._note(why)
        client.close()
        del self._waiting[client]
