"""Converts entries of run.json to words; invalid entries are refused."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

from shapepose_fg.core.run_summary import covered_frames, entries_of, has_identities
from shapepose_fg.estimation.noise_law import NoiseLaw
from shapepose_fg.pipeline.config import PipelineConfig

Run = Mapping[str, Any]


def page_entries(run: Run) -> dict[str, Any]:
    """The entries of a run that the page shows, by the names in the page's template. InputError if
    one of them is invalid.
    """
    entries, spans = entries_of(run), covered_frames(run) or []
    listed = entries.probability if isinstance(entries.probability, list) else []
    return {
        "warnings": entries.setup.warnings,
        "notes": entries.notes,
        "problems": [
            ", ".join(f"{key} {it}" for key, it in each.model_dump(exclude_unset=True).items())
            for each in entries.people.problems
        ],
        "dropped": [
            (reason, count, _frames_words(entries.dropped_frames.get(reason, [])))
            for reason, count in entries.people.dropped.items()
        ],
        "probabilities": {each.person: each.probability for each in listed},
        "fps": entries.time.fps,
        "source": entries.time.source,
        "frames": ", ".join(f"{span.start}–{span.stop - 1}" for span in spans if len(span) > 0),
        "cuts": ", ".join(map(str, entries.cuts)),
        "body": entries.body,
        "time": _time(entries.seconds),
        "configured": "configuration" in run,
        "noise": _noise(run),
        "over_time": has_identities(run),
        "changed": _changed_settings(entries.configuration),
        "versions": [(name, _text(value)) for name, value in entries.versions.items()],
        "inputs": [(name, _text(value)) for name, value in entries.inputs.items()],
    }


def _changed_settings(configuration: Run) -> list[tuple[str, str, str]]:
    """Settings that differ from the default: dotted name, value, default; a dash if the setting no
    longer exists.

    Tables of older versions, which contain all settings, are left out.
    """
    usual = dict(_flat(asdict(PipelineConfig())))
    given = {
        name: (_text(value), _text(usual.get(name, "–"))) for name, value in _flat(configuration)
    }
    return [
        (name, value, default)
        for name, (value, default) in given.items()
        if value != default and name.split(".")[0] not in PipelineConfig.replaced
    ]


def _noise(run: Run) -> list[tuple[float, float, float, float, int]]:
    """Table of the detector's noise law, with a row for each range of scores that had detections.

    Columns are the middle of the range, the standard deviation, mm, that of the shipped law, mm,
    the share of gross errors, and the number of detections.
    """
    law, usual = NoiseLaw.read(run, Path("run.json")).as_dict(), NoiseLaw.shipped().as_dict()
    columns = law["score"], law["sigma_mm"], usual["sigma_mm"], law["gross"], law["count"]
    return [row for row in zip(*columns, strict=True) if row[-1] > 0]


def _time(spent: Mapping[str, float]) -> str:
    """Durations of the stages, the longest first; empty if they are missing."""
    longest = sorted((each for each in spent.items() if each[1] >= 0.05), key=lambda each: -each[1])
    listed = ", ".join(f"{name} {value:.1f}" for name, value in longest)
    return f"{sum(spent.values()):.1f} s of processor time: {listed}" if len(spent) > 0 else ""


def _flat(table: Run, prefix: str = "") -> Iterator[tuple[str, Any]]:
    """Dotted names and values of nested tables."""
    for key, value in table.items():
        if isinstance(value, dict):
            yield from _flat(value, f"{prefix}{key}.")
        else:
            yield f"{prefix}{key}", value


def _text(value: object) -> str:
    """A setting for comparison and display: lists equal tuples, and 1 equals 1.0."""
    if isinstance(value, list | tuple):
        return ", ".join(map(_text, value))
    is_number = isinstance(value, int | float) and not isinstance(value, bool)
    return f"{value:g}" if is_number else str(value)


def _frames_words(spans: Sequence[Sequence[int]]) -> str:
    """`0–3, 17, 20–25 and more` of [start, stop) spans."""
    words = [f"{start}" if stop == start + 1 else f"{start}–{stop - 1}" for start, stop in spans]
    return ", ".join(words[:12]) + (
        f" and {len(words) - 12} more segments" if len(words) > 12 else ""
    )
