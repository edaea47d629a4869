"""Writes a calibration in the format from which it was read, or, if this format lacks something, as
this project's rig file.
"""

import json
import re
import tempfile
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import ArrayLike

from shapepose_fg.core.camera import Camera, Rig
from shapepose_fg.core.errors import InputError
from shapepose_fg.core.rig_file import write_rig
from shapepose_fg.core.storage.files import read_text, write_content
from shapepose_fg.io.calibration.colmap import COLMAP
from shapepose_fg.io.calibration.content import Content, load
from shapepose_fg.io.calibration.json_and_toml import entries, wanted_tables
from shapepose_fg.io.calibration.opencv_and_ros import OPENCV
from shapepose_fg.io.calibration.reading import FORMATS, recognised
from shapepose_fg.io.calibration.rewriting import REWRITTEN, numbers_of
from shapepose_fg.io.calibration.written import METRES, CalibrationFormat, Unit, WrittenRig

_SEVERAL = (OPENCV[0].name, COLMAP.name)
"""Formats that consist of several files."""
_YAML = (".yml", ".yaml")
_DIGITS, _DIGITS_PX = 1e-6, 1e-4
"""Tolerances when the file is read back: for metres and numbers without unit, and for pixels."""
_TABLE = re.compile(r"\s*\[\s*(?P<key>[^\]]+?)\s*\]\s*(#.*)?$")
_ENTRY = re.compile(r"(?P<head>\s*(?P<name>matrix|rotation|translation|distortions)\s*=\s*)")


def write_like(source: Path, rig: Rig, target: Path, unit: Unit | None = None) -> tuple[str, Path]:
    """Write `rig`, which was read from `source` and then changed, to `target`; returns the format's
    name and the written path.

    Poses, intrinsics and distortions are replaced; all other values are unchanged. For formats
    of several files, `target` is a folder, without file extension. If the format is no JSON, a
    target named .json gets this project's rig file. `unit` is the argument given to
    `read_rig`. The file is read back; if the result is not equal to `rig` (the format lacks a
    field, the file is unusual, or `rig` has only some of its cameras), this project's rig file is
    written instead, with the extension .json. Raises InputError as `check_target` does.
    """
    check_target(source, target)
    content, form, written = _found(source)
    asks_own = target.suffix.lower() == ".json" and content.syntax != "JSON"
    if asks_own or [each.name for each in written.cameras] != list(rig.names):
        return _own(rig, target)
    metres = METRES[unit or written.unit or "m"]
    if content.syntax == "JSON":
        for camera, entry in zip(rig.cameras, entries(content).values(), strict=True):
            _fill(entry, camera, metres)
        files = {source: json.dumps(content.value, indent=1)}
    elif content.syntax == "TOML":
        files = {source: _toml(source, content, rig, metres)}
    else:
        files = REWRITTEN.get(form.name, lambda *_: {})(content, rig, metres)
    several = len(files) > 1 or source.is_dir()
    if files and not (several and target.suffix):
        with tempfile.TemporaryDirectory() as folder:
            draft = Path(folder) / ("cameras" if several else source.name)
            _write(files, draft, several=several)
            try:
                again = form.read(load(draft))
                reads = again is not None and _same(again, rig, metres)
            except InputError:
                reads = False
        if reads:
            _write(files, target, several=several)
            return form.name, target
    return _own(rig, target)


def write_pose2sim(rig: Rig, target: Path) -> None:
    """Write a rig with z up as Pose2Sim's TOML: camera from world, metres, distortions k1 k2 p1 p2.

    InputError if a lens has other coefficients.
    """
    tables = list[str]()
    for number, camera in enumerate(rig.cameras):
        if camera.lens != "perspective" or camera.distortion[4:].any():
            raise InputError(f"{target}: Pose2Sim's TOML cannot hold the lens of {camera.name}")
        turn, size = cv2.Rodrigues(camera.cTw[:, :3])[0].ravel(), map(float, camera.image_size)
        values = {"name": camera.name, "size": list(size), "matrix": camera.K.tolist()}
        values |= {"distortions": np.r_[camera.distortion, np.zeros(4)][:4].tolist()}
        values |= {"rotation": turn.tolist(), "translation": camera.cTw[:, 3].tolist()}
        lines = [f"{key} = {json.dumps(value)}" for key, value in values.items()]
        tables += [f"[cam_{number + 1:02d}]", *lines, "fisheye = false", ""]
    write_content(target, "\n".join([*tables, "[metadata]", "adjusted = false", "error = 0.0", ""]))


