"""The summary that `shapepose-fg reconstruct` prints at its end: people, quality, and problems."""

from typing import Any

import numpy as np
from rich.table import Table

from shapepose_fg.cameras.check.diagnosis import detected_sizes, other_sizes
from shapepose_fg.cameras.check.report import ResultCheck, SetupReport, unseen
from shapepose_fg.cameras.check.report import check_setup as check_detections
from shapepose_fg.cli.reconstruct.request import Prepared
from shapepose_fg.cli.setup_table import use_table
from shapepose_fg.cli.terminal import note, show, warn
from shapepose_fg.core.compiling import compiled_for_s
from shapepose_fg.core.errors import InputError
from shapepose_fg.core.frame_times import rate_words
from shapepose_fg.core.reconstruction import Reconstruction
from shapepose_fg.io.footage.placement import FOOTAGE
from shapepose_fg.pipeline.pipeline import Task
from shapepose_fg.pipeline.runs.assembly import Assembly

_SURE = 0.9
"""People with a probability below this are listed."""
_KNOWN_WORDS = {
    "seen": "seen by two views",
    "weak": "seen by one view or weakly",
    "body": "inferred from the body",
    "motion": "inferred from motion",
    "unknown": "unknown",
}


def check_setup(known: Prepared, task: Task) -> SetupReport:
    """Check whether cameras, detections and (for a project) videos are consistent."""
    frames, sizes = task.whole()[0], ()
    used = known.detections / FOOTAGE
    if used.is_file():
        sizes = detected_sizes(used, task.rig)
    elif known.project is not None:
        videos = known.project.folder / "videos"
        try:
            sizes = other_sizes([str(videos)], task.rig) if videos.is_dir() else ()
        except InputError as error:  # the result does not depend on the videos
            note(f"{error}; their sizes are not checked")
    return check_detections(task.detections, task.rig, frames, sizes)


def summary_table(
    result: Assembly, people: Reconstruction, task: Task, seconds: float, *, unchecked: bool
) -> Table:
    """Summary of a reconstruction: people, quality, and times.

    `people` are rows of the `result` of `task`, with covariances of joints. If the set-up was
    `unchecked`, the summary also states whether cameras see people who were not reconstructed.
    """
    run, counts, span, cameras = result.run, result.counts(), task.whole()[0], len(task.rig)
    per_frame = np.bincount(result.columns()["frame"].array() - span.start, minlength=len(span))
    table = Table(show_header=False, box=None, padding=(0, 2, 0, 0))
    table.add_column(style="bold", min_width=len("written"))  # the line after the table
    table.add_column(overflow="fold")
    table.add_row(
        "frames", f"{len(span)} ({span.start}:{span.stop}) of {cameras} cameras{rate_words(run)}"
    )
    over_time = run.get("configuration", {}).get("temporal", False)
    for each in run.get("trajectories", []):
        corrected = (
            f"corrected by up to {each['moved_mm']:.0f} mm and {each['turned_deg']:.1f} degrees"
        )
        known = f"sigma {each['sigma_mm']:.0f} mm and {each['sigma_deg']:.1f} degrees"
        words = (
            f"{each['way_m']:.1f} m; {corrected}; {known}"
            if each["refined"]
            else f"{each['way_m']:.1f} m, as given"
        )
        table.add_row("moving", f"{' '.join(each['cameras'])}: {words}")
    known = len(result.parts_of)
    count = f"{known} {'person' if known == 1 else 'people'} over time"
    count = count if over_time else "without identities"
    table.add_row(
        "people",
        f"{count}, {per_frame.mean():.1f} a frame ({per_frame.min()} to {per_frame.max()})",
    )
    table.add_row("rows", f"{len(result)} in all")
    for status, count in sorted(counts["status"].items()):
        table.add_row("", f"{count} {status}", style="green" if status == "ok" else "yellow")
    if len(doubtful := _doubtful(run)) > 0:
        table.add_row("", doubtful, style="yellow")
    lost = [
        (
            f"{count} rows dropped: "
            f"{reason}{_frames_words(run.get('dropped_frames', {}).get(reason, []))}"
        )
        for reason, count in run.get("people", {}).get("dropped", {}).items()
    ]
    if unchecked:  # otherwise the check reports it
        lasts = (
            float(np.ptp(task.whole()[1].frame_s[span.start : span.stop]))
            * len(span)
            / max(len(span) - 1, 1)
        )
        lost += unseen(
            task.detections,
            task.rig.names,
            span,
            per_frame,
            lasts if task.config.temporal else None,
        )
    if len(lost) > 0:
        table.add_row("lost", "; ".join(lost), style="yellow")
    for what, spans in run.get("thinned_frames", {}).items():
        table.add_row(
            "",
            f"too many {what}; those of highest confidence were used{_frames_words(spans)}",
            style="yellow",
        )
    for camera, spans in run.get("repeated_pictures", {}).items():
        words = f"{camera} repeats pictures; the repeated ones are left out{_frames_words(spans)}"
        table.add_row("", words, style="yellow")
    if len(people) > 0:
        table.add_row("joints", _joints(counts["joints"], people))
    # Loading the body and the set-up check are done once, and not part of the time per frame.
    once, spent = ("load", "set-up check"), run.get("seconds", {})
    ms = sum(1e3 * each / len(span) for name, each in spent.items() if name not in once)
    words = f"{seconds:.1f} s in all"
    if (compiled_s := compiled_for_s()) > 1:
        words += f", {compiled_s:.0f} s of it to compile, only at the first run"
    else:
        words = f"{ms:.1f} ms a frame, {words}"
    table.add_row("time", words)
    return table


def _doubtful(run: dict[str, Any]) -> str:
    """People with a probability below `_SURE`; without identities, their number of rows; empty if
    there are none.
    """
    probabilities = run.get("probability", [])
    if isinstance(probabilities, dict):
        count = sum(rows for tenth, rows in probabilities.items() if float(tenth) < _SURE)
        return f"{count} have a probability below {_SURE}" if count > 0 else ""
    unlikely = [
        f"{each['person']} ({each['probability']:.2f})"
        for each in probabilities
        if each["probability"] < _SURE
    ]
    return (
        f"probability below {_SURE}: person {', '.join(unlikely[:8])}{' ...' * (len(unlikely) > 8)}"
        if unlikely
        else ""
    )


def _frames_words(spans: list[list[int]]) -> str:
    """The frames in words, shortened to fit; run.json has all."""
    words = [
        f"{start}" if stop == start + 1 else f"{start}-{stop - 1}" for start, stop in spans[:4]
    ]
    return f" (frames {' '.join(words)}{' ...' * (len(spans) > 4)})" if words else ""


def _joints(count: dict[str, int], people: Reconstruction) -> str:
    """Shares of joints by how they are known, and standard deviations, in words."""
    total = max(sum(count.values()), 1)
    shares = [
        f"{100 * count[how] / total:.1f} % {word}"
        for how, word in _KNOWN_WORDS.items()
        if count[how] > 0
    ]
    variance = np.trace(people.covariance, axis1=-2, axis2=-1) / 3
    variance = variance[np.isfinite(variance) & (variance >= 0)]
    sigma = (
        f"; median sigma {1e3 * np.sqrt(np.median(variance)):.0f} mm" if len(variance) > 0 else ""
    )
    return ", ".join(shares) + sigma


def show_check(checked: ResultCheck) -> None:
    """Print the residuals of each camera against the result, and on stderr any problems."""
    if len(checked.cameras) > 0:
        print()
        show(use_table(checked.cameras))
    for each in checked.warnings:
        warn(each)
