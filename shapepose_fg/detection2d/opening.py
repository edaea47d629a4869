"""A network by its name, its ONNX file or its TOML file, ready to detect.

Named networks are fetched when asked for, and the same ever after: their checksums are pinned at first use.
"""

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

import numpy as np

from shapepose_fg.core.errors import InputError
from shapepose_fg.core.skeleton import SKELETONS
from shapepose_fg.core.storage.files import SMALL, read_bytes, read_text, read_toml, user_cache, write_content
from shapepose_fg.detection2d.heat_maps import HeatMapNetwork
from shapepose_fg.detection2d.onnx_network import MOST_BYTES, OnnxNetwork
from shapepose_fg.detection2d.top_down import BoxForm, BoxNetwork, KeypointForm, TopDownNetwork
from shapepose_fg.io.skeleton_file import find_skeleton
from shapepose_fg.io.validation import validated

BASES = (
    "https://download.openmmlab.com/mmpose/v1/projects/rtmposev1/onnx_sdk",
    "https://huggingface.co/Tau-J/RTMPose/resolve/main/rtmposev1/onnx_sdk",
)
"""Addresses of the folders that hold the named networks, as rtmlib publishes them: OpenMMLab's, its mirror."""

_TIMEOUT_S = 30.0
_INSIDE = "end2end.onnx"
"""What the network is called in its archive."""
_BROKEN = (zipfile.BadZipFile, zlib.error, NotImplementedError)


@dataclass(frozen=True)
class NamedNetwork:
    """A network that can be asked for by name."""

    file: str
    """The archive that holds it, at each of `BASES`."""
    size: tuple[int, int]
    """(width, height) of its input."""
    boxes: str | None = None
    """The name of the network that finds people for it; None of one that finds people."""


@lru_cache(maxsize=1)
def named_networks() -> dict[str, NamedNetwork]:
    """All of them by name: RTMPose of HALPE-26, and the YOLOX that rtmlib gives each."""
    table = json.loads((files("shapepose_fg.detection2d") / "data" / "networks.json").read_text(encoding="utf-8"))
    return {name: NamedNetwork(**(entry | {"size": tuple(entry["size"])})) for name, entry in table.items()}


def named_file(
    name: str,
    *,
    fetch: bool = False,
    say: Callable[[str], object] = print,
    progress: Callable[[int, int], object] = lambda done, total: None,
) -> Path:
    """The file of the named network `name`, fetched first where it is not there and `fetch` says so.

    The sha256 of the ONNX file is told to `say` and pinned at first use. InputError where it is another later.
    """
    kept, pin = (user_cache("networks") / f"{name}.{ending}" for ending in ("onnx", "sha256"))
    there = kept.is_file()
    if not there and not fetch:
        raise InputError(f"{name}: it has not been fetched yet; --download {name} does so, or give a file's path")
    content = read_bytes(kept, MOST_BYTES) if there else _fetched(named_networks()[name].file, progress)
    digest = hashlib.sha256(content).hexdigest()
    if not pin.is_file():
        write_content(pin, digest)
        say(f"{name}: sha256 {digest} is pinned in {pin}")
    pinned = read_text(pin, most=SMALL).strip()
    if digest != pinned:
        raise InputError(
            f"{kept}: the sha256 of {'the file' if there else 'what came'} is {digest}, and {pinned[:64]} was"
            f" pinned at first use; if that is meant, delete the file and {pin.name} beside it"
        )
    if not there:
        write_content(kept, content)
    return kept


class _OnlyHttps(urllib.request.HTTPRedirectHandler):
    """Follows no redirection to where others may listen and change what comes."""

    def redirect_request(self, req: Any, fp: Any, code: int, msg: str, headers: Any, newurl: str) -> Any:
        if not newurl.startswith("https://"):
            raise urllib.error.URLError(f"it leads on to {newurl[:200]}, which is not https")
        return super().redirect_request(req, fp, code, msg, headers, newurl)


def _fetched(file: str, progress: Callable[[int, int], object]) -> bytes:
    """The network in an archive, from the first address that has it."""
    problems, opener = list[str](), urllib.request.build_opener(_OnlyHttps)
    for base in BASES:
        try:
            with opener.open(f"{base}/{file}", timeout=_TIMEOUT_S) as answer, tempfile.TemporaryFile() as archive:
                total, done = int(answer.headers.get("Content-Length") or 0), 0
                # No more is read than a network has: an address that never ends fills no disk.
                while done <= MOST_BYTES and (part := answer.read(1 << 16)):
                    archive.write(part)
                    done += len(part)
                    progress(done, max(total, done))
                if done < total or done > MOST_BYTES:
                    raise ValueError(f"{done} bytes came of {total}" if done < total else "it has no end")
                return _inside(archive)
        except (OSError, ValueError, EOFError, RuntimeError, http.client.HTTPException, *_BROKEN) as error:
            told = error if isinstance(error, urllib.error.HTTPError) else getattr(error, "reason", error)
            problems.append(f"{base}/{file} ({told})")
    raise InputError(
        f"the network cannot be fetched from {' or '.join(problems)}; fetch it by hand and give the path of the"
        f" {_INSIDE} in it"
    )


