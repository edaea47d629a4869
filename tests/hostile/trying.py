"""A reader on changed files: what may come of it, and what is a fault."""

import faulthandler
import importlib
import os
import random
import resource
import sys
import tempfile
import time
import traceback
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from shapepose_fg.core.errors import InputError
from shapepose_fg.core.storage.files import user_cache
from tests.hostile.mutations import mutated

CASE_S, CASE_MB = 20, 1024
"""So long a case may take, and so much more memory than was in use before."""

_WRITES = os.O_WRONLY | os.O_RDWR | os.O_CREAT | os.O_TRUNC
_CHANGES = {
    "os.rename": ((0, 2), (1, 3)),
    "os.link": ((1, 3),),
    "os.symlink": ((1, 2),),
    "os.remove": ((0, 1),),
    "os.mkdir": ((0, 2),),
    "os.rmdir": ((0, 1),),
}
"""What Python tells of files that are changed: which arguments are paths, and the folders that
these are in."""
_KERNELS = os.path.realpath(os.environ.get("NUMBA_CACHE_DIR") or user_cache("kernels"))
"""Where compiled functions are kept, which are part of the program."""
_READABLE = (
    *{
        os.path.realpath(each)
        for each in (sys.prefix, sys.base_prefix, Path(__file__).parents[2], _KERNELS)
    },
    *("/proc", "/sys", "/dev", "/usr/share/zoneinfo"),
)
"""Where files may be read besides: this project and what it is made of."""
_allowed: list[tuple[str, ...]] = []
"""Where files may be changed at present: the last ones count."""
_outside: list[str] = []
"""What was to be changed elsewhere."""


Prepare = Callable[[Path, int], Callable[[], object]]
"""Writes valid files into a folder, other ones for another seed, and returns what reads them."""


class Trial:
    """A reader with valid files in a folder, of which one at a time is changed."""

    def __init__(self, prepare: Prepare, folder: Path, seed: int) -> None:
        """`prepare` writes the files there, other ones for another `seed`, and gives the reader."""
        self.folder, self.read = folder, prepare(folder, seed)
        self.files = sorted(path for path in folder.rglob("*") if path.is_file())
        self.valid = [file.read_bytes() for file in self.files]
        self._allowed = str(folder), tempfile.gettempdir()

    def run(self, number: int, content: bytes) -> bool:
        """Whether the files are refused, in one sentence, when a file has this content.

        AssertionError where more is said, or something is written elsewhere; whatever else the
        reader raises.
        """
        file = self.files[number]
        file.write_bytes(content)
        _outside.clear()
        try:
            with only_in(*self._allowed):
                self.read()
            return False
        except InputError as error:
            if "\n" in str(error) or len(str(error)) > 1000:
                raise AssertionError("more than a sentence") from error
            return True
        finally:
            file.write_bytes(self.valid[number])
            if len(_outside) > 0:
                raise AssertionError(f"written or read elsewhere: {_outside}")


@contextmanager
def only_in(*folders: str | Path) -> Iterator[None]:
    """What Python itself changes outside of these folders during the block, or reads outside of
    them and of the program, is an AssertionError.
    """
    if len(_allowed) == 0 and not _watching:
        sys.addaudithook(_watch)
        _watching.append(True)
    _allowed.append(tuple(os.path.realpath(folder) for folder in folders))
    try:
        yield
    finally:
        _allowed.pop()


_watching: list[bool] = []


def _watch(event: str, told: tuple[Any, ...]) -> None:
    """What Python calls before files are opened or changed; it cannot be taken back, only sent to
    sleep.
    """
    if len(_allowed) == 0:
        return
    paths: list[tuple[Any, Any]] = []
    if event == "open" and told[2] is not None and told[2] & _WRITES:
        paths = [(told[0], -1)]
    elif event == "open" and isinstance(told[0], str | bytes):
        place = Path(os.path.realpath(os.fsdecode(told[0])))
        if not any(place.is_relative_to(each) for each in (*_allowed[-1], *_READABLE)):
            _outside.append(f"open {place}")
            raise AssertionError(f"read elsewhere: {place}")
    elif event in _CHANGES:
        paths = [(told[path], told[folder]) for path, folder in _CHANGES[event]]
    for path, folder in paths:
        if isinstance(path, str | bytes):
            named = Path("." if folder == -1 else f"/proc/self/fd/{folder}") / os.fsdecode(path)
            place = Path(os.path.realpath(named.parent)) / named.name
            inside = any(place.is_relative_to(each) for each in (*_allowed[-1], _KERNELS))
            if not inside and str(place) != os.devnull and "__pycache__" not in place.parts:
                _outside.append(f"{event} {place}")
                raise AssertionError(f"written elsewhere: {place}")


