"""The report on a set-up as one value, in words and figures, for run.json and the terminal.

`check_setup` needs cameras and detections; `result_check` adds results of a reconstruction.
"""

import time
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass, field
from itertools import combinations
from typing import Any

import numpy as np
from numpy.typing import NDArray

from shapepose_fg.cameras.check.diagnosis import Diagnosis, diagnose
from shapepose_fg.cameras.check.evidence import SetupHypothesis
from shapepose_fg.cameras.check.findings import Finding, Kind, sentence
from shapepose_fg.cameras.resection import match
from shapepose_fg.cameras.sightings import GATE, miss_px, size_of
from shapepose_fg.cameras.stature import ADULT_M, Build
from shapepose_fg.cameras.triangulation import left_out
from shapepose_fg.core.arrays import Array, Whole
from shapepose_fg.core.camera import Rig, Views
from shapepose_fg.core.detections import DetectionSequence
from shapepose_fg.core.observation_table import Gate, ObservationTable
from shapepose_fg.core.reconstruction import Reconstruction, Status
from shapepose_fg.core.run_summary import has_identities
from shapepose_fg.core.trust import BELIEVED, Spell, Trust, trust_in


@dataclass(frozen=True)
class CameraFigures:
    """Fit of one camera to the others. Lengths are at the joints' depth."""

    camera: str
    """Name of the camera."""
    people: int
    """Number of people seen in the frames used."""
    matched: float
    """Share of the camera's people whom another camera sees, too."""
    median_px: float | None
    """Median reprojection error of all matched joints, pixels."""
    high_px: float | None
    """90 % quantile of the reprojection error, pixels."""
    median_mm: float | None
    """Median reprojection error as a length, millimetres."""
    high_mm: float | None
    """90 % quantile of the reprojection error as a length, millimetres."""
    left_out_px: float | None
    """Median distance from joints triangulated by the other cameras only, pixels."""
    left_out_mm: float | None
    """Median distance from where the other cameras place the joints, millimetres."""
    left_out_matched: float
    """Share of the possible matches with people of the others that the camera has."""
    late_frames: int
    """Delay against the others, frames; negative: early."""


@dataclass(frozen=True)
class PairFigures:
    """Fit of two cameras to each other."""

    first: str
    second: str
    """Names of the two cameras."""
    matched: float | None
    """Share of the possible common people that fit; None if they never see people at once."""
    miss_px: float | None
    """Median distance between the rays to a joint, pixels of the first camera's picture."""


@dataclass(frozen=True)
class SetupReport:
    """Findings on a set-up, and the fit of its cameras."""

    findings: tuple[Finding, ...]
    """Findings, gross mistakes first; empty if nothing is wrong."""
    warnings: tuple[str, ...]
    """The findings as sentences."""
    cameras: tuple[CameraFigures, ...]
    """Figures of each camera, for the set-up as given."""
    pairs: tuple[PairFigures, ...]
    """Figures of each pair of cameras."""
    frames: int
    """Number of frames used."""
    stature_m: float | None
    """Median stature of the people, metres; None without people."""
    trust: Trust = BELIEVED
    """Cameras that `reconstruct` should exclude or doubt."""
    notes: tuple[str, ...] = ()
    """Observations that are not necessarily mistakes: people with biased detections in one view, or
    of small stature."""
    seconds: float = 0.0
    """Time that the check took, s."""

    def with_consequences(self, rig: Rig) -> list[str]:
        """The warnings, with their consequences for a reconstruction."""
        out = {view for view, _, _ in self.trust.left_out}
        words = [
            f"{warning}. It is left out of these frames (--no-check keeps it)"
            if out & set(found.cameras)
            else warning
            for found, warning in zip(self.findings, self.warnings, strict=True)
        ]
        if len(self.trust.doubted) > 0:
            names = ", ".join(
                rig.names[view] for view in sorted({view for view, _, _ in self.trust.doubted})
            )
            words.append(
                f"it is unknown which of {names} is wrong: rows that depend on them have the status"
                f" {str(Status.CONTRADICTED)!r} instead of 'ok'"
            )
        return words

    def as_dict(self) -> dict[str, Any]:
        """Content of `setup` in run.json."""
        names = [each.camera for each in self.cameras]
        return {
            "findings": [
                {
                    "kind": str(each.kind),
                    "cameras": [names[view] for view in each.cameras],
                    "says": words,
                }
                for each, words in zip(self.findings, self.warnings, strict=True)
            ],
            "notes": list(self.notes),
            "cameras": [rounded(asdict(each)) for each in self.cameras],
            "pairs": [rounded(asdict(each)) for each in self.pairs],
            "left_out": _spells(self.trust.left_out, names),
            "doubted": _spells(self.trust.doubted, names),
            "frames_looked_at": self.frames,
            "stature_m": None if self.stature_m is None else round(self.stature_m, 4),
        }


