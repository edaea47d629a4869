"""Reads files within size limits and with one clear error, and writes them atomically."""

import codecs
import glob
import json
import os
import re
import stat
import tomllib
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager, suppress
from io import BufferedReader
from pathlib import Path
from secrets import token_hex
from typing import Any, BinaryIO

from shapepose_fg.core.errors import InputError, naming

SMALL, MIDDLE, BIG, LARGE = 2**20, 2**26, 2**28, 2**32
"""Maximum sizes of files, bytes: settings and small tables; cameras, or detections of one frame;
times of a recording; detections of a recording."""
PIECE = SMALL
"""Number of bytes that are read at a time from files that may be larger than memory."""
BLOCK_FRAMES = 128
"""Number of frames that are read and stored together."""
ROWS_AT_ONCE = 4096
"""Number of rows of a table, or lines of a file, that are processed at once."""
MOST_DEPTH = 64
"""Maximum depth of nested lists and objects: no format needs a fifth of it, and libyaml's loader is
recursive."""
_MOST_DOTS = 100
"""Maximum number of dots in a line of TOML: the parser's time grows with the square of the parts of
a dotted key."""
_LONG_NUMBER = re.compile(r"\d{19}")
_BROKEN_OFF = re.compile(r"(-|\.|[eE][+-]?|tr?u?|fa?l?s?|nu?l?)?\s*")
"""Matches the rest of a truncated JSON text, which ends within a number or a word, or between two
values."""


def open_regular(
    path: Path, cure: str = "check the path", most: int | None = None
) -> BufferedReader:
    """Open the file at `path` for reading bytes.

    InputError if it is missing, unreadable, larger than `most` bytes, or not a regular file:
    reading from a pipe could block forever, and a device may be endless.
    """
    try:
        _refuse_unusable(path, path.stat(), most)
        # Opened without blocking, in case the file is replaced by a pipe in between.
        flags = os.O_RDONLY | getattr(os, "O_NONBLOCK", 0) | getattr(os, "O_BINARY", 0)
        stream = os.fdopen(os.open(path, flags), "rb")
    except InputError:
        raise
    except FileNotFoundError:
        raise InputError(f"{path}: there is no such file; {cure}") from None
    except OSError as error:
        raise InputError(
            f"{path}: cannot be read ({error.strerror}); check its permissions"
        ) from None
    except ValueError:  # a zero byte in the path
        raise InputError(f"{str(path)!r}: this is not a valid file name; check the path") from None
    _refuse_unusable(path, os.fstat(stream.fileno()), most)
    return stream


def _refuse_unusable(path: Path, status: os.stat_result, most: int | None) -> None:
    if stat.S_ISDIR(status.st_mode):
        raise InputError(f"{path}: this is a folder; give the file inside it")
    if not stat.S_ISREG(status.st_mode):
        raise InputError(f"{path}: this is a pipe or a device; write it into a file first")
    if most is not None:
        _check_size(path, status.st_size, most)


def is_inside(folder: Path, name: str | Path) -> bool:
    """Whether `folder / name` lies in the folder after resolving links; False if the name is not a
    valid path.
    """
    try:
        return (folder / name).resolve().is_relative_to(folder.resolve())
    except (OSError, RuntimeError, ValueError):  # cyclic links, or a zero byte
        return False


def inside(folder: Path, name: str) -> Path:
    """`folder / name`; InputError if a link there leads out of the folder, so that nothing is
    written outside.
    """
    if not is_inside(folder, name):
        cure = "remove it, or give that folder"
        raise InputError(f"{folder / name}: this link leads out of its folder; {cure}")
    return folder / name


def files_below(folder: Path, suffixes: tuple[str, ...] | None = None) -> Iterator[Path]:
    """Files in a folder and its subfolders, with one of the `suffixes`; links to folders are
    followed.
    """
    entered = {folder.resolve()}
    for place, folders, names in os.walk(folder, followlinks=True):
        real = {name: Path(place, name).resolve() for name in folders}
        folders[:] = [name for name in folders if real[name] not in entered]
        entered.update(real.values())
        yield from (
            Path(place, name) for name in names if suffixes is None or Path(name).suffix in suffixes
        )


def read_bytes(path: Path, most: int = LARGE) -> bytes:
    """Content of the file at `path`. Raises InputError as `open_regular` does, also if it has more
    than `most` bytes.
    """
    with open_regular(path, most=most) as stream:
        # As many bytes as are asked for are allocated.
        content = stream.read(min(os.fstat(stream.fileno()).st_size, most) + 1)
    _check_size(path, len(content), most)
    return content


