"""What is said of a joint, and why it is where it is: as data, and in words."""

from dataclasses import asdict, dataclass
from enum import StrEnum
from typing import Any

from shapepose_fg.core.observation_table import Gate

GATES = {gate: gate.name.lower().replace("_", " ") for gate in Gate}
"""How gates are called."""


class Cause(StrEnum):
    """What is the matter with a joint, the gravest first."""

    NOT_SOLVED = "not solved"
    """The solver found no place for it."""
    WRONG_CAMERA = "wrong camera"
    """A camera that saw it is off with whatever it sees: its pose, its lens or its clock is wrong."""
    FOREIGN = "foreign detection"
    """A detection is another's, or of the other side of the body."""
    CONTRADICTION = "contradiction"
    """Several views, or a view and the body, put it at places that cannot all be true."""
    GATED = "gated view"
    """One detection lies where, by all others, the joint is not, and is nobody else's."""
    PRIOR_ONLY = "prior only"
    """No view's detection was used."""
    ONE_VIEW = "one view"
    """One view's detection was used, which tells no depth."""


@dataclass(frozen=True)
class Finding:
    """One thing that is the matter."""

    cause: Cause
    """What."""
    cameras: tuple[str, ...]
    """With which cameras; none where it is with no camera."""
    words: str
    """In a sentence or two."""


@dataclass(frozen=True)
class ViewReason:
    """What one camera has to do with a joint."""

    camera: str
    """Its name."""
    gate: str
    """Whether its detection was used, and why not: a name of `Gate`."""
    detection_px: tuple[float, float] | None
    """Where it is, undistorted pixels; None where there is none."""
    score: float
    """The detector's, 0 to 1."""
    probability: float
    """That the detection is this person's, by the assignment."""
    sigma_px: float | None
    """Standard deviation of such a detection per axis, pixels."""
    residual_px: tuple[float, float] | None
    """The projection of the joint as reported minus the detection, pixels."""
    off_px: float | None
    """Distance from the detection to where everything *else* puts the joint, this detection not counted,
    pixels."""
    off_sigma: float | None
    """The distance `off_px` in standard deviations of the detection and of where everything else puts the
    joint."""
    share: float
    """Share of the information about the joint that this view gives, 0 to 1."""
    looks_like: str = ""
    """Whose joint the detection rather is, as `person 3's RWrist`; empty where it fits nobody better."""


@dataclass(frozen=True)
class FactorReason:
    """What factors of the user's own have to do with a joint."""

    name: str
    """The function that made them."""
    others: tuple[str, ...]
    """The joints that they tie it to, as `person 3's RWrist`; none where they are on this joint alone."""
    share: float
    """Share of the information about the joint that these factors give, 0 to 1."""


@dataclass(frozen=True)
class Explanation:
    """Why a joint is where it is."""

    person: int
    joint: str
    frame: int
    time_s: float | None
    position_m: tuple[float, float, float] | None
    """As reported, world; None where unknown."""
    sigma_m: float | None
    """As reported: root mean square over the axes."""
    known: str
    """A name of `Known`."""
    status: str
    """Status of the row."""
    views: tuple[ViewReason, ...]
    """Camera by camera."""
    body_share: float
    """Share of the information about the joint that the body gives, the joint's own views not counted, 0 to 1."""
    motion_share: float
    """Share of the information about the joint that comes from other frames, 0 to 1."""
    findings: tuple[Finding, ...]
    """What is the matter, the gravest first; none where nothing is."""
    factors: tuple[FactorReason, ...] = ()
    """What factors of your own say of the joint in this frame, one entry for those of one function that tie it to
    the same joints. What they say in other frames is in `motion_share`."""
    missing_factors: tuple[str, ...] = ()
    """Functions of the user's own with which the result was solved and which were not given: shares are without
    them."""

    def as_dict(self) -> dict[str, Any]:
        """Plain values, as `shapepose-fg explain --json` prints them."""
        return asdict(self)

    @property
    def words(self) -> tuple[str, ...]:
        """The explanation in sentences: where the joint is, what is wrong, and what it is estimated from."""
        when = f"frame {self.frame}" + (f" ({self.time_s:.3f} s)" if self.time_s is not None else "")
        who = f"{self.joint} of person {self.person} in {when}"
        if self.position_m is None or self.sigma_m is None:
            where = f"{who} has no place."
        else:
            x, y, z = self.position_m
            where = f"{who} is at ({x:.3f}, {y:.3f}, {z:.3f}) m, within {1e3 * self.sigma_m:.0f} mm (one sigma)."
        used = [view for view in self.views if view.gate == GATES[Gate.USED]]
        told = [f"{view.camera} {view.share:.0%}" for view in used]
        told += [f"{each.name}{_with(each.others)} {each.share:.0%}" for each in self.factors]
        parts = [*told, f"the body {self.body_share:.0%}", f"motion, from other frames, {self.motion_share:.0%}"]
        shares = f"What is known of it comes from: {', '.join(parts)}."
        if self.missing_factors:
            shares += (
                f" The result was solved with factors of {', '.join(self.missing_factors)} too, which are unknown"
                " here: in Python, `explain(..., extra_factors=...)` counts them."
            )
        matter = [finding.words for finding in self.findings]
        good = f"{len(used)} cameras agree on it, and nothing speaks against them."
        return (where, *(matter or [good]), *([shares] if self.position_m is not None else []))


def _with(others: tuple[str, ...]) -> str:
    return f" (with {', '.join(others)})" if others else ""
