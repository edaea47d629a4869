"""What run.json says of a result, in words; entries that are not what they should be say nothing."""

from collections.abc import Iterator, Mapping
from dataclasses import asdict
from typing import Any

from shapepose_fg.pipeline.config import PipelineConfig
from shapepose_fg.viz.report.figures import number

Run = Mapping[str, Any]


def changed_settings(run: Run) -> list[tuple[str, str, str]]:
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


def dropped(run: Run) -> list[tuple[str, int, str]]:
    """Why somebody was left out: reason, how many, and in which frames, as far as there is room."""
    reasons = _object(_object(run.get("people")).get("dropped"))
    frames = _object(run.get("dropped_frames"))
    counts = {reason: number(count) for reason, count in reasons.items()}
    return [
        (reason, int(count), _frames_words(frames.get(reason)))
        for reason, count in counts.items()
        if count is not None
    ]


def probabilities(run: Run) -> dict[int, float]:
    """How probable it is that each person was there, by number; empty frame by frame."""
    listed = run.get("probability")
    entries = [_object(each) for each in (listed if isinstance(listed, list) else [])]
    found = {number(each.get("person")): number(each.get("probability")) for each in entries}
    return {int(who): value for who, value in found.items() if who is not None and value is not None}


def problems(run: Run) -> list[str]:
    """What could not be solved: person, frame, joint and reason."""
    listed = _object(run.get("people")).get("problems")
    entries = listed if isinstance(listed, list) else []
    return [", ".join(f"{key} {value}" for key, value in _object(each).items()) for each in entries]


def warnings(run: Run) -> list[str]:
    """What the check of the set-up says, a sentence each."""
    return _texts(_object(run.get("setup")).get("warnings"))


def notes(run: Run) -> list[str]:
    """What the reader made of the detections, a sentence each."""
    return _texts(run.get("notes"))


def rate(run: Run) -> tuple[float | None, str]:
    """Frames a second, and where the times come from."""
    time = _object(run.get("time"))
    return number(time.get("fps")), str(time.get("source", ""))


def stages(run: Run) -> list[tuple[str, float]]:
    """Seconds of each stage."""
    spent = {name: number(value) for name, value in _object(run.get("seconds")).items()}
    return [(name, value) for name, value in spent.items() if value is not None]


def pairs(run: Run, key: str) -> list[tuple[str, str]]:
    """The entries of an object such as `versions` or `inputs`, as texts."""
    return [(str(name), _text(value)) for name, value in _object(run.get(key)).items()]


def _object(value: object) -> Mapping[str, Any]:
    return value if isinstance(value, dict) else {}


def _texts(value: object) -> list[str]:
    return [str(each) for each in value] if isinstance(value, list) else []


def _flat(table: object, prefix: str = "") -> Iterator[tuple[str, Any]]:
    """Dotted names and values of nested tables."""
    for key, value in _object(table).items():
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
    for span in spans if isinstance(spans, list) else []:
        ends = [number(end) for end in span] if isinstance(span, list) else []
        if len(ends) == 2 and None not in ends:
            start, stop = int(ends[0] or 0), int(ends[1] or 0)
            told.append(f"{start}" if stop == start + 1 else f"{start}–{stop - 1}")
    return ", ".join(told[:12]) + (f" and {len(told) - 12} stretches more" if len(told) > 12 else "")
