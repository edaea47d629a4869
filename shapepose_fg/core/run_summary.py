"""The content of run.json: checks it on reading, and merges that of several results."""

import json
from collections import Counter
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any

import numpy as np
from pydantic import BaseModel, Field, FiniteFloat

from shapepose_fg.core.frame_times import spans_of
from shapepose_fg.core.validation import validated

Run = dict[str, Any]
MOST_FRAMES = 10_000_000
"""Maximum number of frames of a recording: over four days at 25 frames a second."""


class _Time(BaseModel, strict=True):
    fps: FiniteFloat | None = None
    source: str = ""


_Span = Annotated[list[int], Field(min_length=2, max_length=2)]


class _Problem(BaseModel, strict=True):
    person: int
    frame: int
    joint: str = ""
    reason: str = ""


class _People(BaseModel, strict=True):
    dropped: dict[str, int] = {}
    problems: list[_Problem] = []


class _Spell(BaseModel, strict=True):
    camera: str
    frames: _Span


class _Finding(BaseModel, strict=True):
    cameras: list[str]
    says: str


class _Setup(BaseModel, strict=True):
    warnings: list[str] = []
    left_out: list[_Spell] = []
    doubted: list[_Spell] = []
    findings: list[_Finding] = []


class _Probability(BaseModel, strict=True):
    person: int
    probability: FiniteFloat


class _Distances(BaseModel, strict=True):
    median_px: FiniteFloat | None = None
    median_mm: FiniteFloat | None = None


class CameraEntry(BaseModel, strict=True):
    """The entry of run.json about the detections of a camera, as `cameras.check.report.CameraUse`
    writes it.
    """

    camera: str = ""
    offered: int | None = None
    used: int = 0
    left_out: _Distances = _Distances()


class RunEntries(BaseModel, strict=True):
    """Entries of run.json that this program reads again; there may be others."""

    configuration: dict[str, Any] = {}
    versions: dict[str, Any] = {}
    inputs: dict[str, Any] = {}
    notes: list[str] = []
    setup: _Setup = _Setup()
    people: _People = _People()
    cameras: list[CameraEntry] = []
    probability: list[_Probability] | dict[str, int] = []
    dropped_frames: dict[str, list[_Span]] = {}
    seconds: dict[str, FiniteFloat] = {}
    time: _Time = _Time()
    cuts: list[Annotated[int, Field(ge=0)]] = []
    body: str | None = None
    extra_factors: dict[str, Any] = {}


def entries_of(run: Mapping[str, Any]) -> RunEntries:
    """The entries of a run, as run.json has them; InputError if one of them is invalid."""
    written = json.loads(json.dumps(dict(run), default=plain))
    return validated(RunEntries, written, "run.json", "restore it or delete the entry")


def merged_run(runs: Sequence[Run]) -> Run:
    """Merge several runs: the entries that are equal in all of them, and the frames of all.

    `frames` becomes [start, stop], or a list of these if there are gaps; it is left out if a part
    has none. ValueError if configurations differ, or if two parts cover the same frame.
    """
    runs = [run for n, run in enumerate(runs) if not any(_same(run, each) for each in runs[:n])]
    if len(runs) <= 1:
        return dict(runs[0]) if runs else {}
    settings = [run["configuration"] for run in runs if run.get("configuration") is not None]
    for other in settings[1:]:
        if (found := difference(settings[0], other)) is not None:
            raise ValueError(
                f"parts must have the same configuration, but {found[0]} differs; reconstruct "
                "them with the same configuration"
            )
    first, *others = runs
    together = {
        key: value
        for key, value in first.items()
        if key != "frames" and all(_same(run.get(key), value) for run in others)
    }
    spans = [covered_frames(run) for run in runs]
    if all(each is not None for each in spans):
        covered = [frame for each in spans for span in each or [] for frame in span]
        if len(set(covered)) < len(covered):
            twice = min(frame for frame, count in Counter(covered).items() if count > 1)
            raise ValueError(f"parts must not overlap, but two of them cover frame {twice}")
        joined = [[span.start, span.stop] for span in spans_of(covered)]
        together["frames"] = joined[0] if len(joined) == 1 else joined
    return together


def difference(one: Any, other: Any, name: str = "") -> tuple[str, Any, Any] | None:
    """The dotted name of the first entry in which two nested plain values differ, and both values;
    None if they are equal.
    """
    if isinstance(one, dict) and isinstance(other, dict):
        for key in dict.fromkeys((*one, *other)):
            found = difference(one.get(key), other.get(key), f"{name}.{key}" if name else key)
            if found is not None:
                return found
        return None
    return None if _same(one, other) else (name or "all of it", one, other)


def _same(one: Any, other: Any) -> bool:
    return json.dumps(one, sort_keys=True, default=plain) == json.dumps(
        other, sort_keys=True, default=plain
    )


def plain(value: object) -> object:
    """Convert `value` to plain values for JSON: arrays to lists, paths to text. TypeError if that
    is impossible.
    """
    if isinstance(value, np.ndarray | np.generic):
        return value.tolist()
    if isinstance(value, Path):
        return str(value)
    raise TypeError(f"run must hold plain values, got {type(value).__name__}")


def covered_frames(run: Mapping[str, Any]) -> list[range] | None:
    """The frames that a run covered, as ranges; None if `run` has no such entry. ValueError if the
    entry is invalid.
    """
    frames = run.get("frames")
    if frames is None:
        return None
    try:
        return [
            range(int(start), int(stop))
            for start, stop in (frames if np.ndim(frames) == 2 else [frames])
        ]
    except (TypeError, ValueError, OverflowError):
        raise ValueError(
            f'"frames" must be [start, stop] or a list of those, got {frames!r}'
        ) from None


def has_identities(run: Mapping[str, Any]) -> bool:
    """Whether people of a run were followed over time, so that their numbers are identities."""
    return bool(run.get("configuration", {}).get("temporal", True))


def check_frames(run: Mapping[str, Any]) -> None:
    """Raise ValueError if the number of frames that a run claims to cover is impossible."""
    spans = covered_frames(run) or []
    # The length of a range may be too large for `len`.
    count = sum(span.stop - span.start for span in spans)
    if any(span.start < 0 or span.stop < span.start for span in spans) or count > MOST_FRAMES:
        raise ValueError(
            f'"frames" must be [start, stop] of at most {MOST_FRAMES} frames, got '
            f"{str(run['frames'])[:40]}"
        )
