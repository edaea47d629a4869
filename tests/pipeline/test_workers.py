"""Worker processes: work in order, errors that come through, and nobody who waits for ever."""

import os
import signal
import subprocess
import sys
from pathlib import Path

import pytest

from shapepose_fg.core.errors import WorkLost
from shapepose_fg.pipeline.workers import Workers, suitable_workers, what_workers_inherit


def times(shared: int, item: int) -> int:
    if item == 13:
        raise ValueError("thirteen")
    return shared * item


@pytest.mark.parametrize("count", [1, 3])
def test_results_come_in_order_wherever_they_are_made(count):
    with Workers(count, 10) as workers:
        assert list(workers.map(times, range(12))) == list(range(0, 120, 10))
        assert list(workers.map(times, [])) == []
        with pytest.raises(ValueError, match="thirteen"):
            list(workers.map(times, [1, 13]))
        assert list(workers.map(times, [5])) == [50], "an error ends no worker"


def test_what_cannot_be_sent_is_said_before_anything_starts():
    with pytest.raises(ValueError, match="at the top of a module, or use workers=1"), Workers(2, lambda: None):
        pass
    with Workers(1, lambda: None) as here:
        assert list(here.map(lambda _, item: item, [1])) == [1]


def what_is_loaded(module: str, _: int) -> tuple[bool, int]:
    return module in sys.modules, os.getppid()


_READY = """
import os
from shapepose_fg.pipeline.workers import Workers, get_ready
from test_workers import what_is_loaded
if __name__ == "__main__":
    get_ready("wave")
    for _ in range(2):
        with Workers(2, "wave") as workers:
            print(*next(workers.map(what_is_loaded, [1])), os.getpid())
"""


@pytest.mark.skipif(sys.platform != "linux", reason="elsewhere each process imports what it needs")
def test_processes_start_from_one_that_has_loaded_what_they_need(tmp_path):
    """In an interpreter of its own: pytest has loaded everything."""
    (tmp_path / "script.py").write_text(_READY)
    environment = os.environ | {"PYTHONPATH": os.pathsep.join([*sys.path, str(Path(__file__).parent)])}
    words = [sys.executable, "script.py"]
    said = subprocess.run(words, cwd=tmp_path, env=environment, capture_output=True, text=True, check=True)
    first, second = (line.split() for line in said.stdout.splitlines())
    assert first == second, "both pools' processes have the same parent"
    loaded, parent, script = first
    assert loaded == "True" and parent != script


def is_killed(_: int, item: int) -> int:
    if item == 3:
        os.kill(os.getpid(), signal.SIGKILL)
    return item


@pytest.mark.skipif(os.name != "posix", reason="kills processes by POSIX signals")
def test_a_worker_that_is_killed_from_outside_is_told_of():
    """As the system does where memory is short; what was done before it comes through."""
    done = []
    with pytest.raises(WorkLost, match="a worker process was killed"), Workers(2, 10, ahead=1) as workers:
        done += workers.map(is_killed, range(9))
    with Workers(2, 10) as workers:
        assert list(workers.map(times, [1])) == [10], "the next ones work"


@pytest.mark.parametrize("count", [0, -1])
def test_no_workers_are_refused(count):
    with pytest.raises(ValueError, match="workers must be 1"):
        Workers(count, None)


def test_workers_pay_for_much_work_only(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(os, "sched_getaffinity", lambda _: range(8), raising=False)
    assert [suitable_workers(items, 100) for items in (0, 1, 60, 300, 3000)] == [1, 1, 1, 3, 8]


def test_what_workers_inherit_is_put_back(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setenv("OMP_NUM_THREADS", "7")
    monkeypatch.delenv("OPENBLAS_NUM_THREADS", raising=False)
    with what_workers_inherit():
        assert os.environ["OMP_NUM_THREADS"] == os.environ["OPENBLAS_NUM_THREADS"] == "1"
        assert signal.SIGINT in signal.pthread_sigmask(signal.SIG_BLOCK, [])
    assert os.environ["OMP_NUM_THREADS"] == "7" and "OPENBLAS_NUM_THREADS" not in os.environ
    assert signal.SIGINT not in signal.pthread_sigmask(signal.SIG_BLOCK, [])
