"""A Pose2Sim project as it lies: which of its files are what, and where its next steps look for results."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from shapepose_fg.core.errors import InputError
from shapepose_fg.core.storage.files import read_toml
from shapepose_fg.io.calibration.content import load
from shapepose_fg.io.calibration.reading import FORMATS
from shapepose_fg.io.detections.json_people import frame_files, frame_number
from shapepose_fg.io.footage.footage import glance
from shapepose_fg.io.footage.places import VIDEOS

CONFIG = "Config.toml"
_POSES = ("pose-sync", "pose", "pose-associated")
"""Folders of 2D detections, the best first: brought into step, as detected, and one person as Pose2Sim chose them.
Who is who in the cameras is found anew, so that what Pose2Sim dropped is not lost."""
_RATE = 30.0
"""Frames a second where neither Config.toml nor a video says it, as in Pose2Sim."""


@dataclass(frozen=True)
class Pose2SimProject:
    """What a project says, and where its files are."""

    folder: Path
    """The trial's own folder."""
    calibration: Path
    """The cameras."""
    detections: Path
    """The folder of 2D detections."""
    fps: float | None
    """Frames a second; None where `times` says when frames were taken."""
    times: Path | None
    """The times that `shapepose-fg detect` wrote beside its detections."""
    first_number: int
    """What the project calls its first frame: results have the project's numbers."""
    frames: tuple[int, int] | None
    """The project's own numbers of the first frame to be reconstructed and of the one after the last."""
    multi_person: bool
    """Whether everybody is of interest, or one person."""
    notes: tuple[str, ...]
    """What was taken to be what."""

    @property
    def output(self) -> Path:
        """Where our own results go."""
        return self.folder / "shapepose-fg"

    @property
    def pose_3d(self) -> Path:
        """Where Pose2Sim's next steps look for TRC and C3D."""
        return self.folder / "pose-3d"

    def name_of(self, person: int | None, first: int, last: int) -> str:
        """The name of a person's files, without ending, as Pose2Sim gives it; `person` None for the only one."""
        who = "" if person is None else f"_P{person}"
        return f"{self.folder.resolve().name}{who}_{first}-{last}"

    def span(self, count: int) -> range:
        """Frames of a recording of `count` that are wanted, counted from 0; InputError where there are none."""
        if self.frames is None:
            return range(count)
        start, stop = (min(max(number - self.first_number, 0), count) for number in self.frames)
        if start >= stop:
            last = self.first_number + count
            raise InputError(
                f"{self.folder / CONFIG}: project.frame_range is {list(self.frames)}, and the detections have"
                f" frames {self.first_number} to {last - 1}; correct it, or write 'all'"
            )
        return range(start, stop)


def read_pose2sim_project(folder: Path) -> Pose2SimProject:
    """The project, or trial of a project, in `folder`; InputError, one sentence, where something is missing."""
    config, session = _settings(folder)
    project = config.get("project", {})
    if not isinstance(project, dict):
        raise InputError(
            f"{folder / CONFIG}: project must be a table; write [project] as Pose2Sim's demos have it"
        )
    calibration = _calibration(session, folder)
    entries = sorted((folder / "videos").iterdir()) if (folder / "videos").is_dir() else []
    videos = [each for each in entries if each.suffix.lower() in VIDEOS]
    detections = _detections(folder, calibration, videos)
    times = detections / "times.csv"
    rate = project.get("frame_rate", "auto")
    fps, said = (
        (None, f"times from {times}") if rate == "auto" and times.is_file() else _rate(rate, videos, folder)
    )
    multi_person = project.get("multi_person", False)
    if not isinstance(multi_person, bool):
        raise InputError(
            f"{folder / CONFIG}: project.multi_person must be true or false, got {multi_person!r}; correct it"
        )
    # Results have the numbers of the files' names, 0 where they have none.
    folders = [each for each in detections.iterdir() if each.is_dir()]
    numbers = (frame_number(file) for each in folders for file in frame_files(each))
    return Pose2SimProject(
        folder,
        calibration,
        detections,
        fps,
        times if fps is None else None,
        min(numbers, default=0),
        _frame_range(project.get("frame_range", "auto"), folder),
        multi_person,
        (f"{folder}: cameras from {calibration}, detections from {detections}", f"{folder}: {said}"),
    )


