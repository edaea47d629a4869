"""Reads a Pose2Sim project: finds its files, and the folders in which its next steps look for
results.
"""

import shlex
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from shapepose_fg.core.errors import InputError
from shapepose_fg.core.joint_names import layouts_called
from shapepose_fg.core.storage.files import read_toml
from shapepose_fg.io.calibration.reading import is_calibration
from shapepose_fg.io.camera_names import listing, numbered
from shapepose_fg.io.detections.json_people import FRAME_FILE
from shapepose_fg.io.detections.people import DeclaredJoints
from shapepose_fg.io.footage.footage import glance
from shapepose_fg.io.footage.places import VIDEOS

CONFIG = "Config.toml"
_POSES = ("pose-sync", "pose", "pose-associated")
"""Folders of 2D detections in order of preference: synchronised, as detected, and Pose2Sim's
selection of one person. People are associated between cameras again, so that people dropped by
Pose2Sim are not lost."""


@dataclass(frozen=True)
class Pose2SimProject:
    """The content of a project, and the paths of its files."""

    folder: Path
    """The trial's own folder."""
    calibration: Path
    """Path of the cameras."""
    detections: Path
    """The folder of 2D detections."""
    fps: float | None
    """Frame rate, Hz; None if times.csv beside the detections has the times of the frames."""
    first_number: int
    """Number of the first frame in the project: results use the project's numbers."""
    frames: tuple[int, int] | None
    """Frame numbers in the project: the first frame to reconstruct, and the first after the
    last."""
    multi_person: bool
    """Whether all people are wanted, or one person."""
    joints: DeclaredJoints | None
    """The detector's joints from pose.pose_model; None if it is missing."""
    notes: tuple[str, ...]
    """Notes on how the files were interpreted."""

    @property
    def output(self) -> Path:
        """Folder of our own results."""
        return self.folder / "shapepose-fg"

    @property
    def pose_3d(self) -> Path:
        """Folder in which Pose2Sim's next steps look for TRC and C3D."""
        return self.folder / "pose-3d"

    @property
    def name(self) -> str:
        """The trial's name."""
        return self.folder.resolve().name

    def name_of(self, person: int | None, first: int, last: int) -> str:
        """File name of a person, without extension, in Pose2Sim's style; `person` None for the only
        one.
        """
        suffix = "" if person is None else f"_P{person}"
        return f"{self.name}{suffix}_{first}-{last}"

    def span(self, count: int) -> range:
        """Wanted frames of a recording of `count` frames, counted from 0; InputError if there are
        none.
        """
        if self.frames is None:
            return range(count)
        start, stop = (min(max(number - self.first_number, 0), count) for number in self.frames)
        if start >= stop:
            last = self.first_number + count
            raise InputError(
                f"{self.folder / CONFIG}: project.frame_range is {list(self.frames)}, but the "
                f"detections have frames {self.first_number} to {last - 1}; correct it, or write "
                "'all'"
            )
        return range(start, stop)


def read_pose2sim_project(folder: Path) -> Pose2SimProject:
    """The project, or trial of a project, in `folder`; InputError, one sentence, if something is
    missing.
    """
    config, session = _settings(folder)
    project = config.get("project", {})
    if not isinstance(project, dict):
        raise InputError(
            f"{folder / CONFIG}: project must be a table; write [project] as Pose2Sim's demos do"
        )
    rate, span, multi_person = _checked(project, folder / CONFIG)
    calibration = _calibration(session, folder)
    entries = sorted((folder / "videos").iterdir()) if (folder / "videos").is_dir() else []
    videos = [each for each in entries if each.suffix.lower() in VIDEOS]
    detections = _detections(folder, len(videos) > 0)
    times = detections / "times.csv"
    if rate == "auto" and times.is_file():
        fps, source = None, f"times from {times}"
    else:
        rates = ((glance(video)[1], f" (from {video.name})") for video in videos)
        # Default frame rate, Hz, as in Pose2Sim, if neither Config.toml nor a video
        # defines it.
        assumed = 30.0, " are assumed, because project.frame_rate is 'auto' and there is no video"
        given = rate != "auto"
        fps, origin = (
            (rate, f" (from {CONFIG})") if given else next((e for e in rates if e[0] > 0), assumed)
        )
        source = f"{fps:g} Hz{origin}"
    # Results have the numbers in the file names (or counted from 0), from the first frame that all
    # cameras have.
    folders = [numbered(each, FRAME_FILE) for each in detections.iterdir() if each.is_dir()]
    numbers = (files[0][0] for files in folders if len(files) > 0)
    return Pose2SimProject(
        folder,
        calibration,
        detections,
        None if fps is None else float(fps),
        max(numbers, default=0),
        (span[0], span[1]) if isinstance(span, list) and len(span) == 2 else None,
        multi_person,
        _joints(config, folder / CONFIG),
        (
            f"{folder}: cameras from {calibration}, detections from {detections}",
            f"{folder}: {source}",
        ),
    )


def _checked(project: dict[str, Any], file: Path) -> tuple[Any, Any, bool]:
    """frame_rate, frame_range and multi_person of [project]; InputError for invalid values."""

    def wrong(key: str, wanted: str) -> InputError:
        return InputError(
            f"{file}: project.{key} must be {wanted}, got {project[key]!r}; correct it"
        )

    rate, span = project.get("frame_rate", "auto"), project.get("frame_range", "auto")
    number = isinstance(rate, int | float) and not isinstance(rate, bool)
    if rate != "auto" and not (number and 0.01 <= rate <= 1e5):
        raise wrong("frame_rate", "a frame rate in Hz or 'auto'")
    pair = isinstance(span, list) and [type(number) for number in span] == [int, int]
    if span not in ("auto", "all", []) and not (pair and 0 <= span[0] < span[1]):
        raise wrong("frame_range", "'auto', 'all', or two frame numbers such as [10, 300]")
    multi_person = project.get("multi_person", False)
    if not isinstance(multi_person, bool):
        raise wrong("multi_person", "true or false")
    return rate, span, multi_person


