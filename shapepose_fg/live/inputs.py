"""Online inputs of detections: lines of JSON from a file, a pipe or clients of a socket; MCAP.

A single bad line does not end the service: it is skipped with a note. A sender that begins with an
unreadable line, or sends ten in a row, is refused: a client is disconnected and the others
continue; for a file, InputError is raised.
"""

import selectors
import socket
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from dataclasses import dataclass, field
from pathlib import Path
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
_PIECE = 2**16
"""Maximum number of bytes read at a time."""
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
        _from_file(sys.stdin.buffer, _Sender("standard input", given))
    else:
        with Path(str(where)).open("rb") as stream:
            _from_file(stream, _Sender(str(where), given))


@dataclass(frozen=True)
class _Given:
    """The arguments of `feed` that all senders share."""

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
        """Push the result of `read`, called with the next line's name, unless None. Raises
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


@dataclass
class _Lines:
    """Cuts bytes into lines as they come, in bounded memory."""

    _begun: bytearray = field(default_factory=bytearray)
    _too_long: bool = False
    """Whether the current line is too long."""

    def split(self, piece: bytes) -> Iterator[bytes | None]:
        """Lines completed by the next bytes, or the last line if `piece` is empty; None for one
        that is too long.
        """
        *ended, begun = piece.split(b"\n") if piece else (b"", b"")
        for part in ended:
            self._begun += part
            if len(self._begun) > SMALL and not self._too_long:
                yield None
            elif not self._too_long:
                yield bytes(self._begun)
            self._begun.clear()
            self._too_long = False
        self._begun += begun
        if len(self._begun) > SMALL:
            if not self._too_long:
                yield None
            self._begun.clear()
            self._too_long = True


def _from_file(stream: IO[bytes], sender: _Sender) -> None:
    lines, piece = _Lines(), b"-"
    while piece:
        piece = stream.read1(_PIECE) if hasattr(stream, "read1") else stream.read(_PIECE)  # pyright: ignore
        for line in lines.split(piece):
            sender.line(line)
    sender.end()


@dataclass(eq=False)
class _Client:
    """A connection that sends lines."""

    connection: socket.socket
    sender: _Sender
    lines: _Lines
    heard_s: float
    """Time of its last data, or of its connection, on the monotonic clock, s."""


def _from_socket(where: str, given: _Given) -> None:
    with ExitStack() as ending, listen(where) as listening, selectors.DefaultSelector() as ready:
        clients = list[_Client]()
        ending.callback(lambda: [each.connection.close() for each in clients])
        ready.register(listening, selectors.EVENT_READ)
        served, served_s, full_s = False, time.monotonic(), -1.0

        def cut_off(client: _Client, why: object = "") -> None:
            if why:
                given.note(f"{client.sender.name}: {why}; the connection is closed")
            ready.unregister(client.connection)
            client.connection.close()
            clients.remove(client)

        def come() -> None:
            found = accept(listening)
            if found is None:
                return
            connection, name = found
            client = _Client(
                connection, _Sender(f"{where}, {name}", given), _Lines(), time.monotonic()
            )
            if len(clients) >= MOST_CLIENTS:
                # The first to go is one without any accepted line, then the longest silent.
                first = min(clients, key=lambda each: (each.sender.good > 0, each.heard_s))
                # Time of silence, s, after which a client may be disconnected
                # to make room for another.
                if first.sender.good > 0 and client.heard_s - first.heard_s < 60.0:
                    connection.close()
                    given.note(
                        f"{where}: {name} is rejected, because {MOST_CLIENTS} clients are "
                        "connected already"
                    )
                    return
                cut_off(
                    first,
                    (
                        f"at most {MOST_CLIENTS} clients are served, and this one was silent for "
                        "the longest time"
                    ),
                )
            clients.append(client)
            ready.register(connection, selectors.EVENT_READ, client)

        def hear(client: _Client) -> None:
            try:
                piece = client.connection.recv(_PIECE)
                client.heard_s = time.monotonic()
                for line in client.lines.split(piece):
                    client.sender.line(line)
            except BlockingIOError:
                return
            except InputError as error:
                cut_off(client, str(error).removeprefix(f"{client.sender.name}, "))
            except OSError as error:
                cut_off(client, error.strerror or error)
            else:
                if not piece:
                    cut_off(client)

        while True:
            for key, _ in ready.select(timeout=_RECONNECT_S / 4):
                if key.data is not None:
                    served |= key.data.sender.good > 0
                    if key.data in clients:
                        hear(key.data)
                    served |= key.data.sender.good > 0
                    continue
                try:
                    come()
                except OSError as error:
                    given.note(f"{where}: no further client can be served ({error.strerror})")
                    ready.unregister(listening)
                    full_s = time.monotonic()
            now_s = time.monotonic()
            if 0 <= full_s < now_s - 1.0:
                ready.register(listening, selectors.EVENT_READ)
                full_s = -1.0
            if not served or any(each.sender.good > 0 for each in clients):
                served_s = now_s
            if now_s - served_s > _RECONNECT_S:
                return