@dataclass
class Tally:
    """What came of many cases."""

    cases: Counter[str] = field(default_factory=Counter)
    """How many there were of each file."""
    refused: int = 0
    """How many were refused."""
    faults: set[str] = field(default_factory=set)
    """Where something broke."""
    slowest: tuple[float, str] = (0.0, "")
    """Seconds that the slowest took, and of which file."""

    def __str__(self) -> str:
        files = ", ".join(f"{file} {count}" for file, count in sorted(self.cases.items()))
        return f", {self.refused} refused; slowest {self.slowest[0]} s, {self.slowest[1]}; {files}"


def tried(trial: Trial, seed: str, numbers: range) -> Tally:
    """What comes of changed files, each by its number.

    What breaks the reader, one of each place in the code, is left in the working folder. A case
    that hangs ends this process, and one that takes over `CASE_MB` is a fault.
    """
    tally, names = Tally(), [str(file.relative_to(trial.folder)) for file in trial.files]
    trial.run(0, trial.valid[0])  # what is loaded once is loaded now
    for number in numbers:
        rng = random.Random(f"{seed} {number}")
        which = rng.randrange(len(names))
        content, start, used_mb = mutated(trial.valid[which], rng), time.perf_counter(), _used_mb()
        case = Path(f"crash-{number:08x}")
        case.write_bytes(bytes([which]) + content)
        faulthandler.dump_traceback_later(CASE_S, exit=True)
        try:
            tally.refused += trial.run(which, content)
            if _used_mb() > used_mb + CASE_MB:
                raise AssertionError(f"took {_used_mb() - used_mb} MiB of memory")
            case.unlink()
        except Exception as error:
            places = traceback.extract_tb(error.__traceback__)
            own = [each for each in places if "/shapepose_fg/" in each.filename] or places
            where = f"{type(error).__name__} {own[-1].filename}:{own[-1].lineno}"
            if where in tally.faults:
                case.unlink()
            else:
                tally.faults.add(where)
                print(f"{case.name}, {names[which]}:", file=sys.stderr)
                traceback.print_exc()
        finally:
            faulthandler.cancel_dump_traceback_later()
        tally.cases[names[which]] += 1
        tally.slowest = max(tally.slowest, (round(time.perf_counter() - start, 2), names[which]))
    return tally


def reader(name: str) -> Prepare:
    """That of `readers.READERS`, which is only loaded now."""
    return importlib.import_module("tests.hostile.readers").READERS[name]


def guided(name: str, seed: int, seconds: int) -> None:
    """Try files changed for a reader, guided by which lines they reach, until one breaks or the
    time is up.
    """
    try:
        atheris: Any = importlib.import_module("atheris")
    except ImportError:
        sys.exit('error: to be guided needs atheris; pip install -e ".[fuzz]", or give --cases')
    with atheris.instrument_imports(include=["shapepose_fg"]):
        prepare = reader(name)
    trial, corpus = Trial(prepare, Path("files").resolve(), seed), Path("corpus")
    corpus.mkdir()
    for index, content in enumerate(trial.valid[:64]):
        (corpus / str(index)).write_bytes(bytes([index]) + content)

    def case(data: bytes) -> None:
        """The first byte says which file, the others are its content."""
        if len(data) > 0:
            trial.run(data[0] % len(trial.files), data[1:])

    def change(data: bytes, most: int, number: int) -> bytes:
        """Mostly by what the file is, now and then by libFuzzer's own changes."""
        rng = random.Random(number)
        if rng.random() < 0.2:
            return atheris.Mutate(data, most)
        index = data[0] % len(trial.files) if data else 0
        content = data[1:] if rng.random() < 0.7 and len(data) > 1 else trial.valid[index]
        return (bytes([index]) + mutated(content, rng))[:most]

    case(bytes([0]) + trial.valid[0])  # what is loaded once is loaded now
    options = [
        f"-max_total_time={seconds}",
        f"-timeout={CASE_S}",
        f"-seed={seed + 1}",
        "-print_final_stats=1",
    ]
    options += [f"-rss_limit_mb={_used_mb() + CASE_MB}", f"-malloc_limit_mb={CASE_MB}"]
    options += [f"-max_len={max(map(len, trial.valid)) + 20_000}", str(corpus)]
    atheris.Setup([sys.argv[0], *options], case, custom_mutator=change)
    atheris.Fuzz()


def _used_mb() -> int:
    """The most memory that this process has had."""
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss // 1024
