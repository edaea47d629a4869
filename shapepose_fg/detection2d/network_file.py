"""A TOML file that describes a network of single people's keypoints, and whose they are."""

from pathlib import Path
from typing import Annotated, Literal

from pydantic import BaseModel, ConfigDict, Field, FiniteFloat

from shapepose_fg.core.errors import InputError
from shapepose_fg.core.skeleton import SKELETONS, Skeleton
from shapepose_fg.core.storage.files import read_toml
from shapepose_fg.io.skeleton_file import read_skeleton
from shapepose_fg.io.validation import validated

_Side = Annotated[int, Field(ge=16, le=4096)]
_Size = tuple[_Side, _Side]
_Three = tuple[FiniteFloat, FiniteFloat, FiniteFloat]
_Above0 = Annotated[FiniteFloat, Field(gt=0)]
_Share = Annotated[FiniteFloat, Field(gt=0, lt=1)]


class BoxFile(BaseModel):
    """A box network, YOLOX."""

    model_config = ConfigDict(extra="forbid")
    network: str = ""
    """Its ONNX file."""
    size: _Size = (640, 640)
    """(width, height) of its input, where the file does not fix it."""
    min_score: _Share | None = None
    """Less sure boxes are nobody's; None for rtmlib's own."""
    max_overlap: _Share = 0.45
    """Of two boxes that share more of their union than this one goes."""


class NetworkFile(BaseModel):
    """A network of keypoints; RTMPose's kind, where nothing else is said."""

    model_config = ConfigDict(extra="forbid")
    network: str = ""
    """Its ONNX file."""
    skeleton: str | None = None
    """One of `SKELETONS`, or a skeleton's TOML file; None where the number of joints tells."""
    joints: list[str] | None = None
    """What each joint of the network is called in the skeleton, "" for none; None for its keypoints in order."""
    decoding: Literal["simcc", "heat map", "coordinates"] = "simcc"
    """What it gives: for each joint two curves, along x and along y; a map; or x, y and score."""
    outputs: list[str] | None = None
    """Names of its outputs that are read: x and y of SimCC, otherwise one; None for the first ones."""
    size: _Size | None = None
    """(width, height) of its input, where the file does not fix it."""
    colours: Literal["bgr", "rgb"] = "bgr"
    """Their order. RTMPose was trained on the other; so is it run by rtmlib, and by everybody since."""
    mean: _Three = (123.675, 116.28, 103.53)
    """Taken off colours from 0 to 255, in their order."""
    std: tuple[_Above0, _Above0, _Above0] = (58.395, 57.12, 57.375)
    """Colours are divided by this then."""
    cells: Literal["corners", "edges"] = "corners"
    """Whether the outer cells of a heat map have their centres on the input's outer pixels, or fill it."""
    scale: tuple[FiniteFloat, FiniteFloat] = (1.0, 1.0)
    """Pixels of the input per unit of coordinates, x and y."""
    padding: Annotated[FiniteFloat, Field(ge=1, le=4)] = 1.25
    """How much larger than its box the network is shown a person."""
    boxes: BoxFile | None = None
    """What finds people; None where it is shown whole pictures."""


def read_network_file(path: Path) -> tuple[NetworkFile, Skeleton | None]:
    """What a network's TOML file says, with paths that are found from its folder, and the skeleton.

    InputError, one sentence that names the file, the key and the cure.
    """
    file = validated(NetworkFile, read_toml(path), path, "docs/detection.md describes the file")
    boxes = file.boxes and file.boxes.model_copy(
        update={"network": _beside(path, "boxes.network", file.boxes.network)}
    )
    named = file.skeleton in SKELETONS or file.skeleton is None
    skeleton = file.skeleton if named else _beside(path, "skeleton", str(file.skeleton))
    network = _beside(path, "network", file.network)
    file = file.model_copy(update={"network": network, "boxes": boxes, "skeleton": skeleton})
    return file, None if skeleton is None else SKELETONS[skeleton] if named else read_skeleton(skeleton)


def _beside(path: Path, key: str, name: str) -> str:
    """A file in the folder of the TOML file, or below it."""
    try:
        found = path.parent / name
        if name and found.resolve().is_relative_to(path.parent.resolve()):
            return str(found)
    except (OSError, RuntimeError, ValueError):  # links in a circle, a zero byte
        pass
    raise InputError(f"{path}: {key} {name[:80]!r} must be a file in the same folder; put it there and name it")
