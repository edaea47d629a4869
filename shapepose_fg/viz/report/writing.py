"""Writes a result's report.html, from a result in memory or in its folder."""

from pathlib import Path

import numpy as np

from shapepose_fg.body.model.result_body import body_of, model_of
from shapepose_fg.body.model.smpl_file import SmplArrays
from shapepose_fg.core.camera import Axis, Rig
from shapepose_fg.core.errors import InputError
from shapepose_fg.core.frame_times import ASSUMED_FPS
from shapepose_fg.core.reconstruction import Reconstruction
from shapepose_fg.core.result_files import results_folder
from shapepose_fg.core.rig_file import CAMERAS
from shapepose_fg.core.run_summary import has_identities
from shapepose_fg.core.storage.files import write_atomically
from shapepose_fg.io.calibration import read_rig
from shapepose_fg.io.export.take import Take
from shapepose_fg.results.track_summary import MOST_ROWS, list_tracks
from shapepose_fg.viz.report.figures import Curve, angle_curves
from shapepose_fg.viz.report.page import page_text
from shapepose_fg.viz.report.scene import PageScene, scene_of

REPORT = "report.html"
"""File name of the report, beside people.npz."""
SCENE_BYTES = 8_000_000
"""Maximum size of people and bodies in a page, bytes: a page of 10 MB opens quickly and can be sent
by e-mail."""


def write_report(
    folder: Path,
    people: Reconstruction,
    rig: Rig | Axis | None,
    *,
    fps: float | None = None,
    body: Path | None = None,
    every: int = 1,
) -> Path:
    """Write report.html of `people` into `folder`, atomically; returns its path.

    `rig` are the cameras; if they are unknown, the up axis, or None for the axis along which people
    stand. `fps` replaces the times of the result. `body` is the file of the body model if it was
    moved after run.json was written. `people` are those of every frame of the result, or of every
    `every`-th frame; for long recordings the scene has only every second, third ... frame. If the
    people have no timeline, the page has no scene and states the reason.
    """
    arrays, remarks = _body(people, body)
    if every > 1:
        remarks.append(f"the result is long: this page uses every {th(every)} frame")
    if rig is None or isinstance(rig, str):
        up, rig = rig or _standing_axis(people), None
        remarks.append(f"{CAMERAS} is missing: cameras are not drawn, and {up} is assumed to be up")
    else:
        up = rig.up
    scene: PageScene | None = None
    if len(people) > 0:
        if fps is None and not _timed(people):
            fps = ASSUMED_FPS
            remarks.append(
                f"the times of the frames are unknown: the scene plays at {fps:g} Hz (--fps)"
            )
        try:
            scene = scene_of(
                Take.of(people, up, rig=rig, fps=fps, identities=False), arrays, SCENE_BYTES
            )
        except ValueError as error:
            remarks.append(f"the scene is not drawn: {error}")
    title = str(people.run.get("project") or folder.resolve().name or folder)
    curves = dict[int, list[Curve]]()
    if arrays is not None and has_identities(people.run):
        try:
            curves = angle_curves(people, up, model_of(people.run, body))
        except InputError as error:
            remarks.append(f"joint angles are not drawn: {error}")
    text = page_text(title, people, list_tracks(people, arrays, every), scene, remarks, curves)
    file = folder / REPORT
    # A name may contain half of a surrogate pair, which cannot be written to a file.
    write_atomically(file, lambda stream: stream.write(text.encode("utf-8", "replace")))
    return file


def report_of(
    results: Path, *, up: Axis | None = None, fps: float | None = None, body: Path | None = None
) -> Path:
    """Write report.html of the saved result at `results` again; InputError if it cannot be read."""
    folder = results_folder(results)
    with Reconstruction.open(results) as opened:
        people, every = opened.thinned(MOST_ROWS)
    cameras = folder / CAMERAS
    rig = read_rig(cameras) if cameras.is_file() else up
    return write_report(folder, people, rig, fps=fps, body=body, every=every)


def th(number: int) -> str:
    """An ordinal number as text, such as 2nd."""
    return {2: "second", 3: "third"}.get(number, f"{number}th")


def _body(people: Reconstruction, given: Path | None) -> tuple[SmplArrays | None, list[str]]:
    """The body model of a result; None and a remark if its file is missing."""
    try:
        return body_of(people.run, given), []
    except InputError as error:
        if given is not None:
            raise
        return None, [f"bodies are not drawn, and heights are unknown: {error}"]


def _timed(people: Reconstruction) -> bool:
    """Whether a result has frame times: two times, or one time and the frame rate."""
    times = np.unique(people.time_s[np.isfinite(people.time_s)])
    rate = people.run.get("time", {}).get("fps")
    return len(times) > 1 or (len(times) == 1 and rate is not None and rate > 0)


def _standing_axis(people: Reconstruction) -> Axis:
    """The axis along which people stand: the most frequent direction from feet to head."""
    ends = (("Neck", "Nose", "Head"), ("RAnkle", "LAnkle", "RKnee", "LKnee"))
    heads, feet = (people.joints[:, np.isin(people.joint_names, each)] for each in ends)
    along = (heads[:, :, None] - feet[:, None]).reshape(-1, 3)
    along = along[np.isfinite(along).all(axis=1)]
    if len(along) == 0:
        return "z"
    mean = np.median(along, axis=0)
    best = int(np.abs(mean).argmax())
    axes: tuple[Axis, ...] = ("x", "y", "z", "-x", "-y", "-z")
    return axes[best if mean[best] > 0 else best + 3]
