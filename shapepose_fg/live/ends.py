"""Where detections come from and people go to, as they come: lines of JSON, a socket, MCAP; rerun, to look.

`-` or nothing is standard input and output; `tcp://:5000` listens on this machine only, `tcp://0.0.0.0:5000` for
everybody; a name that ends in `.mcap` or `.rrd` is that, `rerun` a viewer that is started, `rerun+http://...` one
that runs; any other is a file or a pipe of lines.
"""

import json
import selectors
import socket
import sys
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any
from urllib.parse import urlsplit

import numpy as np

from shapepose_fg.core.camera import Rig
from shapepose_fg.core.errors import InputError
from shapepose_fg.core.reconstruction import BODY, Reconstruction
from shapepose_fg.core.skeleton import Skeleton
from shapepose_fg.io.detections.lines import read_view_line
from shapepose_fg.io.ros.mcap_files import McapWriter, read_views
from shapepose_fg.io.solved_setup import body_of

View = tuple[Any, ...]
"""What `OnlineReconstructor.push_view` takes."""
Publish = Callable[[str, Reconstruction], None]
"""Of a kind, `now` or `settled`, and its rows."""
_LONGEST_LINE, _MOST_WAITING = 2**20, 2**23
"""Bytes of a line of detections, of 600 people; and that a client may be behind with."""
_OWN_MACHINE = "127.0.0.1"


def views(where: str | None, rig: Rig, skeleton: Skeleton, note: Callable[[str], None]) -> Iterator[View]:
    """What cameras saw, as it comes, to the end of the input; of a socket, until the last who sent has left.

    InputError for a line that is none. On a socket `note` is told, and who sent it is cut off.
    """
    if where is not None and where.startswith("tcp:"):
        yield from _from_socket(where, rig, skeleton, note)
    elif where is not None and where.endswith(".mcap"):
        yield from read_views(Path(where), rig, skeleton, note)
    else:
        with ExitStack() as files:
            named = where not in (None, "-")
            source = files.enter_context(Path(str(where)).open(encoding="utf-8")) if named else sys.stdin
            for number, line in enumerate(source, start=1):
                if line.strip():
                    place = f"{where if named else 'standard input'}, line {number}"
                    yield read_view_line(line, place, rig, skeleton)


@contextmanager
def published(where: Sequence[str], rig: Rig, note: Callable[[str], None]) -> Iterator[Publish]:
    """What takes people out, frame by frame, to all those places; standard output where there is none."""
    with ExitStack() as files:
        targets = [files.enter_context(_target(each, rig, note)) for each in where or ["-"]]

        def publish(kind: str, people: Reconstruction) -> None:
            for target in targets:
                target(kind, people)

        yield publish


@contextmanager
def _target(where: str, rig: Rig, note: Callable[[str], None]) -> Iterator[Publish]:
    with ExitStack() as files:
        if where.endswith(".mcap"):
            written = files.enter_context(McapWriter(files.enter_context(Path(where).open("wb")), rig))
            yield lambda kind, people: _by_time(people, lambda rows, time_s: written.frame(rows, time_s, kind))
            return
        if where == "rerun" or where.startswith("rerun+") or where.endswith(".rrd"):
            from shapepose_fg.io.export import rerun_app, rerun_log  # with scipy.stats: half a second

            first = rerun_app.layout(rig.up, rig, rig.centres, ["world/people/**"])
            if where.endswith(".rrd"):
                stream = files.enter_context(rerun_app.written(Path(where), first))
            else:
                if where == "rerun":
                    note(*rerun_app.quiet_viewer())
                stream = files.enter_context(rerun_app.shown(first, None if where == "rerun" else where))
            log = rerun_log.LiveLog(stream, rig, body_of({}, None))
            yield lambda kind, people: log.moment(people) if kind == "now" else None
            return
        if where.startswith("tcp:"):
            send = files.enter_context(_Listeners(_listening(where), note)).send
        else:
            sink = sys.stdout if where == "-" else files.enter_context(Path(where).open("w", encoding="utf-8"))

            def send(line: str) -> None:
                sink.write(line)
                sink.flush()

        yield lambda kind, people: _by_time(people, lambda rows, time_s: send(line_of(kind, rows, time_s)))


