"""Rerun recordings of a take: written to an RRD file or shown in the viewer, with a layout, and
with telemetry switched off.

In the recording's own axes, metres; missing values are not drawn.
"""

import json
import os
import shutil
import subprocess
import sys
import sysconfig
import tempfile
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np

from shapepose_fg.body.model.smpl_file import SmplArrays
from shapepose_fg.core.arrays import Array
from shapepose_fg.core.camera import Axis, Rig
from shapepose_fg.core.errors import InputError, optional
from shapepose_fg.core.storage.files import write_atomically
from shapepose_fg.core.world_axes import y_up
from shapepose_fg.io.export.registry import Job, Written
from shapepose_fg.io.export.rerun_log import camera_path, log_take, person_path
from shapepose_fg.io.export.take import Take

APPLICATION = "shapepose-fg"


def new_stream() -> Any:
    """An empty recording; InputError if rerun-sdk is not installed."""
    rr = optional("rerun", "view")
    stream = rr.RecordingStream(APPLICATION)
    rr.set_log_time_enabled(False, recording=stream)
    rr.set_log_tick_enabled(False, recording=stream)
    return stream


@contextmanager
def shown(first: Any, url: str | None) -> Iterator[Any]:
    """A recording that is shown by the viewer at `url`, or by a newly started one; `first` is its
    layout. InputError if that fails.
    """
    stream, rr = new_stream(), optional("rerun", "view")
    displays = ("DISPLAY", "WAYLAND_DISPLAY", "WAYLAND_SOCKET")
    if url is None and sys.platform == "linux" and not any(map(os.environ.get, displays)):
        raise InputError(
            "the rerun viewer cannot be started, because there is no display; write a file (such "
            "as by `shapepose-fg export RESULTS rrd`), and open it elsewhere by `rerun FILE`, or "
            "in a browser by `rerun --web-viewer FILE`"
        )
    try:
        if url is not None:
            stream.connect_grpc(url, default_blueprint=first)
            # Maximum time to connect to a running viewer, and to a newly started one, s.
            stream.flush(timeout_sec=10.0)
        else:
            rr.spawn(
                recording=stream,
                default_blueprint=first,
                executable_path=viewer_file(),
                hide_welcome_screen=True,  # the welcome screen would load examples from the network
            )
    except (RuntimeError, ValueError, OSError) as error:
        place = "started" if url is None else f"reached at {url}"
        raise InputError(
            f"the rerun viewer cannot be {place}: {' '.join(str(error).split())}"
        ) from None
    yield stream
    stream.flush()


def viewer_file() -> str | None:
    """The viewer of rerun-sdk, even if its folder is not on the PATH; otherwise another installed
    viewer, or None.
    """
    return shutil.which("rerun", path=sysconfig.get_path("scripts")) or shutil.which("rerun")


def quiet_viewer() -> list[str]:
    """Switch telemetry off; returns notes. InputError if that fails."""
    viewer = viewer_file()
    if viewer is None or not switch_off(viewer):
        return []
    return [
        (
            "rerun's usage statistics were on and have been switched off; `rerun analytics enable` "
            "switches them on"
        )
    ]


def body_if_there(job: Job) -> tuple[SmplArrays | None, list[str]]:
    """The body model, or a note if its file is missing: the rest can be shown without it."""
    try:
        return job.arrays, []
    except InputError as error:
        return None, [f"bodies are not drawn ({error})"]


@contextmanager
def written(path: Path, first: Any) -> Iterator[Any]:
    """A recording that is written to `path` at the end of the block, atomically."""
    stream = new_stream()
    with tempfile.TemporaryDirectory() as folder:  # rerun writes only to a path
        draft = Path(folder) / "people.rrd"
        stream.save(draft, default_blueprint=first)
        yield stream
        stream.flush()
        stream.disconnect()
        with draft.open("rb") as source:
            write_atomically(path, lambda target: shutil.copyfileobj(source, target))


