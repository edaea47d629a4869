"""Trained weights of the learned fitter, and the body model that they are for."""

import hashlib
import json
import os
from dataclasses import asdict, dataclass, field, replace
from functools import cache
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from safetensors import SafetensorError, safe_open
from safetensors.numpy import save

from shapepose_fg.body.fitting.network import NetworkConfig, UpdateNetwork
from shapepose_fg.body.fitting.person_frame import PersonFrame
from shapepose_fg.body.model.body_model import BodyModel
from shapepose_fg.body.model.smpl_file import DATA
from shapepose_fg.body.model.target_skeletons import BODY_POINTS, slots
from shapepose_fg.core.arrays import Array
from shapepose_fg.core.errors import InputError
from shapepose_fg.core.storage.files import open_regular, user_cache, write_content

_DEFAULT = DATA / "fitter.safetensors"
_FORMAT = "shapepose-fg fitter 1"
_KINDS = ("F32", "F64")
"""Supported number types, by their safetensors names."""
_CURE = "train or fetch it again"
_FRAME, _SPREAD = "frame.", "spread"


@dataclass(frozen=True, eq=False)
class FitterWeights:
    """A trained update network, and the person's coordinate frame in which it works."""

    network: UpdateNetwork
    """The trained network."""
    frame: PersonFrame
    """Coordinate frame of a person, with the mean body in its mean pose, from which the network
    starts."""
    body: str
    """Fingerprint of the body model used in training (see `fingerprint`)."""
    spread: Array = field(default_factory=lambda: np.ones(len(BODY_POINTS)))
    """(K,) calibrated factors on the variance of each of `BODY_POINTS` without its own target."""
    card: dict[str, str] = field(default_factory=dict)
    """Training data, command, and errors."""
    file: Path | None = None
    """File that they were read from; None for those of the package and new ones."""

    def __post_init__(self) -> None:
        if self.spread.shape != (len(BODY_POINTS),):
            raise ValueError(f"spread must be ({len(BODY_POINTS)},), got {self.spread.shape}")

    @staticmethod
    @cache
    def default() -> "FitterWeights":
        """The weights of the package (read once)."""
        return replace(FitterWeights.load(_DEFAULT), file=None)

    @staticmethod
    def of(model: BodyModel) -> "FitterWeights":
        """The weights that `shapepose-fg train-fitter` stored for this body; if there are none,
        those of the package.
        """
        shipped = FitterWeights.default()
        if fingerprint(model) == shipped.body:
            return shipped
        kept = adapted_file(model)
        # `Path.is_file` raises if the user's cache is not accessible.
        return FitterWeights.load(kept) if os.path.isfile(kept) else shipped  # noqa: PTH113

    def spread_of(self, names: tuple[str, ...]) -> Array:
        """(J,) factors `spread` for the named keypoints."""
        return np.asarray(self.spread[list(slots(names))], dtype=np.float64)

    @classmethod
    def load(cls, path: Path) -> "FitterWeights":
        """Read a safetensors file; raises InputError naming the file if it is invalid."""
        about, tensors = _read_tensors(path)
        if about.get("format") != _FORMAT:
            raise InputError(
                f"{path}: these are not weights of the learned fitter; train some with "
                "shapepose-fg train-fitter"
            )
        if not all(np.isfinite(tensor).all() for tensor in tensors.values()):
            raise InputError(
                f"{path}: the weights have values that are not finite; train or fetch them again"
            )
        try:
            spread = tensors.pop(_SPREAD)
            learnt = {name: value for name, value in tensors.items() if not name.startswith(_FRAME)}
            network = UpdateNetwork(NetworkConfig(**json.loads(about["network"])), learnt)
            placed = {k: v.astype(np.float64) for k, v in tensors.items() if k.startswith(_FRAME)}
            frame = PersonFrame(**{k.removeprefix(_FRAME): v for k, v in placed.items()})
            return cls(
                network,
                frame,
                about["body"],
                spread.astype(np.float64),
                json.loads(about["card"]),
                path,
            )
        except (KeyError, TypeError, ValueError, RuntimeError) as error:
            why = (
                "the weights are of another version of the fitter "
                f"({str(error).splitlines()[0]}); train them again"
            )
            raise InputError(f"{path}: {why}") from error

    def save(self, path: Path) -> None:
        """Write a safetensors file."""
        tensors = {**self.network.weights, _SPREAD: self.spread}
        tensors |= {_FRAME + name: value for name, value in vars(self.frame).items()}
        tensors = {
            name: np.ascontiguousarray(value, dtype=np.float32) for name, value in tensors.items()
        }
        about = {
            "format": _FORMAT,
            "network": json.dumps(asdict(self.network.config)),
            "body": self.body,
            "card": json.dumps(self.card),
        }
        write_content(path, save(tensors, metadata=about))

    def check(self, model: BodyModel) -> None:
        """Raise InputError if `model` is not the body used in training: betas would have another
        meaning.
        """
        if fingerprint(model) != self.body:
            raise InputError(
                "these weights were trained on another body model: train weights for yours with "
                "shapepose-fg train-fitter --body, or use the plain fitter"
            )


def _read_tensors(path: Path) -> tuple[dict[str, str], dict[str, NDArray[np.floating]]]:
    """Metadata and tensors of a safetensors file; raises InputError if it is not readable."""
    try:
        with open_regular(path, _CURE), safe_open(path, framework="np") as file:
            names = list(file.keys())
            for name in names:
                kind = file.get_slice(name).get_dtype()
                if kind not in _KINDS:
                    raise InputError(
                        f"{path}: {name} holds {kind}, not numbers of {' '.join(_KINDS)}; {_CURE}"
                    )
            return file.metadata() or {}, {name: file.get_tensor(name) for name in names}
    except (OSError, SafetensorError) as error:
        raise InputError(f"{path}: cannot be read as safetensors ({error}); {_CURE}") from error


def fingerprint(model: BodyModel) -> str:
    """Identifies a body model: SHA-256 of template, shapes and joint regressor, rounded
    to float32.
    """
    return model.arrays.fingerprint


def adapted_file(model: BodyModel) -> Path:
    """File in which `shapepose-fg train-fitter` stores weights for this body, specific to the
    package's weights.
    """
    digest = hashlib.sha256(fingerprint(model).encode() + _DEFAULT.read_bytes())
    for array in (model.arrays.weights, model.arrays.keypoint_regressor):
        digest.update(np.ascontiguousarray(array, dtype=np.float32).tobytes())
    return user_cache("fitters") / f"{digest.hexdigest()[:32]}.safetensors"
