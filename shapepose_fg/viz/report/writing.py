"""A result's report.html, from a result in memory or in its folder: data/page.html filled in."""

import base64
import hashlib
from collections.abc import Sequence
from importlib.resources import files
from pathlib import Path
from typing import get_args

import numpy as np

from shapepose_fg.body.model.smpl_file import SmplArrays
from shapepose_fg.core.camera import Axis, Rig
from shapepose_fg.core.drawing import PALETTE
from shapepose_fg.core.errors import InputError
from shapepose_fg.core.frame_times import ASSUMED_FPS
from shapepose_fg.core.observation_table import Gate
from shapepose_fg.core.reconstruction import Reconstruction
from shapepose_fg.core.result_files import results_folder
from shapepose_fg.core.storage.files import write_atomically
from shapepose_fg.io.calibration import read_rig
from shapepose_fg.io.export.take import Take
from shapepose_fg.io.solved_setup import CAMERAS, body_of
from shapepose_fg.tracking.listing import TrackSummary, list_tracks
from shapepose_fg.viz.report.figures import KINDS, camera_figures, known_counts, overall, told_by
from shapepose_fg.viz.report.scene import Scene, scene_of

_SCRIPTS = ("geometry.js", "skin.js", "drawing.js", "page.js")
"""In the order in which they are loaded."""


def page_text(
    title: str, people: Reconstruction, tracks: Sequence[TrackSummary], scene: Scene | None, remarks: Sequence[str]
) -> str:
    """The page of a result as HTML: self-contained, with no address of anything else in it.

    `tracks` are its identities, `scene` is drawn where there is one, and `remarks` say what the page lacks. Texts
    of the input are escaped, and the page's own policy forbids every script but those that are part of it.
    """
    from jinja2 import Environment, StrictUndefined

    page = Environment(autoescape=True, undefined=StrictUndefined, trim_blocks=True, extensions=["jinja2.ext.do"])
    page.policies["json.dumps_kwargs"] = {"allow_nan": False, "separators": (",", ":")}
    page.filters |= {"dash": _dash, "share": _share, "percent": _percent, "count": _count, "path": _path}
    scripts = [_asset(name) for name in _SCRIPTS] if scene is not None else []
    digests = (base64.b64encode(hashlib.sha256(text.encode("utf-8")).digest()).decode("ascii") for text in scripts)
    hashes = " ".join(f"'sha256-{digest}'" for digest in digests) or "'none'"
    by_person = known_counts(people, np.searchsorted([each.person for each in tracks], people.person))
    by_joint, kinds = known_counts(people), [kind.name.lower() for kind in KINDS]
    return page.from_string(_asset("page.html")).render(
        Gate=Gate,
        policy=f"default-src 'none'; style-src 'unsafe-inline'; script-src {hashes}; img-src data:",
        title=title,
        style=_asset("report.css"),
        scripts=scripts,
        scene=scene,
        remarks=[*remarks],
        run=told_by(people.run),
        overall=overall(people),
        cameras=camera_figures(people),
        tracks=[
            (each, dict(zip(kinds, counts, strict=True)), PALETTE[each.person % len(PALETTE)])
            for each, counts in zip(tracks, by_person.tolist(), strict=True)
        ],
        known=dict(zip(kinds, by_joint.sum(axis=0).tolist(), strict=True)),
        joints=[
            (name, dict(zip(kinds, counts, strict=True)))
            for name, counts in zip(people.joint_names.tolist(), by_joint.tolist(), strict=True)
        ],
    )


def _dash(value: float | None, text: str, none: str = "–") -> str:
    """`value` as `text` formats it; a dash where it is None or NaN."""
    return none if value is None or value != value else text % value


def _share(count: int, total: int) -> str:
    """A share that is neither 0 nor 1 is not shown as if it were; a dash of nothing."""
    if count in (0, total):
        return "–" if total == 0 else f"{100 * count / total:.0f} %"
    percent = 100 * count / total
    return "under 0.1 %" if percent < 0.05 else f"{min(percent, 99.9):.1f} %"


def _percent(share: float | None) -> str:
    """A share of 0 to 1 in three digits; one that is under 1 is not shown as if it were all."""
    return "–" if share is None else f"{min(100 * share, 99.9) if share < 1 else 100:.3g} %"


def _count(value: float | None) -> str:
    """Whole numbers with a thin space between thousands."""
    return "–" if value is None else f"{value:,.0f}".replace(",", "\u202f")


