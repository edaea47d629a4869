"""A network by its name, its ONNX file or its description, ready to detect."""

from collections.abc import Callable
from pathlib import Path
from typing import Any

from shapepose_fg.core.errors import InputError
from shapepose_fg.detection2d.boxes import BoxNetwork
from shapepose_fg.detection2d.detector import Network
from shapepose_fg.detection2d.heat_maps import HeatMapNetwork
from shapepose_fg.detection2d.keypoints import KeypointNetwork
from shapepose_fg.detection2d.network_file import BoxFile, NetworkFile, read_network_file
from shapepose_fg.detection2d.networks import NamedNetwork, named_networks
from shapepose_fg.detection2d.onnx_network import OnnxNetwork
from shapepose_fg.detection2d.top_down import TopDownNetwork


def open_network(
    network: str, boxes: str | None, named_file: Callable[[str], Path], device: str = "cpu", **openpose: Any
) -> Network:
    """What `network` is: an ONNX file, a network's TOML file, or a name that `named_file` finds.

    `boxes` is an ONNX file or a name of what finds people, in place of the network's own; an ONNX file without is
    of OpenPose's kind, and `openpose` what else `HeatMapNetwork.load` takes. InputError, one sentence.
    """
    skeleton, named = None, _named("--network", network)
    if network.endswith(".toml"):
        form, skeleton = read_network_file(Path(network))
    elif named is None and boxes is None:
        return HeatMapNetwork.load(network, device=device, **openpose)
    elif named is None:
        form = NetworkFile(network=network)
    else:
        form, boxes = NetworkFile(network=str(named_file(network)), size=named.size), boxes or named.boxes
        if boxes is None:
            raise InputError(f"--network {network}: it finds people, not their joints; name it with --boxes")
    for name in (name for name, value in openpose.items() if value is not None):
        raise InputError(f"--{name.replace('_', '-')} is for networks of OpenPose's kind; leave it out")
    people = form.boxes
    if boxes is not None:
        named = _named("--boxes", boxes)
        people = BoxFile(network=str(named_file(boxes)), size=named.size) if named else BoxFile(network=boxes)
    opened = people and BoxNetwork(OnnxNetwork.open(people.network, device=device), people)
    keypoints = OnnxNetwork.open(form.network, device=device)
    return TopDownNetwork(KeypointNetwork.of(keypoints, form, skeleton), opened)


def _named(option: str, name: str) -> NamedNetwork | None:
    """The network of a name; None where it is a file, InputError where it is neither."""
    named = named_networks()
    if Path(name).is_file():
        return None
    if name not in named:
        names = " ".join(named)
        raise InputError(f"{option} {name}: there is no such file, and no network of this name; names are {names}")
    return named[name]
