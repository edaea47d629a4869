"""The same work for many items on the processes of a Dask cluster: this machine's, or that of many machines."""

from collections import deque
from collections.abc import Callable, Iterable, Iterator
from typing import TYPE_CHECKING, Any, Generic, TypeVar

from shapepose_fg.errors import InputError

if TYPE_CHECKING:
    from distributed import Client, Future

Shared = TypeVar("Shared")
Item = TypeVar("Item")
Result = TypeVar("Result")

RETRIES = 2
"""So often an item whose process was lost, or that failed, is tried again."""
_SECONDS = 10
"""A cluster that does not answer for so long is not there."""


class Cluster(Generic[Shared]):
    """The processes of a Dask cluster, each of which has `shared`: what `Workers` is for one machine.

    A context. Results come in order and do not depend on which process they come from, or how many there are.
    """

    def __init__(self, address: str | None, count: int, shared: Shared, ahead: int = 2) -> None:
        """The cluster whose scheduler is at `address`, `tcp://host:8786`; None: one of `count` processes here.

        `ahead` items a process are under way. InputError where Dask is not installed.
        """
        self._address, self._count, self._shared, self._ahead = address, count, shared, ahead
        self._client: Client | None = None
        self._at: Future[Any] | None = None

    def __enter__(self) -> "Cluster[Shared]":
        Client, LocalCluster = _dask()
        try:
            if self._address is None:
                # One thread a process: GTSAM holds Python's lock, and Dask leaves linear algebra one by itself.
                local = LocalCluster(
                    n_workers=self._count,
                    threads_per_worker=1,
                    processes=True,
                    dashboard_address=None,
                    silence_logs=50,
                )
                client = Client(local, timeout=_SECONDS)
            else:
                client = Client(self._address, timeout=_SECONDS)
        except (OSError, ValueError, TimeoutError) as error:
            reason = " ".join(str(error).split())
            raise InputError(
                f"--cluster {self._address or 'local'}: no Dask scheduler answers there ({reason}); start one with"
                " `dask scheduler`, or leave it out"
            ) from None
        with _large():
            # A task, not data that was scattered: what is lost with a process can be made again.
            self._client, self._at = client, client.submit(_same, self._shared, pure=False)
        return self

    def __exit__(self, *_: object) -> None:
        client, self._client, self._at = self._client, None, None
        if client is not None:
            if self._address is None:
                client.shutdown()
            client.close()

    def map(self, work: Callable[[Shared, Item], Result], items: Iterable[Item]) -> Iterator[Result]:
        """`work(shared, item)` for each item, in order; `items` are taken as they are needed.

        An item whose process is lost is done again by another; RuntimeError where that happens too often.
        """
        from distributed import KilledWorker

        client: Any = self._client
        waiting = deque["Future[Any]"]()
        if client is None:
            raise RuntimeError("a cluster is a context: use it in `with`")
        try:
            for item in items:
                with _large():
                    waiting.append(client.submit(_work, work, self._at, item, pure=False, retries=RETRIES))
                if len(waiting) >= self._ahead * max(1, len(client.nthreads())):
                    yield waiting.popleft().result()
            while len(waiting) > 0:
                yield waiting.popleft().result()
        except KilledWorker as error:
            raise RuntimeError(
                f"{error.allowed_failures + 1} processes of the cluster ended one after the other before their"
                " work: there may be too little memory for one"
            ) from None
        finally:
            client.cancel(list(waiting))


def _dask() -> tuple[Any, Any]:
    try:
        from distributed import Client, LocalCluster
    except ImportError:
        raise InputError(
            'Dask is not installed: pip install "shapepose-fg[cluster]", or leave --cluster out'
        ) from None
    return Client, LocalCluster


def _large() -> Any:
    """Context in which Dask does not complain of large tasks: bodies and minutes of footage are large."""
    from dask import config

    return config.set({"distributed.admin.large-graph-warning-threshold": "1GiB"})


def _same(shared: Shared) -> Shared:
    """What all work shares."""
    return shared


def _work(work: Callable[[Any, Any], Any], shared: Any, item: Any) -> Any:
    """One item, in a process of the cluster."""
    import torch

    if torch.get_num_threads() != 1:
        torch.set_num_threads(1)
    return work(shared, item)