def _inside(archive: IO[bytes]) -> bytes:
    """The one network in an archive. Nothing is unpacked to where the archive says."""
    with zipfile.ZipFile(archive) as opened:
        found = [each for each in opened.infolist() if PurePosixPath(each.filename).name == _INSIDE]
        if len(found) != 1:
            raise ValueError(f"it holds {len(found)} files {_INSIDE}")
        with opened.open(found[0]) as stream:
            content = stream.read(MOST_BYTES + 1)
    if len(content) > MOST_BYTES:
        raise ValueError(f"its {_INSIDE} has over {MOST_BYTES} bytes")
    return content


Network = HeatMapNetwork | TopDownNetwork
"""What finds joints in upright pictures. Each says what it is shown of a picture (`view`), what it finds in that
(`detect`), how a file says it (`suffix`, `head`, `text`, `tail`), and what it depends on (`settings`)."""


def open_network(
    network: str, boxes: str | None, named_file: Callable[[str], Path], device: str = "cpu", **openpose: Any
) -> Network:
    """What `network` is: an ONNX file, a network's TOML file, or a name that `named_file` finds.

    `boxes` is an ONNX file or a name of what finds people, in place of the network's own; an ONNX file without is
    of OpenPose's kind, and `openpose` what else `HeatMapNetwork.load` takes. InputError, one sentence.
    """
    named = _named("--network", network)
    if network.endswith(".toml"):
        form = read_form(Path(network))
    elif named is None and boxes is None:
        return HeatMapNetwork.load(network, device=device, **openpose)
    elif named is None:
        form = KeypointForm(network=network)
    elif named.boxes is None:
        raise InputError(f"--network {network}: it finds people, not their joints; name it with --boxes")
    else:
        form, boxes = KeypointForm(network=str(named_file(network)), size=named.size), boxes or named.boxes
    for name in (name for name, value in openpose.items() if value is not None):
        raise InputError(f"--{name.replace('_', '-')} is for networks of OpenPose's kind; leave it out")
    people = form.boxes
    if boxes is not None:
        named = _named("--boxes", boxes)
        people = BoxForm(network=str(named_file(boxes)), size=named.size) if named else BoxForm(network=boxes)
    opened = None
    if people is not None:
        opened = OnnxNetwork.open(people.network, device=device)
        opened = BoxNetwork(opened, people.model_copy(update={"size": opened.size or people.size}))
        opened.find(np.zeros((64, 64, 3), dtype=np.uint8))
    keypoints = OnnxNetwork.open(form.network, device=device)
    for name, there in (form.input, keypoints.inputs), *((each, keypoints.outputs) for each in form.outputs or ()):
        if name is not None and name not in there:
            raise InputError(f"{network}: the network has no {name!r}, but {' '.join(there)}; name that instead")
    form = form.model_copy(update={"size": keypoints.size or form.size})
    return TopDownNetwork.of(keypoints, form, find_skeleton(form.skeleton), opened)


def _named(option: str, name: str) -> NamedNetwork | None:
    """The network of a name; None where it is a file, InputError where it is neither."""
    named = named_networks()
    if Path(name).is_file():
        return None
    if name not in named:
        names = " ".join(named)
        raise InputError(f"{option} {name}: there is no such file, and no network of this name; names are {names}")
    return named[name]


def read_form(path: Path) -> KeypointForm:
    """What a network's TOML file says, with paths that are found from its folder.

    InputError, one sentence that names the file, the key and the cure.
    """
    form = validated(KeypointForm, read_toml(path), path, "docs/detection.md describes the file")
    found = {"network": _beside(path, "network", form.network)}
    if form.skeleton is not None and form.skeleton not in SKELETONS:
        found["skeleton"] = _beside(path, "skeleton", form.skeleton)
    boxes = form.boxes
    if boxes is not None:
        boxes = boxes.model_copy(update={"network": _beside(path, "boxes.network", boxes.network)})
    return form.model_copy(update={**found, "boxes": boxes})


def _beside(path: Path, key: str, name: str) -> str:
    """A file in the folder of the TOML file, or below it."""
    try:
        found = path.parent / name
        if name and found.resolve().is_relative_to(path.parent.resolve()):
            return str(found)
    except (OSError, RuntimeError, ValueError):  # links in a circle, a zero byte
        pass
    raise InputError(f"{path}: {key} {name[:80]!r} must be a file in the same folder; put it there and name it")