def check_setup(
    detections: DetectionSequence,
    rig: Rig,
    frames: range | None = None,
    more: tuple[Finding, ...] = (),
) -> SetupReport:
    """Check whether cameras and detections of a recording are consistent, and diagnose the mistake
    if not.

    Uses frames spread over `frames` (by default all), a few if nothing in them is odd, and needs no
    reconstruction; takes about a second. `more` are findings from elsewhere.
    """
    start = time.perf_counter()
    diagnosis = diagnose(detections, rig, frames)
    findings, build = (*diagnosis.findings, *more), diagnosis.build
    return SetupReport(
        findings,
        tuple(sentence(finding, rig) for finding in findings),
        _camera_figures(diagnosis, rig),
        tuple(
            _pair_figures(diagnosis.setup, rig, *pair) for pair in combinations(range(len(rig)), 2)
        ),
        len(diagnosis.setup.evidence.anchors),
        build.stature if build is not None and build.count > 0 else None,
        diagnosis.trust,
        (*(sentence(finding, rig) for finding in diagnosis.biased), *_children(build)),
        time.perf_counter() - start,
    )


def _children(build: Build | None) -> list[str]:
    """A note for people as tall as children, on the scale of the rig."""
    if build is None or not build.are_children:
        return []
    lengths = (
        f"lengths in the calibration are about {build.stature / ADULT_M:.1f} times what they "
        "should be"
    )
    return [
        f"the stature of people is {build.stature:.2f} m, as of children; if they are adults, "
        f"{lengths}: check the size of the board's squares"
    ]


def _spells(spells: Sequence[Spell], names: Sequence[str]) -> list[dict[str, Any]]:
    return [{"camera": names[view], "frames": [first, last]} for view, first, last in spells]


def _camera_figures(diagnosis: Diagnosis, rig: Rig) -> tuple[CameraFigures, ...]:
    """Figures of every camera."""
    setup = diagnosis.setup
    groups, structure = setup.structure(steps=5)
    px = structure.miss_px
    mm = 1e3 * px * structure.depth / setup.views.focal_px
    seen = np.bincount(setup.sightings.view, minlength=len(rig))
    remaining = [lag.frames if lag.is_offset else 0 for lag in diagnosis.lags] or [0] * len(rig)
    late = diagnosis.corrected.lag + remaining  # corrected and remaining offset
    found = []
    for view, name in enumerate(rig.names):
        others, own, camera = setup.others(view), setup.seen_by(view), setup.camera(view)
        matched = match(others, own, camera)
        points = others.points[matched.person]
        at, depth = camera.project(points)
        out_px = miss_px(at, depth, own.xy[matched.sighting])
        figures = CameraFigures(
            camera=name,
            people=int(seen[view]),
            matched=float((groups.member[:, view] >= 0).sum() / max(seen[view], 1)),
            median_px=quantile(px[..., view], 0.5),
            high_px=quantile(px[..., view], 0.9),
            median_mm=quantile(mm[..., view], 0.5),
            high_mm=quantile(mm[..., view], 0.9),
            left_out_px=quantile(out_px, 0.5),
            left_out_mm=quantile(1e3 * out_px * depth / setup.views.focal_px[view], 0.5),
            left_out_matched=float(len(matched.person) / max(matched.possible, 1)),
            late_frames=int(late[view]),
        )
        found.append(figures)
    return tuple(found)


