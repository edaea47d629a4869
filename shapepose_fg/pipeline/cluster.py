"""Run one function on many items in the processes of a Dask cluster, on this machine or on many
machines.
"""

import multiprocessing
import socket
import warnings
from collections.abc import Callable, Iterator
from concurrent.futures import CancelledError
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from functools import cache
from importlib.util import find_spec
from typing import Any, TypeVar, cast

import cloudpickle

from shapepose_fg.core.errors import InputError, WorkLost, naming, optional
from shapepose_fg.core.provenance import program_digest, versions
from shapepose_fg.pipeline.workers import Pool, Processes, naming_lost_work, nothing, packed

Shared = TypeVar("Shared")

_ITSELF = "shapepose-fg itself"


@contextmanager
def cluster(
    address: str | None, count: int, shared: Shared, ahead: int = 2, *, sharing: int = 1
) -> Iterator[Pool[Shared]]:
    """The processes of a Dask cluster, each with `shared`: the counterpart of `workers` for many
    machines.

    The scheduler is at `address`, `tcp://host:8786`; None: a temporary one with `count` processes
    on this machine. `ahead` items per process are submitted in total by all runs `sharing` the
    cluster; they wait in the scheduler's memory. Results depend neither on the process nor on the
    number of processes; items of lost processes are repeated. Raises InputError if Dask is not
    installed; `WorkLost` if processes are lost too often, or the scheduler is lost.
    """
    with ExitStack() as opened:
        at = opened.enter_context(local_cluster(count)).address if address is None else address
        client = opened.enter_context(_client(at))
        if address is not None:
            refuse_other_programs(client, at)
        # A task instead of scattered data, since it can be repeated after a process is lost.
        remote = client.submit(cloudpickle.loads, packed(shared), pure=False)
        call = (one_item, tuple(this_program().items()), remote)
        with _naming_lost_work():
            yield pool_of(client, call, ahead / sharing)


def pool_of(client: Any, call: tuple[Any, ...], ahead: float) -> Pool[Any]:
    """A pool of a client's processes, with `ahead` submitted items each, and a minimum in total."""
    # Maximum number of retries of an item after it failed or its process was lost.
    executor = client.get_executor(pure=False, retries=2)
    # Minimum number of submitted items, so that processes do not wait for the next one.
    return Pool(executor, call, lambda: max(2, ahead * len(client.nthreads())))


@contextmanager
def _naming_lost_work() -> Iterator[None]:
    """Raise `WorkLost` if work in the block is lost."""
    from distributed import KilledWorker

    try:
        yield
    except KilledWorker as error:
        raise WorkLost(
            f"{error.allowed_failures + 1} processes of the cluster ended in turn before they "
            "finished; there may be too little memory"
        ) from None
    except CancelledError:
        raise WorkLost("the scheduler of the cluster has ended") from None


@dataclass(frozen=True)
class Scheduler:
    """A responding Dask scheduler."""

    address: str
    """`tcp://host:8786`."""
    processes: int
    """Current number of worker processes."""
    dashboard: str | None
    """Address of the scheduler's dashboard; None if it has none."""


@contextmanager
def local_cluster(count: int, *, dashboard: bool = False) -> Iterator[Scheduler]:
    """A cluster of `count` processes on this machine, inaccessible to others, for the duration of
    the block.

    Raises InputError if Dask is not installed. With `dashboard`, the scheduler has a dashboard if
    bokeh is installed.
    """
    optional("distributed", "cluster")
    # Dask's processes import `__main__`, which fails for some notebooks and scripts: an own process
    # leads them.
    with Processes(1, nothing) as one, naming_lost_work():
        yield one.submit(_local_cluster, count, dashboard and has_dashboard()).result()
        one.submit(_end_local_cluster).result()


_running: list[Any] = []
"""The local cluster, in the process that started it; empty in others."""


def _local_cluster(count: int, dashboard: bool) -> Scheduler:
    import dask.config
    from distributed import LocalCluster

    multiprocessing.set_start_method(
        "spawn", force=True
    )  # loky's own start method is unknown to others
    # One thread per process: GTSAM holds the GIL, and Dask gives linear algebra a single one.
    with (
        dask.config.set({"distributed.worker.multiprocessing-method": "spawn"}),
        warnings.catch_warnings(),
    ):
        warnings.simplefilter("ignore")  # the dashboard's usual port may be in use
        cluster = LocalCluster(
            n_workers=count,
            threads_per_worker=1,
            processes=True,
            host="127.0.0.1",
            dashboard_address=cast(str, "127.0.0.1:8787" if dashboard else None),
            silence_logs=50,
        )
    _running.append(cluster)
    return Scheduler(
        cluster.scheduler_address, count, cluster.dashboard_link if dashboard else None
    )


def _end_local_cluster() -> None:
    _running.pop().close()


def has_dashboard() -> bool:
    """Whether a scheduler of this machine can have a dashboard."""
    return find_spec("bokeh") is not None


def look_at(address: str) -> Scheduler:
    """The scheduler at an address. Raises InputError if its processes have another version of the
    program.
    """
    with _client(address) as client:
        refuse_other_programs(client, address)
        shown = "dashboard" in client.scheduler_info().get("services", {})
        return Scheduler(address, len(client.nthreads()), client.dashboard_link if shown else None)


@contextmanager
def _client(address: str) -> Iterator[Any]:
    """A connection to the scheduler at an address, configured for large tasks."""
    Client = optional("distributed", "cluster").Client
    import dask.config

    words, cure = "no Dask scheduler answers there ({})", "start one with `dask scheduler`"
    with naming(f"--cluster {address}", f"{cure}, or leave it out", words, OSError, ValueError):
        # Time limit for an answer of a cluster, s.
        client = Client(address, timeout=10)
    with client, dask.config.set({"distributed.admin.large-graph-warning-threshold": "1GiB"}):
        yield client


def refuse_other_programs(client: Any, address: str) -> None:
    """Raise InputError if a process has another version of this program, or of a package that
    affects results.
    """
    for process, found in client.run(this_program, on_error="return").items():
        if not isinstance(found, dict):
            raise InputError(
                f"--cluster {address}: its process {process} cannot run this program"
                f' ({" ".join(str(found).split())[:200]}); install "shapepose-fg[cluster]" there'
            )
        _refuse_other(f"--cluster {address}: its process {process}", this_program(), found)


def _refuse_other(process: str, own: dict[str, str], other_versions: dict[str, str]) -> None:
    """Raise InputError if a process has other versions than `own`."""
    other = next((name for name in own if other_versions.get(name) != own[name]), None)
    if other is not None:
        which = (
            f" ({other_versions.get(other)} there, {own[other]} here)" if other != _ITSELF else ""
        )
        raise InputError(
            f"{process} has another version of {other}{which}; install the same version there, "
            "because results must not depend on the process"
        )


@cache
def this_program() -> dict[str, str]:
    """Versions of everything that affects the results of this process."""
    return {**versions(), _ITSELF: program_digest()}


def one_item(
    program: tuple[tuple[str, str], ...], shared: Any, work: Callable[[Any, Any], Any], item: Any
) -> Any:
    """Process one item in a process of the cluster. Raises InputError if its `program` differs from
    the caller's.

    Processes may join at any time, after the others were checked.
    """
    _refuse_other(
        f"--cluster: one of its processes, {socket.gethostname()},", dict(program), this_program()
    )
    return work(shared, item)
