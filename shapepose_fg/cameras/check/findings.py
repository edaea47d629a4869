"""Findings of the check, and their description: the camera, the likely mistake, and the cure."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from enum import StrEnum

from shapepose_fg.cameras.stature import ADULT_M
from shapepose_fg.core.camera import Rig


class Kind(StrEnum):
    """Kind of a mistake."""

    TURNED = "turned"
    MOVED = "moved"
    LATE = "late"
    EXCHANGED = "exchanged"
    INVERTED = "inverted extrinsics"
    TRANSPOSED = "transposed rotation"
    AXES = "other camera axes"
    MIRRORED = "mirrored"
    SIDES = "exchanged sides"
    """Left and right joints are exchanged in the detections of a camera, in most frames."""
    BUMPED = "bumped"
    DRIFTING = "drifting"
    FOCAL = "focal length"
    RESIZED = "picture size"
    PRINCIPAL_POINT = "principal point"
    DUPLICATE = "duplicate"
    UNIT = "unit"
    UP = "up axis"
    JOINT_ORDER = "joint order"
    NOBODY = "nobody"
    STOPPED = "stopped"
    UNFIT = "does not fit"
    CROWDED = "crowded"
    PICTURE_SIZE = "size of the pictures"
    BIASED = "biased"
    """Bias of one person's detections, not a mistake of the set-up."""


@dataclass(frozen=True)
class Finding:
    """One mistake of a set-up."""

    kind: Kind
    """Kind of the mistake."""
    cameras: tuple[int, ...]
    """Cameras with the mistake; empty if it is about people, all if they share it."""
    amount: float = 0.0
    """Degrees, frames (positive is late), factor of a focal length or picture size, stature in
    metres, or share of a person's size, by kind."""
    shift_px: tuple[tuple[float, float], ...] = ()
    """For each camera, the apparent error of its principal point: right and down, pixels."""
    moved: float = 0.0
    """Apparent translation of the camera, metres."""
    axis: str = ""
    """World axis that is up, judging by the people."""
    frames: tuple[int | None, int | None] = (None, None)
    """First affected frame, and the one after the last; None for the recording's
    beginning or end."""
    probability: float = 1.0
    """Probability of this finding, against other mistakes and none."""
    joints: tuple[str, ...] = ()
    """The layout that fits people and the one used for reading; or the exchanged joints only, "" if
    it is not a single exchange."""
    same: str = ""
    """Which of "pose" and "detections" two cameras have in common; empty if both."""
    instead: "tuple[Finding, ...]" = ()
    """Alternative findings, most probable first, with their values of `probability`."""


SURE = 0.95
"""Findings above this probability are reported without it, and without alternatives."""


def one_of(found: Sequence[Finding]) -> Finding:
    """The most probable of mutually exclusive findings; others that are not improbable become its
    alternatives.
    """
    probability: dict[tuple[Kind, tuple[int, ...]], float] = {}
    first: dict[tuple[Kind, tuple[int, ...]], Finding] = {}
    for each in sorted(found, key=lambda each: -each.probability):
        what = each.kind, each.cameras
        probability[what] = probability.get(what, 0.0) + each.probability
        first.setdefault(what, each)
    ranked = sorted(
        (replace(first[what], probability=p) for what, p in probability.items()),
        key=lambda each: -each.probability,
    )
    return replace(
        ranked[0], instead=tuple(each for each in ranked[1:] if each.probability >= 1 - SURE)
    )


def sentence(finding: Finding, rig: Rig) -> str:
    """The finding as a sentence, with its alternatives."""
    text = _words(finding, rig)
    text += f" (probability {finding.probability:.2f})" if finding.probability < SURE else ""
    for each in finding.instead:
        text += f"; or {_words(each, rig).split(';')[0]} ({each.probability:.2f})"
    return text if text.startswith(rig.names) else f"{text[0].upper()}{text[1:]}"


