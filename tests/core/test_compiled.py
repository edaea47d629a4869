"""Kernels: compiled anew when they change, kept where that is possible, and said when they are
compiled.
"""

import json
import os
import shutil
import subprocess
import sys
from collections import defaultdict
from collections.abc import Iterator
from pathlib import Path

import numba
import pytest

import shapepose_fg
from shapepose_fg.cameras.check.report import check_setup
from shapepose_fg.core.compiled import KERNELS, Kernel, signature
from shapepose_fg.core.frame_times import FrameTimes
from shapepose_fg.pipeline.pipeline import reconstruct
from shapepose_fg.simulation import built_in_scene, simulate

ROOT = Path(shapepose_fg.__file__).parents[1]
IMPORT = "from shapepose_fg.core.compiled import kernel, part\n"
FILES = {
    "inner": IMPORT + "@part\ndef twice(x):\n    return 2 * x\n",
    "outer": IMPORT + "from inner import twice\n@part\ndef more(x):\n    return twice(x) + 1\n",
    "own": IMPORT + "from outer import more\n@kernel('f0')\ndef run(x):\n    return more(x)\n"
    "@kernel('f1')\ndef every(x):\n    for i in range(len(x)):\n        x[i] = run(x[i])\n",
}
"""Modules of somebody's: a kernel, one that calls it, and parts from other files."""
PROGRAM = """
import numpy as np
from own import every, run
x = np.full(2, 10.0)
every(x)
print(run(10.0), *x, *(sum(each.loaded.stats.cache_hits.values()) for each in (run, every)))
"""
"""Prints three times the result, and how many times it was read and not compiled, of each."""


SERVER = """
import json, os, sys
import numba
numba.njit(lambda x: x + 1)(1.0)
for line in sys.stdin:
    asked = json.loads(line)
    if isinstance(asked, int):
        print(os.waitstatus_to_exitcode(os.waitpid(asked, 0)[1]), flush=True)
    elif (pid := os.fork()) > 0:
        print(pid, flush=True)
    else:
        os.environ.clear()
        os.environ.update(asked["environment"])
        sys.path[:0] = os.environ["PYTHONPATH"].split(os.pathsep)
        for number in (1, 2):
            os.dup2(os.open(asked["said"][number - 1], os.O_WRONLY | os.O_CREAT, 0o600), number)
        exec(asked["program"])
        break
"""
"""Runs programs, each in a process of its own that has Numba loaded: that takes a second and a half
otherwise."""


@pytest.fixture(scope="module")
def server() -> Iterator[subprocess.Popen]:
    with subprocess.Popen(
        [sys.executable, "-B", "-c", SERVER],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        text=True,
        env={name: each for name, each in os.environ.items() if name != "PYTHONPATH"},
    ) as process:
        yield process
        assert process.stdin is not None
        process.stdin.close()


class Program:
    """Modules in a folder and a cache: a call runs the program and returns the result, what was
    read, stderr.
    """

    def __init__(self, folder: Path, server: subprocess.Popen) -> None:
        self.modules, self.cache, self.program = folder / "modules", folder / "cache", PROGRAM
        self.temporary, self.folder, self.server = folder / "tmp", folder, server
        self.started = 0
        for each in (self.modules, self.temporary):
            each.mkdir()
        for name, text in FILES.items():
            (self.modules / f"{name}.py").write_text(text)

    def start(self, **variables: str) -> tuple[int, list[Path]]:
        where = {
            "PYTHONPATH": f"{self.modules}{os.pathsep}{ROOT}",
            "NUMBA_CACHE_DIR": str(self.cache),
        }
        where |= {"TMPDIR": str(self.temporary)} | variables
        environment = {name: each for name, each in (os.environ | where).items() if each}
        self.started += 1
        said = [self.folder / f"{self.started}.{each}" for each in ("out", "err")]
        asked = {"program": self.program, "environment": environment, "said": [*map(str, said)]}
        return self.ask(asked), said

    def ask(self, what: object) -> int:
        assert self.server.stdin is not None and self.server.stdout is not None
        print(json.dumps(what), file=self.server.stdin, flush=True)
        return int(self.server.stdout.readline())

    def __call__(self, **variables: str) -> tuple[float, list[int], str]:
        return self.end(*self.start(**variables))

    def end(self, pid: int, files: list[Path]) -> tuple[float, list[int], str]:
        code, (said, complaints) = self.ask(pid), (file.read_text() for file in files)
        assert code == 0, complaints
        *results, run, every = said.split()
        assert len(set(results)) == 1
        return float(results[0]), [int(run), int(every)], complaints

    def files(self, ending: str) -> list[Path]:
        return sorted(self.cache.rglob(f"*{ending}"))


