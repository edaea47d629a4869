"""Reads the items of a list in a JSON file one at a time: as Python's objects, all of them would
take many times the memory of the text.
"""

import json
import re
from collections.abc import Collection, Iterator
from pathlib import Path
from typing import Any

from shapepose_fg.core.errors import InputError
from shapepose_fg.core.storage.files import (
    bounded,
    has_long_number,
    parse_json,
    read_text,
    unique_keys,
)

_SPACE = re.compile(r"[ \t\n\r]*")


class JsonItems:
    """Iterates over the items of a JSON file that is a list, or an object with a list under one of
    some keys.

    Raises InputError as `files.read_json` does, when the faulty place is reached.
    """

    def __init__(self, path: Path, keys: Collection[str]) -> None:
        """Decode up to the list's first item, or to the end if there is no such list."""
        self.path = path
        self.key: str | None = None
        """The key of the list; None if the file itself is the list, or if there is none."""
        self.value: Any = None
        """The value if it is not a list: under the key, or of the whole file (for an object,
        without its values)."""
        self.others: dict[str, Any] = {}
        """Values of other keys; those after the list are complete when all items have been read."""
        self._text, self._at = read_text(path), 0
        self._decoder = json.JSONDecoder(object_pairs_hook=lambda pairs: unique_keys(pairs, path))
        begin = self._peek()
        self.found, self._in_object = begin == "[", begin == "{"
        """Whether there is such a list."""
        if self._in_object:
            self.value = {}
            self._next_of("{")
            self._members(keys, may_end=True)
        elif not self.found:
            self.value = self._decoded()
            self._end()
        if self.found:
            self._next_of("[")

    def __iter__(self) -> Iterator[Any]:
        """Iterate over the items; possible only once."""
        if not self.found:
            return
        if self._peek() == "]":
            self._next_of("]")
        else:
            yield self._decoded()
            while self._next_of(",]") == ",":
                yield self._decoded()
        if self._in_object and self._next_of(",}") == ",":
            self._members(())
        else:
            self._end()

    def _members(self, keys: Collection[str], *, may_end: bool = False) -> None:
        """Decode keys and values of the object, up to the list under one of `keys` or to the end of
        the object.
        """
        going = not (may_end and self._peek() == "}" and self._next_of("}"))
        while going:
            if self._peek() != '"':
                raise self._refused()
            key = self._decoded()
            self._next_of(":")
            if key in self.others or key == self.key:
                unique_keys([(key, None), (key, None)], self.path)
            if key in keys:
                self.key, self.found = key, self._peek() == "["
                if self.found:
                    return
                self.value = self._decoded()
            else:
                self.others[key] = self._decoded()
            going = self._next_of(",}") == ","
        self._end()

    def _peek(self) -> str:
        """The next character that is not white space; empty at the end."""
        self._at = _SPACE.match(self._text, self._at).end()  # type: ignore[union-attr]
        return self._text[self._at : self._at + 1]

    def _next_of(self, characters: str) -> str:
        """Skip the next character, which must be one of `characters`."""
        found = self._peek()
        if found == "" or found not in characters:
            raise self._refused()
        self._at += 1
        return found

    def _decoded(self) -> Any:
        """The next value."""
        self._peek()
        start = self._at
        try:
            value, self._at = self._decoder.raw_decode(self._text, start)
        except InputError:
            raise
        except (ValueError, RecursionError):  # also 5,000 digits, or 10,000 open brackets
            raise self._refused() from None
        return bounded(value, self.path, numbers=has_long_number(self._text, start, self._at))

    def _end(self) -> None:
        """The text must end here."""
        if self._peek() != "":
            raise self._refused()

    def _refused(self) -> InputError:
        """The error of the whole file."""
        try:
            parse_json(self._text, self.path)
        except InputError as error:
            return error
        return InputError(f"{self.path}: this is not JSON; write the file again")
