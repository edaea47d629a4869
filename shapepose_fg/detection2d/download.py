"""Named networks, downloaded on request; their checksums are pinned at first use."""

import hashlib
import http.client
import json
import tempfile
import urllib.error
import urllib.request
import zipfile
import zlib
from collections.abc import Callable
from dataclasses import dataclass
from functools import lru_cache
from importlib.resources import files
from pathlib import Path, PurePosixPath
from typing import IO, Any

from shapepose_fg.core.errors import InputError
from shapepose_fg.core.storage.files import SMALL, read_bytes, read_text, user_cache, write_content
from shapepose_fg.detection2d.onnx_file import MOST_BYTES

BASES = (
    "https://download.openmmlab.com/mmpose/v1/projects/rtmposev1/onnx_sdk",
    "https://huggingface.co/Tau-J/RTMPose/resolve/main/rtmposev1/onnx_sdk",
)
"""Addresses of the folders with the named networks, as rtmlib publishes them: OpenMMLab's, and its
mirror."""

_INSIDE = "end2end.onnx"
"""Name of the network in its archive."""
_BROKEN = (zipfile.BadZipFile, zlib.error, NotImplementedError)


@dataclass(frozen=True)
class NamedNetwork:
    """A downloadable network that can be selected by name."""

    file: str
    """Archive of the network, at each of `BASES`."""
    size: tuple[int, int]
    """Width and height of the network's input, pixels."""
    boxes: str | None = None
    """Name of the YOLOX network that detects people for this network; None if it detects people
    itself."""


@lru_cache(maxsize=1)
def named_networks() -> dict[str, NamedNetwork]:
    """Downloadable networks by name: RTMPose (HALPE-26), with the YOLOX that rtmlib pairs with
    each.
    """
    table = json.loads(
        (files("shapepose_fg.detection2d") / "data" / "networks.json").read_text(encoding="utf-8")
    )
    return {
        name: NamedNetwork(**(entry | {"size": tuple(entry["size"])}))
        for name, entry in table.items()
    }


def named_file(
    name: str,
    *,
    fetch: bool = False,
    say: Callable[[str], object] = print,
    progress: Callable[[int, int], object] = lambda done, total: None,
) -> Path:
    """The file of the named network `name`, downloaded first if it is missing and `fetch` is set.

    The SHA-256 of the ONNX file is passed to `say` and pinned at first use. InputError if it
    differs later.
    """
    kept, pin = (user_cache("networks") / f"{name}.{ending}" for ending in ("onnx", "sha256"))
    exists = kept.is_file()
    if not exists and not fetch:
        raise InputError(
            f"{name}: this network has not been downloaded yet; give --download {name}, or the "
            "path of a file"
        )
    content = (
        read_bytes(kept, MOST_BYTES) if exists else _fetched(named_networks()[name].file, progress)
    )
    digest = hashlib.sha256(content).hexdigest()
    if not pin.is_file():
        write_content(pin, digest)
        say(f"{name}: sha256 {digest} is pinned in {pin}")
    pinned = read_text(pin, most=SMALL).strip()
    if digest != pinned:
        raise InputError(
            f"{kept}: the sha256 of {'the file' if exists else 'the download'} is {digest}, but "
            f"{pinned[:64]} was pinned at first use; if the change is intended, delete the file "
            f"and {pin.name} beside it"
        )
    if not exists:
        write_content(kept, content)
    return kept


class _OnlyHttps(urllib.request.HTTPRedirectHandler):
    """Follows no redirection to unencrypted addresses, where content could be changed."""

    def redirect_request(
        self, req: Any, fp: Any, code: int, msg: str, headers: Any, newurl: str
    ) -> Any:
        if not newurl.startswith("https://"):
            raise urllib.error.URLError(f"it redirects to {newurl[:200]}, which is not https")
        return super().redirect_request(req, fp, code, msg, headers, newurl)


def _fetched(file: str, progress: Callable[[int, int], object]) -> bytes:
    """The network from its archive, downloaded from the first address that has it."""
    problems, opener = list[str](), urllib.request.build_opener(_OnlyHttps)
    for base in BASES:
        try:
            with (
                opener.open(f"{base}/{file}", timeout=30.0) as answer,
                tempfile.TemporaryFile() as archive,
            ):
                total, done = int(answer.headers.get("Content-Length") or 0), 0
                # The number of bytes read is bounded, so that an endless response cannot fill the
                # disk.
                while done <= MOST_BYTES and (part := answer.read(1 << 16)):
                    archive.write(part)
                    done += len(part)
                    progress(done, max(total, done))
                if done < total or done > MOST_BYTES:
                    raise ValueError(
                        f"only {done} of {total} bytes were received"
                        if done < total
                        else "the download is too long"
                    )
                return _inside(archive)
        except (
            OSError,
            ValueError,
            EOFError,
            RuntimeError,
            http.client.HTTPException,
            *_BROKEN,
        ) as error:
            reason = (
                error
                if isinstance(error, urllib.error.HTTPError)
                else getattr(error, "reason", error)
            )
            problems.append(f"{base}/{file} ({reason})")
    raise InputError(
        f"the network cannot be downloaded from {' or '.join(problems)}; download it by hand and "
        f"give --network the path of the {_INSIDE} in it"
    )


def _inside(archive: IO[bytes]) -> bytes:
    """The network in an archive with exactly one. Paths in the archive are ignored."""
    with zipfile.ZipFile(archive) as opened:
        found = [each for each in opened.infolist() if PurePosixPath(each.filename).name == _INSIDE]
        if len(found) != 1:
            raise ValueError(f"it holds {len(found)} files {_INSIDE}")
        with opened.open(found[0]) as stream:
            content = stream.read(MOST_BYTES + 1)
    if len(content) > MOST_BYTES:
        raise ValueError(f"its {_INSIDE} has over {MOST_BYTES} bytes")
    return content
