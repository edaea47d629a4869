"""Worker processes: work in order, errors that come through, nobody who waits for ever, from any
`__main__`.
"""

import os
import signal
import subprocess
import sys
import threading
import time
from pathlib import Path

import pytest

from shapepose_fg.core.errors import WorkLost
from shapepose_fg.pipeline.workers import suitable_workers, workers
from tests.marks import slow

posix = pytest.mark.skipif(os.name != "posix", reason="asks POSIX about processes")


def times(shared: int, item: int) -> int:
    if item == 13:
        raise ValueError("thirteen")
    return shared * item


@pytest.mark.slow
@pytest.mark.parametrize("count", [1, 2])
def test_workers_do_what_one_process_does(count, monkeypatch: pytest.MonkeyPatch):
    """Results in order, items taken as they are needed, an error that ends no worker; each has a
    thread and is deaf to Ctrl-C.
    """
    monkeypatch.setenv("OMP_NUM_THREADS", "7")
    monkeypatch.setenv("MINE", "kept")
    taken = list[int]()
    with workers(count, 10, ahead=2) as pool:
        found = pool.map(times, (taken.append(n) or n for n in range(12)))
        assert next(found) == 0 and len(taken) == (1 if count == 1 else 2 * count)
        assert list(found) == list(range(10, 120, 10))
        assert list(pool.map(times, [])) == []
        with pytest.raises(ValueError, match="thirteen"):
            list(pool.map(times, [1, 13]))
        assert list(pool.map(times, [5])) == [50], "an error ends no worker"
        (process, threads, mine, heard), *_ = pool.map(about_itself, range(4))
    if count == 1:
        assert process == os.getpid() and threads == "7"
    else:
        assert process != os.getpid() and (threads, mine, heard) == ("1", "kept", signal.SIG_IGN)
    assert os.environ["OMP_NUM_THREADS"] == "7"
    if os.name == "posix":
        assert signal.SIGINT not in signal.pthread_sigmask(signal.SIG_BLOCK, [])


def test_what_cannot_be_sent_is_said_before_anything_starts():
    with (
        pytest.raises(ValueError, match="cannot be sent to worker processes"),
        workers(2, threading.Lock()),
    ):
        pass
    with workers(1, threading.Lock()) as here:
        assert list(here.map(lambda _, item: item, [1])) == [1]


def about_itself(_: object, _item: int) -> tuple[int, str, str | None, object]:
    return (
        os.getpid(),
        os.environ["OMP_NUM_THREADS"],
        os.environ.get("MINE"),
        signal.getsignal(signal.SIGINT),
    )


# What a user types: functions of their own, and no guard.
_TYPED = """
import os
from shapepose_fg.pipeline.workers import workers
print("begins")
base, here = 10, os.getpid()
def power(shared, item):
    return shared(item), os.getpid() != here
with workers(2, lambda item: base**item) as pool:
    print(list(pool.map(power, range(4))))
"""
_RESULT = "[(1, True), (10, True), (100, True), (1000, True)]"


@pytest.mark.parametrize("how", ["standard input", *slow("a cell", "a script without a guard")])
def test_any_main_will_do(how, tmp_path):
    """As a notebook's cell does, `exec` runs code in a `__main__` that no other process can
    import.
    """
    code, words, given = _TYPED, [], None
    match how:
        case "standard input":
            words, given = ["-"], code
        case "a cell":
            words = [
                "-c",
                f"import __main__\nexec(compile({code!r}, '<cell 1>', 'exec'), vars(__main__))",
            ]
        case _:
            (tmp_path / "script.py").write_text(code)
            words = ["script.py"]
    environment = os.environ | {"PYTHONPATH": os.pathsep.join(sys.path)}
    for _ in range(2):
        said = subprocess.run(
            [sys.executable, *words], input=given, cwd=tmp_path, env=environment,
            capture_output=True, text=True, timeout=120,
        )  # fmt: skip
        assert said.stdout.split("\n") == ["begins", _RESULT, ""], said.stderr
        # Rarely, loky's helper process looks for a semaphore between its end and the message of it.
        if "FileNotFoundError" not in said.stderr:
            break
    assert said.stderr == ""


def is_killed(_: int, item: int) -> int:
    if item == 3:
        os.kill(os.getpid(), signal.SIGKILL)
    return item


@posix
@pytest.mark.slow
def test_a_worker_that_is_killed_from_outside_is_told_of():
    """As the system does where memory is short; what was done before it comes through."""
    with (
        pytest.raises(WorkLost, match="a worker process was killed"),
        workers(2, 10, ahead=1) as pool,
    ):
        list(pool.map(is_killed, range(9)))
    with workers(2, 10) as pool:
        assert list(pool.map(times, [1])) == [10], "the next ones work"


_ENDLESS = """
import os, time
from shapepose_fg.pipeline.workers import workers
def endless(_, item):
    os.write(1, b"%d\\n" % os.getpid())  # in one piece
    time.sleep(600)
with workers(2, None) as pool:
    list(pool.map(endless, range(2)))
"""


@posix
@pytest.mark.parametrize("how", [signal.SIGKILL, *slow(signal.SIGINT, signal.SIGTERM)])
def test_workers_end_with_the_process_that_started_them_whatever_ends_it(how):
    environment = os.environ | {"PYTHONPATH": os.pathsep.join(sys.path)}
    run = subprocess.Popen([sys.executable, "-c", _ENDLESS], stdout=subprocess.PIPE,
                           stderr=subprocess.PIPE,
                           env=environment, text=True, start_new_session=True,
                           preexec_fn=lambda: signal.signal(signal.SIGINT,
                                                            signal.SIG_DFL))  # fmt: skip
    assert run.stdout is not None
    children = [int(run.stdout.readline()) for _ in range(2)]
    if how == signal.SIGINT:
        os.killpg(run.pid, how)  # to all of them, as a terminal does
    else:
        run.send_signal(how)
    run.communicate(timeout=60)  # a guard against hanging, not a measure
    patience = time.monotonic() + 30
    while (
        left := [child for child in children if is_alive(child)]
    ) and time.monotonic() < patience:
        time.sleep(0.05)
    assert left == []


def is_alive(process: int) -> bool:
    """Whether a process runs; one that has ended and that nobody has fetched yet does not."""
    if (stat := Path(f"/proc/{process}/stat")).exists():
        return stat.read_text(encoding="utf-8").rsplit(")", 1)[1].split()[0] != "Z"
    try:
        os.kill(process, 0)
    except ProcessLookupError:
        return False
    return not Path("/proc/self/stat").exists()


@pytest.mark.parametrize("count", [0, -1])
def test_no_workers_are_refused(count):
    with pytest.raises(ValueError, match="workers must be 1"), workers(count, None):
        pass


def test_workers_pay_for_much_work_only(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(os, "sched_getaffinity", lambda _: range(8), raising=False)
    assert [suitable_workers(items, 100) for items in (0, 1, 60, 300, 3000)] == [1, 1, 1, 3, 8]
