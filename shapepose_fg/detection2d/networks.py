"""Which channel of a network's output is what, and which networks are known by name or checksum."""

import json
from dataclasses import dataclass
from functools import lru_cache
from importlib.resources import files
from typing import Any

from shapepose_fg.core.errors import InputError
from shapepose_fg.io.detections.association_text import TEXT_SKELETONS, TextSkeleton

STRIDE = 8
"""Pixels of the input per cell of the output, along each axis."""
MULTIPLE = 16
"""Both sides of the input are multiples of this."""


@dataclass(frozen=True)
class NetworkLayout:
    """What a network of OpenPose's kind takes and gives.

    In one array: the heat maps of the skeleton's joints, one of the background, and two maps (x, y) of part
    affinities for each limb.
    """

    name: str
    """What it is called."""
    about: str
    """Which networks have it, in a sentence."""
    skeleton: str
    """The skeleton whose joints and limbs these are, a name of `TEXT_SKELETONS`."""
    scale: float
    """The input is `scale` * colour + `offset`, with colours (blue, green, red) from 0 to 255."""
    offset: float
    """See `scale`."""
    files: str = ""
    """Checksums of known networks that have it."""

    @property
    def text(self) -> TextSkeleton:
        """The joints and limbs, in order."""
        return TEXT_SKELETONS[self.skeleton]

    @property
    def first_affinity(self) -> int:
        """Channel of the x of limb 0."""
        return len(self.text.joints) + 1

    @property
    def channels(self) -> int:
        """How many channels the output has."""
        return self.first_affinity + 2 * len(self.text.limbs)


@dataclass(frozen=True)
class NamedNetwork:
    """A network that can be asked for by name."""

    file: str
    """The archive that holds it, at each of `bases()`."""
    size: tuple[int, int]
    """(width, height) of its input."""
    boxes: str | None = None
    """The name of the network that finds people for it; None of one that finds people."""


@lru_cache(maxsize=1)
def _table() -> dict[str, Any]:
    return json.loads((files("shapepose_fg.detection2d") / "data" / "networks.json").read_text(encoding="utf-8"))


@lru_cache(maxsize=1)
def layouts() -> dict[str, NetworkLayout]:
    """All layouts by name."""
    return {name: NetworkLayout(name, **entry) for name, entry in _table()["layouts"].items()}


def named_networks() -> dict[str, NamedNetwork]:
    """All named networks: RTMPose of HALPE-26, and the YOLOX that rtmlib gives each."""
    named = _table()["named"].items()
    return {name: NamedNetwork(**(entry | {"size": tuple(entry["size"])})) for name, entry in named}


def bases() -> tuple[str, ...]:
    """Addresses of the folders that hold the named networks, as rtmlib publishes them: OpenMMLab's, its mirror."""
    return tuple(_table()["bases"])


def find_layout(wanted: str | None, sha256: str, channels: int | None, place: object) -> NetworkLayout:
    """The layout of a network: the one that is `wanted`, or that of a known file, or the only one that fits.

    `channels` is the number of channels of the output, None where the file does not say. InputError, naming the
    file `place`, where nothing tells.
    """
    every = layouts()
    listing = "; ".join(f"{each.name} ({each.about})" for each in every.values())
    if wanted is not None:
        if wanted not in every:
            raise InputError(f"--layout {wanted}: not known; known are {listing}")
        return every[wanted]
    fitting = [each for each in every.values() if each.channels == channels]
    for found in ([each for each in every.values() if sha256 in each.files], fitting):
        if len(found) == 1:
            return found[0]
    gives = "gives no fixed number of channels" if channels is None else f"gives {channels} channels"
    choice = " or ".join(each.name for each in fitting) or "another network"
    raise InputError(
        f"{place}: the network {gives}, which does not say how its output is to be read; give --layout {choice}"
        f" (known are {listing})"
    )
