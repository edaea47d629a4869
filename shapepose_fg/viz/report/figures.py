"""What a report shows of a result: what run.json says, in words, and figures of cameras and joints.

Entries of run.json that are not what they should be say nothing.
"""

from collections import Counter
from collections.abc import Iterator, Mapping
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from shapepose_fg.core.arrays import Index, Mask, Real, Whole
from shapepose_fg.core.observation_table import Gate, ObservationTable
from shapepose_fg.core.reconstruction import Known, Reconstruction, sigma_m
from shapepose_fg.core.run_summary import covered_frames
from shapepose_fg.pipeline.config import PipelineConfig

Run = Mapping[str, Any]


def told_by(run: Run) -> dict[str, Any]:
    """The entries of a run that the page shows, by the names that its template uses."""
    people, time = objects(run.get("people")), objects(run.get("time"))
    problems, spans = people.get("problems"), covered_frames(run) or []
    return {
        "warnings": [*map(str, lists(objects(run.get("setup")).get("warnings")))],
        "notes": [*map(str, lists(run.get("notes")))],
        "problems": [", ".join(f"{key} {it}" for key, it in objects(each).items()) for each in lists(problems)],
        "dropped": _dropped(objects(people.get("dropped")), objects(run.get("dropped_frames"))),
        "probabilities": _probabilities(run.get("probability")),
        "fps": number(time.get("fps")),
        "source": str(time.get("source", "")),
        "frames": ", ".join(f"{span.start}–{span.stop - 1}" for span in spans if len(span) > 0),
        "cuts": ", ".join(map(str, run.get("cuts", []))),
        "body": run.get("body"),
        "time": _time(objects(run.get("seconds"))),
        "configured": isinstance(run.get("configuration"), dict),
        "over_time": bool(objects(run.get("configuration")).get("temporal", True)),
        "changed": _changed_settings(run),
        **{
            key: [(str(name), _text(value)) for name, value in objects(run.get(key)).items()]
            for key in ("versions", "inputs")
        },
    }


def number(value: object) -> float | None:
    """A finite number of run.json; None for anything else."""
    if isinstance(value, bool) or not isinstance(value, int | float) or not abs(value) < 1e300:
        return None
    return float(value)


def objects(value: object) -> Mapping[str, Any]:
    """An object of run.json; an empty one for anything else."""
    return value if isinstance(value, dict) else {}


def _changed_settings(run: Run) -> list[tuple[str, str, str]]:
    """Settings that are not the default: dotted name, value, default; a dash where there is none any more.

    Tables of an older program, of which everything was written down, are left out.
    """
    usual = dict(_flat(asdict(PipelineConfig())))
    given = {name: (_text(value), _text(usual.get(name, "–"))) for name, value in _flat(run.get("configuration"))}
    return [
        (name, value, default)
        for name, (value, default) in given.items()
        if value != default and name.split(".")[0] not in PipelineConfig.replaced
    ]


def _dropped(reasons: Run, frames: Run) -> list[tuple[str, int, str]]:
    """Why somebody was left out: reason, how many, and in which frames, as far as there is room."""
    counts = {reason: number(count) for reason, count in reasons.items()}
    told = [(reason, int(count)) for reason, count in counts.items() if count is not None]
    return [(reason, count, _frames_words(frames.get(reason))) for reason, count in told]


def _probabilities(listed: object) -> dict[int, float]:
    """How probable it is that each person was there, by number; empty frame by frame."""
    entries = [objects(each) for each in lists(listed)]
    found = {number(each.get("person")): number(each.get("probability")) for each in entries}
    return {int(who): value for who, value in found.items() if who is not None and value is not None}


def _time(seconds: Run) -> str:
    """How long the stages took, the longest first; empty where that is not said."""
    spent = {name: value for name, each in seconds.items() if (value := number(each)) is not None}
    longest = sorted((each for each in spent.items() if each[1] >= 0.05), key=lambda each: -each[1])
    listed = ", ".join(f"{name} {value:.1f}" for name, value in longest)
    return f"{sum(spent.values()):.1f} s of processors: {listed}" if len(spent) > 0 else ""


def lists(value: object) -> list[Any]:
    """A list of run.json; an empty one for anything else."""
    return value if isinstance(value, list) else []


def _flat(table: object, prefix: str = "") -> Iterator[tuple[str, Any]]:
    """Dotted names and values of nested tables."""
    for key, value in objects(table).items():
        if isinstance(value, dict):
            yield from _flat(value, f"{prefix}{key}.")
        else:
            yield f"{prefix}{key}", value


def _text(value: object) -> str:
    """A setting as it is compared and shown: lists and tuples alike, 1 and 1.0 alike."""
    if isinstance(value, list | tuple):
        return ", ".join(map(_text, value))
    told = number(value)
    return f"{told:g}" if told is not None else str(value)


def _frames_words(spans: object) -> str:
    """`0-3, 17, 20-25 and more` of [start, stop) spans."""
    told = []
    for span in lists(spans):
        ends = [number(end) for end in lists(span)]
        if len(ends) == 2 and None not in ends:
            start, stop = int(ends[0] or 0), int(ends[1] or 0)
            told.append(f"{start}" if stop == start + 1 else f"{start}–{stop - 1}")
    return ", ".join(told[:12]) + (f" and {len(told) - 12} segments more" if len(told) > 12 else "")