def write_rrd(job: Job) -> Written:
    """Write `people.rrd`; without bodies if the body model is missing."""
    found, path = Written(), job.folder / "people.rrd"
    take, origin = found.near_origin(
        job.take, np.eye(3), "rrd", "origin_m of the entity world/origin"
    )
    arrays, notes = body_if_there(job)
    notes += ["cameras are not drawn, because cameras.json is missing"] if take.rig is None else []
    with written(path, layout_of(take)) as stream:
        log_take(stream, take, arrays)
        if origin.any():
            rr = optional("rerun", "view")
            stream.log("world/origin", rr.AnyValues(origin_m=origin), static=True)
    return Written([path], [*found.notes, *(f"rrd: {note}" for note in notes)])


def layout_of(take: Take) -> Any:
    """The viewer's initial layout for a take."""
    drawn = [f"{person_path(identity)}/bones" for identity in take.persons.tolist()]
    return layout(take.up, take.rig, take.people.joints.reshape(-1, 3), drawn)


def layout(up: Axis, rig: Rig | None, around: Array, drawn: Sequence[str]) -> Any:
    """The viewer's initial layout: the world, every camera with people drawn over its detections,
    and two plots.

    The initial view shows the points `around` (N, 3), metres; `drawn` are the parts of people that
    are drawn in camera views.
    """
    optional("rerun", "view")
    import rerun.blueprint as rrb

    cameras = () if rig is None else rig.cameras
    world = rrb.Spatial3DView(
        origin="world",
        name="world",
        contents=["$origin/**", *(f"- {camera_path(camera.name)}/seen/**" for camera in cameras)],
        line_grid=rrb.LineGrid3D(visible=False),
        eye_controls=_eye(rrb, up, around),
    )
    plots = [rrb.TimeSeriesView(origin="plots/sigma", name="median sigma, mm")]
    if len(cameras) > 0:
        plots.append(rrb.TimeSeriesView(origin="plots/residual", name="median residual, px"))
    views = [
        rrb.Spatial2DView(
            origin=camera_path(camera.name),
            name=camera.name,
            contents=["$origin/**", *drawn],
            visual_bounds=rrb.VisualBounds2D(
                x_range=[0, camera.image_size[0]], y_range=[0, camera.image_size[1]]
            ),
        )
        for camera in cameras
    ]
    rows = [rrb.Grid(*views), rrb.Horizontal(*plots)] if views else plots
    return rrb.Blueprint(
        rrb.Horizontal(
            world, rrb.Vertical(*rows, row_shares=[3, 1] if views else None), column_shares=[1, 1]
        ),
        rrb.TimePanel(timeline="time", state="collapsed"),
        rrb.SelectionPanel(state="collapsed"),
        rrb.BlueprintPanel(state="collapsed"),
    )


def _eye(rrb: Any, axis: Axis, around: Array) -> Any:
    """A viewpoint above and beside the points (N, 3), far enough to see all of them."""
    around = around[np.isfinite(around).all(axis=1)]
    low, high = (
        np.quantile(around, [0.02, 0.98], axis=0) if len(around) > 0 else (np.zeros(3), np.ones(3))
    )
    middle, reach = (low + high) / 2, max(float(np.linalg.norm(high - low)), 2.0)
    up = y_up(axis)[1]
    side = np.roll(up, 1) + 0.6 * np.roll(up, 2)
    place = middle + reach * (side / np.linalg.norm(side) + 0.45 * up)
    return rrb.EyeControls3D(position=place, look_target=middle, eye_up=up)


def switch_off(viewer: str) -> bool:
    """Switch off rerun's telemetry (usage statistics that its viewer sends to the developers), by
    the program `viewer`.

    According to rerun's manual, the setting is permanent. Returns True if telemetry was on.
    InputError if switching off fails, so that nothing is sent without consent.
    """

    def says(command: str) -> str:
        words = [viewer, "analytics", command]
        done = subprocess.run(words, capture_output=True, text=True, timeout=30, check=True)
        return done.stdout

    def on() -> bool:
        """Whether telemetry is on. If the variable CI is set, rerun has no telemetry and prints
        `null`.
        """
        settings = json.loads(says("config"))
        return settings is not None and settings.get("analytics_enabled", True)

    try:
        if not on():
            return False
        says("disable")
        if not on():
            return True
        problem = "they are still on"
    except (OSError, ValueError, AttributeError, subprocess.SubprocessError) as error:
        problem = " ".join(str(error).split())
    raise InputError(
        f"rerun's usage statistics cannot be switched off ({problem}); run `rerun analytics "
        "disable`, or give --statistics to allow them"
    )
