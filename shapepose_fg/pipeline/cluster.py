"""The same work for many items on the processes of a Dask cluster: this machine's, or that of many machines."""

import socket
import warnings
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import CancelledError
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from functools import cache, partial
from importlib.util import find_spec
from typing import TYPE_CHECKING, Any, Generic, TypeVar

from shapepose_fg.core.errors import InputError, WorkLost
from shapepose_fg.core.provenance import program_digest, versions
from shapepose_fg.pipeline.workers import get_ready, in_order, processes, what_workers_inherit

if TYPE_CHECKING:
    from distributed import Client, Future

Shared = TypeVar("Shared")
Item = TypeVar("Item")
Result = TypeVar("Result")

_LOADED = ("shapepose_fg.pipeline.pipeline", "distributed")
"""Modules that have loaded what a process needs."""
RETRIES = 2
"""So often an item whose process was lost, or that failed, is tried again."""
_LEAST = 2
"""So many items are always under way, so that the next one does not wait for the last."""
_SECONDS = 10
"""A cluster that does not answer for so long is not there."""
_ITSELF = "shapepose-fg itself"


class Cluster(Generic[Shared]):
    """The processes of a Dask cluster, each of which has `shared`: what `Workers` is for one machine.

    A context. Results come in order and do not depend on which process they come from, or how many there are.
    """

    def __init__(
        self, address: str | None, count: int, shared: Shared, ahead: int = 2, *, sharing: int = 1
    ) -> None:
        """The cluster whose scheduler is at `address`, `tcp://host:8786`; None: one of `count` processes here.

        `ahead` items a process are under way, of all who are `sharing` the cluster together: they wait in its
        scheduler's memory. InputError where Dask is not installed.
        """
        self._address, self._count, self._shared = address, count, shared
        self._ahead = ahead / sharing
        self._open = ExitStack()
        self._client: Client | None = None
        self._at: Future[Any] | None = None

    def __enter__(self) -> "Cluster[Shared]":
        with ExitStack() as opened:
            address = self._address
            if address is None:
                address = opened.enter_context(local_cluster(self._count)).address
            client = opened.enter_context(_client(address))
            if self._address is not None:
                refuse_other_programs(client, address)
            # A task, not data that was scattered: what is lost with a process can be made again.
            self._client, self._at = client, client.submit(_same, self._shared, pure=False)
            self._open = opened.pop_all()
        return self

    def __exit__(self, *_: object) -> None:
        self._client = self._at = None
        self._open.close()

    def map(self, work: Callable[[Shared, Item], Result], items: Iterable[Item]) -> Iterator[Result]:
        """`work(shared, item)` for each item, in order; `items` are taken as they are needed.

        An item whose process is lost is done again by another; `WorkLost` where that happens too often, or the
        scheduler is gone.
        """
        from distributed import KilledWorker

        client: Any = self._client
        if client is None:
            raise RuntimeError("a cluster is a context: use it in `with`")
        how = {"pure": False, "retries": RETRIES}
        submit = partial(client.submit, one_item, tuple(this_program().items()), work, self._at, **how)
        try:
            yield from in_order(submit, items, self._most_under_way, client.cancel)
        except KilledWorker as error:
            raise WorkLost(
                f"{error.allowed_failures + 1} processes of the cluster ended one after the other before their"
                " work: there may be too little memory for one"
            ) from None
        except CancelledError:
            raise WorkLost("the cluster's scheduler is gone") from None

    def _most_under_way(self) -> float:
        """As many items as keep every process of the cluster busy."""
        client: Any = self._client
        return max(_LEAST, self._ahead * len(client.nthreads()))


@dataclass(frozen=True)
class Scheduler:
    """A Dask scheduler that answers."""

    address: str
    """`tcp://host:8786`."""
    processes: int
    """How many there are at present."""
    dashboard: str | None
    """Where its dashboard is; None where it has none."""