def _pair_figures(setup: SetupHypothesis, rig: Rig, first: int, second: int) -> PairFigures:
    names = rig.names[first], rig.names[second]
    groups, possible = setup.pair(first, second)
    if possible == 0:
        return PairFigures(*names, None, None)
    miss = groups.error * setup.sightings.size_px[groups.member[:, first]]
    return PairFigures(
        *names, float((groups.error < GATE / 2).sum() / possible), quantile(miss, 0.5)
    )


def quantile(values: Array, part: float) -> float | None:
    """Return a quantile of the finite values; None without any."""
    values = values[np.isfinite(values)]
    return float(np.quantile(values, part)) if len(values) > 0 else None


def rounded(value: Any) -> Any:
    """The value with all floats inside rounded to four digits, for run.json."""
    if isinstance(value, dict):
        return {key: rounded(each) for key, each in value.items()}
    return float(f"{value:.4g}") if isinstance(value, float) else value


_MOST_SAMPLES = 200
"""Number of frames in which unused detections are counted, and of rows whose distances from the
other cameras are measured, spread over the recording."""
_REASONS = {
    Gate.TOO_FAR: "are too far from the joint",
    Gate.CONTRADICTS_BODY: "contradict the body",
    Gate.BEHIND_CAMERA: "are of joints behind the camera",
    Gate.NOT_PLACED: "are of joints without a position",
}
"""Reasons why assigned detections were not used."""


@dataclass(frozen=True)
class Distances:
    """Summary of reprojection distances, in the picture and at the joint's depth."""

    count: int
    """Number of distances."""
    median_px: float | None
    high_px: float | None
    """Median and 90 % quantile, pixels; None without any."""
    median_mm: float | None
    high_mm: float | None
    """Median and 90 % quantile as lengths, millimetres."""

    @classmethod
    def of(cls, px: Array, mm: Array) -> "Distances":
        """Summarise all finite distances `px` and `mm`, arrays of one shape."""
        finite = np.isfinite(px) & np.isfinite(mm)
        return cls(
            int(finite.sum()),
            *(quantile(each[finite], part) for each in (px, mm) for part in (0.5, 0.9)),
        )


@dataclass(frozen=True)
class CameraUse:
    """Use of one camera's detections."""

    camera: str
    """Name of the camera."""
    offered: int
    """Number of joint detections in the reconstructed frames."""
    used: int
    """Number of detections used in the solution."""
    given: Distances
    """Distances of all assigned detections from the solved joint, before gating."""
    after_gates: Distances
    """Distances of the used detections."""
    left_out: Distances
    """Distances of all assigned detections from the joint triangulated by the other
    cameras only."""
    unused: dict[str, int] = field(default_factory=dict)
    """Number of unused detections by reason: excluded camera, unassigned, or a gate."""


@dataclass(frozen=True)
class ResultCheck:
    """The check of a set-up with the results of a reconstruction."""

    report: SetupReport
    """The check of cameras and detections only."""
    cameras: tuple[CameraUse, ...]
    """Use of each camera's detections."""
    warnings: tuple[str, ...]
    """All warnings as sentences."""

    def as_run(self) -> dict[str, Any]:
        """Content of `setup` and `cameras` in run.json."""
        return {
            "setup": {**self.report.as_dict(), "warnings": list(self.warnings)},
            "cameras": [rounded(asdict(each)) for each in self.cameras],
        }