def _joints(config: dict[str, Any], file: Path) -> DeclaredJoints | None:
    """Joints from pose.pose_model: the name of a layout, or a tree of joints under this name."""
    pose = config.get("pose", config.get("pose-2d", {}))
    if not isinstance(pose, dict):
        raise InputError(f"{file}: pose must be a table; write [pose] as Pose2Sim's demos do")
    name = pose.get("pose_model")
    if not isinstance(name, str) or not name.strip():
        return None
    tree, source = pose.get(name), f"{file}: pose.pose_model"
    names = (
        {}
        if layouts_called(name)
        else _joints_of_tree(tree[0] if isinstance(tree, list) and tree else tree)
    )
    if not names:
        return DeclaredJoints(name, source)
    return DeclaredJoints(tuple(names.get(place, "") for place in range(max(names) + 1)), source)


def _joints_of_tree(tree: Any) -> dict[int, str]:
    """Joint names by keypoint index, from a tree of joints: tables with `id`, `name` and
    `children`.
    """
    names, waiting = dict[int, str](), [tree]
    while waiting:
        each = waiting.pop()
        if not isinstance(each, dict):
            continue
        children, place, name = each.get("children"), each.get("id"), each.get("name")
        waiting += children if isinstance(children, list) else []
        place = (
            int(place) if isinstance(place, str) and place.isdecimal() and len(place) < 6 else place
        )
        # Maximum id of a keypoint; a larger one is a mistake.
        if type(place) is int and 0 <= place < 1000 and isinstance(name, str):
            names[place] = name
    return names


def _settings(folder: Path) -> tuple[dict[str, Any], Path]:
    """Config.toml of a trial merged over that of its session, and the session's folder."""
    if not folder.is_dir():
        raise InputError(
            f"{folder}: there is no such folder; give the folder of a Pose2Sim project"
        )
    own, above = folder / CONFIG, folder.resolve().parent / CONFIG
    if not own.is_file():
        raise InputError(
            f"{own}: there is no such file; give the folder of a Pose2Sim project, which "
            "contains it"
        )
    trials = sorted(each.parent.name for each in folder.glob(f"*/{CONFIG}"))
    if len(trials) > 0 and not any((folder / name).is_dir() for name in (*_POSES, "videos")):
        raise InputError(
            f"{folder}: this is a session of several trials; give one of them: {listing(trials)}"
        )
    config = read_toml(own, may_be_empty=True)
    if not above.is_file():
        return config, folder
    return _over(read_toml(above, may_be_empty=True), config), above.parent


def _over(below: dict[str, Any], own: dict[str, Any]) -> dict[str, Any]:
    """Merge the settings `own` over those in `below`, table by table."""
    together = below | own
    for key in own.keys() & below.keys():
        if isinstance(own[key], dict) and isinstance(below[key], dict):
            together[key] = _over(below[key], own[key])
    return together


def _calibration(session: Path, folder: Path) -> Path:
    """The calibration of a session: the newest TOML, as in Pose2Sim, otherwise a file or folder in
    a known format.
    """
    places = dict.fromkeys((session.resolve(), folder.resolve()))
    inside = [each for place in places for each in sorted(place.iterdir()) if each.is_dir()]
    rooms = [each for each in inside if "calib" in each.name.lower()]
    if len(rooms) == 0:
        raise InputError(
            f"{session}: there is no calibration folder; put the calibration into "
            f"{session}/calibration"
        )
    files = [each for room in rooms for each in room.iterdir() if each.is_file()]
    files.sort(key=lambda file: (file.stat().st_mtime, file.name), reverse=True)
    files.sort(key=lambda file: file.suffix != ".toml")  # the newest stays first within each kind
    found = next((each for each in (*files, rooms[0]) if is_calibration(each)), None)
    if found is None:
        names = listing(sorted(each.name for each in rooms[0].iterdir()))
        cure = "run Pose2Sim's calibration, or put a format of docs/calibration_files.md there"
        raise InputError(
            f"{rooms[0]}: there is no calibration in a known format; it contains {names}; {cure}"
        )
    return found


def _detections(folder: Path, has_videos: bool) -> Path:
    """The folder of 2D detections; if there are only videos, InputError with the command that
    computes them.
    """

    def is_pose(path: Path) -> bool:
        has_poses = (
            len(numbered(path, FRAME_FILE)) > 0
            if path.is_dir()
            else path.suffix in (".json", ".txt")
        )
        return has_poses and not path.name.startswith(".")

    for place in (folder / name for name in _POSES):
        if place.is_dir() and any(map(is_pose, place.iterdir())):
            return place
    pose, videos = folder / "pose", folder / "videos"
    if not has_videos:
        problem = f"there are neither 2D detections ({' '.join(_POSES)}) nor videos"
        raise InputError(
            f"{folder}: {problem}; put the videos into {videos} and detect people in them"
        )
    command = shlex.join(
        ["shapepose-fg", "detect", "--project", str(folder.resolve()), "--network", "NETWORK"]
    )
    raise InputError(
        f"{pose}: there are no 2D detections yet; run Pose2Sim's poseEstimation, or {command}"
    )


def footage_of(folder: Path) -> tuple[Path, Path, Path]:
    """Cameras, videos, and folder for the 2D detections of the project in `folder`. Raises
    InputError as `read_pose2sim_project` does.
    """
    return _calibration(_settings(folder)[1], folder), folder / "videos", folder / "pose"
