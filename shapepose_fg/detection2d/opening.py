"""Opens a network by its name, its ONNX file or its TOML file."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from shapepose_fg.core.errors import InputError
from shapepose_fg.core.skeleton import SKELETONS
from shapepose_fg.core.storage.files import is_inside, read_toml
from shapepose_fg.core.validation import validated
from shapepose_fg.detection2d.boxes import BoxForm, BoxNetwork
from shapepose_fg.detection2d.download import NamedNetwork, named_networks
from shapepose_fg.detection2d.heat_maps import HeatMapNetwork
from shapepose_fg.detection2d.onnx_network import OnnxNetwork, runtime_for
from shapepose_fg.detection2d.top_down import KeypointForm, TopDownNetwork
from shapepose_fg.io.skeleton_file import find_skeleton

Network = HeatMapNetwork | TopDownNetwork
"""A network that finds joints in upright pictures. Each has its input (`view`), detections
(`detect`), their file format (`suffix`, `head`, `text`, `tail`), and all settings that affect them
(`settings`)."""


def open_network(
    network: str,
    boxes: str | None,
    named_file: Callable[[str], Path],
    device: str = "cpu",
    **openpose: Any,
) -> Network:
    """Open the network of an ONNX file, of a network's TOML file, or of a name that `named_file`
    resolves to a file.

    `boxes` is an ONNX file or a name of a network that detects people, and replaces the network's
    own. An ONNX file without `boxes` is OpenPose-like; `openpose` are further arguments of
    `HeatMapNetwork.load`. InputError, one sentence, if it cannot be opened.
    """
    named, described = _named("--network", network), network.endswith(".toml")
    if not described and named is None and boxes is None:
        return HeatMapNetwork.load(network, device=device, **openpose)
    for name in (name for name, value in openpose.items() if value is not None):
        raise InputError(
            f"--{name.replace('_', '-')} is for networks such as OpenPose; leave it out"
        )
    runtime_for(device)  # fails before anything is downloaded
    if described:
        form = read_form(Path(network))
    elif named is None:
        form = KeypointForm(network=network)
    elif named.boxes is None:
        raise InputError(
            f"--network {network}: this network detects people, not their joints; give it with "
            "--boxes"
        )
    else:
        form, boxes = (
            KeypointForm(network=str(named_file(network)), size=named.size),
            boxes or named.boxes,
        )
    people = form.boxes
    if boxes is not None:
        named = _named("--boxes", boxes)
        people = (
            BoxForm(network=str(named_file(boxes)), size=named.size)
            if named
            else BoxForm(network=boxes)
        )
    opened = None
    if people is not None:
        opened = OnnxNetwork.open(people.network, device=device)
        opened = BoxNetwork(opened, people.model_copy(update={"size": opened.size or people.size}))
        opened.find(np.zeros((64, 64, 3), dtype=np.uint8))
    keypoints = OnnxNetwork.open(form.network, device=device)
    for name, known in (
        (form.input, keypoints.inputs),
        *((each, keypoints.outputs) for each in form.outputs or ()),
    ):
        if name is not None and name not in known:
            raise InputError(
                f"{network}: the network has no {name!r}, but {' '.join(known)}; name one of these"
            )
    form = form.model_copy(update={"size": keypoints.size or form.size})
    return TopDownNetwork.of(keypoints, form, find_skeleton(form.skeleton), opened)


def _named(option: str, name: str) -> NamedNetwork | None:
    """The named network; None if `name` is a file, InputError if it is neither."""
    named = named_networks()
    if Path(name).is_file():
        return None
    if name not in named:
        names = " ".join(named)
        raise InputError(
            f"{option} {name}: there is no such file, and no network of this name; known names "
            f"are {names}"
        )
    return named[name]


def read_form(path: Path) -> KeypointForm:
    """Content of a network's TOML file, with paths relative to the folder of the file.

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
    """Path of a file in the folder of the TOML file, or below it."""
    if not (name and is_inside(path.parent, name)):
        cure = "put it there"
        raise InputError(f"{path}: {key} {name[:80]!r} must be a file in the same folder; {cure}")
    return str(path.parent / name)