def result_check(
    report: SetupReport,
    people: Reconstruction,
    detections: DetectionSequence,
    rig: Rig,
    frames: Sequence[int],
) -> ResultCheck:
    """Add the results of a reconstruction to the check of a set-up.

    `people` are the rows of all `frames`; detections of other frames are ignored.
    """
    uses = tuple(camera_use(people, detections, rig, frames))
    warnings = report.with_consequences(rig)
    if len(people) == 0 and Kind.NOBODY not in {finding.kind for finding in report.findings}:
        warnings.append(
            "No people were found; see the findings of the set-up check"
            if warnings
            else (
                "No people were found; check with check-calibration whether cameras and "
                "detections fit"
            )
        )
    warnings += _speeds(people)
    chance = [*_too_many(people), *_clutter(uses)][:1]
    if Kind.JOINT_ORDER not in {finding.kind for finding in report.findings}:
        # With a wrong order of joints, most detections fit no person.
        warnings += chance or _mostly_unused(uses, people, detections, rig, frames)
    return ResultCheck(report, uses, tuple(warnings))


def camera_use(
    people: Reconstruction, detections: DetectionSequence, rig: Rig, frames: Sequence[int]
) -> list[CameraUse]:
    """Use of each camera's detections; empty if the result has no observations."""
    table = people.observations
    if table is None:
        return []
    trust = trust_in(detections)
    offered, excluded = (np.zeros(len(rig), dtype=np.int64) for _ in range(2))
    for frame in frames:
        count = np.bincount(detections[frame].view, minlength=len(rig))
        offered += count
        excluded[list(trust.excluded(frame))] += count[list(trust.excluded(frame))]
    depth = np.moveaxis(rig.project(people.joints)[1], 0, 2)
    px = np.linalg.norm(table.residual_px.astype(np.float64), axis=-1)
    mm = 1e3 * px * depth / rig.focal_px
    used = table.gate == Gate.USED
    out_px, out_mm = _left_out(table, rig)
    return [
        CameraUse(
            name,
            int(offered[view]),
            int(used[..., view].sum()),
            Distances.of(px[..., view], mm[..., view]),
            Distances.of(px[..., view][used[..., view]], mm[..., view][used[..., view]]),
            Distances.of(out_px[..., view], out_mm[..., view]),
            _reasons(table.gate[..., view], int(offered[view]), int(excluded[view])),
        )
        for view, name in enumerate(rig.names)
    ]


LEFT_OUT, NOBODY = "are left out with the camera", "are not assigned to any person"
"""Reasons why detections were not assigned."""


def _reasons(gate: NDArray[np.uint8], offered: int, excluded: int) -> dict[str, int]:
    """Numbers of a camera's unused detections by reason, without zeros."""
    given = int((gate != Gate.NOT_SEEN).sum())
    counts = {LEFT_OUT: excluded, NOBODY: max(offered - given - excluded, 0)}
    counts |= {words: int((gate == each).sum()) for each, words in _REASONS.items()}
    return {words: count for words, count in counts.items() if count > 0}


def _left_out(table: ObservationTable, rig: Rig) -> tuple[Array, Array]:
    """(R, J, V) distances of detections from joints triangulated by two or more others, px and mm;
    R sampled rows.
    """
    rows = np.unique(np.linspace(0, len(table) - 1, min(len(table), _MOST_SAMPLES)).astype(np.intp))
    xy, gate = table.xy[rows].astype(np.float64), table.gate[rows]
    weight, size = table.confidence[rows].astype(np.float64), size_of(np.moveaxis(xy, 2, 1))
    px, depth = left_out(xy, weight, size, Views.of(rig), gate == Gate.USED)
    return px, 1e3 * px * depth / rig.focal_px


