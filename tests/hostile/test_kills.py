"""Runs that are killed from outside, and whose files are spoilt then: the same bytes, or one
sentence.
"""

import sys

import pytest

from tests.hostile.kills import Killing


@pytest.mark.slow
@pytest.mark.skipif(sys.platform != "linux", reason="looks for worker processes in /proc")
def test_killed_and_spoilt_runs_go_on_or_say_why(tmp_path):
    """A worker amid its work, and the whole with a bit turned; `tests/hostile/fuzz.py --kills 50`
    does more.
    """
    killing = Killing.of(tmp_path)
    of_worker, of_whole = (killing.once(number, tmp_path / str(number)) for number in (4, 3))
    assert of_worker.endswith("the same bytes")
    assert "error: " in of_whole or of_whole.endswith("the same bytes")
