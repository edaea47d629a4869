"""Explanation of a joint's estimate, as data and in words."""

from dataclasses import asdict, dataclass
from enum import StrEnum
from typing import Any

from shapepose_fg.core.observation_table import Gate

GATES = {gate: gate.name.lower().replace("_", " ") for gate in Gate}
"""Names of gates in explanations."""


class Cause(StrEnum):
    """Kinds of problems of a joint, most serious first."""

    NOT_SOLVED = "not solved"
    """The solver found no position for the joint."""
    WRONG_CAMERA = "wrong camera"
    """All detections of a camera are displaced: its pose, lens or clock is wrong."""
    FOREIGN = "foreign detection"
    """A detection belongs to another person, or to the other side of the body."""
    CONTRADICTION = "contradiction"
    """Several views, or a view and the body, contradict each other."""
    GATED = "gated view"
    """One detection contradicts all others, and belongs to no other person."""
    PRIOR_ONLY = "prior only"
    """No view's detection was used."""
    ONE_VIEW = "one view"
    """One view's detection was used, which does not determine depth."""


@dataclass(frozen=True)
class Finding:
    """One problem of a joint."""

    cause: Cause
    """The kind of problem."""
    cameras: tuple[str, ...]
    """Cameras with the problem; empty if it concerns none."""
    words: str
    """A description in a sentence or two."""


@dataclass(frozen=True)
class ViewReason:
    """The contribution of one camera to a joint."""

    camera: str
    """Name of the camera."""
    gate: str
    """Whether the camera's detection was used, and the reason if not: a name of `Gate`."""
    detection_px: tuple[float, float] | None
    """The detection, undistorted pixels; None where there is none."""
    score: float
    """Confidence of the detector, 0 to 1."""
    probability: float
    """Probability that the detection is this person's, from the assignment."""
    sigma_px: float | None
    """Standard deviation of a detection with this score per axis, pixels."""
    residual_px: tuple[float, float] | None
    """The projection of the joint as reported minus the detection, pixels."""
    off_px: float | None
    """Distance of the detection from the prediction by all *else*, excluding this detection,
    pixels."""
    off_sigma: float | None
    """The distance `off_px` in standard deviations of the detection and the prediction together."""
    share: float
    """Share of the information about the joint that this view gives, 0 to 1."""
    looks_like: str = ""
    """The joint that the detection more likely belongs to, as `person 3's RWrist`;
    empty if none."""


@dataclass(frozen=True)
class FactorReason:
    """The contribution of the user's factors to a joint."""

    name: str
    """Name of the function that made the factors."""
    others: tuple[str, ...]
    """Joints to which the factors connect this joint, as `person 3's RWrist`; empty for factors on
    this joint only."""
    share: float
    """Share of the user's factors in the information about the joint, 0 to 1."""


@dataclass(frozen=True)
class Explanation:
    """Explanation of a joint's estimate."""

    person: int
    joint: str
    frame: int
    time_s: float | None
    position_m: tuple[float, float, float] | None
    """Position as reported, in the world, m; None where unknown."""
    sigma_m: float | None
    """Standard deviation as reported, m: root mean square over the axes; None where unknown."""
    known: str
    """How the joint is known: a name of `Known`."""
    status: str
    """Status of the row."""
    views: tuple[ViewReason, ...]
    """Contributions of the cameras."""
    body_share: float
    """Share of the information about the joint from the body, excluding the joint's own views, 0 to
    1."""
    motion_share: float
    """Share of the information about the joint that comes from other frames, 0 to 1."""
    findings: tuple[Finding, ...]
    """Problems, most serious first; empty if there are none."""
    factors: tuple[FactorReason, ...] = ()
    """Contributions of your own factors to the joint in this frame, one entry for those of one
    function that connect it to the same joints. Their contributions in other frames are in
    `motion_share`."""
    missing_factors: tuple[str, ...] = ()
    """Functions of user factors with which the result was solved, but which were not given for the
    explanation; the shares exclude their factors."""

    def as_dict(self) -> dict[str, Any]:
        """Plain values, as printed by `shapepose-fg explain --json`."""
        return asdict(self)

    @property
    def words(self) -> tuple[str, ...]:
        """The explanation in sentences: position, problems, and contributions."""
        when = f"frame {self.frame}" + (
            f" ({self.time_s:.3f} s)" if self.time_s is not None else ""
        )
        joint = f"{self.joint} of person {self.person} in {when}"
        if self.position_m is None or self.sigma_m is None:
            where = f"{joint} has no position."
        else:
            x, y, z = self.position_m
            where = (
                f"{joint} is at ({x:.3f}, {y:.3f}, {z:.3f}) m, within {1e3 * self.sigma_m:.0f} mm "
                "(one sigma)."
            )
        used = [view for view in self.views if view.gate == GATES[Gate.USED]]
        parts = [
            *(f"{view.camera} {view.share:.0%}" for view in used),
            *(f"{each.name}{_with(each.others)} {each.share:.0%}" for each in self.factors),
            f"the body {self.body_share:.0%}",
            f"motion from other frames {self.motion_share:.0%}",
        ]
        shares = f"Its position comes from: {', '.join(parts)}."
        if self.missing_factors:
            shares += (
                f" The shares do not include factors of {', '.join(self.missing_factors)}, with "
                "which the result was solved: in Python, pass them to `explain(..., "
                "extra_factors=...)`."
            )
        matter = [finding.words for finding in self.findings]
        good = f"{len(used)} cameras agree on it, and nothing contradicts them."
        return (where, *(matter or [good]), *([shares] if self.position_m is not None else []))


def _with(others: tuple[str, ...]) -> str:
    return f" (with {', '.join(others)})" if others else ""