def _settings(folder: Path) -> tuple[dict[str, Any], Path]:
    """Config.toml of a trial over that of the session above it, and the session's folder."""
    if not folder.is_dir():
        raise InputError(f"{folder}: there is no such folder; give that of a Pose2Sim project")
    own, above = folder / CONFIG, folder.resolve().parent / CONFIG
    if not own.is_file():
        raise InputError(f"{own}: there is no such file; give the folder of a Pose2Sim project, which has one")
    trials = sorted(each.parent.name for each in folder.glob(f"*/{CONFIG}"))
    if len(trials) > 0 and not any((folder / name).is_dir() for name in (*_POSES, "videos")):
        raise InputError(
            f"{folder}: a session of several trials; give one of them: {' '.join(trials[:8])}"
            + (" ..." if len(trials) > 8 else "")
        )
    config = read_toml(own, may_be_empty=True)
    if not above.is_file():
        return config, folder
    return _over(read_toml(above, may_be_empty=True), config), above.parent


def _over(below: dict[str, Any], own: dict[str, Any]) -> dict[str, Any]:
    """Settings `own` over those `below`, table by table."""
    together = below | own
    for key in own.keys() & below.keys():
        if isinstance(own[key], dict) and isinstance(below[key], dict):
            together[key] = _over(below[key], own[key])
    return together


def _calibration(session: Path, folder: Path) -> Path:
    """The calibration of a session: the newest TOML, as Pose2Sim takes it, else a file of another known format, or
    the folder itself, where a format has several files.
    """
    places = dict.fromkeys((session.resolve(), folder.resolve()))
    rooms = [
        each
        for place in places
        for each in sorted(place.iterdir())
        if each.is_dir() and "calib" in each.name.lower()
    ]
    if len(rooms) == 0:
        raise InputError(
            f"{session}: no folder of the calibration here; put the cameras into {session}/calibration"
        )
    files = [each for room in rooms for each in room.iterdir() if each.is_file()]
    files.sort(key=lambda file: (file.stat().st_mtime, file.name), reverse=True)
    files.sort(key=lambda file: file.suffix != ".toml")  # the newest stays first among its kind
    found = next((each for each in (*files, rooms[0]) if _is_calibration(each)), None)
    if found is None:
        there = " ".join(sorted(each.name for each in rooms[0].iterdir())[:8]) or "nothing"
        raise InputError(
            f"{rooms[0]}: no calibration that is known here, only {there}; run Pose2Sim's calibration, or put one"
            " of the formats of docs/conventions.md there"
        )
    return found


def _is_calibration(path: Path) -> bool:
    """Whether a file or folder is of one of the formats of cameras."""
    try:
        content = load(path)
    except InputError:
        return False
    return content.syntax != "pickle" and any(each.recognise(content) for each in FORMATS)


def _detections(folder: Path, calibration: Path, videos: Sequence[Path]) -> Path:
    """The folder of 2D detections; InputError with the command that makes them where there are videos only."""
    for name in _POSES:
        place = folder / name
        if place.is_dir() and any(_is_pose(each) for each in place.iterdir()):
            return place
    pose = folder / "pose"
    if len(videos) == 0:
        raise InputError(
            f"{folder}: neither 2D detections ({' '.join(_POSES)}) nor videos here; put the videos into"
            f" {folder / 'videos'} and detect people in them"
        )
    raise InputError(
        f"{pose}: no 2D detections yet; run Pose2Sim's poseEstimation, or shapepose-fg detect --calibration"
        f" {calibration} --videos {folder / 'videos'} --network NETWORK --output {pose}"
    )


def _is_pose(path: Path) -> bool:
    """Whether a file or folder may hold what a camera's detector wrote."""
    if path.name.startswith("."):
        return False
    return len(frame_files(path)) > 0 if path.is_dir() else path.suffix in (".json", ".txt")


def _rate(given: Any, videos: Sequence[Path], folder: Path) -> tuple[float, str]:
    """Frames a second, and where that comes from."""
    if given == "auto":
        for video in videos:
            _, fps = glance(video)
            if fps > 0:
                return fps, f"{fps:g} frames a second, as {video.name} says"
        return _RATE, f"{_RATE:g} frames a second are assumed: project.frame_rate is 'auto', and there is no video"
    if isinstance(given, bool) or not isinstance(given, int | float) or not 0.01 <= given <= 1e5:
        raise InputError(
            f"{folder / CONFIG}: project.frame_rate must be frames a second or 'auto', got {given!r}; correct it"
        )
    return float(given), f"{float(given):g} frames a second, as {CONFIG} says"


def _frame_range(given: Any, folder: Path) -> tuple[int, int] | None:
    if given in ("auto", "all") or given == []:
        return None
    whole = isinstance(given, list) and len(given) == 2 and all(type(number) is int for number in given)
    if not whole or not 0 <= given[0] < given[1]:
        raise InputError(
            f"{folder / CONFIG}: project.frame_range must be 'auto', 'all', or two frame numbers such as [10,"
            f" 300], got {given!r}; correct it"
        )
    return given[0], given[1]