def _path(values: list[float | None], most: float) -> str:
    """A line over time in a box of 120 x 22, from 0 to `most`, as SVG draws it; None is a gap."""
    step, drawn, pen_down = 120 / max(len(values) - 1, 1), list[str](), False
    for index, value in enumerate(values):
        if value is not None:
            at = f"{index * step:.1f} {21 - 20 * min(value / most, 1.0) if most > 0 else 21:.1f}"
            drawn.append(f"L{at}" if pen_down else f"M{at}h.8v0h-.8M{at}")
        pen_down = value is not None
    return "".join(drawn) or "M0 0"


def _asset(name: str) -> str:
    """Text of a file that ships beside this one."""
    return (files("shapepose_fg.viz.report") / "data" / name).read_text(encoding="utf-8")


MOST_ROWS = 40_000
"""Rows that check and report look at, about 400 MB: of longer results every second, third ... frame."""
REPORT = "report.html"
"""The report of a result, beside its people.npz."""
SCENE_BYTES = 8_000_000
"""What people and bodies may take: a page of 10 MB opens at once and still fits in a mail."""


def write_report(
    folder: Path,
    people: Reconstruction,
    rig: Rig | Axis | None,
    *,
    fps: float | None = None,
    body: Path | None = None,
    every: int = 1,
) -> Path:
    """Write report.html of `people` into `folder`, whole or not at all; returns its path.

    `rig` are the cameras; where they are not known the axis that is up, or None for the one along which people
    stand. `fps` takes the place of the result's times. `body` is the body model's file where it is no longer where
    run.json says. `people` are those of every frame of the result, or of `every` so many; of longer recordings the
    scene has every second, third ... frame. Where people cannot be put on one timeline, the page has no scene and
    says why.
    """
    arrays, remarks = _body(people, body)
    if every > 1:
        remarks.append(f"the result is long: all on this page is of every {th(every)} frame")
    if rig is None or isinstance(rig, str):
        up, rig = rig or _standing(people), None
        remarks.append(f"{CAMERAS} is not there: no cameras are drawn, and {up} is taken to be up")
    else:
        up = rig.up
    scene: Scene | None = None
    if len(people) > 0:
        if fps is None and not _timed(people):
            fps = ASSUMED_FPS
            remarks.append(f"nothing says when the frames were taken: the scene plays {fps:g} a second (--fps)")
        try:
            scene = scene_of(Take.of(people, up, rig=rig, fps=fps, identities=False), arrays, SCENE_BYTES)
        except ValueError as error:
            remarks.append(f"there is no scene: {error}")
    title = str(people.run.get("project") or folder.resolve().name or folder)
    text = page_text(title, people, list_tracks(people, arrays, every), scene, remarks)
    file = folder / REPORT
    # A name may hold half of a pair of surrogates, which no file can.
    write_atomically(file, lambda stream: stream.write(text.encode("utf-8", "replace")))
    return file


def report_of(
    results: Path, *, up: Axis | None = None, fps: float | None = None, body: Path | None = None
) -> Path:
    """Write report.html of the saved result at `results` anew; InputError where it cannot be read."""
    folder = results_folder(results)
    with Reconstruction.open(results) as opened:
        people, every = opened.thinned(MOST_ROWS)
    if up is not None and up not in get_args(Axis):
        raise InputError(f"--up {up}: must be one of x -x y -y z -z")
    cameras = folder / CAMERAS
    rig = read_rig(cameras) if cameras.is_file() else up
    return write_report(folder, people, rig, fps=fps, body=body, every=every)


def th(number: int) -> str:
    """An ordinal."""
    return {2: "second", 3: "third"}.get(number, f"{number}th")


def _body(people: Reconstruction, given: Path | None) -> tuple[SmplArrays | None, list[str]]:
    """The body model of a result; None, and a remark, where its file is not there any more."""
    try:
        return body_of(people.run, given), []
    except InputError as error:
        if given is not None:
            raise
        return None, [f"no bodies and heights: {error}"]


def _timed(people: Reconstruction) -> bool:
    """Whether a result says when its frames were taken: by two times, or by a time and the rate."""
    times = np.unique(people.time_s[np.isfinite(people.time_s)])
    rate = people.run.get("time", {}).get("fps")
    return len(times) > 1 or (len(times) == 1 and rate is not None and rate > 0)


def _standing(people: Reconstruction) -> Axis:
    """The axis along which people stand: from their feet to their heads, mostly."""
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
