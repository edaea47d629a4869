"""Which pictures detections were made from: footage.json beside them, for who draws on the pictures."""

import json
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel, ConfigDict, Field

from shapepose_fg.core.errors import InputError
from shapepose_fg.core.storage.files import read_json, write_content
from shapepose_fg.io.footage.placement import Placement, PlacementKind
from shapepose_fg.io.validation import validated

FOOTAGE = "footage.json"
"""The file, beside the detections."""
_FORMAT, _CURE = "shapepose-fg footage 1", "run shapepose-fg detect again"


@dataclass(frozen=True)
class CameraFootage:
    """The pictures of one camera."""

    name: str
    """The camera."""
    path: Path
    """The video, picture, or folder of pictures."""
    placement: Placement
    """Where calibrated pixels lie in the pictures."""
    places: NDArray[np.intp]
    """(T,) the picture of each frame, counted from 0 in the file; -1 where there is none."""


def write_used_footage(file: Path, cameras: Sequence[CameraFootage], about: dict[str, Any]) -> None:
    """Write `file`; `about` is kept with it."""
    entries = [
        {
            "name": each.name,
            "path": str(each.path),
            "placement": str(each.placement.kind),
            "picture_size": list(each.placement.picture_size),
            "calibrated_size": list(each.placement.calibrated_size),
            "pictures": each.places.tolist(),
        }
        for each in cameras
    ]
    content = {"format": _FORMAT, **about, "cameras": entries}
    write_content(file, json.dumps(content, indent=1, allow_nan=False))


class _Camera(BaseModel):
    model_config = ConfigDict(extra="forbid")

    name: str
    path: str
    placement: PlacementKind
    picture_size: tuple[int, int]
    calibrated_size: tuple[int, int]
    pictures: list[int] = Field(max_length=10_000_000)


class _File(BaseModel):
    format: str
    cameras: list[_Camera]


def read_used_footage(file: Path) -> list[CameraFootage]:
    """Read what `write_used_footage` wrote; InputError, one sentence, on anything else."""
    parsed = validated(_File, read_json(file), file, _CURE)
    if parsed.format != _FORMAT:
        raise InputError(f"{file}: format must be {_FORMAT!r}, got {parsed.format[:40]!r}; {_CURE}")
    found = []
    for camera in parsed.cameras:
        sizes = camera.picture_size, camera.calibrated_size
        if min(*sizes[0], *sizes[1]) < 1:
            raise InputError(f"{file}: camera {camera.name}: sizes must be positive; {_CURE}")
        placement = Placement.of(camera.placement, *sizes)
        places = np.array(camera.pictures, dtype=np.intp)
        found.append(CameraFootage(camera.name, Path(camera.path), placement, places))
    return found
