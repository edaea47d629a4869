"""The check of a set-up as one value: what is wrong in words, and the figures; for run.json and the terminal."""

from dataclasses import dataclass
from typing import Any

from shapepose_fg.core.camera import Rig
from shapepose_fg.core.detections import DetectionSequence
from shapepose_fg.setup_check.diagnosis import Diagnosis, Finding, diagnose
from shapepose_fg.setup_check.figures import CameraFigures, PairFigures, camera_figures, pair_figures, plain
from shapepose_fg.setup_check.words import sentence


@dataclass(frozen=True)
class SetupReport:
    """What is wrong with a set-up, and how its cameras fit."""

    findings: tuple[Finding, ...]
    """One after the other, gross mistakes first; none where nothing is wrong."""
    warnings: tuple[str, ...]
    """The same in words, a sentence each."""
    cameras: tuple[CameraFigures, ...]
    """By camera, as the set-up was given."""
    pairs: tuple[PairFigures, ...]
    """By pair of cameras."""
    frames: int
    """Frames that were looked at."""
    stature_m: float | None
    """How tall the people come out, median; None where nobody does."""

    def as_dict(self) -> dict[str, Any]:
        """What run.json holds under `setup`."""
        findings = [
            {
                "kind": str(each.kind),
                "cameras": [self.cameras[view].camera for view in each.cameras],
                "says": words,
            }
            for each, words in zip(self.findings, self.warnings, strict=True)
        ]
        return {
            "findings": findings,
            "cameras": plain(self.cameras),
            "pairs": plain(self.pairs),
            "frames_looked_at": self.frames,
            "stature_m": None if self.stature_m is None else round(self.stature_m, 4),
        }


def check_setup(detections: DetectionSequence, rig: Rig, frames: range | None = None) -> SetupReport:
    """Whether cameras and detections of a recording fit each other, and what it looks like where they do not.

    Looks at frames spread over `frames` (all by default) and needs no reconstruction; takes about a second.
    """
    return report_of(diagnose(detections, rig, frames), rig)


def report_of(diagnosis: Diagnosis, rig: Rig, more: tuple[Finding, ...] = ()) -> SetupReport:
    """A diagnosis as it is said, with findings that others made."""
    findings = (*diagnosis.findings, *more)
    build = diagnosis.build
    return SetupReport(
        findings,
        tuple(sentence(finding, rig) for finding in findings),
        camera_figures(diagnosis, rig),
        pair_figures(diagnosis.look, rig.names),
        len(diagnosis.look.evidence.anchors),
        build.stature if build is not None and build.count > 0 else None,
    )
