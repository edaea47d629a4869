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
    parse_json,
    read_text,
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
                raise text.refused()
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
        self._path, self._pieces = path, text_pieces(path)
        self._left, self._at = "", 0
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
            raise self.refused()
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
                raise self.refused() from None
            except (ValueError, RecursionError) as error:  # 5,000 digits, or 10,000 open brackets
                raise error if isinstance(error, InputError) else self.refused() from None
            number = isinstance(value, int | float) and end >= len(self._left) - len("e-")
            if number and self._more():  # the number may continue
                continue
            long = has_long_number(self._left, self._at, end)
            self._at = end
            return bounded(value, self._path, numbers=long)

    def end(self) -> None:
        """The text must end here."""
        if self.peek() != "":
            raise self.refused()

    def refused(self) -> InputError:
        """The error of the whole file, which is read again for it."""
        try:
            parse_json(read_text(self._path), self._path)
        except InputError as error:
            return error
        return InputError(f"{self._path}: the file changed while it was read; start again")

    def _more(self) -> bool:
        """Read on, at least as much as is waiting, so that a long value is decoded few times; False
        at the end.
        """
        left = self._left[self._at :]
        if len(left) > MIDDLE:
            raise InputError(
                f"{self._path}: one value has over {MIDDLE >> 20} MiB; write the file again"
            )
        parts, wanted = [left], max(len(left), 1)
        while wanted > 0 and (piece := next(self._pieces, None)) is not None:
            parts.append(piece)
            wanted -= len(piece)
        if len(parts) == 1:
            return False
        self._left, self._at = "".join(parts), 0
        return True
