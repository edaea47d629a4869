"""Converts entries of run.json to words; invalid entries are left out."""

from collections.abc import Iterator, Mapping
from dataclasses import asdict
from typing import Any

from shapepose_fg.core.run_summary import covered_frames
from shapepose_fg.estimation.noise_law import NoiseLaw
from shapepose_fg.pipeline.config import PipelineConfig

Run = Mapping[str, Any]


def told_by(run: Run) -> dict[str, Any]:
    """The entries of a run that the page shows, by the names in the page's template."""
    people, time = objects(run.get("people")), objects(run.get("time"))
    problems, spans = people.get("problems"), covered_frames(run) or []
    return {
        "warnings": [*map(str, lists(objects(run.get("setup")).get("warnings")))],
        "notes": [*map(str, lists(run.get("notes")))],
        "problems": [
            ", ".join(f"{key} {it}" for key, it in objects(each).items())
            for each in lists(problems)
        ],
        "dropped": _dropped(objects(people.get("dropped")), objects(run.get("dropped_frames"))),
        "probabilities": _probabilities(run.get("probability")),
        "fps": number(time.get("fps")),
        "source": str(time.get("source", "")),
        "frames": ", ".join(f"{span.start}–{span.stop - 1}" for span in spans if len(span) > 0),
        "cuts": ", ".join(map(str, run.get("cuts", []))),
        "body": run.get("body"),
        "time": _time(objects(run.get("seconds"))),
        "configured": isinstance(run.get("configuration"), dict),
        "noise": _noise(objects(run.get("noise_law"))),
        "over_time": bool(objects(run.get("configuration")).get("temporal", True)),
        "changed": _changed_settings(run),
        **{
            key: [(str(name), _text(value)) for name, value in objects(run.get(key)).items()]
            for key in ("versions", "inputs")
        },
    }


def number(value: object) -> float | None:
    """`value` if it is a finite number, otherwise None."""
    if isinstance(value, bool) or not isinstance(value, int | float) or not abs(value) < 1e300:
        return None
    return float(value)


def objects(value: object) -> Mapping[str, Any]:
    """`value` if it is an object, otherwise an empty one."""
    return value if isinstance(value, dict) else {}


def _changed_settings(run: Run) -> list[tuple[str, str, str]]:
    """Settings that differ from the default: dotted name, value, default; a dash if the setting no
    longer exists.

    Tables of older versions, which contain all settings, are left out.
    """
    usual = dict(_flat(asdict(PipelineConfig())))
    given = {
        name: (_text(value), _text(usual.get(name, "–")))
        for name, value in _flat(run.get("configuration"))
    }
    return [
        (name, value, default)
        for name, (value, default) in given.items()
        if value != default and name.split(".")[0] not in PipelineConfig.replaced
    ]


def _dropped(reasons: Run, frames: Run) -> list[tuple[str, int, str]]:
    """Reasons for dropping people: reason, number, and frames, shortened to fit."""
    counts = {reason: number(count) for reason, count in reasons.items()}
    told = [(reason, int(count)) for reason, count in counts.items() if count is not None]
    return [(reason, count, _frames_words(frames.get(reason))) for reason, count in told]


def _noise(told: Run) -> list[tuple[float, float, float, float, int]]:
    """Table of the detector's noise law, with a row for each range of scores that had detections.

    Columns are the middle of the range, the standard deviation, mm, that of the shipped law, mm,
    the share of gross errors, and the number of detections.
    """
    try:
        law, usual = NoiseLaw.from_dict(told).as_dict(), NoiseLaw.shipped().as_dict()
    except (KeyError, TypeError, ValueError, OverflowError):
        return []
    columns = law["score"], law["sigma_mm"], usual["sigma_mm"], law["gross"], law["count"]
    return [row for row in zip(*columns, strict=True) if row[-1] > 0]


def _probabilities(listed: object) -> dict[int, float]:
    """Probability of each person by number; empty for frame-by-frame results."""
    entries = [objects(each) for each in lists(listed)]
    found = {number(each.get("person")): number(each.get("probability")) for each in entries}
    return {
        int(who): value for who, value in found.items() if who is not None and value is not None
    }


def _time(seconds: Run) -> str:
    """Durations of the stages, the longest first; empty if they are missing."""
    spent = {name: value for name, each in seconds.items() if (value := number(each)) is not None}
    longest = sorted((each for each in spent.items() if each[1] >= 0.05), key=lambda each: -each[1])
    listed = ", ".join(f"{name} {value:.1f}" for name, value in longest)
    return f"{sum(spent.values()):.1f} s of processor time: {listed}" if len(spent) > 0 else ""


def lists(value: object) -> list[Any]:
    """`value` if it is a list, otherwise an empty one."""
    return value if isinstance(value, list) else []


def _flat(table: object, prefix: str = "") -> Iterator[tuple[str, Any]]:
    """Dotted names and values of nested tables."""
    for key, value in objects(table).items():
        if isinstance(value, dict):
            yield from _flat(value, f"{prefix}{key}.")
        else:
            yield f"{prefix}{key}", value


def _text(value: object) -> str:
    """A setting for comparison and display: lists equal tuples, and 1 equals 1.0."""
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
    return ", ".join(told[:12]) + (f" and {len(told) - 12} more segments" if len(told) > 12 else "")