def _words(finding: Finding, rig: Rig) -> str:
    """The sentence without probability and alternatives."""
    words, amount = _WORDS[finding.kind], finding.amount
    names = [rig.names[view] for view in finding.cameras]
    all_of_them = len(names) == len(rig) > 2
    width, height = rig.cameras[finding.cameras[0] if names else 0].image_size
    shifts = [_shift(x, y) for x, y in finding.shift_px]
    count = abs(round(amount))
    return (words if isinstance(words, str) else words(finding)).format(
        who="all cameras"
        if all_of_them
        else " and ".join(filter(None, (", ".join(names[:-1]), *names[-1:]))),
        first=names[0] if names else "",
        second=names[-1] if names else "",
        sees="sees" if len(names) == 1 else "see",
        others="each other" if len(names) == len(rig) else "the others",
        amount=amount,
        degrees=f"{amount:.1f}" if amount < 10 else f"{amount:.0f}",
        percent=100 * abs(amount - (finding.kind not in (Kind.STOPPED, Kind.BIASED))),
        frames=f"{count} frame{'s' if count != 1 else ''}",
        at=100 + round(amount),
        moved=_length(finding.moved),
        stature=_length(amount),
        shift="".join(shifts[:1]),
        shifts=", ".join(f"{by} in {name}" for by, name in zip(shifts, names, strict=False)),
        found="{:.0f} x {:.0f}".format(*finding.shift_px[0]) if shifts else "",
        calibrated=f"{width} x {height}",
        resized=f"{width * amount:.0f} x {height * amount:.0f}",
        axis=finding.axis,
        when=_when(*finding.frames),
        up=rig.up,
    )


_POSE_AGAIN = "calibrate its pose again, or refine it with shapepose-fg refine-calibration"


def _turned(finding: Finding) -> str:
    return (
        "{who} appears to be rotated by about {degrees} degrees"
        + (" and moved by {moved}" if finding.moved > 0.1 else "")
        + f"; {_POSE_AGAIN}"
    )


def _principal_point(finding: Finding) -> str:
    cure = (
        "check that pictures have the calibrated sizes and are not cropped, or calibrate the "
        "intrinsics again"
    )
    if len(finding.cameras) == 1:
        return f"the principal point of {{who}} appears to be wrong, it should be {{shift}}; {cure}"
    return (
        "principal points appear to be wrong, they should be {shifts} (equivalent to rotations "
        f"of at most {{degrees}} degrees); {cure}"
    )


def _late(finding: Finding) -> str:
    if finding.amount > 0:
        late, rest = "late", "its first {frames}"
    else:
        late, rest = "early", "the first {frames} of all others"
    words = "it shows at frame {at} what the others show at frame 100; leave out"
    return f"{{who}} appears to be about {{frames}} {late}: {words} {rest}"


def _focal(finding: Finding) -> str:
    what = "long" if finding.amount > 1 else "short"
    by, more = (
        ("{percent:.0f} %", "")
        if 0.8 < finding.amount < 1.25
        else ("{amount:.2g} times the fitting value,", " and the size of its pictures")
    )
    return (
        f"{{who}} has a focal length in the calibration that appears to be {by} too {what}; "
        f"check its intrinsics{more}"
    )


def _duplicate(finding: Finding) -> str:
    if finding.same == "":
        return "{first} and {second} are one camera listed twice; remove one of them"
    detections = finding.same == "detections"
    same, others = (
        ("the same detections", "files") if detections else ("the same pose", "calibration")
    )
    return (
        f"{{first}} and {{second}} have {same}: one of the two was given the {others} of the "
        "other; give it its own"
    )


_UNITS = (
    (1e-3, "m", "mm"),
    (1e3, "mm", "m"),
    (1e-2, "m", "cm"),
    (1e2, "cm", "m"),
    (0.1, "cm", "mm"),
    (10, "mm", "cm"),
)
"""Apparent scale of lengths, with the true unit and the unit assumed when reading."""


def _unit(finding: Finding) -> str:
    factor = finding.amount / ADULT_M
    for times, truth, taken in _UNITS:
        if 0.55 < factor / times < 1.45:
            unit = (
                f"the calibration is probably in {truth}, but was read as {taken}; give its unit "
                "with --unit"
            )
            return f"the stature of people is {{stature}}: {unit}"
    off = f"{1 / factor:.2g} times too small" if factor < 1 else f"{factor:.2g} times too large"
    return (
        f"the stature of people is {{stature}}: lengths in the calibration are about {off}; "
        "check its unit, and the size of the squares of the calibration board"
    )


def _joint_order(finding: Finding) -> str:
    if len(finding.joints) == 2:
        fits, read_as = finding.joints
        order = (
            f"people do not look like a body in the joint order of {read_as}, but do in that of "
            f"{fits}"
        )
        return f"{order}; give --skeleton {fits}"
    if finding.joints == ("left and right",):
        what = "left and right appear to be exchanged: knees and faces point backwards"
        return (
            f"{what}; exchange them in a --skeleton file, or check whether all pictures are "
            "mirrored"
        )
    if any(finding.joints):
        return (
            f"{finding.joints[0]} appear to be exchanged in all detections; give their order in "
            "a --skeleton file"
        )
    return (
        "people do not look like a body: the joints are in another order; give the keypoint "
        "layout of the detector with --skeleton"
    )


