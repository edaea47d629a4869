"""The part of a report about what was not used, of detections and of people."""

from collections.abc import Sequence

from shapepose_fg.core.observation_table import Gate
from shapepose_fg.core.reconstruction import Reconstruction
from shapepose_fg.viz.report import facts
from shapepose_fg.viz.report.elements import Child, Element, element, table
from shapepose_fg.viz.report.figures import REASONS, CameraFigures
from shapepose_fg.viz.report.sections import count_words, percent, section

_REASON_WORDS = {
    Gate.TOO_FAR: ("too far", "farther from the projected joint than the gate (observations.rho_2d_m) allows"),
    Gate.CONTRADICTS_BODY: ("against the body", "too far from where the rest of the body puts the joint"),
    Gate.BEHIND_CAMERA: ("behind camera", "the joint lies behind this camera"),
    Gate.NOT_PLACED: ("joint not placed", "there is no place to compare the detection with"),
}


def unused_section(people: Reconstruction, cameras: Sequence[CameraFigures]) -> Element:
    """What was not used, of detections and of people, and why."""
    parts: list[Child] = []
    reasons = [gate for gate in REASONS if any(each.gates[gate] > 0 for each in cameras)]
    if len(reasons) > 0:
        given = sum(each.given for each in cameras)
        unused = sum(each.given - each.gates[Gate.USED] for each in cameras)
        parts.append(element("h3", "Detections"))
        parts.append(
            element(
                "p",
                f"{count_words(unused)} of the {count_words(given)} detections that were given to people",
                f" ({percent(unused, given)}) were not used.",
            )
        )
        head: list[Child] = ["camera", *(_REASON_WORDS[gate][0] for gate in reasons), "share of given"]
        rows: list[list[Child]] = [
            [
                each.name,
                *(count_words(each.gates[gate]) for gate in reasons),
                percent(each.given - each.gates[Gate.USED], each.given),
            ]
            for each in cameras
        ]
        parts.append(table(head, rows, numbers=set(range(1, len(head))), label="Detections that were not used"))
        meanings = [
            element("li", element("b", _REASON_WORDS[gate][0]), f": {_REASON_WORDS[gate][1]}") for gate in reasons
        ]
        parts.append(element("ul", *meanings, class_="legend"))
    elif len(cameras) > 0:
        parts.append(element("p", "Every detection that was given to somebody was used."))
    lost = facts.dropped(people.run)
    if len(lost) > 0:
        rows = [[reason, count_words(count), frames or "–"] for reason, count, frames in lost]
        parts += [
            element("h3", "People who were not kept"),
            element("p", "Candidates of which too little fits together to be somebody, counted frame by frame."),
            table(["reason", "count", "frames"], rows, numbers={1}, label="People who were not kept"),
        ]
    unsolved = facts.problems(people.run)
    if len(unsolved) > 0:
        shown = [element("li", each) for each in unsolved[:50]]
        more = f"and {len(unsolved) - 50} more, in run.json" if len(unsolved) > 50 else None
        parts += [element("h3", "What could not be solved"), element("ul", *shown), element("p", more or "")]
    if len(parts) == 0:
        parts.append(element("p", "Nothing is recorded about this result."))
    return section("unused", "What was not used, and why", *parts)
