"""2D detections of every camera, from a folder, as candidates with part affinities."""

from pathlib import Path

from shapepose_fg.camera import Rig
from shapepose_fg.errors import InputError
from shapepose_fg.io.association_text import read_association_text
from shapepose_fg.io.detection_table import DetectionTable, assemble
from shapepose_fg.io.openpose_json import read_openpose_folder
from shapepose_fg.skeleton import BODY_25


def read_detections(path: str | Path, rig: Rig) -> DetectionTable:
    """Read what every camera of `rig` saw from the folder `path`, undistorted.

    Two formats are known by their files: `<camera>.txt` of 4D Association (also inside a `detection`
    subfolder), and a folder `<camera>/` of OpenPose's `*_keypoints.json` per camera. Cameras that the rig
    does not have are passed over. Raises InputError, one sentence that names file, place and cure.
    """
    folder = _folder(Path(path))
    texts = [folder / f"{name}.txt" for name in rig.names]
    folders = [folder / name for name in rig.names]
    if any(text.is_file() for text in texts):
        _complete(texts, rig, folder)
        views = [read_association_text(text, camera) for text, camera in zip(texts, rig.cameras, strict=True)]
    elif any(each.is_dir() for each in folders):
        _complete(folders, rig, folder)
        views = [read_openpose_folder(each) for each in folders]
    else:
        raise InputError(
            f"{folder}: no detections of the cameras {' '.join(rig.names)} here, only {_listing(folder)};"
            " give the folder with <camera>.txt (4D Association) or <camera>/*_keypoints.json (OpenPose)"
        )
    return assemble(views, rig, BODY_25)


def _folder(path: Path) -> Path:
    """The folder that holds the detections of `path`."""
    if path.is_file():
        raise InputError(f"{path}: this is a file; give the folder that holds the detections of all cameras")
    if not path.is_dir():
        raise InputError(f"{path}: there is no such folder; check the path of the detections")
    inner = path / "detection"
    return inner if inner.is_dir() else path


def _complete(places: list[Path], rig: Rig, folder: Path) -> None:
    """Refuse a recording in which a camera of the rig is missing."""
    for name, place in zip(rig.names, places, strict=True):
        if not place.exists():
            raise InputError(
                f'{place}: the detections of camera "{name}" are missing, {folder} holds {_listing(folder)};'
                " add them, or take the camera out of the calibration"
            )


def _listing(folder: Path) -> str:
    """The first names in a folder, for a message."""
    names = sorted(entry.name for entry in folder.iterdir() if not entry.name.startswith("."))
    if len(names) == 0:
        return "nothing"
    return " ".join(names[:8]) + (f" and {len(names) - 8} more" if len(names) > 8 else "")
