"""TRC, the marker file of OpenSim and Pose2Sim: one person's points over time, y up."""

import math
from dataclasses import dataclass
from pathlib import Path
from typing import NoReturn

import numpy as np
from numpy.typing import NDArray

from shapepose_fg.core.camera import Axis
from shapepose_fg.core.errors import InputError
from shapepose_fg.core.skeleton import MID_HIP
from shapepose_fg.core.storage.files import read_text
from shapepose_fg.io.export.take import opensim_axes

METRES = {"m": 1.0, "cm": 0.01, "mm": 0.001}
"""What a unit of the header is."""
MIDDLES = ("CHip", "Hip")
"""What Pose2Sim calls the middle of the hips."""

_MAX_MARKERS = 1000
_HEADINGS = ("nummarkers", "units")
_CURE = "write the file again"


@dataclass(frozen=True)
class TrcFile:
    """One person's M markers in F frames."""

    names: tuple[str, ...]
    """(M,) names, the middle of the hips as `MidHip`."""
    frame: NDArray[np.int64]
    """(F,) numbers of the frames, as written, which rise."""
    time_s: NDArray[np.float64]
    """(F,) seconds, as written."""
    xyz: NDArray[np.float64]
    """(F, M, 3) metres in the world; NaN where a marker is missing."""


def read_trc(path: Path, up: Axis = "z") -> TrcFile:
    """Read such a file into a world with the axis `up` upwards, turned as Pose2Sim and `export` turn it to y up.

    A marker is missing where a cell is empty or NaN, or the line ends early. How many frames the header promises
    is not looked at: Pose2Sim's filter leaves one out and keeps the number. InputError that names file and line
    for anything else that is no number, for a unit that is not m, cm or mm, and for frames that do not rise.
    """
    lines = _Table(path)
    header = lines.header()
    scale = METRES.get(header["units"].lower())
    if scale is None:
        lines.refuse(3, f"has the unit {header['units'][:20]!r}; it must be m, cm or mm")
    names = lines.names(header["nummarkers"])
    numbers, times, rows = list[int](), list[float](), list[list[float]]()
    for place, cells in lines.rows():
        number, time_s = (lines.number(place, cell) for cell in (*cells[:2], *[""] * (2 - len(cells[:2]))))
        if not (math.isfinite(number) and math.isfinite(time_s) and number == int(number)):
            lines.refuse(place, "must begin with the number of a frame and its time")
        if abs(number) >= 2**53 or (numbers and number <= numbers[-1]):
            lines.refuse(place, f"is of frame {number:.0f}: frames must rise")
        values = [lines.number(place, cell) for cell in cells[2:]]
        if len(values) > 3 * len(names):
            if not all(math.isnan(value) for value in values[3 * len(names) :]):
                lines.refuse(place, f"holds more than {len(names)} markers")
            values = values[: 3 * len(names)]
        numbers.append(int(number))
        times.append(time_s)
        rows.append(values + [math.nan] * (3 * len(names) - len(values)))
    written = scale * np.array(rows, dtype=np.float64).reshape(len(rows), len(names), 3)
    # A marker of which one coordinate is missing is missing.
    written = np.where(np.isfinite(written).all(axis=-1, keepdims=True), written, np.nan)
    named = tuple(MID_HIP if name in MIDDLES else name for name in names)
    return TrcFile(
        named, np.array(numbers, dtype=np.int64), np.array(times, dtype=np.float64), written @ opensim_axes(up)
    )


class _Table:
    """The lines of a file, cut at tabs."""

    def __init__(self, path: Path) -> None:
        self._path = path
        self._lines = [line.split("\t") for line in read_text(path).splitlines()]

    def refuse(self, place: int, complaint: str) -> NoReturn:
        raise InputError(f"{self._path}: line {place} {complaint}; {_CURE}")

    def header(self) -> dict[str, str]:
        """Values of the third line by the headings of the second, in small letters."""
        if not is_trc(self._lines[0][0]) or len(self._lines) < 5:
            raise InputError(
                f"{self._path}: does not begin as a TRC file does (PathFileType, then five lines); {_CURE}"
            )
        headings = [cell.strip().lower() for cell in self._lines[1]]
        found = dict(zip(headings, (cell.strip() for cell in self._lines[2]), strict=False))
        for heading in _HEADINGS:
            if heading not in found:
                self.refuse(3, f"has no value for {heading}")
        return found

    def names(self, count: str) -> tuple[str, ...]:
        """The names of the markers, as many as the header says."""
        names = [cell.strip() for cell in self._lines[3][2:] if cell.strip()]
        if not count.isdecimal() or not 0 < int(count[:9]) <= _MAX_MARKERS:
            self.refuse(3, f"says {count[:20]!r} markers; it must say 1 to {_MAX_MARKERS}")
        if len(names) != int(count[:9]):
            self.refuse(4, f"names {len(names)} markers, line 3 says {count[:9]}")
        if len(set(names)) < len(names):
            self.refuse(4, "gives two markers one name")
        return tuple(names)

    def rows(self) -> list[tuple[int, list[str]]]:
        """Number and cells of the lines that are not blank, after the five of the header."""
        return [
            (place, cells) for place, cells in enumerate(self._lines[5:], 6) if any(cell.strip() for cell in cells)
        ]

    def number(self, place: int, cell: str) -> float:
        """What a cell holds; NaN for an empty one."""
        word = cell.strip()
        try:
            value = float(word) if word else math.nan
        except ValueError:
            value = math.inf
        if math.isinf(value):
            self.refuse(place, f"holds {word[:20]!r}, which is no number")
        return value


def is_trc(beginning: str) -> bool:
    """Whether a file that begins so is a TRC file."""
    return beginning.lstrip("\ufeff").startswith("PathFileType")
