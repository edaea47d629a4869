"""Reads the items of a list in a JSON file one at a time, so that the file may be larger than
memory.
"""

import json
from collections.abc import Collection, Iterator
from pathlib import Path
from typing import Any

from shapepose_fg.core.errors import InputError
from shapepose_fg.core.storage.files import (
    MIDDLE,
    bounded,
    has_long_number,
    not_json,
    text_pieces,
    unique_keys,
)

_SPACE = " \t\n\r"


class JsonItems:
    """Iterates over the items of a JSON file that is a list, or an object with a list under one of
    some keys.

    Raises InputError as `files.read_json` does, when the faulty place is reached.
    """

    def __init__(self, path: Path, keys: Collection[str]) -> None:
        """Read up to the list's first item, or to the end if there is no such list."""
        self.path = path
        self.key: str | None = None
        """The key of the list; None if the file itself is the list, or if there is none."""
        self.value: Any = None
        """The value if it is not a list: under the key, or of the whole file (for an object,
        without its values)."""
        self.others: dict[str, Any] = {}
        """Values of other keys; those after the list are complete when all items have been read."""
        self._text = _Text(path)
        begin = self._text.peek()
        self.found, self._in_object = begin == "[", begin == "{"
        """Whether there is such a list."""
        if self._in_object:
            self.value = {}
            self._text.next_of("{")
            self._members(keys, may_end=True)
        elif not self.found:
            self.value = self._text.value()
            self._text.end()
        if self.found:
            self._text.next_of("[")

    def __iter__(self) -> Iterator[Any]:
        """Iterate over the items; possible only once."""
        text = self._text
        if not self.found:
            return
        if text.peek() == "]":
            text.next_of("]")
        else:
            yield text.value()
            while text.next_of(",]") == ",":
                yield text.value()
        if self._in_object and text.next_of(",}") == ",":
            self._members(())
        else:
            text.end()

    def _members(self, keys: Collection[str], *, may_end: bool = False) -> None:
        """Read keys and values of the object, up to the list under one of `keys` or to the end of
        the object.
        """
        text = self._text
        going = not (may_end and text.peek() == "}" and text.next_of("}"))
        while going:
            if text.peek() != '"':
                raise text.refuse("Expecting property name enclosed in double quotes")
            key = text.value()
            text.next_of(":")
            if key in self.others or key == self.key:
                unique_keys([(key, None), (key, None)], self.path)
            if key in keys:
                self.key, self.found = key, text.peek() == "["
                if self.found:
                    return
                self.value = text.value()
            else:
                self.others[key] = text.value()
            going = text.next_of(",}") == ","
        text.end()


class _Text:
    """A JSON text of which only the part that has not been decoded is in memory."""

    def __init__(self, path: Path) -> None:
        self._path = path
        self._pieces = text_pieces(path)
        self._left, self._at = "", 0
        self._lines, self._column = 0, 0
        self._over = False
        self._decoder = json.JSONDecoder(object_pairs_hook=lambda pairs: unique_keys(pairs, path))

    def peek(self) -> str:
        """The next character that is not white space; empty at the end."""
        while True:
            while self._at < len(self._left) and self._left[self._at] in _SPACE:
                self._at += 1
            if self._at < len(self._left):
                return self._left[self._at]
            if not self._more():
                return ""

    def next_of(self, characters: str) -> str:
        """Skip the next character, which must be one of `characters`."""
        found = self.peek()
        if found == "" or found not in characters:
            wanted = "," if "," in characters else characters
            raise self.refuse(f"Expecting {wanted!r} delimiter")
        self._at += 1
        return found

    def value(self) -> Any:
        """Decode the next value."""
        self.peek()
        while True:
            try:
                value, end = self._decoder.raw_decode(self._left, self._at)
            except json.JSONDecodeError as error:
                # Number of characters at the end of the text read so far in
                # which an error may be due to a truncated value, such as `\u00`
                # of `\u00e9`.
                cut = (
                    error.msg.startswith("Unterminated string") or error.pos >= len(self._left) - 16
                )
                if cut and self._more():
                    continue
                raise self.refuse(error.msg, error.pos) from None
            except InputError:
                raise
            except (
                ValueError,
                RecursionError,
            ) as error:  # of 5,000 digits, or 10,000 open brackets
                raise InputError(
                    f"{self._path}: cannot be read as JSON ({error}); write the file again"
                ) from None
            number = isinstance(value, int | float) and end >= len(self._left) - len("e-")
            if number and self._more():  # the number may continue
                continue
            long = has_long_number(self._left, self._at, end)
            self._at = end
            return bounded(value, self._path, numbers=long)

    def end(self) -> None:
        """Raise InputError if any text is left."""
        if self.peek() != "":
            raise self.refuse("Extra data")

    def refuse(self, problem: str, at: int | None = None) -> InputError:
        """An error at a position of the text in memory, by default at the beginning of the next
        value.
        """
        at = self._at if at is None else at
        line = self._lines + self._left.count("\n", 0, at) + 1
        begin = self._left.rfind("\n", 0, at)
        column = at - begin if begin >= 0 else self._column + at + 1
        return not_json(
            self._path, line, column, problem, rest=self._left[at:] if self._over else None
        )

    def _more(self) -> bool:
        """Read as much text again as is in memory, and drop decoded text; returns whether there was
        more.
        """
        done, left = self._left[: self._at], len(self._left) - self._at
        breaks = done.count("\n")
        if left > MIDDLE:
            problem = f"one value has over {MIDDLE >> 20} MiB"
            raise InputError(
                f"{self._path}: line {self._lines + breaks + 1}: {problem}; write the file again"
            )
        parts, wanted = [self._left[self._at :]], max(left, 1)
        while wanted > 0 and (piece := next(self._pieces, None)) is not None:
            parts.append(piece)
            wanted -= len(piece)
        if len(parts) == 1:
            self._over = True
            return False
        self._lines += breaks
        self._column = len(done) - 1 - done.rfind("\n") if breaks else self._column + len(done)
        self._left, self._at = "".join(parts), 0
        return True
