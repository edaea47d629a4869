"""Sockets on which `live` listens, and the number of their clients."""

import socket
from urllib.parse import urlsplit

from shapepose_fg.core.errors import InputError

MOST_CLIENTS = 64
"""Maximum number of clients of a socket; below the usual limit of open files per process."""
_OWN_MACHINE = "127.0.0.1"


def listen(where: str) -> socket.socket:
    """A listening socket for `tcp://HOST:PORT`; without a host, on this machine only. Raises
    InputError on failure.
    """
    try:
        parts = urlsplit(where)
        host, port = parts.hostname or _OWN_MACHINE, parts.port
        if port is None or parts.path.strip("/") or parts.username:
            raise ValueError("no port")
        listening = socket.create_server((host, port))
    except (ValueError, OSError) as error:
        raise InputError(
            f"{where}: cannot be opened ({error}); give tcp://:PORT or tcp://HOST:PORT"
        ) from None
    listening.setblocking(False)
    return listening


def accept(listening: socket.socket) -> tuple[socket.socket, str] | None:
    """The next connection, non-blocking, and its address; None if there is none. Raises OSError if
    the system has no resources for it.
    """
    try:
        client, address = listening.accept()
    except (BlockingIOError, ConnectionError):  # or it was closed
        return None
    client.setblocking(False)
    client.setsockopt(socket.SOL_SOCKET, socket.SO_KEEPALIVE, 1)
    return client, f"{address[0]}:{address[1]}"