@pytest.fixture
def program(tmp_path, server) -> Program:
    return Program(tmp_path, server)


@pytest.mark.slow
def test_a_kernel_is_compiled_anew_when_a_file_has_changed_that_it_calls_into(program, tmp_path):
    """Its own file, or one whose part it calls by way of another; else it is read, wherever it
    stands.
    """
    assert [program()[:2], program()[:2]] == [(21.0, [0, 0]), (21.0, [1, 1])]
    shutil.copytree(program.modules, tmp_path / "there")
    (program.modules / "inner.py").write_text(FILES["inner"].replace("2 * x", "3 * x"))
    assert [program()[:2], program()[:2]] == [(31.0, [0, 0]), (31.0, [1, 1])]
    program.modules = tmp_path / "there"
    assert program()[:2] == (21.0, [1, 1])


@pytest.mark.slow
def test_a_damaged_cache_is_made_anew(program):
    program()
    for ending, damage in (
        (".nbi", lambda whole: b""),
        (".nbc", lambda whole: b""),
        (".nbi", lambda whole: whole[: len(whole) // 2]),
        (".nbc", lambda whole: whole[: len(whole) // 2]),
        (".nbi", lambda whole: b"cut"),
        (".nbc", lambda whole: bytes(1000)),
    ):
        for file in program.files(ending):
            file.write_bytes(damage(file.read_bytes()))
        result, _, complaints = program()
        assert result == 21.0 and "Traceback" not in complaints
        assert ending == ".nbi" or program()[:2] == (21.0, [1, 1])


@pytest.mark.slow
def test_a_cache_that_cannot_be_written_is_read(program):
    """As in an image, where another user made it; nothing is left in the folder for temporary
    files.
    """
    program()
    program.program = "import tempfile, pathlib\n" + refuse("cache") + PROGRAM
    assert program()[:2] == (21.0, [1, 1])
    assert list(program.temporary.iterdir()) == []


@pytest.mark.slow
@pytest.mark.parametrize("refused", ["cache", "cache tmp"])
def test_where_nothing_can_be_kept_it_still_runs(program, refused):
    program.program = refuse(*refused.split()) + PROGRAM
    result, hits, complaints = program()
    assert result == 21.0 and "Traceback" not in complaints
    assert program()[1] == hits == [0, 0]
    assert list(program.temporary.iterdir()) == []


def refuse(*folders: str) -> str:
    """Program text after which nothing can be written below these folders, whoever runs it."""
    return f"""
import builtins, os, pathlib, sys
def refuse(event, arguments):
    changes = event in ("os.mkdir", "os.rename", "os.remove", "os.rmdir", "os.utime", "os.link")
    if event == "open" and arguments[2] is not None:
        changes = bool(arguments[2] & (os.O_WRONLY | os.O_RDWR | os.O_CREAT))
    if changes and isinstance(arguments[0], str):
        path = pathlib.Path(arguments[0])
        if set(path.parts[:-1] if event == "os.mkdir" else path.parts) & set({folders!r}):
            raise PermissionError(13, "Permission denied", arguments[0])
sys.addaudithook(refuse)
"""


@pytest.mark.slow
def test_a_disk_that_is_full_is_no_obstacle(program):
    """Files of more than 4 kB cannot be written: sources can, compiled functions cannot."""
    limit = "import resource\nresource.setrlimit(resource.RLIMIT_FSIZE, (4096, 4096))\n"
    program.program = limit + PROGRAM
    assert program()[:2] == (21.0, [0, 0])
    program.program = PROGRAM
    assert program()[0] == 21.0 and program()[:2] == (21.0, [1, 1])


@pytest.mark.slow
def test_no_home(program, tmp_path):
    """A container's user of any number: no home, or one that is not there."""
    for home in ("", "/nonexistent/home"):
        assert program(HOME=home, NUMBA_CACHE_DIR="", XDG_CACHE_HOME="/proc/nothing")[0] == 21.0


@pytest.mark.slow
def test_two_processes_at_the_same_time(program):
    together = [program.start() for _ in range(2)]
    assert [program.end(*each)[0] for each in together] == [21.0, 21.0]
    assert program()[:2] == (21.0, [1, 1])


@pytest.mark.slow
@pytest.mark.skipif(not hasattr(os, "fork"), reason="starts each version from one process")
def test_old_folders_are_removed(program):
    program.program = f"""
import os, pathlib
from shapepose_fg.core.kept_kernels import module_folder
import shapepose_fg.core.compiled
for n in range(20):
    if os.fork() == 0:
        file = pathlib.Path({str(program.modules / "own.py")!r})
        file.write_text(file.read_text() + "# changed")
        import own
        module_folder("own")
        os._exit(0)
    assert os.wait()[1] == 0
print(1, 1, 1)
"""
    program()
    assert 2 <= len(list(program.cache.glob("shapepose-fg/own-*"))) <= 17


SLOW = """
import time
from shapepose_fg.core import compiled, compiling
compiling._BYTES_S, compiling.cores = 1, lambda: 2
real = compiling._share_out
compiling._share_out = lambda *arguments: (real(*arguments), time.sleep(1.5))
"""
"""Changes by which two functions are work for two processes, and for more than a second."""


@pytest.mark.slow
def test_compiling_is_done_side_by_side_and_said_once_before_it_ends(program):
    """On stderr, though it is no terminal; and not when functions are read."""
    program.program = SLOW + PROGRAM
    result, hits, complaints = program()
    assert (result, hits) == (21.0, [1, 1])  # neither was compiled there
    assert (
        complaints.count("\n") == 1
        and "compiling 2 functions for this machine, which takes about" in complaints
    )
    assert program()[2] == ""


@pytest.mark.slow
def test_what_can_not_be_kept_is_said_with_the_cure(program):
    program.program = refuse("cache") + SLOW + PROGRAM
    assert "cannot be written; set NUMBA_CACHE_DIR" in program()[2]


@pytest.mark.slow
def test_the_command_compiles_all_ahead():
    """In the cache of the user who runs the tests, where most are already."""
    command = [sys.executable, "-m", "shapepose_fg", "compile"]
    done = subprocess.run(command, capture_output=True, text=True, check=True, cwd=ROOT)
    assert " are stored in " in " ".join(done.stdout.split())
    place = os.environ | {"NUMBA_CACHE_DIR": "/proc/nothing"}
    done = subprocess.run(command, capture_output=True, text=True, check=False, cwd=ROOT, env=place)
    assert (
        done.returncode == 2
        and "/proc/nothing/shapepose-fg: cannot be written; set NUMBA_CACHE_DIR" in done.stderr
    )


@pytest.mark.slow
def test_a_reconstruction_calls_kernels_with_the_types_that_they_name(monkeypatch):
    """Each is compiled once: for one more layout of an array it would be compiled again, for
    seconds.
    """
    used, call = defaultdict[str, set](set), Kernel.__call__

    def watched(self: Kernel, *arguments: object) -> object:
        used[self.name].add(tuple(map(numba.typeof, arguments)))
        return call(self, *arguments)

    monkeypatch.setattr(Kernel, "__call__", watched)
    scene = built_in_scene(seed=3, frames=12)
    recording = simulate(scene, seed=3)
    check_setup(recording, scene.rig)
    reconstruct(recording, scene.rig, times=FrameTimes.from_fps(scene.fps, len(scene)))
    others = {name: types - {signature(KERNELS[name])} for name, types in used.items()}
    assert not any(others.values()), {name: each for name, each in others.items() if each}
    assert len(used) >= 34