def check_target(source: Path, target: Path) -> None:
    """Raise InputError if `target` has neither the suffix of `source`'s format nor .json (this
    project's rig file).
    """
    _, form, _ = _found(source)
    several = source.is_dir() or form.name in _SEVERAL
    ending, own = target.suffix.lower(), source.suffix.lower()
    same = ending == own or (ending in _YAML and own in _YAML)
    if ending not in ("", ".json") and (several or not same):
        name = (
            "a folder (without a suffix)"
            if several
            else f"FILE{''.join(source.suffixes[-2:]) or '.json'}"
        )
        raise InputError(
            f"{target}: cameras read as {form.name} can be written as that, or as a rig file; "
            f"name the output {name} or FILE.json"
        )


def _found(source: Path) -> tuple[Content, CalibrationFormat, WrittenRig]:
    """The content of `source`, its format, and its cameras."""
    content = load(source)
    if (found := recognised(content)) is None:
        raise InputError(f"{source}: the calibration is not there any more; read it again")
    return content, *found


def _own(rig: Rig, target: Path) -> tuple[str, Path]:
    """Write this project's rig file to `target`, with its suffix replaced by .json if necessary."""
    file, number = target, 0
    while file.suffix.lower() != ".json" or (file != target and file.exists()):
        stem = target.name.removesuffix("".join(target.suffixes[-2:]))
        file, number = target.with_name(f"{stem}{f'-{number}' if number else ''}.json"), number + 1
    write_rig(rig, file)
    return FORMATS[0].name, file


def _write(files: dict[Path, str], target: Path, *, several: bool) -> None:
    if several:
        target.mkdir(parents=True, exist_ok=True)
    for file, text in files.items():
        write_content(target / file.name if several else target, text)


def _same(written: WrittenRig, rig: Rig, metres: float) -> bool:
    """Whether the cameras of a file equal those of a rig, within the precision of the file."""
    if [each.name for each in written.cameras] != list(rig.names):
        return False
    for each, camera in zip(written.cameras, rig.cameras, strict=True):
        wTc, d = each.wTc.copy(), np.zeros(14)
        wTc[:3, 3] *= metres
        d[: len(each.distortion)] = each.distortion
        own = np.r_[camera.distortion, np.zeros(14)][:14]
        if not (np.allclose(wTc, camera.wTc, atol=_DIGITS) and np.allclose(d, own, atol=_DIGITS)):
            return False
        if not np.allclose(each.K, camera.K, atol=_DIGITS_PX):
            return False
    return True


def _fill(entry: dict[str, Any], camera: Camera, metres: float) -> None:
    """Replace the values of a camera in its entry, preserving the shape of each value."""
    own = dict[str, ArrayLike]()
    if "fx" in entry:  # VoxelPose: T is the camera's centre, R (X - T)
        own = dict(zip(("fx", "cx", "fy", "cy"), camera.K[[0, 0, 1, 1], [0, 2, 1, 2]], strict=True))
        d = np.r_[camera.distortion, np.zeros(14)]
        own |= {"k": d[[0, 1, 4]], "p": d[2:4], "T": camera.centre / metres}
    for name, old in entry.items():
        new = own.get(name, numbers_of(name, camera, metres, np.size(old)))
        if old is not None and new is not None:
            entry[name] = np.reshape(new, np.shape(old)).tolist()


def _toml(source: Path, content: Content, rig: Rig, metres: float) -> str:
    """The TOML text with the values of each camera's table replaced, line by line."""
    tables = wanted_tables(content.value)
    cameras, camera, lines, depth = dict(zip(tables, rig.cameras, strict=True)), None, [], 0
    for line in read_text(source).splitlines():
        if depth > 0:  # rest of a replaced value
            depth += line.count("[") - line.count("]")
            continue
        if (table := _TABLE.match(line)) is not None:
            key = table["key"].removeprefix("cameras.").strip("\"'")
            camera = cameras.get(key)
        elif camera is not None and (entry := _ENTRY.match(line)) is not None:
            old = tables[key][entry["name"]]
            depth = line.count("[") - line.count("]")
            new = numbers_of(entry["name"], camera, metres, np.size(old))
            line = entry["head"] + json.dumps(np.reshape(np.asarray(new), np.shape(old)).tolist())
        lines.append(line)
    return "\n".join(lines) + "\n"
