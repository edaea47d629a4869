"""`shapepose-fg reconstruct`, or a worker of it, killed at random moments; a bit turned or not;
then --resume.
"""

import io
import os
import random
import signal
import subprocess
import sys
import time
from collections.abc import Iterable, Iterator
from contextlib import redirect_stderr, redirect_stdout, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any
from unittest.mock import patch

from shapepose_fg.cli.main import main
from shapepose_fg.core.storage.kept_arrays import InFolder
from shapepose_fg.simulation import built_in_scene, simulate
from shapepose_fg.simulation.files import write_simulated
from shapepose_fg.tracking import identities

SETTINGS = """
batch_frames = 6
[following]
look_ahead_s = 0.15
[windows]
overlap_s = 0.1
[offsets]
frames = 6
"""
_BLOCK_S = 0.3
PROGRAM = f"from shapepose_fg.tracking import identities; identities.BLOCK_S = {_BLOCK_S}\n"
PROGRAM += "from shapepose_fg.__main__ import main; main()"
"""The command, which decides after blocks so short that a run of a second stops in the middle of
them, too."""
_LONGEST_S = 300


@dataclass(frozen=True)
class Killing:
    """A recording, and what comes of it when nobody is killed."""

    command: list[str]
    """What reconstructs it, but for the folder and the number of workers."""
    people: bytes
    """people.npz."""
    kept: int
    """How many windows and bodies it keeps on its way."""

    @classmethod
    def of(cls, folder: Path, seed: int = 0) -> "Killing":
        """Two people before three cameras for 0.8 s, written into `folder` and reconstructed
        there.
        """
        scene = built_in_scene(seed=seed, people=2, cameras=3, frames=24)
        files = write_simulated(scene, simulate(scene, seed=seed), folder / "recording", "openpose")
        (folder / "settings.toml").write_text(SETTINGS)
        command = [
            "reconstruct",
            "--calibration",
            str(files["cameras"]),
            "--detections",
            str(files["detections"]),
        ]
        command += ["--config", str(folder / "settings.toml"), "--fps", "30"]
        command += ["--no-report", "--no-check"]
        names, keep = set[str](), InFolder.keep

        def listed(self: InFolder, name: str, *more: Any) -> None:
            names.add(name)
            keep(self, name, *more)

        with patch.object(InFolder, "keep", listed):
            said = _ended_here([*command, "--workers", "1", "--output", str(folder / "whole")])
        if said != "":
            raise AssertionError(said)
        return cls(command, (folder / "whole" / "people.npz").read_bytes(), _sets(names))

    def once(self, number: int, out: Path) -> str:
        """Kill a run into `out` and go on with it: what came of it. AssertionError for what may
        not.
        """
        rng = random.Random(number)
        workers = 1 if number % 4 == 3 else 2
        command = [*self.command, "--workers", str(workers), "--output", str(out)]
        process = _begun(command)
        least = rng.randint(-1, self.kept)
        for kept in _kept_so_far(process, out):
            if kept >= least:
                break
        time.sleep(rng.uniform(0, 1 if least < 0 else 0.3))
        victims = _descendants(process.pid) if number % 4 < 2 else []
        with suppress(ProcessLookupError):  # it has just ended by itself
            if len(victims) > 0:
                os.kill(rng.choice(victims), signal.SIGKILL)
            else:
                os.killpg(process.pid, signal.SIGKILL)
        first = _ended(process)
        done = (out / "people.npz").exists() and not (out / "parts").exists()
        flipped = "nothing"
        if number % 2 == 1 and not done:
            files = sorted(
                file for file in out.rglob("*") if file.is_file() and file.stat().st_size > 0
            )
            if len(files) > 0:
                file = rng.choice(files)
                content = bytearray(file.read_bytes())
                content[rng.randrange(len(content))] ^= 1 << rng.randrange(8)
                file.write_bytes(content)
                flipped = file.name
        second = "" if done else _ended_here([*command, "--resume"])
        if second.startswith("error:"):
            if flipped == "nothing":
                raise AssertionError(f"kill {number}: it did not go on: {second}")
        elif (out / "people.npz").read_bytes() != self.people:
            raise AssertionError(f"kill {number}, {flipped} flipped: other bytes than without it")
        killed = (
            f"{'a worker' if len(victims) > 0 else 'all'} killed behind {least} of {self.kept} sets"
        )
        left = "a finished result" if done else first or "nothing said"
        return f"{killed}: {left}; flipped {flipped}; {second or 'the same bytes'}"


def _kept_so_far(process: subprocess.Popen[str], out: Path) -> Iterator[int]:
    """How many windows and bodies a run has kept, again and again until it ends; -1 before its
    first file.
    """
    while process.poll() is None:
        names = {file.name for file in (out / "parts").glob("*")}
        yield _sets(names) if names else -1
        time.sleep(0.01)


def _sets(names: Iterable[str]) -> int:
    """How many of these are windows and bodies."""
    return sum(name.startswith(("part-", "bodies-")) for name in names)


def _begun(words: list[str]) -> subprocess.Popen[str]:
    """The command, in a group of processes of its own."""
    command, pipe = [sys.executable, "-c", PROGRAM, *words], subprocess.PIPE
    return subprocess.Popen(command, stdout=pipe, stderr=pipe, text=True, start_new_session=True)


def _ended(process: subprocess.Popen[str]) -> str:
    """The one sentence with which it ended; nothing where it did its work, or was killed.
    AssertionError else.
    """
    _, said = process.communicate(timeout=_LONGEST_S)
    return _sentence(process.returncode, said)


def _ended_here(words: list[str]) -> str:
    """The same of a command in this process, which has loaded the program."""
    code, said, before = 0, io.StringIO(), identities.BLOCK_S
    identities.BLOCK_S = _BLOCK_S
    try:
        with redirect_stdout(io.StringIO()), redirect_stderr(said):
            main(words)
    except SystemExit as ended:
        code = ended.code
    finally:
        identities.BLOCK_S = before
    return _sentence(code, said.getvalue())


def _sentence(code: object, said: str) -> str:
    """The error in what a command wrote, and only one that ends it."""
    errors = [line for line in said.splitlines() if line.startswith("error:")]
    if code in (0, -signal.SIGKILL) and "Traceback" not in said:
        return ""
    if code != 2 or len(errors) != 1 or "Traceback" in said:
        raise AssertionError(f"code {code}: {said}")
    return errors[0]


def _descendants(pid: int) -> list[int]:
    """Its workers; not the helpers of Python and loky, which only clear up."""
    parents = dict[int, int]()
    for place in Path("/proc").glob("[0-9]*/stat"):
        try:
            words, said = (
                place.read_text().rpartition(")")[2].split(),
                (place.parent / "cmdline").read_bytes(),
            )
        except OSError:  # it has ended
            continue
        if b"resource_tracker" not in said:
            parents[int(place.parent.name)] = int(words[1])
    found = [pid]
    for each in found:
        found += [child for child, parent in parents.items() if parent == each]
    return sorted(found[1:])
