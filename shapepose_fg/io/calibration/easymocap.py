"""EasyMocap's intri.yml and extri.yml, written by OpenCV's FileStorage: metres, z up, camera from world."""

from pathlib import Path
from typing import Any

import numpy as np

from shapepose_fg.core.errors import InputError
from shapepose_fg.core.storage.files import MIDDLE, read_text
from shapepose_fg.io.calibration.content import Content
from shapepose_fg.io.calibration.filestorage import load_storage
from shapepose_fg.io.calibration.written import Format, WrittenCamera, WrittenRig, picture_size, pose


def recognise(content: Content) -> bool:
    """Whether this is one of the two files, or the folder of both."""
    if content.syntax == "folder":
        return any(_is_part(path.name) for path in content.value)
    if content.syntax != "OpenCV" or not _is_part(content.path.name):
        return False
    return isinstance(content.value.get("names"), list)


def read(content: Content) -> WrittenRig:
    """The cameras in the order of the names in the intrinsics."""
    intri, extri = _both(content)
    inner, outer = (load_storage(path, read_text(path, most=MIDDLE)) for path in (intri, extri))
    names = inner.get("names")
    if not isinstance(names, list) or not all(isinstance(name, str | int) for name in names):
        raise InputError(f"{intri}: names must be a list of the cameras' names; write it with EasyMocap again")
    cameras = [_camera(str(name), number, inner, outer, intri, extri) for number, name in enumerate(names, 1)]
    return WrittenRig(cameras, "m", "z")


def _is_part(name: str) -> bool:
    return name.endswith((".yml", ".yaml")) and ("intri" in name or "extri" in name)


def _both(content: Content) -> tuple[Path, Path]:
    """The file with the intrinsics and the one with the extrinsics."""
    if content.syntax == "folder":
        one = next(path for path in content.value if _is_part(path.name))
    else:
        one = content.path
    intri, extri = (
        one.with_name(one.name.replace(other, wanted))
        for wanted, other in (("intri", "extri"), ("extri", "intri"))
    )
    for path in (intri, extri):
        if not path.is_file():
            raise InputError(
                f"{path}: this half of EasyMocap's calibration is missing; put both files into one folder"
            )
    return intri, extri


def _camera(
    name: str, number: int, inner: dict[str, Any], outer: dict[str, Any], intri: Path, extri: Path
) -> WrittenCamera:
    # EasyMocap writes K_<name>; Pose2Sim's writer numbers them from 1.
    tags = (name, str(number))
    K = _matrix(inner, "K", tags, 9, intri).reshape(3, 3)
    distortion = _matrix(inner, "dist", tags, None, intri)
    rotation = "Rot" if any(f"Rot_{tag}" in outer for tag in tags) else "R"
    R = _matrix(outer, rotation, tags, 9 if rotation == "Rot" else 3, extri)
    wTc = pose(R, _matrix(outer, "T", tags, 3, extri), f"{rotation}_{name}", str(extri))
    width, height = (inner.get(f"{letter}_{name}") for letter in "WH")
    size = picture_size(width, height, f'{intri}: camera "{name}"')
    return WrittenCamera(name, K, wTc, size, distortion.tolist())


def _matrix(nodes: dict[str, Any], key: str, tags: tuple[str, ...], count: int | None, path: Path) -> np.ndarray:
    """The numbers of the matrix `key`_<tag>, flat."""
    value = next((nodes[f"{key}_{tag}"] for tag in tags if f"{key}_{tag}" in nodes), None)
    if not isinstance(value, np.ndarray) or (count is not None and value.size != count):
        got = f"got {value.size}" if isinstance(value, np.ndarray) else "it is missing"
        wanted = "a matrix" if count is None else f"a matrix of {count} numbers"
        raise InputError(f"{path}: {key}_{tags[0]} must be {wanted}, {got}; write it with EasyMocap again")
    if not np.isfinite(value).all():
        raise InputError(
            f"{path}: {key}_{tags[0]} holds a number that is not finite; write it with EasyMocap again"
        )
    return value.ravel()


EASYMOCAP = Format("EasyMocap's intri.yml and extri.yml", recognise, read)
