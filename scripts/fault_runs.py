"""Runs of `shapepose-fg reconstruct` to be disturbed by faults.py: cheap by a fork, compared to the byte."""

import contextlib
import hashlib
import json
import os
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path

import shapepose_fg.cli.reconstruct.run  # noqa: F401
from shapepose_fg.cli.main import main
from shapepose_fg.pipeline.pipeline import reconstruct_parts  # noqa: F401  what a run loads, torch too, is loaded before the fork
from shapepose_fg.pipeline.runs.manifest import PARTS
from shapepose_fg.simulation import built_in_scene, simulate
from shapepose_fg.simulation.files import write_simulated

WINDOW = 24
"""Frames that are solved together, or fewer."""


@dataclass(frozen=True)
class Command:
    """A command line of `reconstruct`, without its output."""

    words: tuple[str, ...]

    @classmethod
    def of_a_recording(cls, folder: Path, frames: int, people: int, cameras: int) -> "Command":
        """A recording of the built-in scene is written into `folder`."""
        scene = built_in_scene(seed=0, people=people, cameras=cameras, frames=frames)
        written = write_simulated(scene, simulate(scene, seed=0), folder / "recording", "association")
        settings = folder / "settings.toml"
        settings.write_text(f"batch_frames = {WINDOW}\n")
        options = {
            "--calibration": written["cameras"],
            "--detections": written["detections"],
            "--config": settings,
        }
        words = [str(word) for option in options.items() for word in option]
        return cls(("reconstruct", *words, "--fps", "25", "--workers", "1"))

    def with_options(self, *more: str) -> "Command":
        """The same with further options."""
        return replace(self, words=(*self.words, *more))

    def into(self, output: Path, *more: str) -> list[str]:
        """All words."""
        return [*self.words, "--output", str(output), *more]

    def run_as_a_user_does(self, output: Path) -> float:
        """In an interpreter of its own, undisturbed; returns its seconds. RuntimeError where it fails."""
        began = time.monotonic()
        words = [sys.executable, "-m", "shapepose_fg", *self.into(output)]
        done = subprocess.run(words, capture_output=True, text=True, check=False)
        if done.returncode != 0:
            raise RuntimeError(f"the run without a fault failed: {done.stderr}")
        return time.monotonic() - began


class Run:
    """A run in a fork of this process, where everything is loaded: it begins at once, and can be killed."""

    def __init__(self, words: list[str], said: Path, before: Callable[[], object] = lambda: None) -> None:
        """`said` is the file for what it prints; `before` is called in the new process first."""
        self.said = said
        sys.stdout.flush()
        self.process = os.fork()
        self._code: int | None = None
        if self.process == 0:
            self._become(words, said, before)

    @staticmethod
    def _become(words: list[str], said: Path, before: Callable[[], object]) -> None:
        code: object = 1
        try:
            output = os.open(said, os.O_WRONLY | os.O_CREAT | os.O_TRUNC)
            os.dup2(output, 1)
            os.dup2(output, 2)
            before()
            main(words)
        except SystemExit as ended:
            code = ended.code
        finally:
            with contextlib.suppress(OSError):
                sys.stdout.flush()
            os._exit(code if isinstance(code, int) else 1)

    def poll(self) -> int | None:
        """Its exit code, minus the number of the signal that killed it; None while it runs."""
        if self._code is None:
            ended, status = os.waitpid(self.process, os.WNOHANG)
            self._code = os.waitstatus_to_exitcode(status) if ended != 0 else None
        return self._code

    def wait(self, seconds: float = 600.0, until: Callable[[], bool] = lambda: False) -> int | None:
        """The exit code; None where it still runs after so long, or when `until` holds."""
        deadline = time.monotonic() + seconds
        while self.poll() is None and time.monotonic() < deadline and not until():
            time.sleep(0.001)
        return self._code

    def kill(self) -> int:
        """SIGKILL."""
        if self.poll() is None:
            os.kill(self.process, signal.SIGKILL)
            _, status = os.waitpid(self.process, 0)
            self._code = os.waitstatus_to_exitcode(status)
        return self._code if self._code is not None else 0


def state(folder: Path) -> dict[str, str]:
    """What is in a folder of results: of each file a checksum; of run.json without its times."""
    found = {}
    for file in sorted(folder.rglob("*")):
        content = file.read_bytes() if file.is_file() else b""
        if file.name == "run.json":
            run = json.loads(content)
            run.pop("seconds")
            content = json.dumps(run).encode()
        if file.name != "report.html":  # it shows the times
            found[str(file.relative_to(folder))] = hashlib.sha256(content).hexdigest()
    return found


def parts(output: Path) -> dict[str, str]:
    """Of each window that an unfinished run keeps a checksum of its arrays; the header before them has times."""
    found = {}
    for file in sorted((output / PARTS).glob("part-*.safetensors")):
        with contextlib.suppress(FileNotFoundError):  # the run has just ended
            content = file.read_bytes()
            header = int.from_bytes(content[:8], "little")
            found[file.name] = hashlib.sha256(content[8 + header :]).hexdigest()
    return found


@dataclass(frozen=True)
class Watched:
    """What a run that nobody disturbs does."""

    seconds: float
    """From fork to end."""
    ending_s: float
    """Of these, after the last window."""
    most_bytes: int
    """What it takes of the disk at the most."""
    windows: dict[str, str]
    """Checksums of the windows it keeps on its way."""

    @classmethod
    def on(cls, command: Command, output: Path, said: Path) -> "Watched":
        """A run into `output`."""
        began = last = time.monotonic()
        at_first = _used(output.parent)
        run, most, windows = Run(command.into(output), said), 0, {}
        while run.wait(0.01) is None:
            most = max(most, _used(output.parent) - at_first)
            if len(list((output / PARTS).glob("part-*.safetensors"))) > len(windows):
                last, windows = time.monotonic(), windows | parts(output)
        if run.wait() != 0:
            raise RuntimeError(f"a forked run failed: {said.read_text()}")
        return cls(time.monotonic() - began, time.monotonic() - last, most, windows)


def _used(folder: Path) -> int:
    disk = os.statvfs(folder)
    return (disk.f_blocks - disk.f_bfree) * disk.f_frsize


def phase(output: Path, windows: int) -> str:
    """What a run was at that has just been killed, by what lies there."""
    kept = len(list((output / PARTS).glob("part-*.safetensors")))
    if not (output / PARTS / "manifest.json").exists():
        return "done" if (output / "run.json").exists() else "reading"
    if any(file.name.endswith(".part") for file in (output / PARTS).glob(".*")):
        return "writing a window or a body"
    if any(file.name.endswith(".part") for file in output.glob(".*")):
        return "writing the results"
    if (output / "run.json").exists():
        return "results written, parts not yet removed"
    return "bodies over time, check" if kept == windows else f"window {kept + 1:2d}"


def emptied(folder: Path) -> Path:
    """The folder, without what was in it."""
    shutil.rmtree(folder, ignore_errors=True)
    folder.mkdir(parents=True)
    return folder
