"""A network by its name, its ONNX file or its description, ready to detect."""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from shapepose_fg.core.errors import InputError
from shapepose_fg.core.skeleton import Skeleton
from shapepose_fg.detection2d.boxes import BoxNetwork
from shapepose_fg.detection2d.heat_maps import LONG_SIDE, HeatMapNetwork
from shapepose_fg.detection2d.keypoints import KeypointNetwork
from shapepose_fg.detection2d.network_file import BoxFile, NetworkFile, read_network_file
from shapepose_fg.detection2d.networks import NamedNetwork, named_networks
from shapepose_fg.detection2d.onnx_network import Backend, OnnxNetwork
from shapepose_fg.detection2d.top_down import TopDownNetwork


@dataclass(frozen=True)
class Running:
    """How a network is run; None is what fits it."""

    layout: str | None = None
    """Of a network of OpenPose's kind: the name of its layout."""
    long_side: int | None = None
    """Of the same: the longer side of its input, pixels."""
    backend: Backend | None = None
    """What runs it: OpenCV networks of OpenPose's kind on the CPU, onnxruntime everything else."""
    device: str = "cpu"
    """One of `PROVIDERS`."""


def open_network(
    network: str, boxes: str | None, running: Running, named_file: Callable[[str], Path]
) -> HeatMapNetwork | TopDownNetwork:
    """What `network` is: an ONNX file, a network's TOML file, or a name that `named_file` finds.

    `boxes` is the same of what finds people, in place of the network's own; an ONNX file without is of OpenPose's
    kind. InputError, one sentence.
    """
    form, skeleton = _described(network, named_file)
    if boxes is not None:
        form = (form or NetworkFile(network=network)).model_copy(update={"boxes": _found(boxes, named_file)})
    if form is None:
        backend = running.backend or ("opencv" if running.device == "cpu" else "onnxruntime")
        side = running.long_side or LONG_SIDE
        return HeatMapNetwork.load(network, running.layout, backend, running.device, side)
    for name in ("layout", "long_side"):
        if getattr(running, name) is not None:
            raise InputError(f"--{name.replace('_', '-')} is for networks of OpenPose's kind; leave it out")
    if running.backend == "opencv":
        raise InputError("--backend opencv is for networks of OpenPose's kind; leave it out")
    found = form.boxes and BoxNetwork(OnnxNetwork.open(form.boxes.network, device=running.device), form.boxes)
    opened = OnnxNetwork.open(form.network, device=running.device)
    return TopDownNetwork(KeypointNetwork.of(opened, form, skeleton), found)


def _described(network: str, named_file: Callable[[str], Path]) -> tuple[NetworkFile | None, Skeleton | None]:
    """The description of a network of single people, and its skeleton; None where none is known."""
    if network.endswith(".toml"):
        return read_network_file(Path(network))
    if Path(network).is_file():
        return None, None
    named = _named("--network", network)
    if named.boxes is None:
        raise InputError(f"--network {network}: it finds boxes, no joints; name it with --boxes")
    boxes = _found(named.boxes, named_file)
    return NetworkFile(network=str(named_file(network)), size=named.size, boxes=boxes), None


def _found(boxes: str, named_file: Callable[[str], Path]) -> BoxFile:
    """A box network by its file or its name."""
    if Path(boxes).is_file():
        return BoxFile(network=boxes)
    named = _named("--boxes", boxes)
    return BoxFile(network=str(named_file(boxes)), size=named.size)


def _named(option: str, name: str) -> NamedNetwork:
    """The network of a name; InputError where there is none."""
    named = named_networks()
    if name not in named:
        raise InputError(
            f"{option} {name}: there is no such file, and no network of this name; the names are {' '.join(named)}"
        )
    return named[name]
