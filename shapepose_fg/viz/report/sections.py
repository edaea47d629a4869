"""The parts of a report below the scene: people, cameras, joints, what was not used, and the run."""

from collections.abc import Sequence

import numpy as np

from shapepose_fg.core.drawing import PALETTE
from shapepose_fg.core.observation_table import Gate
from shapepose_fg.core.reconstruction import Known, Reconstruction
from shapepose_fg.tracking.listing import TrackSummary
from shapepose_fg.viz.report import facts
from shapepose_fg.viz.report.elements import Child, Element, element, listing, section, share_bar, table, trend
from shapepose_fg.viz.report.figures import KINDS, REASONS, CameraFigures, known_counts

KIND_WORDS = {
    Known.SEEN: "seen",
    Known.WEAK: "seen by one view or weakly",
    Known.BODY: "inferred from the body",
    Known.MOTION: "carried by motion",
    Known.UNKNOWN: "unknown",
}
"""How a joint is known, in words."""
_MEANING = {
    Known.SEEN: "two cameras' detections of it were used in this frame",
    Known.WEAK: "one camera's was, or detections that are hardly sure",
    Known.BODY: "no detection was used; the fitted body places it",
    Known.MOTION: "no detection was used; the frames before and after place it",
    Known.UNKNOWN: "not placed",
}
_REASON_WORDS = {
    Gate.TOO_FAR: ("too far", "farther from the projected joint than the gate (observations.rho_2d_m) allows"),
    Gate.CONTRADICTS_BODY: ("against the body", "too far from where the rest of the body puts the joint"),
    Gate.BEHIND_CAMERA: ("behind camera", "the joint lies behind this camera"),
    Gate.NOT_PLACED: ("joint not placed", "there is no place to compare the detection with"),
}
_DASH = "–"


def people_section(people: Reconstruction, tracks: Sequence[TrackSummary], over_time: bool) -> Element:
    """Who is there: from when to when, how tall, how well seen."""
    if len(tracks) == 0:
        return section("people", "People", element("p", "Nobody was found."))
    persons = np.array([each.person for each in tracks])
    counts = known_counts(people, np.searchsorted(persons, people.person))
    head: list[Child] = ["person", "from – to", "frames", "gaps", "height", "walked", "confidence", "probability"]
    head.append("how joints are known")
    sure = facts.probabilities(people.run)
    rows: list[list[Child]] = [
        [
            swatch(each.person),
            f"{each.first}{_DASH}{each.last}",
            str(each.rows),
            str(each.gaps),
            or_dash(each.stature_m, "{:.2f} m"),
            f"{each.walked_m:.1f} m",
            f"{each.confidence:.2f}",
            or_dash(sure.get(each.person), "{:.2f}"),
            known_bar(count, f"person {each.person}"),
        ]
        for each, count in zip(tracks, counts, strict=True)
    ]
    words = (
        "A person is the same number and colour everywhere. Height is that of the fitted body standing upright."
        if over_time
        else "Every frame was solved by itself (--no-temporal): a number is no identity."
    )
    return section(
        "people",
        "People",
        element(
            "p",
            words,
            " Gaps are stretches between first and last frame without a row. Probability: of so many people in",
            " simulated recordings with as much evidence of their own this share was there.",
            class_="lead",
        ),
        table(head, rows, numbers={1, 2, 3, 4, 5, 6, 7}, label="People"),
    )


def cameras_section(cameras: Sequence[CameraFigures]) -> Element:
    """How far the result is from what each camera saw."""
    title = "Cameras"
    if len(cameras) == 0:
        return section("cameras", title, element("p", "There is no observations.npz beside the result."))
    offered = any(each.offered is not None for each in cameras)
    left_out = any(each.left_out_mm is not None for each in cameras)
    head: list[Child] = ["camera", *(["detections"] if offered else []), "given to people", "used of these"]
    head += ["error, all", "error, used", *(["left out"] if left_out else []), "median error over time"]
    most = max((value for each in cameras for value in each.trend_px if value is not None), default=0.0)
    longest = max((each.all.high_px or 0.0 for each in cameras), default=0.0)
    rows: list[list[Child]] = []
    for each in cameras:
        row: list[Child] = [each.name]
        row += [_count_words(each.offered)] if offered else []
        row += [_count_words(each.given), _percent(each.gates[Gate.USED], each.given), _error(each, longest)]
        row += [f"{or_dash(each.used.median_px, '{:.1f}')} / {or_dash(each.used.high_px, '{:.1f}')} px"]
        if left_out:
            mm = or_dash(each.left_out_mm, "{:.0f} mm")
            row.append(f"{or_dash(each.left_out_px, '{:.1f}')} px, {mm}")
        line = f"{each.name}: median error over time, 0 to {most:.0f} px"
        rows.append([*row, trend(each.trend_px, most, line)])
    words = [
        "Error is the distance between a detection and the projected joint, undistorted pixels: median / 90 %. ",
        "“All” counts every detection that was given to somebody, before gates. ",
        "Left out: the median distance to where the other cameras alone put the joint. " if left_out else "",
        f"Lines over time go from 0 to {most:.0f} px. A camera whose error stands out is calibrated badly, ",
        "late, or sees people that the others do not see.",
    ]
    numbers = set(range(1, len(head) - 1))
    return section(
        "cameras", title, element("p", *words, class_="lead"), table(head, rows, numbers=numbers, label="Cameras")
    )