def _check_size(path: Path, size: int, most: int) -> None:
    if size > most:
        raise InputError(
            f"{path}: the file is over {most >> 20} MiB, too large for its kind; check the path"
        )


def read_text(path: Path, *, may_be_empty: bool = False, most: int = LARGE) -> str:
    """Text of the UTF-8 file at `path`. Raises InputError as `read_bytes` does, and if the file is
    empty or not UTF-8.
    """
    try:
        text = read_bytes(path, most).decode("utf-8-sig")
    except UnicodeDecodeError as error:
        raise not_text(path, error.start) from None
    if not may_be_empty and not text.strip():
        raise _empty(path)
    return text


def text_pieces(path: Path) -> Iterator[str]:
    """Text of the UTF-8 file at `path` in pieces of up to `PIECE` bytes. Raises InputError as
    `read_text` does.
    """
    decoder, at, empty = codecs.getincrementaldecoder("utf-8-sig")(), 0, True
    with open_regular(path, most=LARGE) as stream:
        ended = False
        while not ended:
            read = stream.read(PIECE)
            _check_size(path, at + len(read), LARGE)
            waiting, ended = len(decoder.getstate()[0]), len(read) == 0
            try:
                text = decoder.decode(read, final=ended)
            except UnicodeDecodeError as error:
                raise not_text(path, at - waiting + error.start) from None
            at, empty = at + len(read), empty and not text.strip()
            if len(text) > 0:
                yield text
    if empty:
        raise _empty(path)


def _empty(path: Path) -> InputError:
    return InputError(f"{path}: the file is empty; write or copy it again")


def read_json(path: Path, *, most: int = LARGE) -> Any:
    """Content of the JSON file at `path`; InputError that names the line, also for a duplicate key.

    NaN and Infinity are accepted as floats; later validation of the values names their key.
    """
    return parse_json(read_text(path, most=most), path)


def parse_json(text: str, path: Path | str) -> Any:
    """Parse the JSON `text` of the file at `path`, with the checks that `read_json` makes."""
    # Others than a JSONDecodeError: an integer of 5,000 digits, or 10,000 open brackets.
    words = "cannot be read as JSON ({})"
    with naming(path, "write the file again", words, ValueError, RecursionError):
        try:
            value = json.loads(text, object_pairs_hook=lambda pairs: unique_keys(pairs, path))
        except json.JSONDecodeError as error:
            cut = error.msg.startswith("Unterminated") or _BROKEN_OFF.fullmatch(text, error.pos)
            ends = " (the file ends too early)" if cut else ""
            raise InputError(
                f"{path}: line {error.lineno} column {error.colno} is not JSON: {error.msg}{ends}; "
                "correct it or write the file again"
            ) from None
    return bounded(value, path, numbers=has_long_number(text))


def not_text(path: Path, byte: int) -> InputError:
    """The error for a file that is not UTF-8 text at `byte`."""
    with path.open("rb") as stream:
        begin = stream.read(2)
    if begin in (codecs.BOM_UTF16_LE, codecs.BOM_UTF16_BE):
        return InputError(f"{path}: this is UTF-16 text; save it as UTF-8")
    return InputError(
        f"{path}: byte {byte} is not UTF-8 text; check the path, or save the file as UTF-8"
    )


def has_long_number(text: str, start: int = 0, stop: int | None = None) -> bool:
    """Whether a number in a JSON text may have more than 64 bits."""
    return _LONG_NUMBER.search(text, start, len(text) if stop is None else stop) is not None


def read_toml(path: Path, *, may_be_empty: bool = False) -> dict[str, Any]:
    """Content of the TOML file at `path`; InputError that names what is wrong with it."""
    return parse_toml(path, read_text(path, may_be_empty=may_be_empty, most=SMALL))


def parse_toml(path: Path, text: str) -> dict[str, Any]:
    """Parse the TOML `text` of the file at `path`."""
    if len(text) > SMALL:
        raise InputError(
            f"{path}: the file has {len(text)} characters, too many for TOML; check the path"
        )
    for number, line in enumerate(text.splitlines(), 1):
        if line.count(".") > _MOST_DOTS and not line.lstrip().startswith("#"):
            raise InputError(
                f"{path}: line {number} has over {_MOST_DOTS} dots; split it into several lines"
            )
    # A ValueError that is no syntax error: an integer of 5,000 digits.
    cure, words = "correct it or write the file again", "cannot be read as TOML ({})"
    with naming(path, cure, words, ValueError, RecursionError):
        return bounded(tomllib.loads(text), path)