def _nobody(finding: Finding) -> str:
    if len(finding.cameras) > 0:
        return "{who} {sees} no people in the checked frames; check the detections"
    if finding.amount < 1:
        return "no camera sees a person in the checked frames; check the detections"
    return (
        "no person is seen by two cameras that agree, although cameras saw {amount:.0f} people; "
        "check that calibration and detections are of one recording, and that the cameras are in "
        "the same order"
    )


def _unfit(finding: Finding) -> str:
    check = "check that its calibration and its detections belong to it"
    if len(finding.cameras) == 1:
        return f"{{who}} fits the others under no tested explanation; {check}"
    since = (
        ""
        if finding.frames == (None, None)
        else " {when}, but agree in other frames: one of them was moved"
    )
    return (
        f"{{who}} contradict {{others}}{since};"
        f" {check.replace('its', 'their').replace('belong to it', 'belong to them')}"
    )


_WORDS: dict[Kind, str | Callable[[Finding], str]] = {
    Kind.TURNED: _turned,
    Kind.MOVED: (
        "{who} appears to be moved by about {moved} and rotated by {amount:.1f} degrees; "
        f"{_POSE_AGAIN}"
    ),
    Kind.LATE: _late,
    Kind.EXCHANGED: (
        "{who} appear to be exchanged: each sees what the other should see; exchange their names "
        "in the calibration, or their detections"
    ),
    Kind.INVERTED: "the extrinsics of {who} appear to be inverted: camera-from-world was read as"
    " world-from-camera, or the reverse; write the inverse",
    Kind.TRANSPOSED: (
        "the rotation of {who} appears to be transposed, but not the translation; transpose it"
    ),
    Kind.AXES: (
        "the camera axes of {who} appear to be those of OpenGL or Blender (y up, z backwards); "
        "reverse y and z"
    ),
    Kind.MIRRORED: "the pictures of {who} appear to be mirrored; mirror them back",
    Kind.SIDES: (
        "left and right joints are exchanged in most detections of {who}; its calibration is not "
        "the cause; reconstruct exchanges them back where other cameras agree"
    ),
    Kind.BUMPED: (
        "{who} appears to be rotated by {degrees} degrees {when}: it was moved; calibrate it for "
        "each part, or leave it out of one"
    ),
    Kind.DRIFTING: (
        "{who} appears to rotate slowly, by {degrees} degrees over the recording; fix it on its "
        "stand, and leave it out of this recording"
    ),
    Kind.FOCAL: _focal,
    Kind.RESIZED: (
        "the detections of {who} appear to be from pictures of {amount:.2g} times the calibrated "
        "size ({resized} instead of {calibrated}); give detections from pictures of the "
        "calibrated size, or the calibration of these pictures"
    ),
    Kind.PRINCIPAL_POINT: _principal_point,
    Kind.DUPLICATE: _duplicate,
    Kind.UNIT: _unit,
    Kind.UP: (
        "people stand along {axis}, but {up} is up in the calibration; give --up {axis} unless "
        "they lie"
    ),
    Kind.JOINT_ORDER: _joint_order,
    Kind.NOBODY: _nobody,
    Kind.STOPPED: (
        "{who} repeats the previous picture in {percent:.0f} % of the checked frames; the "
        "repeated pictures are left out; check its recording"
    ),
    Kind.UNFIT: _unfit,
    Kind.CROWDED: (
        "pictures show {amount:.0f} people or more, who occlude each other, so the cameras "
        "cannot be checked; use frames with fewer people"
    ),
    Kind.BIASED: (
        "{who} sees one person {percent:.0f} % of the stature away from where the other cameras "
        "see this person: this is an error of the detector"
    ),
    Kind.PICTURE_SIZE: (
        "the pictures of {first} have {found} pixels, but the calibration is for {calibrated}; "
        "give --image-placement, or calibrate with these pictures"
    ),
}
"""Sentence of each kind: a template for `sentence`, or a function that chooses it by the
finding."""


def _when(first: int | None, last: int | None) -> str:
    """The affected frames in words."""
    if first is None:
        return "in all frames" if last is None else f"before frame {last}"
    return f"from frame {first} on" if last is None else f"in frames {first} to {last - 1}"


def _shift(x: float, y: float) -> str:
    """A shift in a picture in words."""
    parts = [(abs(x), "right" if x > 0 else "left"), (abs(y), "down" if y > 0 else "up")]
    words = [f"{size:.0f} px {way}" for size, way in parts if size >= 0.5]
    return " and ".join(words) or "less than a pixel"


def _length(metres: float) -> str:
    """A length in a suitable unit."""
    if metres < 0.01:
        return f"{1e3 * metres:.2g} mm"
    if metres < 1:
        return f"{100 * metres:.0f} cm"
    return f"{metres:.1f} m" if metres < 100 else f"{metres:,.0f} m"
