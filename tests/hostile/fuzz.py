"""Change valid files until a reader breaks: python -m tests.hostile.fuzz [--cases N | --seconds
600] [reader ...].

Every reader of files from others, also of runs, finished and not, and of what exports read
(readers.py), is run on changed files. A case may end in a result or an InputError. Anything else,
over 20 s, over 1 GiB beyond what was in use before, or a file written, or read, elsewhere is a
fault: its file is kept in data/fuzz, where test_every_reader.py tries it again.

With `--cases` each reader gets so many, the same ones each time. With `--seconds` they are guided
by which lines of this project they reach (atheris, libFuzzer: pip install ".[fuzz]"). `--held-out`
starts from other files and random numbers, which nothing was mended by, and keeps nothing. `--kills
50` kills `reconstruct` so often instead.
"""

import argparse
import os
import re
import subprocess
import sys
import tempfile
import time
from pathlib import Path

from tests.hostile import trying

ROOT = Path(__file__).parents[2]
FOUND = Path(__file__).parent / "data" / "fuzz"
HELD_OUT = 1_000_000
"""What other random numbers begin with."""


def main() -> None:
    """All readers, one after the other, in processes that may die."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("reader", nargs="*", help="which readers; all by default")
    parser.add_argument("--seconds", type=int, default=600, help="for all readers together")
    parser.add_argument("--cases", type=int, default=0, help="for each reader")
    parser.add_argument(
        "--kills", type=int, default=0, help="of reconstruct, every second one with a bit turned"
    )
    parser.add_argument("--held-out", action="store_true", help="other files and random numbers")
    parser.add_argument("--worker", help=argparse.SUPPRESS)
    parser.add_argument("--begin", type=int, default=0, help=argparse.SUPPRESS)
    given = parser.parse_args()
    if given.worker is not None:
        work(given)
        return
    if given.kills:
        kill(given.kills, HELD_OUT if given.held_out else 0)
        return
    from tests.hostile.readers import READERS

    names = given.reader or list(READERS)
    cases = faults = 0
    for name in names:
        ran, failed = fuzz(name, given, max(1.0, given.seconds / len(names)))
        cases, faults = cases + ran, faults + failed
    print(f"all: {cases} cases, {faults} faults")
    sys.exit(1 if faults else 0)


def kill(times: int, first: int) -> None:
    """Kill `reconstruct` or a worker so many times: it ends with the same bytes, or says one
    sentence.
    """
    from tests.hostile.kills import Killing

    with tempfile.TemporaryDirectory() as folder:
        killing = Killing.of(Path(folder))
        for number in range(first, first + times):
            print(f"{number}: {killing.once(number, Path(folder) / str(number))}", flush=True)


def fuzz(name: str, given: argparse.Namespace, left: float) -> tuple[int, int]:
    """Cases and faults of one reader; a worker that died is followed by another, which starts
    elsewhere.
    """
    cases = faults = begin = 0
    environment = os.environ | {"PYTHONPATH": str(ROOT)}
    while faults < 20 and (begin < given.cases if given.cases else left >= 1):
        command = [sys.executable, "-m", __spec__.name, "--worker", name, "--begin", str(begin)]
        command += [
            "--cases",
            str(given.cases),
            "--seconds",
            str(int(left)),
            *(["--held-out"] if given.held_out else []),
        ]
        with tempfile.TemporaryDirectory(
            dir="/dev/shm" if os.access("/dev/shm", os.W_OK) else None
        ) as folder:
            start = time.monotonic()
            ended = subprocess.run(
                command,
                cwd=folder,
                env=environment,
                capture_output=True,
                text=True,
                errors="replace",
                check=False,
            )
            left -= time.monotonic() - start
            counts = re.findall(
                r"^#(\d+)|stat::number_of_executed_units:\s*(\d+)", ended.stderr, re.MULTILINE
            )
            broken = [
                file
                for file in Path(folder).iterdir()
                if re.match(r"(crash|timeout|oom|leak)-", file.name)
            ]
            # A process that dies leaves the case that it was at.
            died = [
                int(file.name[6:], 16)
                for file in broken
                if given.cases and ended.returncode not in (0, 1)
            ]
            begin = begin + 1 if not given.cases else max(died) + 1 if died else given.cases
            cases += max(died, default=0) or max(
                (int(one or other) for one, other in counts), default=0
            )
            faults += len(broken)
            if not given.held_out:
                _keep(name, broken)
        said = ended.stdout + ended.stderr
        if ended.returncode != 0 and len(broken) == 0:
            sys.exit(f"{said}{name}: the reader did not begin")
        if ended.returncode != 0:
            print(
                "\n".join(
                    said[max(said.find("=== Uncaught Python exception"), 0) :].splitlines()[-60:]
                )
            )
        print(
            f"{name}: {cases} cases, {faults} faults{ended.stdout.rpartition('#')[2].rstrip()}",
            flush=True,
        )
    return cases, faults


def _keep(name: str, broken: list[Path]) -> None:
    """Lay what broke a reader where a test tries it again: which of the reader's files, and its
    content.
    """
    place = FOUND / re.sub(r"\W+", "_", name)
    for content, file in ((file.read_bytes(), file.name) for file in broken):
        place.mkdir(parents=True, exist_ok=True)
        if content:
            (place / f"{content[0]}-{file.rsplit('-', 1)[1][:8]}").write_bytes(content[1:])


def work(given: argparse.Namespace) -> None:
    """Cases of one reader in this process."""
    Path("files").mkdir()
    tempfile.tempdir = str(Path.cwd())
    first = HELD_OUT if given.held_out else 0
    if not given.cases:
        trying.guided(given.worker, first + given.begin, given.seconds)
        return
    trial = trying.Trial(trying.reader(given.worker), Path("files").resolve(), int(given.held_out))
    tally = trying.tried(trial, f"{given.worker} {first}", range(given.begin, given.cases))
    print(f"#{sum(tally.cases.values())}", file=sys.stderr)
    print(f"#{tally}")
    sys.exit(1 if tally.faults else 0)


if __name__ == "__main__":
    main()
