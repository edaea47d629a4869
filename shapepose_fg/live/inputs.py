"""Online inputs of detections: lines of JSON from a file, a pipe or clients of a socket; MCAP.

A single bad line does not end the service: it is skipped with a note. A sender that begins with an
unreadable line, or sends ten in a row, is refused: a client is disconnected and the others
continue; for a file, InputError is raised.
"""

import select
import socket
import sys
import time
from collections.abc import Callable
from contextlib import ExitStack, suppress
from dataclasses import dataclass
from pathlib import Path
from threading import Lock, Thread
from typing import IO, Any

from shapepose_fg.core.camera import Rig
from shapepose_fg.core.errors import InputError, naming
from shapepose_fg.core.skeleton import Skeleton
from shapepose_fg.core.storage.files import SMALL
from shapepose_fg.io.detections.lines import read_view_line
from shapepose_fg.io.ros.mcap_files import read_views
from shapepose_fg.live.sockets import MOST_CLIENTS, accept, listen

Push = Callable[..., None]
"""Function with the parameters of `OnlineReconstructor.push_view`; raises ValueError if it refuses
a view."""
Note = Callable[[str], None]
_RECONNECT_S = 2.0
"""Time for which a socket stays open after its last client has left, s: clients may reconnect."""


def feed(where: str | None, rig: Rig, skeleton: Skeleton, note: Note, push: Push) -> None:
    """Pass detections to `push` as they come, until the input ends.

    `where` is a file or a pipe of lines, `-` or None for standard input, `FILE.mcap`, or
    `tcp://HOST:PORT`, which ends when all clients that sent something have left. `note` receives a
    message for each skipped line. Raises InputError if the input cannot be used.
    """
    given = _Given(rig, skeleton, note, push)
    if where is not None and where.startswith("tcp:"):
        _from_socket(where, given)
    elif where is not None and where.endswith(".mcap"):
        sender = _Sender(where, given)
        for view in read_views(Path(where), rig, skeleton, note):
            sender.take(lambda place, view=view: view)
        sender.end()
    elif where in (None, "-"):
        if sys.stdin is None:
            raise InputError("standard input is closed; name a file or a socket with --detections")
        sender = _Sender("standard input", given)
        _read_lines(sys.stdin.buffer, sender.line)
        sender.end()
    else:
        sender = _Sender(str(where), given)
        with Path(str(where)).open("rb") as stream:
            _read_lines(stream, sender.line)
        sender.end()


@dataclass(frozen=True)
class _Given:
    """Arguments of `feed` that are the same for all senders."""

    rig: Rig
    skeleton: Skeleton
    note: Note
    push: Push


@dataclass
class _Sender:
    """A sender of lines."""

    name: str
    """Name of the file or the client, for messages."""
    given: _Given
    good: int = 0
    """Number of accepted lines."""
    refused: InputError | None = None
    """The first refusal by `push`."""
    _number: int = 0
    _bad: int = 0
    """Number of consecutive unreadable lines."""

    def line(self, line: bytes | None) -> None:
        """Process the next line, None for one that is too long. Raises InputError if the sender
        must be refused.
        """
        if line is not None and self._number == 0:
            line = line.removeprefix(b"\xef\xbb\xbf")
        if line is None or line.strip():
            self.take(lambda place: self._read(line, place))
        else:
            self._number += 1

    def take(self, read: Callable[[str], tuple[Any, ...] | None]) -> None:
        """Call `read` with the name of the next line, and push its result unless it is None. Raises
        InputError as `line` does.
        """
        self._number += 1
        place = f"{self.name}, line {self._number}"
        try:
            view = read(place)
        except InputError as error:
            self._bad += 1
            # Number of consecutive unusable lines after which their sender is
            # refused.
            if self.good == 0 or self._bad >= 10:
                raise
            self.given.note(f"{error}; the line is left out")
            return
        self._bad = 0
        if view is None:
            return
        try:
            with naming(place):
                self.given.push(*view)
        except InputError as error:  # maybe another client's fault
            self.refused = self.refused or error
            self.given.note(f"{error}; the line is left out")
        else:
            self.good += 1

    def end(self) -> None:
        """Raise InputError if no detections were accepted."""
        if self.good == 0:
            raise self.refused or InputError(
                f"{self.name}: the input ended without detections; check that the detector runs "
                "and writes a line for each picture"
            )

    def _read(self, line: bytes | None, place: str) -> tuple[Any, ...] | None:
        if line is None:
            raise InputError(
                f"{place}: the line is longer than {SMALL} bytes; write a line for each picture"
            )
        try:
            text = line.decode()
        except UnicodeDecodeError as error:
            raise InputError(
                f"{place}: byte {error.start} is not UTF-8 text; write JSON in UTF-8"
            ) from None
        return read_view_line(text, place, self.given.rig, self.given.skeleton)


