"""The trained weights of the learned fitter: what is in the file, and which body they are for."""

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
from shapepose_fg.body.model.target_skeletons import BODY_POINTS, slots
from shapepose_fg.core.arrays import Array
from shapepose_fg.core.errors import InputError
from shapepose_fg.core.storage.files import open_regular, user_cache, write_content

_DEFAULT = Path(__file__).parents[1] / "data" / "fitter.safetensors"
_FORMAT = "shapepose-fg fitter 1"
_KINDS = ("F32", "F64")
"""Number types that are read, by their safetensors names."""
_CURE = "train or fetch it again"
_FRAME, _SPREAD = "frame.", "spread"


@dataclass(frozen=True, eq=False)
class FitterWeights:
    """A trained update network and the frame in which it works."""

    network: UpdateNetwork
    """What it has learnt."""
    frame: PersonFrame
    """Mean body and mean pose from which it starts."""
    body: str
    """Fingerprint of the body model it was trained on (see `fingerprint`)."""
    spread: Array = field(default_factory=lambda: np.ones(len(BODY_POINTS)))
    """(K,) by which the variance of each of `BODY_POINTS` without its own target is multiplied: calibrated."""
    card: dict[str, str] = field(default_factory=dict)
    """What it was trained on, by which command, and its errors."""
    file: Path | None = None
    """What they were read from; None where they ship with the package, or are new."""

    def __post_init__(self) -> None:
        if self.spread.shape != (len(BODY_POINTS),):
            raise ValueError(f"spread must be ({len(BODY_POINTS)},), got {self.spread.shape}")

    @staticmethod
    @cache
    def default() -> "FitterWeights":
        """The weights that ship with the package (read once)."""
        return replace(FitterWeights.load(_DEFAULT), file=None)

    @staticmethod
    def of(model: BodyModel) -> "FitterWeights":
        """Those that `shapepose-fg train-fitter` keeps for this body; where it has not run, the shipped ones."""
        shipped = FitterWeights.default()
        kept = adapted_file(model)
        # The user's cache may be closed to us: then `Path.is_file` raises.
        own = fingerprint(model) != shipped.body and os.path.isfile(kept)  # noqa: PTH113
        return FitterWeights.load(kept) if own else shipped

    def spread_of(self, names: tuple[str, ...]) -> Array:
        """(J,) `spread` of the keypoints with these names."""
        return np.asarray(self.spread[list(slots(names))], dtype=np.float64)

    @classmethod
    def load(cls, path: Path) -> "FitterWeights":
        """Read a safetensors file; InputError naming it where it cannot be used."""
        about, tensors = _read_tensors(path)
        if about.get("format") != _FORMAT:
            raise InputError(
                f"{path}: these are not weights of the learned fitter; train some with shapepose-fg train-fitter"
            )
        if not all(np.isfinite(tensor).all() for tensor in tensors.values()):
            raise InputError(f"{path}: the weights have values that are not finite; train or fetch them again")
        try:
            spread = tensors.pop(_SPREAD)
            learnt = {name: value for name, value in tensors.items() if not name.startswith(_FRAME)}
            network = UpdateNetwork(NetworkConfig(**json.loads(about["network"])), learnt)
            placed = {k: v.astype(np.float64) for k, v in tensors.items() if k.startswith(_FRAME)}
            frame = PersonFrame(**{k.removeprefix(_FRAME): v for k, v in placed.items()})
            return cls(network, frame, about["body"], spread.astype(np.float64), json.loads(about["card"]), path)
        except (KeyError, TypeError, ValueError, RuntimeError) as error:
            why = (
                f"the weights are of another version of the fitter ({str(error).splitlines()[0]}); train"
                " them again"
            )
            raise InputError(f"{path}: {why}") from error

    def save(self, path: Path) -> None:
        """Write a safetensors file."""
        tensors = {**self.network.weights, _SPREAD: self.spread}
        tensors |= {_FRAME + name: value for name, value in vars(self.frame).items()}
        tensors = {name: np.ascontiguousarray(value, dtype=np.float32) for name, value in tensors.items()}
        about = {
            "format": _FORMAT,
            "network": json.dumps(asdict(self.network.config)),
            "body": self.body,
            "card": json.dumps(self.card),
        }
        write_content(path, save(tensors, metadata=about))

    def check(self, model: BodyModel) -> None:
        """InputError where `model` is not the body they were trained on: betas would mean other shapes."""
        if fingerprint(model) != self.body:
            raise InputError(
                "these weights were trained on another body model: train weights for yours with shapepose-fg"
                " train-fitter --body, or use the plain fitter"
            )


def _read_tensors(path: Path) -> tuple[dict[str, str], dict[str, NDArray[np.floating]]]:
    """Texts and tensors of a safetensors file; InputError where it cannot be read."""
    try:
        with open_regular(path, _CURE), safe_open(path, framework="np") as file:
            names = list(file.keys())
            for name in names:
                kind = file.get_slice(name).get_dtype()
                if kind not in _KINDS:
                    raise InputError(f"{path}: {name} holds {kind}, not numbers of {' '.join(_KINDS)}; {_CURE}")
            return file.metadata() or {}, {name: file.get_tensor(name) for name in names}
    except (OSError, SafetensorError) as error:
        raise InputError(f"{path}: cannot be read as safetensors ({error}); {_CURE}") from error


def fingerprint(model: BodyModel) -> str:
    """What tells body models apart: SHA-256 of template, shapes and joint regressor, rounded to float32."""
    digest = hashlib.sha256()
    for array in (model.arrays.template, model.arrays.shapes, model.arrays.joint_regressor):
        digest.update(np.ascontiguousarray(array, dtype=np.float32).tobytes())
    return digest.hexdigest()


def adapted_file(model: BodyModel) -> Path:
    """Where `shapepose-fg train-fitter` keeps weights for this body, begun as those that ship now."""
    digest = hashlib.sha256(fingerprint(model).encode() + _DEFAULT.read_bytes())
    for array in (model.arrays.weights, model.arrays.keypoint_regressor):
        digest.update(np.ascontiguousarray(array, dtype=np.float32).tobytes())
    return user_cache("fitters") / f"{digest.hexdigest()[:32]}.safetensors"