_BINS = 60
"""Points of a line over time: as many as can be told apart in a cell of a table."""
KINDS = (Known.SEEN, Known.WEAK, Known.BODY, Known.MOTION, Known.UNKNOWN)
"""The ways in which joints are known, the surest first."""


@dataclass(frozen=True)
class Residual:
    """Distances of projected joints to their detections, pixels."""

    median_px: float | None
    """Half of them are nearer; None where there are none."""
    high_px: float | None
    """Nine of ten are nearer."""

    @classmethod
    def of(cls, px: Real) -> "Residual":
        """Of all finite distances in `px`."""
        px = px[np.isfinite(px)]
        return cls(*np.quantile(px, [0.5, 0.9]).tolist()) if len(px) > 0 else cls(None, None)


@dataclass(frozen=True)
class CameraFigures:
    """What became of one camera's detections."""

    name: str
    """Its name."""
    given: int
    """Detections that were given to people."""
    gates: dict[Gate, int]
    """How many of them were used, and how many were not for which reason."""
    all: Residual
    """Of all that were given to people."""
    used: Residual
    """Of those that were used."""
    trend_px: list[float | None]
    """Median over time of all that were given to people: equal segments of the recording."""
    offered: float | None = None
    """Detections in all, given to people or not; None where run.json does not say."""
    left_out_px: float | None = None
    """Median distance to where the other cameras alone put the joint; None where run.json does not say."""
    left_out_mm: float | None = None
    """The same as a length at the joint's depth."""


def camera_figures(people: Reconstruction) -> list[CameraFigures]:
    """One entry for each camera; none where the result has no observations."""
    table = people.observations
    if table is None:
        return []
    px, segment = np.linalg.norm(table.residual_px, axis=-1), _segments(table)
    entries = [objects(each) for each in lists(people.run.get("cameras"))]
    told = {str(each.get("camera")): each for each in entries}
    made = []
    for view, name in enumerate(table.view_names.tolist()):  # a handful of cameras
        gate, error = table.gate[..., view], px[..., view]
        more = told.get(name, {})
        left_out = objects(more.get("left_out"))
        made.append(
            CameraFigures(
                name,
                int((gate != Gate.NOT_SEEN).sum()),
                {each: int((gate == each).sum()) for each in Gate if each != Gate.NOT_SEEN},
                Residual.of(error),
                Residual.of(error[gate == Gate.USED]),
                [Residual.of(error[segment == index]).median_px for index in range(segment.max(initial=-1) + 1)],
                number(more.get("offered")),
                number(left_out.get("median_px")),
                number(left_out.get("median_mm")),
            )
        )
    return made


def overall(people: Reconstruction) -> dict[str, Any]:
    """The figures by which a result is judged first, by the template's names; shares 0 to 1, None of nothing."""
    table, known = people.observations, people.known[people.known != Known.UNKNOWN]
    sigma = sigma_m(people.covariance)
    sigma = sigma[np.isfinite(sigma)]
    spans = [np.arange(span.start, span.stop) for span in covered_frames(people.run) or []]
    gate = np.zeros(0) if table is None else table.gate[table.gate != Gate.NOT_SEEN]
    return {
        "placed": bool(np.isfinite(people.joints).all(axis=-1).any()),
        "seen": _share(known == Known.SEEN),
        "error": Residual.of(np.zeros(0) if table is None else np.linalg.norm(table.residual_px, axis=-1)),
        "used": _share(gate == Gate.USED),
        "sigma_mm": 1e3 * float(np.median(sigma)) if len(sigma) > 0 else None,
        "solved": _share(people.status == "ok"),
        "rows": len(people),
        "people": len(np.unique(people.person)),
        "frames": len(np.unique(np.concatenate([people.frame, *spans]))),
        "status": ", ".join(f"{count} {name}" for name, count in Counter(people.status.tolist()).items()),
    }


def known_counts(people: Reconstruction, by: Whole | None = None) -> NDArray[np.int64]:
    """How many joints are known in each of `KINDS`: (J, 5) by joint, or (G, 5) by groups `by` (N,) of the rows."""
    kinds = people.known[..., None] == np.array(KINDS)
    if by is None:
        return kinds.sum(axis=0)
    counts = np.zeros((int(by.max(initial=-1)) + 1, len(KINDS)), dtype=np.int64)
    np.add.at(counts, by, kinds.sum(axis=1))
    return counts


def _share(true: Mask) -> float | None:
    return float(true.mean()) if true.size > 0 else None


def _segments(table: ObservationTable) -> Index:
    """(N,) which segment of the recording each row is in."""
    if len(table) == 0:
        return np.zeros(0, dtype=np.intp)
    first, last = int(table.frame.min()), int(table.frame.max())
    bins = min(_BINS, last - first + 1)
    return np.asarray((table.frame - first) * bins // (last - first + 1), dtype=np.intp)