def _read_lines(stream: IO[bytes], take: Callable[[bytes | None], None]) -> None:
    """Pass the lines of a file, a pipe or a connection to `take`; None for one that is too long."""
    while line := stream.readline(SMALL + 1):
        too_long = len(line) > SMALL
        while len(line) > SMALL and not line.endswith(b"\n"):
            line = stream.readline(SMALL + 1)
        take(None if too_long else line)


@dataclass(eq=False)
class _Client:
    """A connection that sends lines."""

    connection: socket.socket
    sender: _Sender
    heard_s: float
    """Time of the client's last line, or of the connection, on the monotonic clock, s."""


def _from_socket(where: str, given: _Given) -> None:
    """Serve clients, each in a thread that processes one line at a time, until all that sent
    something have left.
    """
    clients, one_at_a_time, failed = list[_Client](), Lock(), list[Exception]()
    served, over, served_s = False, False, time.monotonic()

    def cut_off(client: _Client, why: object) -> None:
        if client in clients:
            clients.remove(client)
            if why:
                given.note(f"{client.sender.name}: {why}; the connection is closed")
        with suppress(OSError):  # it may have left
            client.connection.shutdown(socket.SHUT_RDWR)

    def serve(client: _Client) -> None:
        def take(line: bytes | None) -> None:
            nonlocal served
            with one_at_a_time:
                if over:
                    raise ConnectionAbortedError
                client.heard_s = time.monotonic()
                client.sender.line(line)
                served |= client.sender.good > 0

        why: object = ""
        try:
            with client.connection.makefile("rb") as stream:
                _read_lines(stream, take)
        except InputError as error:
            why = str(error).removeprefix(f"{client.sender.name}, ")
        except OSError as error:
            why = error.strerror or error
        except Exception as error:  # not the client's fault
            failed.append(error)
        with client.connection, one_at_a_time:
            cut_off(client, why)

    def come(connection: socket.socket, name: str) -> None:
        now_s = time.monotonic()
        client = _Client(connection, _Sender(f"{where}, {name}", given), now_s)
        if len(clients) >= MOST_CLIENTS:
            # The first to go is one without any accepted line, then the longest silent.
            first = min(clients, key=lambda each: (each.sender.good > 0, each.heard_s))
            # Time of silence, s, after which a client may be disconnected to make room for
            # another.
            if first.sender.good > 0 and now_s - first.heard_s < 60.0:
                connection.close()
                reason = f"because {MOST_CLIENTS} clients are connected already"
                given.note(f"{where}: {name} is rejected, {reason}")
                return
            reason = "and this one was silent for the longest time"
            cut_off(first, f"at most {MOST_CLIENTS} clients are served, {reason}")
        clients.append(client)
        connection.setblocking(True)
        Thread(target=serve, args=(client,), daemon=True).start()

    def end() -> None:
        nonlocal over
        with one_at_a_time:
            over = True
            for client in list(clients):
                cut_off(client, "")

    with ExitStack() as ending, listen(where) as listening:
        ending.callback(end)
        while not failed and time.monotonic() - served_s <= _RECONNECT_S:
            waits = select.select([listening], [], [], _RECONNECT_S / 4)[0]
            try:
                with one_at_a_time:
                    found = accept(listening) if waits else None
                    if found is not None:
                        come(*found)
                    if not served or any(each.sender.good > 0 for each in clients):
                        served_s = time.monotonic()
            except OSError as error:
                given.note(f"{where}: no further client can be served ({error.strerror})")
                time.sleep(1.0)
    if failed:
        raise failed[0]
