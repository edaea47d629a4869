"""Which tests reach a line of the code, and what they say when it is changed, for mutants.py.

Tests run in forks of a process that has loaded the large libraries but nothing of this project, in a copy of the
repository; so a change costs the seconds of its tests, and tests that start programs see it, too.
"""

import hashlib
import importlib
import json
import os
import re
import resource
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any

ROOT = Path(__file__).parents[1]
_LIBRARIES = (
    "numpy scipy.optimize scipy.spatial torch gtsam cv2 pydantic yaml safetensors hypothesis pytest typer rich"
)
_TESTS_A_SECOND = 12.5
"""So many tests are run at the most for each second that they may take: starting each takes its time."""


class Tree:
    """A copy of the repository, in which one file at a time is changed."""

    def __init__(self, folder: Path) -> None:
        """Bring the copy up to date."""
        self.folder = folder
        listed = ["git", "ls-files", "-z", "--cached", "--others", "--exclude-standard"]
        names = subprocess.run(listed, cwd=ROOT, capture_output=True, check=True).stdout.decode().split("\0")
        wanted = {name for name in names if name and (ROOT / name).is_file()}
        for file in [each for each in folder.rglob("*") if each.is_file() and each.suffix != ".pyc"]:
            if str(file.relative_to(folder)) not in wanted:
                file.unlink()
        for name in wanted:
            source, copy = ROOT / name, folder / name
            if not copy.exists() or copy.read_bytes() != source.read_bytes():
                copy.parent.mkdir(parents=True, exist_ok=True)
                shutil.copyfile(source, copy)

    def forked(self, work: Callable[[], int], seconds: float, said: Path) -> int | None:
        """The exit code of `work` in a fork inside the copy; None where it takes more of a processor than that.

        By the clock it may take a hundred times as long: others may need the machine, too.
        """
        for name in _LIBRARIES.split():
            importlib.import_module(name)
        sys.stdout.flush()
        child = os.fork()
        if child == 0:
            code = 3
            try:
                os.setpgrp()
                resource.setrlimit(resource.RLIMIT_CPU, (int(seconds) + 1, int(seconds) + 2))
                output = os.open(said, os.O_WRONLY | os.O_CREAT | os.O_TRUNC)
                os.dup2(output, 1)
                os.dup2(output, 2)
                os.chdir(self.folder)
                # The copy's packages, here and in programs that tests start.
                os.environ["PYTHONPATH"] = str(self.folder)
                sys.path[:] = [str(self.folder)] + [each for each in sys.path if Path(each) not in (ROOT, Path())]
                code = work()
            finally:
                os._exit(code)
        deadline = time.monotonic() + 100 * seconds
        while time.monotonic() < deadline:
            ended, status = os.waitpid(child, os.WNOHANG)
            if ended != 0:
                _end_group(child)
                code = os.waitstatus_to_exitcode(status)
                return None if code in (-signal.SIGXCPU, -signal.SIGKILL) else code
            time.sleep(0.005)
        _end_group(child)
        os.waitpid(child, 0)
        return None

    def test(self, tests: list[str], seconds: float, said: Path, plugins: Iterable[Any] = ()) -> int | None:
        """Pytest's exit code; `tests` are run in order, until one fails."""
        words = ["-x", "-q", "-p", "no:cacheprovider", "-p", "no:xdist", "--tb=line", *tests]

        def work() -> int:
            return int(importlib.import_module("pytest").main(words, plugins=list(plugins)))

        return self.forked(work, seconds, said)

    def test_changed(self, path: str, code: str, tests: list[str], seconds: float, said: Path) -> int | None:
        """`test` with another content of a file."""
        file = self.folder / path
        before = file.read_bytes()
        file.write_text(code)
        _forget_compiled(file)  # both may be as long and as old
        try:
            return self.test(tests, seconds, said)
        finally:
            file.write_bytes(before)
            _forget_compiled(file)


def _forget_compiled(file: Path) -> None:
    for each in (file.parent / "__pycache__").glob(f"{file.stem}.*.pyc"):
        each.unlink()


def _end_group(child: int) -> None:
    """What a test may have started."""
    try:
        os.killpg(child, signal.SIGKILL)
    except (ProcessLookupError, PermissionError):
        return


