"""Files of every kind, changed: they are read, or refused in one sentence, at once; nothing else."""

import random
import re
import signal
import time
from pathlib import Path

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from shapepose_fg.core.errors import InputError
from tests.hostile.mutations import mutated
from tests.hostile.readers import READERS

FOUND = Path(__file__).parent / "data" / "fuzz"
"""What `scripts/fuzz.py` found once: folders called after the reader, with the files as they were."""
MOST_S = 5.0
"""No small file may take longer to read; most take a millisecond."""


def files_of(folder: Path) -> list[Path]:
    return sorted(path for path in folder.rglob("*") if path.is_file())


def check(read) -> bool:
    """Whether the files were refused; anything but a sentence, or a long time, is a mistake."""
    start = time.process_time()
    try:
        read()
        return False
    except InputError as error:
        assert "\n" not in str(error) and len(str(error)) <= 1000
        return True
    finally:
        assert time.process_time() - start < MOST_S


@pytest.mark.parametrize("name", READERS)
def test_changed_files_are_read_or_refused(tmp_path, name):
    read = READERS[name](tmp_path, 0)
    read_once = name != "corrections" and not check(read)
    assert read_once or name == "corrections"  # these belong to another result
    valid = {path: path.read_bytes() for path in files_of(tmp_path)}
    refused = []

    @settings(
        max_examples=25,
        derandomize=True,
        database=None,
        deadline=None,
        suppress_health_check=list(HealthCheck),
    )
    @given(st.integers(0, 2**32))
    def change_one(seed: int) -> None:
        rng = random.Random(seed)
        path = rng.choice(sorted(valid))
        path.write_bytes(mutated(valid[path], rng))
        try:
            refused.append(check(read))
        finally:
            path.write_bytes(valid[path])

    change_one()
    assert any(refused)


@pytest.mark.parametrize("case", sorted(FOUND.glob("*/*")), ids=lambda case: f"{case.parent.name}-{case.name}")
def test_what_fuzzing_found_stays_mended(tmp_path, case):
    name = next(name for name in READERS if re.sub(r"\W+", "_", name) == case.parent.name)
    read = READERS[name](tmp_path, 0)
    path = files_of(tmp_path)[int(case.name.split("-")[0])]
    path.write_bytes(case.read_bytes())
    signal.alarm(60)
    try:
        check(read)
    finally:
        signal.alarm(0)
