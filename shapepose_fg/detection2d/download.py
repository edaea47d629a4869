"""A named network, fetched once from its public address, and only if its checksum is right."""

import hashlib
import urllib.error
import urllib.parse
import urllib.request
from collections.abc import Callable
from pathlib import Path

from shapepose_fg.core.errors import InputError
from shapepose_fg.core.storage.files import user_cache, write_atomically
from shapepose_fg.detection2d.networks import KnownNetwork, known_networks

_CHUNK = 1 << 16
_TIMEOUT_S = 30.0


def cache_folder() -> Path:
    """Where fetched networks are kept: the user's cache, XDG_CACHE_HOME where it is set."""
    return user_cache("networks")


def find_network(
    name: str,
    *,
    download: bool = False,
    address: str | None = None,
    progress: Callable[[int, int], None] | None = None,
) -> Path:
    """The file of the network that is called `name`, a file's path or one of `known_networks()`.

    A named network is fetched only where `download` says so, from `address` or from its own, and then kept.
    InputError where it is not there and may not be fetched, or what comes is not it.
    """
    if Path(name).is_file():
        return Path(name)
    known = known_networks().get(name)
    if known is None:
        listing = "; ".join(f"{each.name} ({each.about})" for each in known_networks().values())
        raise InputError(
            f"--network {name}: there is no such file, and no network of this name; named networks are {listing}"
        )
    kept = cache_folder() / f"{known.name}.onnx"
    if kept.is_file() and _digest(kept) == known.sha256:
        return kept
    if not download:
        raise InputError(
            f"--network {name}: it has not been fetched yet; add --download to fetch {known.bytes / 1e6:.1f} MB"
            " once, or give the path of its file"
        )
    source = address or known.address
    if source is None:
        raise InputError(
            f"--network {name}: no public address of this file is known; name one with --network-address"
            f" (what comes is checked: sha256 {known.sha256}), or give the path of the file"
        )
    content = _fetch(source, known, progress)
    write_atomically(kept, lambda stream: stream.write(content))
    return kept


def _digest(file: Path) -> str:
    with file.open("rb") as stream:
        return hashlib.file_digest(stream, "sha256").hexdigest()


def _fetch(address: str, known: KnownNetwork, progress: Callable[[int, int], None] | None) -> bytes:
    """What is at `address`, if it is the network."""
    scheme = urllib.parse.urlsplit(address).scheme
    if scheme not in ("https", "http"):
        raise InputError(f"--network-address {address}: must be an address that begins with https:// or http://")
    parts: list[bytes] = []
    size = 0
    try:
        with urllib.request.urlopen(address, timeout=_TIMEOUT_S) as answer:
            # No more is read than the network has: an address that never ends fills no memory.
            while size <= known.bytes and (part := answer.read(_CHUNK)):
                parts.append(part)
                size += len(part)
                if progress is not None:
                    progress(min(size, known.bytes), known.bytes)
    except (OSError, urllib.error.URLError, ValueError) as error:
        told = error if isinstance(error, urllib.error.HTTPError) else getattr(error, "reason", error)
        raise InputError(
            f"{address}: the network {known.name} cannot be fetched ({told}); fetch it by hand and give its path"
        ) from None
    content = b"".join(parts)
    if hashlib.sha256(content).hexdigest() != known.sha256:
        what = f"more than {known.bytes}" if size > known.bytes else str(size)
        raise InputError(
            f"{address}: what came ({what} bytes) is not the network {known.name}, its checksum differs;"
            " nothing was kept"
        )
    return content
