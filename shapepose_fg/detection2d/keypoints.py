"""A network that finds the joints of one person: what it is shown, and how its output is read."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from shapepose_fg.core.arrays import Array, Index
from shapepose_fg.core.errors import InputError
from shapepose_fg.core.skeleton import SKELETONS, Skeleton
from shapepose_fg.detection2d.decoding import between_cells
from shapepose_fg.detection2d.network_file import NetworkFile
from shapepose_fg.detection2d.onnx_network import Blob, OnnxNetwork, words

_AXES = {"simcc": (3, 3), "heat map": (4,), "coordinates": (3, 4)}
"""How many axes the outputs of each decoding have; people of a whole picture may add one to coordinates."""
_USUAL = (192, 256)
"""RTMPose's input."""


@dataclass(frozen=True)
class KeypointNetwork:
    """A network that finds the joints of the person in a picture."""

    network: OnnxNetwork
    """What is run."""
    form: NetworkFile
    """How it is to be read."""
    skeleton: Skeleton
    """Whose joints it finds."""
    place: Index
    """(N,) which of the skeleton's keypoints each joint of the network is, -1 for none."""

    @classmethod
    def of(cls, network: OnnxNetwork, form: NetworkFile, skeleton: Skeleton | None) -> "KeypointNetwork":
        """Tried on an empty picture: InputError where the network does not fit its description."""
        count = _decoded(network, form, np.zeros((1, 3, *_size(network, form)[::-1]), dtype=np.float32))[1].shape[
            1
        ]
        if skeleton is None:
            count = count if form.joints is None else len(form.joints)
            skeleton = next((each for each in SKELETONS.values() if each.keypoint_count == count), None)
        if skeleton is None:
            raise InputError(
                f"{network.file}: no skeleton known here has {count} joints; name one in a network's TOML file"
            )
        keypoints = np.arange(len(skeleton)) if skeleton.keypoints is None else np.array(skeleton.keypoints)
        if form.joints is None:
            place = np.where(keypoints >= 0, np.arange(len(keypoints)), -1)
        else:
            given = {skeleton.joints[joint]: n for n, joint in enumerate(keypoints.tolist()) if joint >= 0}
            wrong = [name for name in form.joints if name and (name not in given or form.joints.count(name) > 1)]
            if wrong:
                raise InputError(
                    f"{network.file}: joints has {wrong[0]!r}, which must be a keypoint of {skeleton.name}, once"
                    f' ({" ".join(given)}), or ""'
                )
            place = np.array([given.get(name, -1) for name in form.joints], dtype=np.intp)
        if len(place) != count:
            raise InputError(
                f"{network.file}: the network finds {count} joints, {skeleton.name} has {len(place)}; name another"
                " skeleton, or its joints, in a network's TOML file"
            )
        return cls(network, form, skeleton, place)

    @property
    def size(self) -> tuple[int, int]:
        """(width, height) of its input."""
        return _size(self.network, self.form)

    def find(self, crops: NDArray[np.uint8]) -> tuple[Array, Array]:
        """Positions (P, K, 2) in pixels of `crops` (B, H, W, 3), blue green red, and scores (P, K).

        K are the skeleton's keypoints. P is B, or a multiple where the network finds several people in each.
        What was not found, or is no number, has a score of 0.
        """
        ordered = crops if self.form.colours == "bgr" else crops[..., ::-1]
        blob = ((ordered - np.array(self.form.mean)) / np.array(self.form.std)).transpose(0, 3, 1, 2)
        xy, score = _decoded(self.network, self.form, np.ascontiguousarray(blob, dtype=np.float32))
        found = np.zeros((len(xy), self.skeleton.keypoint_count, 3))
        known = np.flatnonzero(self.place >= 0)
        found[:, self.place[known]] = np.dstack([xy, score])[:, known]
        found[~np.isfinite(found).all(axis=2)] = 0
        return found[..., :2], found[..., 2]


def _size(network: OnnxNetwork, form: NetworkFile) -> tuple[int, int]:
    return network.size or form.size or _USUAL


def _decoded(network: OnnxNetwork, form: NetworkFile, blob: Blob) -> tuple[Array, Array]:
    """Positions (P, N, 2) of the network's joints in pixels of its input, and scores (P, N)."""
    outputs, axes = network.run(blob), _AXES[form.decoding]
    for name in form.outputs or ():
        if name not in network.outputs:
            known = " ".join(network.outputs)
            raise InputError(f"{network.file}: the network has no output {name!r}; outputs are {known}")
    if form.outputs is not None:
        outputs = [outputs[network.outputs.index(name)] for name in form.outputs]
    read = [each.astype(np.float64) for each in outputs[: 2 if form.decoding == "simcc" else 1]]
    fits = all(each.ndim in axes and 0 not in each.shape for each in read)
    if form.decoding == "coordinates":
        fits = fits and read[0].shape[-1] in (2, 3)
    elif form.decoding == "simcc":
        fits = fits and len(read) == 2 and read[0].shape[:2] == read[1].shape[:2]
    if not fits or len(read[0]) != len(blob):
        shapes = " and ".join(words(each.shape) for each in outputs) or "nothing"
        raise InputError(
            f"{network.file}: the network gives {shapes}, which is no {form.decoding}; describe it in a TOML file"
            " (docs/detection.md)"
        )
    size = np.array(blob.shape[:1:-1])
    if form.decoding == "simcc":
        split = np.array([each.shape[2] for each in read]) / size
        return np.dstack([each.argmax(axis=2) for each in read]) / split, np.minimum(
            *(each.max(axis=2) for each in read)
        )
    if form.decoding == "heat map":
        return _peaks(read[0], size, form.cells == "corners")
    found = read[0].reshape(-1, *read[0].shape[-2:])
    return found[..., :2] * form.scale, found[..., 2] if found.shape[2] == 3 else np.ones(found.shape[:2])


def _peaks(maps: Array, size: Index, corners: bool) -> tuple[Array, Array]:
    """Pixels (B, N, 2) and heights (B, N) of the highest places of maps (B, N, H, W), between the cells."""
    shape = np.array(maps.shape[:1:-1])
    flat = maps.reshape(-1, *maps.shape[2:])
    row, column = np.divmod(flat.reshape(len(flat), -1).argmax(axis=1), shape[0])
    padded = np.pad(flat, ((0, 0), (1, 1), (1, 1)), constant_values=-np.inf)
    cell, height = between_cells(padded, np.arange(len(flat)), row + 1, column + 1)
    cell -= 1
    pixel = cell * (size - 1) / np.maximum(shape - 1, 1) if corners else (cell + 0.5) * size / shape - 0.5
    return pixel.reshape(*maps.shape[:2], 2), height.reshape(maps.shape[:2])
