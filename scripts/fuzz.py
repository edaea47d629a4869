"""Change valid files until a reader breaks: python scripts/fuzz.py [--seconds 600] [--held-out] [reader ...].

Every reader of files from others (tests/hostile/readers.py) is run on changed files, guided by which lines of this
project they reach (atheris, libFuzzer: pip install ".[fuzz]"). A case may end in a result or an InputError.
Anything else, over 10 s, or over 1 GiB beyond what was in use before, is a fault: its file is kept in
tests/hostile/data/fuzz, where tests/hostile/test_every_reader.py tries it again. `--held-out` starts from other
files and other random numbers, which nothing was mended by, and keeps nothing.
"""

import argparse
import importlib
import os
import random
import re
import resource
import shutil
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

ROOT = Path(__file__).parents[1]
FOUND = ROOT / "tests" / "hostile" / "data" / "fuzz"
CASE_S, CASE_MB = 10, 1024


def main() -> None:
    """All readers, one after the other, in processes that may die."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("reader", nargs="*", help="which readers; all by default")
    parser.add_argument("--seconds", type=int, default=600, help="for all readers together")
    parser.add_argument("--held-out", action="store_true", help="other files and random numbers")
    parser.add_argument("--worker", help=argparse.SUPPRESS)
    parser.add_argument("--seed", type=int, default=0, help=argparse.SUPPRESS)
    given = parser.parse_args()
    if given.worker is not None:
        work(given.worker, given.held_out, given.seed, given.seconds)
        return
    names = given.reader or list(readers())
    cases = faults = 0
    for name in names:
        ran, failed = fuzz(name, max(1, given.seconds // len(names)), given.held_out)
        cases, faults = cases + ran, faults + failed
        print(f"{name}: {ran} cases, {failed} faults", flush=True)
    print(f"all: {cases} cases, {faults} faults")
    sys.exit(1 if faults else 0)


def readers() -> dict[str, Any]:
    """Every reader, as the tests list them."""
    # The project first: of an editable install `factors` would be the folder of tests.
    sys.path.insert(0, str(ROOT))
    return importlib.import_module("tests.hostile.readers").READERS


def fuzz(name: str, seconds: int, held_out: bool) -> tuple[int, int]:
    """Cases and faults of one reader; a worker that died is followed by another, which starts elsewhere."""
    cases = faults = 0
    left = float(seconds)
    seed = 1_000_000 if held_out else 1
    while left >= 1 and faults < 20:
        command = [sys.executable, __file__, "--worker", name, "--seed", str(seed), "--seconds", str(int(left))]
        command += ["--held-out"] if held_out else []
        with tempfile.TemporaryDirectory() as folder:
            start = time.monotonic()
            ended = subprocess.run(
                command, cwd=folder, capture_output=True, text=True, errors="replace", check=False
            )
            left -= time.monotonic() - start
            counts = re.findall(r"^#(\d+)|stat::number_of_executed_units:\s*(\d+)", ended.stderr, re.MULTILINE)
            cases += max((int(one or other) for one, other in counts), default=0)
            if ended.returncode != 0:
                faults += 1
                said = ended.stdout + ended.stderr
                start_of = said.find("=== Uncaught Python exception")
                lines = said[max(start_of, 0) :].splitlines()
                print("\n".join(lines[:40] if start_of >= 0 else lines[-40:]), flush=True)
                if not held_out:
                    _keep(name, Path(folder))
        seed += 1
    return cases, faults


def _keep(name: str, folder: Path) -> None:
    """Lay what broke a reader where a test tries it again: which of the reader's files, and its content."""
    place = FOUND / re.sub(r"\W+", "_", name)
    for each in (file for file in folder.iterdir() if re.match(r"(crash|timeout|oom|leak)-", file.name)):
        content = each.read_bytes()
        place.mkdir(parents=True, exist_ok=True)
        if content:
            (place / f"{content[0]}-{each.name.rsplit('-', 1)[1][:8]}").write_bytes(content[1:])


def work(name: str, held_out: bool, seed: int, seconds: int) -> None:
    """One reader in this process, until it breaks or the time is up."""
    try:
        atheris: Any = importlib.import_module("atheris")
    except ImportError:
        sys.exit('error: the fuzzer needs atheris; pip install -e ".[fuzz]"')
    with atheris.instrument_imports(include=["shapepose_fg"]):
        prepare = readers()[name]
    mutated = importlib.import_module("mutations").mutated
    from shapepose_fg.core.errors import InputError

    shared = "/dev/shm" if os.access("/dev/shm", os.W_OK) else None
    folder = Path(tempfile.mkdtemp(dir=shared))
    corpus = Path.cwd() / "corpus"
    corpus.mkdir()
    read = prepare(folder, 12345 if held_out else 0)
    files = sorted(path for path in folder.rglob("*") if path.is_file())
    valid = [path.read_bytes() for path in files]
    for index, content in enumerate(valid[:64]):
        (corpus / str(index)).write_bytes(bytes([index]) + content)

    def case(data: bytes) -> None:
        """The first byte says which file, the others are its content."""
        if len(data) == 0:
            return
        path = files[data[0] % len(files)]
        path.write_bytes(data[1:])
        try:
            read()
        except InputError as error:
            if "\n" in str(error):
                raise AssertionError("more than one line") from error
        finally:
            path.write_bytes(valid[data[0] % len(files)])

    def change(data: bytes, most: int, number: int) -> bytes:
        """Mostly by what the file is, now and then by libFuzzer's own changes."""
        rng = random.Random(number)
        if rng.random() < 0.2:
            return atheris.Mutate(data, most)
        index = data[0] % len(files) if data else 0
        content = data[1:] if rng.random() < 0.7 and len(data) > 1 else valid[index]
        return (bytes([index]) + mutated(content, rng))[:most]

    try:
        case(bytes([0]) + valid[0])  # what is loaded once is loaded now
        used_mb = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss // 1024
        largest = max(map(len, valid)) + 20_000
        options = [f"-max_total_time={seconds}", f"-timeout={CASE_S}", f"-rss_limit_mb={used_mb + CASE_MB}"]
        options += [f"-malloc_limit_mb={CASE_MB}", f"-max_len={largest}", f"-seed={seed}", "-print_final_stats=1"]
        atheris.Setup([sys.argv[0], *options, str(corpus)], case, custom_mutator=change)
        atheris.Fuzz()
    finally:
        shutil.rmtree(folder, ignore_errors=True)


if __name__ == "__main__":
    main()
