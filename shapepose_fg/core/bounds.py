"""Settings with bounds: declared in the type of a field, and checked whenever settings are created.
It also has the types of options with a few allowed values.
"""

from functools import cache
from typing import Annotated, Any, Literal, get_args, get_type_hints

from annotated_types import Interval

Metres = Annotated[float, Interval(gt=0, le=10)]
"""A distance between joints, people or rays, m; above 0."""
MetresOrNone = Annotated[float, Interval(ge=0, le=10)]
"""A distance, m, at least 0; the setting's docstring states what 0 means."""
Seconds = Annotated[float, Interval(gt=0, le=60)]
"""A duration, s; above 0."""
Share = Annotated[float, Interval(ge=0, le=1)]
"""A share, or a score, 0 to 1."""
Factor = Annotated[float, Interval(gt=0, le=1e6)]
"""A factor or a threshold without unit; above 0."""
Count = Annotated[int, Interval(ge=1, le=1000)]
"""A minimum count, 1 or more."""
Repeats = Annotated[int, Interval(ge=1, le=100)]
"""A number of repetitions, 1 or more."""
RepeatsOrNone = Annotated[int, Interval(ge=0, le=100)]
"""A number of repetitions, 0 or more."""
MOST_NUMBER = 2**53 - 1
"""The highest number of a frame or a person: the largest integer up to which doubles represent all
integers."""
Axis = Literal["x", "-x", "y", "-y", "z", "-z"]
"""A world axis, used to name the up direction of a calibration."""
Unit = Literal["m", "cm", "mm"]
"""A unit of lengths."""


class Settings:
    """Base class of dataclasses with bounds on fields. ValueError names a field if its value is out
    of bounds.
    """

    def __post_init__(self) -> None:
        for name, interval in _intervals(type(self)).items():
            problem = violated(interval, getattr(self, name))
            if problem is not None:
                raise ValueError(f"{name} must {problem}, got {getattr(self, name)}")


def range_of(kind: type, name: str) -> str | None:
    """The bounds of a field in words, such as "above 0, at most 10"; None if it has none."""
    interval = _intervals(kind).get(name) if issubclass(kind, Settings) else None
    if interval is None:
        return None
    low = f"above {interval.gt}, at most" if interval.ge is None else f"{interval.ge} to"
    return f"{low} {interval.le}"


@cache
def _intervals(kind: type) -> dict[str, Interval]:
    """The bounds of each field that has bounds."""
    hints = get_type_hints(kind, include_extras=True)
    return {name: found for name, hint in hints.items() if (found := interval_of(hint)) is not None}


def interval_of(hint: Any) -> Interval | None:
    """The bounds in a type such as `Annotated[float, Interval(gt=0)] | None`, or None."""
    parts = (part for each in (hint, *get_args(hint)) for part in getattr(each, "__metadata__", ()))
    return next((part for part in parts if isinstance(part, Interval)), None)


def violated(interval: Interval, value: Any) -> str | None:
    """The bound that a value violates, in words; None if it is within. NaN violates all bounds."""
    low, high = interval.gt if interval.ge is None else interval.ge, interval.le
    inside = low < value <= high if interval.ge is None else low <= value <= high
    if inside:
        return None
    if interval.ge == 0 and high == 1:
        return "be between 0 and 1"
    if value > high:
        return f"be at most {high}"
    return (
        "be positive"
        if interval.gt == 0
        else "not be negative"
        if low == 0
        else f"be at least {low}"
    )