def line_of(kind: str, people: Reconstruction, time_s: float) -> str:
    """A moment's people as a line of JSON: metres, m², m/s; null where unknown."""
    rows = [
        {
            "person": int(people.person[n]),
            "joints": _plain(people.joints[n]),
            "covariance": _plain(people.covariance[n]),
            "velocity": _plain(people.velocity[n]),
            "known": people.known[n].tolist(),
            "status": str(people.status[n]),
            "body": {name: _plain(getattr(people, name)[n]) for name in BODY},
        }
        for n in range(len(people))
    ]
    return json.dumps({"kind": kind, "time_s": time_s, "people": rows}, allow_nan=False) + "\n"


def _by_time(people: Reconstruction, take: Callable[[Reconstruction, float], None]) -> None:
    for time_s in np.unique(people.time_s).tolist():
        take(people.rows(people.time_s == time_s), time_s)


def _plain(values: np.ndarray) -> Any:
    """Nested lists of numbers of 6 digits, null where one of an innermost list is unknown."""
    if values.ndim > 1:
        return [_plain(each) for each in values]
    return [float(f"{value:.6g}") for value in values] if np.isfinite(values).all() else None


def _listening(where: str) -> socket.socket:
    """A socket for `tcp://HOST:PORT`; without a host, on this machine only."""
    try:
        parts = urlsplit(where)
        host, port = parts.hostname or _OWN_MACHINE, parts.port
        if port is None or parts.path.strip("/") or parts.username:
            raise ValueError("no port")
        return socket.create_server((host, port))
    except (ValueError, OSError) as error:
        raise InputError(
            f"{where}: cannot be listened on ({error}); give tcp://:PORT or tcp://HOST:PORT"
        ) from None


def _from_socket(where: str, rig: Rig, skeleton: Skeleton, note: Callable[[str], None]) -> Iterator[View]:
    with ExitStack() as all_of_them, _listening(where) as listening, selectors.DefaultSelector() as ready:
        ready.register(listening, selectors.EVENT_READ)
        heard, served = dict[socket.socket, bytes](), False
        while True:
            for key, _ in ready.select():
                if key.fileobj is listening:
                    client = all_of_them.enter_context(listening.accept()[0])
                    ready.register(client, selectors.EVENT_READ)
                    heard[client] = b""
                    continue
                client = next(each for each in heard if each is key.fileobj)
                try:
                    given = client.recv(2**16)
                    *lines, rest = (heard[client] + given).split(b"\n")
                    heard[client] = rest
                    if len(rest) > _LONGEST_LINE:
                        raise InputError(f"a line is longer than {_LONGEST_LINE} bytes")
                    for line in [*lines, rest] if given == b"" else lines:
                        if line.strip():
                            view = read_view_line(line.decode(errors="replace"), where, rig, skeleton)
                            served = True
                            yield view
                except (OSError, InputError) as error:
                    note(f"{error}; who sent it is cut off")
                    given = b""
                if given == b"":
                    ready.unregister(client)
                    client.close()
                    del heard[client]
                    if served and not heard:
                        return


class _Listeners:
    """Sends lines to whoever is there; who reads too slowly is cut off, and nobody is waited for."""

    def __init__(self, listening: socket.socket, note: Callable[[str], None]) -> None:
        self._listening, self._note = listening, note
        self._waiting: dict[socket.socket, bytes] = {}
        listening.setblocking(False)

    def __enter__(self) -> "_Listeners":
        return self

    def __exit__(self, *_: object) -> None:
        for client, rest in self._waiting.items():
            with client:
                client.settimeout(1.0)
                try:
                    client.sendall(rest)
                except OSError:
                    continue
        self._listening.close()

    def send(self, line: str) -> None:
        while True:
            try:
                client, _ = self._listening.accept()
            except BlockingIOError:
                break
            client.setblocking(False)
            self._waiting[client] = b""
        for client, rest in list(self._waiting.items()):
            rest += line.encode()
            try:
                rest = rest[client.send(rest) :]
            except BlockingIOError:
                pass
            except OSError:
                rest = None
            if rest is None or len(rest) > _MOST_WAITING:
                self._note("a reader left" if rest is None else "a reader is too slow, and cut off")
                client.close()
                del self._waiting[client]
            else:
                self._waiting[client] = rest
