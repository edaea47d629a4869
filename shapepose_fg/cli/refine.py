"""The command `refine-calibration`: refines cameras by the people of a recording."""

import tempfile
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, cast

from annotated_types import Interval

from shapepose_fg.cli.found_cameras import report_option, write_page
from shapepose_fg.cli.options import (
    REQUIRED,
    RESULT,
    ProjectOptions,
    RateOptions,
    Stature,
    check_output_files,
    grouped,
    json_option,
    next_reconstruct,
    option,
)
from shapepose_fg.cli.terminal import note, progress, show, show_json, table
from shapepose_fg.core.errors import InputError

if TYPE_CHECKING:
    from shapepose_fg.cameras.refine import Refinement

_CAMERAS = "Prior uncertainty"


@dataclass(frozen=True, kw_only=True)
class FreedomOptions:
    """Options: prior standard deviations of the cameras around the given calibration."""

    off_degrees: Annotated[float, Interval(gt=0, le=20)] = option(
        _CAMERAS, "Prior sigma of rotations, degrees.", 1.0
    )
    off_cm: Annotated[float, Interval(gt=0, le=200)] = option(
        _CAMERAS, "Prior sigma of positions, centimetres.", 2.0
    )
    focal: bool = option(_CAMERAS, "Refine focal lengths, too (prior sigma 2 %).", False, "--focal")
    centre: bool = option(
        _CAMERAS,
        "Refine principal points, too (prior sigma 10 pixels).",
        False,
        "--principal-point",
    )
    lens: bool = option(
        _CAMERAS, "Refine k1 k2 p1 p2, too (prior sigma 0.02).", False, "--distortion"
    )
    reference: str | None = option(
        _CAMERAS,
        "Camera whose pose is fixed; by default that of the rig as a whole.",
        metavar="CAMERA",
    )
    stature: Stature | None = option(
        _CAMERAS, "Mean stature of the people, metres; it then determines the scale."
    )


@grouped
def refine_calibration(
    given: ProjectOptions,
    rate: RateOptions,
    may: FreedomOptions,
    output: Path = option(
        RESULT, "File or folder for the refined cameras: in their own format, or .json.", REQUIRED
    ),
    report: Path | None = report_option(),
    as_json: bool = json_option(),
) -> None:
    """Refine camera poses, and lenses if requested, from the people in a recording.

    The refined rig is tested on held-out frames. If it does not fit them better, the given rig is
    written.
    """
    from shapepose_fg.cameras.bundle import Freedom
    from shapepose_fg.cameras.refine import refine
    from shapepose_fg.io.calibration import check_target, write_like

    seen = given.located()
    rate, source = seen.rate(rate), cast(Path, seen.calibration)
    rig = seen.still_rig("refine-calibration")
    check_target(source, output)
    check_output_files({"--report": report})
    if report is not None and report.resolve() == output.resolve():
        raise InputError(f"--output and --report {report}: this is one file; give two")
    if may.reference is not None and may.reference not in rig.names:
        raise InputError(
            f"--reference {may.reference}: there is no such camera; give one of "
            f"{' '.join(rig.names)}"
        )
    bent = [
        camera.name
        for camera in rig.cameras
        if camera.lens == "fisheye" or camera.distortion[4:].any()
    ]
    if may.lens and bent:
        raise InputError(
            f"camera {bent[0]}: only distortions of k1 k2 p1 p2 can be refined; leave out "
            "--distortion"
        )
    freedom = Freedom(
        may.off_degrees,
        may.off_cm / 100,
        0.02 if may.focal else 0.0,
        10.0 if may.centre else 0.0,
        0.02 if may.lens else 0.0,
    )
    with tempfile.TemporaryDirectory(prefix="shapepose-fg-") as folder:
        recording, times, span = rate.part(seen.detections, seen.joints, rig, Path(folder))
        reference = None if may.reference is None else rig.names.index(may.reference)
        with progress("refining", "rounds") as done:
            found = refine(recording, rig, times, span, freedom, reference, done)
    note(*found.notes)
    new = found.rig if may.stature is None else found.of_stature(may.stature)
    form, output = write_like(source, new, output, seen.unit)
    heads, rows = _figures(found, may)
    lines = _words(found, may)
    write_page(
        report,
        rig=new,
        before=found.given if found.better else None,
        points=found.adjusted.people.points,
        frame=found.adjusted.people.frame,
        time_s=times.frame_s,
        skeleton=recording.skeleton,
        heads=heads,
        rows=rows,
        missed_px=dict(zip(("before, px", "after, px"), found.missed_px, strict=True)),
        lines=lines,
        remarks=found.notes,
    )
    if as_json:
        show_json(found.as_dict())
    else:
        show(table(("camera", *heads), [(name, *each) for name, each in rows], caption=lines[0]))
        print("\n".join(lines[1:]))
        print(f"{output}: {form}")
        # Our own rig file defines axis, unit and picture sizes itself.
        options = {"--calibration": output} | seen.given()
        options |= {} if form == "rig file" else seen.calibration_options()
        print(
            next_reconstruct(
                options | rate.given() | ({} if seen.source else {"--output": "results"})
            )
        )


def _figures(
    found: "Refinement", may: FreedomOptions
) -> tuple[list[str], list[tuple[str, list[str]]]]:
    """Changes by camera: headings, and the values of each camera."""
    change, sigma = found.change(), found.sigma()
    parts = {"turn": "rotation, °", "move": "position, mm"} | (
        {"focal": "focal, %"} if may.focal else {}
    )
    parts |= {"centre": "centre, px"} if may.centre else {}
    rows = []
    for view, name in enumerate(found.given.names):
        digits = {part: 0 if part == "move" else 2 for part in parts}
        figures = [
            f"{change[part][view]:.{n}f} ± {sigma[part][view]:.{n}f}" for part, n in digits.items()
        ]
        rows.append((name, [str(found.counts[view]), *figures]))
    return ["people", *parts.values()], rows


def _words(found: "Refinement", may: FreedomOptions) -> list[str]:
    """The table's caption, and whether the refined cameras are better."""
    scale = (
        "the distances between the cameras are kept"
        if may.stature is None
        else f"from the mean stature, {may.stature:g} m"
    )
    stays = "the rig as a whole" if may.reference is None else f"camera {may.reference}"
    figures = f"{found.before_px:.1f} px before, {found.after_px:.1f} px after"
    why = "the error did not decrease"
    if found.after_px < found.before_px:
        why = (
            "a bias of the detector explains the errors as well"
            f" (probability of wrong cameras: {found.probability:.2f})"
        )
    return [
        f"±: one sigma, relative to {stays}; scale: {scale}",
        f"error of a joint against the other cameras, on frames that were not used: {figures}",
        *([f"the cameras were not changed: {why}"] if not found.better else []),
    ]
