"""The processes of a Dask cluster: order, lost processes, and sentences."""

import os
import signal
import time

import pytest

from shapepose_fg.core.errors import InputError
from shapepose_fg.pipeline.cluster import (
    cluster,
    has_dashboard,
    local_cluster,
    one_item,
    pool_of,
    this_program,
)
from shapepose_fg.pipeline.workers import Here


def power(base: int, exponent: int) -> int:
    """The work."""
    return base**exponent


def once_killed(marker: str, item: int) -> int:
    """Ends its own process the first time that anybody does item 3."""
    try:
        if item == 3:
            os.close(os.open(marker, os.O_CREAT | os.O_EXCL))
            os.kill(os.getpid(), signal.SIGKILL)
    except FileExistsError:
        pass
    return 10 * item


def late(_: str, item: int) -> int:
    """Later items are done sooner."""
    time.sleep(0.05 * (6 - item))
    return item


def fails(_: str, item: int) -> int:
    raise ArithmeticError(f"item {item}")


@pytest.fixture(scope="module", autouse=True)
def installed():
    pytest.importorskip("distributed", reason="Dask is an extra")


@pytest.mark.slow
def test_results_come_in_order_and_an_error_or_a_kill_costs_only_its_own_work(tmp_path):
    with cluster(None, 2, str(tmp_path / "killed")) as pool:
        assert list(pool.map(late, range(6))) == list(range(6))
        assert list(pool.map(late, [])) == []
        with pytest.raises(ArithmeticError, match="item 0"):
            list(pool.map(fails, range(3)))
        assert list(pool.map(once_killed, range(6))) == [0, 10, 20, 30, 40, 50]
    assert (tmp_path / "killed").exists()


def test_a_process_that_comes_later_with_another_program_does_no_work():
    """Whoever asks says what it has; a process compares, whenever it came."""
    own = this_program()
    assert one_item(tuple(own.items()), 2, power, 5) == 32
    other = tuple((own | {"numpy": "1.0"}).items())
    with pytest.raises(
        InputError, match=r"another version of numpy \(\S+ there, 1\.0 here\); install the same"
    ):
        one_item(other, 2, power, 5)


class FakeClient:
    """Four processes that do everything at once."""

    def nthreads(self):
        return dict.fromkeys("abcd", 1)

    def get_executor(self, **_):
        return Here()


@pytest.mark.parametrize(("sharing", "under_way"), [(1, 8), (2, 4), (30, 2)])
def test_who_shares_a_cluster_keeps_a_part_of_the_work_ready(sharing, under_way):
    """Two items a process, of all who share them together; two at the least."""
    taken: list[int] = []
    pool = pool_of(FakeClient(), (lambda work, item: work(2, item),), 2 / sharing)
    next(pool.map(power, (taken.append(n) or n for n in range(20))))
    assert len(taken) == under_way


@pytest.mark.slow
def test_processes_of_this_machine_listen_to_this_machine_and_are_deaf_to_ctrl_c():
    import psutil

    with local_cluster(1, dashboard=True) as scheduler:
        own = psutil.Process()
        listening = [
            each.laddr.ip
            for process in (own, *own.children(recursive=True))
            for each in process.net_connections()
            if each.status == "LISTEN"
        ]
        assert len(listening) >= 2 and set(listening) == {"127.0.0.1"}
        assert scheduler.address.startswith("tcp://127.0.0.1:") and scheduler.processes == 1
        assert (scheduler.dashboard is not None) == has_dashboard()
        for process in own.children(recursive=True):
            if "tracker" not in " ".join(process.cmdline()):  # Python's own helpers are
                os.kill(process.pid, signal.SIGINT)
                time.sleep(0.2)
                assert process.is_running() and process.status() != "zombie"


@pytest.mark.slow
def test_nobody_answers():
    with (
        pytest.raises(InputError, match=r"tcp://127\.0\.0\.1:9: no Dask scheduler answers"),
        cluster("tcp://127.0.0.1:9", 1, 2),
    ):
        pass