def joints_section(people: Reconstruction) -> Element:
    """How each joint is known, over all people and frames."""
    title = "How joints are known"
    counts = known_counts(people)
    if counts.sum() == 0 or counts[:, :-1].sum() == 0:
        return section("joints", title, element("p", "This result does not say how its joints are known."))
    legend = element(
        "ul",
        *(
            element(
                "li",
                element("span", class_=f"dot {kind.name.lower()}"),
                element("b", KIND_WORDS[kind]),
                f" {_share(total, counts.sum())}: {_MEANING[kind]}",
            )
            for kind, total in zip(KINDS, counts.sum(axis=0).tolist(), strict=True)
        ),
        class_="legend",
    )
    items = [
        element(
            "li",
            element("span", name, class_="name"),
            known_bar(count, name),
            element("span", _share(int(count[0]), int(count.sum())), class_="value"),
        )
        for name, count in zip(people.joint_names.tolist(), counts, strict=True)
    ]
    return section("joints", title, legend, element("ol", *items, class_="bars"))


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
                f"{_count_words(unused)} of the {_count_words(given)} detections that were given to people",
                f" ({_percent(unused, given)}) were not used.",
            )
        )
        head: list[Child] = ["camera", *(_REASON_WORDS[gate][0] for gate in reasons), "share of given"]
        rows: list[list[Child]] = [
            [
                each.name,
                *(_count_words(each.gates[gate]) for gate in reasons),
                _percent(each.given - each.gates[Gate.USED], each.given),
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
        rows = [[reason, _count_words(count), frames or "–"] for reason, count, frames in lost]
        parts += [
            element("h3", "People who were not kept"),
            element("p", "Candidates of which too little fits together to be somebody, counted frame by frame."),
            table(["reason", "count", "frames"], rows, numbers={1}, label="People who were not kept"),
        ]
    unsolved = facts.problems(people.run)
    if len(unsolved) > 0:
        more = f"and {len(unsolved) - 50} more, in run.json" if len(unsolved) > 50 else None
        parts += [element("h3", "What could not be solved"), listing(unsolved[:50]), element("p", more or "")]
    if len(parts) == 0:
        parts.append(element("p", "Nothing is recorded about this result."))
    return section("unused", "What was not used, and why", *parts)


def swatch(person: int) -> Element:
    """A person's number in the colour that is theirs."""
    dot = element("span", class_="dot", style=f"background:{PALETTE[person % len(PALETTE)]}")
    return element("span", dot, f"person {person}", class_="who")


def known_bar(counts: np.ndarray, name: str) -> Element:
    """(5,) how often something is known in each way, as a bar."""
    total = max(int(counts.sum()), 1)
    shares = [(kind.name.lower(), int(count) / total) for kind, count in zip(KINDS, counts, strict=True)]
    said = ", ".join(
        f"{_share(int(count), total)} {KIND_WORDS[kind]}"
        for kind, count in zip(KINDS, counts, strict=True)
        if count > 0
    )
    return share_bar(shares, f"{name}: {said}")


def or_dash(value: float | None, text: str) -> str:
    """`value` as `text` formats it; a dash where it is None or NaN."""
    return _DASH if value is None or value != value else text.format(value)


def _error(camera: CameraFigures, longest: float) -> Element:
    """Median and 90 % residual, in words and as a bar."""
    figures = f"{or_dash(camera.all.median_px, '{:.1f}')} / {or_dash(camera.all.high_px, '{:.1f}')} px"
    bar = element(
        "span",
        element("span", class_="high", style=f"width:{100 * _ratio(camera.all.high_px, longest):.1f}%"),
        element("span", class_="median", style=f"width:{100 * _ratio(camera.all.median_px, longest):.1f}%"),
        class_="range",
        aria_hidden="true",
    )
    return element("span", figures, bar, class_="error")


def _ratio(value: float | None, most: float) -> float:
    return 0.0 if value is None or not most > 0 else min(value / most, 1.0)


def _share(count: int, total: int) -> str:
    """A share that is neither 0 nor 1 is not shown as if it were."""
    percent = 100 * count / max(total, 1)
    if count in (0, total):
        return f"{percent:.0f} %"
    return "under 0.1 %" if percent < 0.05 else f"{min(percent, 99.9):.1f} %"


def _percent(count: int, total: int) -> str:
    return _DASH if total == 0 else _share(count, total)


def _count_words(value: float | None) -> str:
    """Whole numbers with a thin space between thousands."""
    return _DASH if value is None else f"{value:,.0f}".replace(",", "\u202f")