class Recorder:
    """Pytest's plugin that writes down which lines each test reaches, in its fixtures and by itself."""

    def __init__(self, file: Path, folder: Path) -> None:
        self.file, self.folder = file, folder
        coverage = importlib.import_module("coverage")
        self.coverage = coverage.Coverage(data_file=None, source=[str(folder / "shapepose_fg")], config_file=False)
        self.seconds: dict[str, float] = {}

    def pytest_sessionstart(self) -> None:
        """Before tests are read: what they import is reached by nobody."""
        self.coverage.start()

    def pytest_runtest_logstart(self, nodeid: str) -> None:
        """The fixtures of a test."""
        self.coverage.switch_context(f"{nodeid}|setup")

    def pytest_runtest_call(self, item: Any) -> None:
        """The test itself."""
        self.coverage.switch_context(f"{item.nodeid}|call")

    def pytest_runtest_logreport(self, report: Any) -> None:
        """Its time."""
        self.seconds[report.nodeid] = self.seconds.get(report.nodeid, 0.0) + report.duration

    def pytest_sessionfinish(self) -> None:
        """Write it down."""
        self.coverage.stop()
        data, lines = self.coverage.get_data(), {}
        for file in data.measured_files():
            name = str(Path(file).relative_to(self.folder))
            lines[name] = {
                str(line): sorted(filter(None, names)) for line, names in data.contexts_by_lineno(file).items()
            }
        self.file.write_text(json.dumps({"seconds": self.seconds, "lines": lines}))


class Reached:
    """Which tests reach which line: by coverage of each test file, measured once and kept."""

    def __init__(self, tree: Tree, folder: Path, files: list[str]) -> None:
        """Measure the test files that are not yet known, or have changed."""
        folder.mkdir(parents=True, exist_ok=True)
        self.seconds: dict[str, float] = {}
        self._lines: dict[tuple[str, int], set[str]] = {}
        self._functions: dict[str, set[str]] = {}
        for file in files:
            digest = hashlib.sha256((tree.folder / file).read_bytes()).hexdigest()[:16]
            kept = folder / f"{file.replace('/', '-')}-{digest}.json"
            if not kept.exists():
                began = time.monotonic()
                code = tree.test([file], 900.0, folder / "said", [Recorder(kept, tree.folder)])
                print(f"{file}: lines it reaches, {time.monotonic() - began:.0f} s", flush=True)
                if code not in (0, 5):
                    raise SystemExit(
                        f"error: {file} fails without any change: {(folder / 'said').read_text()[-2000:]}"
                    )
            self._add(json.loads(kept.read_text()))

    def _add(self, found: dict[str, Any]) -> None:
        self.seconds |= found["seconds"]
        for file, lines in found["lines"].items():
            for line, contexts in lines.items():
                tests = {name.removesuffix("|call") for name in contexts if name.endswith("|call")}
                for name in contexts:
                    if name.endswith("|setup"):  # whoever of its file comes first makes a fixture for all
                        module = name.split("::")[0]
                        tests |= {each for each in found["seconds"] if each.split("::")[0] == module}
                self._lines.setdefault((file, int(line)), set()).update(tests)
                self._functions.setdefault(file, set()).update(tests)

    def tests(self, path: str, lines: range) -> set[str]:
        """Those that reach one of the lines."""
        return set().union(*(self._lines.get((path, line), set()) for line in lines))

    def users(self, name: str, sources: dict[str, str]) -> set[str]:
        """Those that reach a line that mentions a name: who uses a setting or a constant."""
        word = re.compile(rf"\b{re.escape(name)}\b")
        found: set[str] = set()
        for path, code in sources.items():
            for number, line in enumerate(code.splitlines(), 1):
                if word.search(line):
                    found |= self.tests(path, range(number, number + 1))
        return found

    def of_file(self, path: str) -> set[str]:
        """Those that reach any line of a file."""
        return self._functions.get(path, set())

    def in_order(self, tests: set[str], path: str, most_s: float) -> tuple[list[str], float]:
        """Tests of the changed file's own folder, then the quickest others, up to `most_s` seconds; their time.

        Of a folder's tests those of one file stay together: they share fixtures.
        """
        own = f"tests/{Path(path).relative_to('shapepose_fg').parts[0]}/"

        def rank(test: str) -> tuple[bool, float, str]:
            return not test.startswith(own), self.seconds.get(test, 0.0), test

        chosen, total = [], 0.0
        for test in sorted(tests, key=rank):
            total += self.seconds.get(test, 0.0)
            if len(chosen) > 0 and (total > most_s or len(chosen) >= _TESTS_A_SECOND * most_s):
                break
            chosen.append(test)
        files = list(dict.fromkeys(test.split("::")[0] for test in chosen))
        return sorted(chosen, key=lambda each: files.index(each.split("::")[0])), total
