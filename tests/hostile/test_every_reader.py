"""Files of every kind, changed: they are read, or refused in one sentence, at once; nothing
else.
"""

import random
import re
import signal
import time
from pathlib import Path

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from tests.hostile.mutations import mutated
from tests.hostile.readers import READERS
from tests.hostile.trying import Trial
from tests.marks import slow

FOUND = Path(__file__).parent / "data" / "fuzz"
"""What `tests/hostile/fuzz.py` found once: folders called after the reader, with the files as they
were."""
MOST_S = 5.0
"""No small file may take longer to read; most take a millisecond."""


HEAVY = {"ONNX", "MCAP of detections", "MCAP of poses", "lines of live", "state of live"}
HEAVY |= {name for name in READERS if name.startswith(("result ", "run ", "parts "))}


@pytest.mark.parametrize("name", [*sorted(READERS.keys() - HEAVY), *slow(*sorted(HEAVY))])
def test_changed_files_are_read_or_refused(tmp_path, name):
    trial = Trial(READERS[name], tmp_path, 0)
    # Corrections belong to another result.
    assert trial.run(0, trial.valid[0]) == (name == "corrections")
    refused = []

    @settings(
        max_examples=6 if name.startswith(("result", "run")) else 16,
        derandomize=True,
        database=None,
        deadline=None,
        suppress_health_check=list(HealthCheck),
    )
    @given(st.integers(0, 2**32))
    def change_one(seed: int) -> None:
        rng = random.Random(seed)
        which = rng.randrange(len(trial.files))
        start = time.process_time()
        refused.append(trial.run(which, mutated(trial.valid[which], rng)))
        assert time.process_time() - start < MOST_S

    change_one()
    assert any(refused)


CASES = sorted(FOUND.glob("*/*"))
OF_LIVE = [case for case in CASES if "live" in case.parent.name]


@pytest.mark.parametrize(
    "case",
    [*(case for case in CASES if case not in OF_LIVE), *slow(*OF_LIVE)],
    ids=lambda case: f"{case.parent.name}-{case.name}",
)
def test_what_fuzzing_found_stays_mended(tmp_path, case):
    name = next(name for name in READERS if re.sub(r"\W+", "_", name) == case.parent.name)
    trial = Trial(READERS[name], tmp_path, 0)
    signal.alarm(60)
    try:
        trial.run(int(case.name.split("-")[0]), case.read_bytes())
    finally:
        signal.alarm(0)