def bounded(value: Any, path: Path | str, *, numbers: bool = True) -> Any:
    """Return `value`, parsed from `path`; InputError if its lists and objects are nested too
    deeply.

    With `numbers`, also if an integer has more than 64 bits: these do not fit into floats and
    arrays, and the time to print them is quadratic in their length.
    """
    waiting: list[tuple[tuple[Any, ...], Any]] = [((), value)]
    while len(waiting) > 0:
        way, each = waiting.pop()
        if len(way) > MOST_DEPTH:
            raise InputError(f"{path}: its lists are over {MOST_DEPTH} deep; write the file again")
        items = (
            each.items()
            if isinstance(each, dict)
            else enumerate(each)
            if isinstance(each, list)
            else ()
        )
        for key, child in items:
            if isinstance(child, dict | list):
                waiting.append(((*way, key), child))
            elif numbers and type(child) is int and not -(2**63) <= child < 2**63:
                place = "".join(
                    f"[{part}]" if isinstance(part, int) else f".{part}" for part in (*way, key)
                )
                place = place.removeprefix(".")[:80]
                raise InputError(f"{path}: {place} is a whole number of over 18 digits; correct it")
    return value


def write_atomically(path: Path, write: Callable[[BinaryIO], object]) -> None:
    """Write a file atomically: `write` fills a temporary file beside `path`, which is then renamed.

    If the process dies, `path` is the old file or the complete new one. OSError that names `path`
    if that fails.
    """
    write_together({path: write})


def write_content(path: Path, content: str | bytes) -> None:
    """Write `content` with `write_atomically`; text as UTF-8."""
    data = content.encode() if isinstance(content, str) else content
    write_atomically(path, lambda stream: stream.write(data))


def write_together(
    files: Mapping[Path, Callable[[BinaryIO], object]],
    check: Callable[[Mapping[Path, Path]], object] = lambda _: None,
) -> None:
    """`write_atomically` for several files, in order; none is put in place before all are complete.

    Before that, `check` is called with the temporary names of the complete files.
    """
    temporary: dict[Path, Path] = {}
    try:
        for path, write in files.items():
            with naming_file(path):
                path.parent.mkdir(parents=True, exist_ok=True)
                temporary[path] = path.with_name(f".{path.name}.{token_hex(4)}{_PART}")
                with temporary[path].open("xb") as stream:
                    write(stream)
                    stream.flush()
                    os.fsync(stream.fileno())
        check(temporary)
        for path in files:
            with naming_file(path):
                temporary[path].replace(path)
            del temporary[path]
    finally:
        for left in temporary.values():
            with suppress(OSError):  # such as on a read-only disk: the first error says why
                left.unlink(missing_ok=True)
    # The renaming itself is synced to disk, if the system supports it; some network file systems do
    # not.
    for folder in {path.parent for path in files} if os.name == "posix" else ():
        descriptor = os.open(folder, os.O_RDONLY)
        with suppress(OSError):
            os.fsync(descriptor)
        os.close(descriptor)


def user_cache(what: str) -> Path:
    """The folder of the user's cache for `what`; below XDG_CACHE_HOME if that is set.

    It may not exist, or not be writable: the user of a container may have no home.
    """
    home = os.path.expanduser("~")  # noqa: PTH111
    base = os.environ.get("XDG_CACHE_HOME") or f"{home if home != '~' else ''}/.cache"
    return Path(base) / "shapepose-fg" / what


def sweep(folder: Path, name: str | None = None) -> None:
    """Remove temporary files that a killed process left in `folder`, of the file `name` or of any
    file.

    No other process may be writing there.
    """
    for left in folder.glob(f".*{_PART}" if name is None else f".{glob.escape(name)}.*{_PART}"):
        left.unlink(missing_ok=True)


_PART = ".part"
"""Suffix of temporary files."""


@contextmanager
def naming_file(path: Path) -> Iterator[None]:
    """Add `path` to an OSError inside the block that names no file, or a temporary file beside
    `path`.
    """
    try:
        yield
    except OSError as error:
        if error.filename is not None and not Path(str(error.filename)).name.startswith(
            f".{path.name}."
        ):
            raise
        raise OSError(error.errno, error.strerror, str(path)) from error


def unique_keys(pairs: list[tuple[str, Any]], path: Path | str) -> dict[str, Any]:
    """The members of an object; InputError for a duplicate key, of which JSON parsers silently keep
    the last.
    """
    members: dict[str, Any] = {}
    for key, value in pairs:
        if key in members:
            raise InputError(
                f'{path}: key "{key}" occurs twice in one object; give each its own name'
            )
        members[key] = value
    return members