def _speeds(people: Reconstruction) -> Iterator[str]:
    """Warning on implausible speeds of people, if rows have identities."""
    if not has_identities(people.run):
        return
    hips = [
        place
        for place, name in enumerate(people.joint_names.tolist())
        if name in ("RHip", "LHip", "MidHip")
    ]
    order = np.lexsort((people.frame, people.person))
    x, t = people.joints[order][:, hips].mean(axis=1), people.time_s[order]
    follows = (np.diff(people.person[order]) == 0) & (np.diff(t) > 0)
    with np.errstate(divide="ignore", invalid="ignore"):
        speed = np.linalg.norm(np.diff(x, axis=0), axis=1)[follows] / np.diff(t)[follows]
    speed = np.sort(speed[np.isfinite(speed)])
    # Minimum number of steps for a speed; and the speed of sprinters, m/s.
    fast = float(np.median(speed[-max(len(speed) // 10, 1) :])) if len(speed) >= 20 else 0.0
    if fast >= 10.0:
        rate = 1 / float(np.median(np.diff(t)[follows] / np.diff(people.frame[order])[follows]))
        yield (
            f"people move at {fast:.0f} m/s, which is implausible: --fps is probably wrong "
            f"({rate:.0f} Hz; usual cameras have 25 to 60), or frames are missing, or the "
            "calibration's unit is wrong"
        )


def _too_many(people: Reconstruction) -> Iterator[str]:
    """Warning on frames with more detections than people could explain."""
    frames = sum(
        last - first for first, last in people.run.get("thinned_frames", {}).get("detections", [])
    )
    if frames > 0:
        yield (
            f"{frames} frames have more detections than people could cause: identities are "
            f"arbitrary there, and rows have the status {str(Status.CONTRADICTED)!r}; use a "
            "higher confidence threshold in the detector"
        )


def _clutter(uses: Sequence[CameraUse]) -> Iterator[str]:
    """Warning if people explain hardly any detections."""
    offered, used = (sum(getattr(use, name) for use in uses) for name in ("offered", "used"))
    # Minimum share of detections that people explain; on Shelf, with false candidates included, it
    # is most.
    if 0 < used < 0.1 * offered:
        yield (
            f"people explain only {100 * used / offered:.1f} % of the detections: identities may "
            "be arbitrary; use a higher confidence threshold in the detector"
        )


def _mostly_unused(
    uses: Sequence[CameraUse],
    people: Reconstruction,
    detections: DetectionSequence,
    rig: Rig,
    frames: Sequence[int],
) -> list[str]:
    """Warnings on cameras with mostly unused detections, and on people that were not found."""
    # Share of used detections below which a camera is reported, and minimum number of detections.
    hardly_used = [use for use in uses if use.offered >= 50 and use.used < 0.5 * use.offered]
    repeated = _repeated(people, detections, rig, frames) if hardly_used else np.zeros(len(rig))
    again = [use for use in hardly_used if repeated[rig.names.index(use.camera)] > 0.5]
    warnings = list(_unused([use for use in hardly_used if use not in again]))
    if again:
        warnings.append(
            f"{' '.join(use.camera for use in again)}: the detector finds people more than once: "
            "most of the unused detections are beside a used one of the same joint; use "
            "non-maximum suppression in the detector"
        )
    return warnings if len(again) > 1 else [*warnings, *_unseen(people, detections, rig, frames)]


def _repeated(
    people: Reconstruction, detections: DetectionSequence, rig: Rig, frames: Sequence[int]
) -> Array:
    """(V,) share of the unassigned detections that are beside an assigned one of the same joint."""
    table = people.observations
    rest, beside = np.zeros((2, len(rig)))
    if table is None:
        return beside
    order = np.argsort(people.frame, kind="stable")
    for at in np.unique(
        np.linspace(0, len(frames) - 1, min(len(frames), _MOST_SAMPLES)).astype(int)
    ):
        found = detections[frames[at]]
        span = np.searchsorted(people.frame[order], [frames[at], frames[at] + 1])
        rows = order[slice(*span)]
        depth = np.moveaxis(rig.project(people.joints[rows])[1], 0, 2)
        # Two people's same joints are hardly ever nearer than 10 cm in a picture.
        reach_px = 0.1 * rig.focal_px / depth
        xy = table.xy[rows].astype(np.float64)[:, found.joint, found.view]
        far_px = np.linalg.norm(xy - found.xy, axis=-1)  # NaN where no detection is assigned
        near = (far_px < reach_px[:, found.joint, found.view]).any(axis=0)
        given = (table.candidate[rows] >= 0).sum(axis=(0, 1))  # an assigned one is beside itself
        rest += np.bincount(found.view, minlength=len(rig)) - given
        beside += np.maximum(np.bincount(found.view[near], minlength=len(rig)) - given, 0)
    return beside / np.maximum(rest, 1)


def _singular(reason: str) -> str:
    """A reason of `CameraUse.unused` for one detection."""
    verb, rest = reason.split(" ", 1)
    return f"{'is' if verb == 'are' else f'{verb}s'} {rest}"


def _unused(uses: Sequence[CameraUse]) -> Iterator[str]:
    """Warnings on cameras with mostly unused detections, with reasons."""
    for use in uses:
        why = [
            f"{count} {_singular(words) if count == 1 else words}"
            for words, count in sorted(use.unused.items(), key=lambda each: -each[1])
        ]
        cure = (
            (
                "; either other cameras do not see these people, or this camera does not fit: run "
                "check-calibration"
            )
            if use.unused.get(NOBODY, 0) > use.offered / 2
            else ""
        )
        yield (
            f"{use.camera}: {use.used} of {use.offered} detections were used: "
            f"{', '.join(why)}{cure}"
        )


def _unseen(
    people: Reconstruction, detections: DetectionSequence, rig: Rig, frames: Sequence[int]
) -> list[str]:
    """`unseen` for a result with people."""
    if len(people) == 0 or len(frames) == 0:
        return []
    fps = people.run.get("time", {}).get("fps")
    alone = not has_identities(people.run)
    rows = np.searchsorted(frames, people.frame[np.isin(people.frame, frames)])
    per_frame = np.bincount(rows, minlength=len(frames))
    return unseen(
        detections, rig.names, frames, per_frame, None if alone or not fps else len(frames) / fps
    )


def unseen(
    detections: DetectionSequence,
    names: Sequence[str],
    frames: Sequence[int],
    per_frame: Whole,
    lasts_s: float | None,
) -> list[str]:
    """A warning if two cameras see more people than there are rows per frame, `per_frame` (F,),
    with the reason.

    A camera's number of people is the median number of detections per core joint. `lasts_s` is the
    duration of the recording, None for isolated frames.
    """
    core = list(detections.skeleton.core)
    looked_at = np.unique(
        np.linspace(0, len(frames) - 1, min(len(frames), _MOST_SAMPLES)).astype(int)
    )
    seen = np.zeros((len(looked_at), len(names)))
    for row, frame in enumerate(looked_at.tolist()):
        found = detections[frames[frame]]
        for view in range(len(names)):
            joints = np.bincount(found.joint[found.view == view], minlength=max(core) + 1)
            seen[row, view] = np.median(joints[core])
    by_two, mean_rows = (
        float(np.sort(seen, axis=1)[:, -2].mean()),
        float(per_frame[looked_at].mean()),
    )
    # Minimum number of missing people per frame, and minimum share of them, for a warning.
    if by_two - mean_rows < max(0.5, 0.1 * by_two):
        return []
    why = "the others are seen too little, or the cameras do not agree on them"
    # Duration, s, below which people seen by two cameras may lack evidence.
    if lasts_s is not None and lasts_s < 1.0:
        why = (
            f"{lasts_s:.2g} s are too short to confirm all people; give more frames, or "
            "--no-temporal"
        )
    two: list[int] = sorted(np.argsort(-np.asarray(seen.mean(axis=0)), kind="stable")[:2].tolist())
    most = " and ".join(names[view] for view in two)
    return [
        (
            f"two cameras see {by_two:.1f} people per frame, but {mean_rows:.1f} are found: {why} "
            f"({most} see most)"
        )
    ]