@contextmanager
def local_cluster(count: int, *, dashboard: bool = False) -> Iterator[Scheduler]:
    """`count` processes of this machine, out of reach of others, while the block runs.

    InputError where Dask is not installed. With `dashboard`, and bokeh installed, the scheduler has one.
    """
    _, LocalCluster = _dask()
    import dask.config

    shown = dashboard and has_dashboard()
    get_ready(*_LOADED)
    method = processes(*_LOADED).get_start_method()
    with dask.config.set({"distributed.worker.multiprocessing-method": method}), ExitStack() as opened:
        # One thread a process: GTSAM holds Python's lock, and Dask leaves linear algebra one by itself. Ctrl-C is
        # for this process alone.
        with what_workers_inherit(), warnings.catch_warnings():
            warnings.simplefilter("ignore")  # another port is taken where the dashboard's usual one is
            cluster = LocalCluster(
                n_workers=count,
                threads_per_worker=1,
                processes=True,
                host="127.0.0.1",
                dashboard_address="127.0.0.1:8787" if shown else None,
                silence_logs=50,
            )
        opened.callback(cluster.close)
        yield Scheduler(cluster.scheduler_address, count, cluster.dashboard_link if shown else None)


def has_dashboard() -> bool:
    """Whether a scheduler of this machine can show one."""
    return find_spec("bokeh") is not None


def look_at(address: str) -> Scheduler:
    """The scheduler at an address, whose processes have this very program; InputError otherwise."""
    with _client(address) as client:
        refuse_other_programs(client, address)
        shown = "dashboard" in client.scheduler_info().get("services", {})
        return Scheduler(address, len(client.nthreads()), client.dashboard_link if shown else None)


@contextmanager
def _client(address: str) -> Iterator[Any]:
    """A connexion to the scheduler at an address; bodies and minutes of footage are large tasks to it."""
    Client, _ = _dask()
    import dask.config

    try:
        client = Client(address, timeout=_SECONDS)
    except (OSError, ValueError, TimeoutError) as error:
        reason = " ".join(str(error).split())
        raise InputError(
            f"--cluster {address}: no Dask scheduler answers there ({reason}); start one with"
            " `dask scheduler`, or leave it out"
        ) from None
    with client, dask.config.set({"distributed.admin.large-graph-warning-threshold": "1GiB"}):
        yield client


def refuse_other_programs(client: Any, address: str) -> None:
    """InputError where a process has another version of this program, or of what decides on numbers."""
    for process, theirs in client.run(this_program, on_error="return").items():
        if not isinstance(theirs, dict):
            raise InputError(
                f"--cluster {address}: its process {process} cannot run this program"
                f' ({" ".join(str(theirs).split())[:200]}); install "shapepose-fg[cluster]" there'
            )
        _refuse_other(f"--cluster {address}: its process {process}", this_program(), theirs)


def _refuse_other(process: str, own: dict[str, str], theirs: dict[str, str]) -> None:
    """InputError where the program of a process has another version of anything than `own`."""
    other = next((name for name in own if theirs.get(name) != own[name]), None)
    if other is not None:
        which = f" ({theirs.get(other)} there, {own[other]} here)" if other != _ITSELF else ""
        raise InputError(
            f"{process} has another version of {other}{which}; install the same there, or results would depend on"
            " who did what"
        )


@cache
def this_program() -> dict[str, str]:
    """What decides about the numbers of this process."""
    return {**versions(), _ITSELF: program_digest()}


def _dask() -> tuple[Any, Any]:
    try:
        from distributed import Client, LocalCluster
    except ImportError:
        raise InputError('Dask is not installed: pip install "shapepose-fg[cluster]", or leave it out') from None
    return Client, LocalCluster


def _same(shared: Shared) -> Shared:
    """What all work shares."""
    return shared


def one_item(program: tuple[tuple[str, str], ...], work: Callable[[Any, Any], Any], shared: Any, item: Any) -> Any:
    """One item, in a process of the cluster; InputError where it has another `program` than the one that asks.

    Processes may come at any time, after the others were looked at.
    """
    _refuse_other(f"--cluster: one of its processes, {socket.gethostname()},", dict(program), this_program())
    return work(shared, item)
