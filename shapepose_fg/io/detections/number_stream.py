"""The numbers of a text file, read piece by piece, so that the file may be larger than memory."""

from collections.abc import Iterator
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from shapepose_fg.core.errors import InputError
from shapepose_fg.core.storage.files import text_pieces
from shapepose_fg.io.validation import is_number

_LONGEST_WORD = 2**20
"""No number is as long."""
_SPACE = " \n\t"
"""Pieces end behind one of these, so that no number, letter or end of line is cut."""


def _whole_words(path: Path) -> Iterator[str]:
    """Text of the file at `path` in pieces that end at white space; InputError as of `files.text_pieces`."""
    left = ""
    for piece in text_pieces(path):
        left += piece
        cut = 1 + max(left.rfind(space) for space in _SPACE)
        if cut == 0 and len(left) > _LONGEST_WORD:
            cut = len(left)
        if cut > 0:
            yield left[:cut]
            left = left[cut:]
    if left:
        yield left


class NumberStream:
    """The numbers of a file in order. Only some of them are in memory: those since the last `forget`."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self.first = 0
        """How many numbers were forgotten."""
        self.values: NDArray[np.float64] = np.zeros(0)
        """Numbers from the first that is not forgotten on."""
        self._pieces = _whole_words(path)
        self._most = path.stat().st_size // 2 + 1

    def reaches(self, count: int) -> bool:
        """Whether the file has so many numbers; they are in memory then."""
        if count > self._most:  # no room in the file: it is not read to its end for that
            return False
        parts, known = [self.values], self.first + len(self.values)
        while known < count and (text := next(self._pieces, None)) is not None:
            parts.append(self._numbers(text, known))
            known += len(parts[-1])
        if len(parts) > 1:
            self.values = np.concatenate(parts)
        return known >= count

    def forget(self, count: int) -> None:
        """The first `count` numbers of the file are done with."""
        self.values, self.first = self.values[count - self.first :].copy(), count

    def count(self) -> int:
        """How many numbers the file has; all are forgotten."""
        while True:
            self.forget(self.first + len(self.values))
            if not self.reaches(self.first + 1):
                return self.first

    def refuse(self, index: int | None, problem: str, cure: str) -> InputError:
        """An error about number `index`; None is what should be behind the last."""
        return InputError(f"{self.path}: line {self._line(index)}: {problem}; {cure}")

    def _numbers(self, text: str, first: int) -> NDArray[np.float64]:
        """The numbers of a piece, finite; `first` are before it."""
        tokens = text.split()
        try:
            values = np.array(tokens, dtype=np.float64)
        except ValueError:
            values = np.full(1, np.nan)
        if not np.isfinite(values).all():
            bad = next(index for index, token in enumerate(tokens) if not is_number(token))
            problem = f"{tokens[bad][:20]!r} is not a finite number"
            raise self.refuse(first + bad, problem, "write the detections again")
        return values

    def _line(self, index: int | None) -> int:
        """The line, from 1, on which a number stands; None, and what is behind the last: the last line."""
        lines, numbers, last = 0, 0, 1
        for text in _whole_words(self.path):
            counts = [len(line.split()) for line in text.splitlines()]
            ends = numbers + np.cumsum(counts)
            if index is not None and len(ends) > 0 and index < ends[-1]:
                return lines + int(np.searchsorted(ends, index, side="right")) + 1
            numbers += sum(counts)
            last = lines + max(len(counts), 1)
            # A line that goes on in the next piece is not over.
            lines += len((text + "|").splitlines()) - 1
        return last
