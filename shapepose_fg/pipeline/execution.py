"""What runs a reconstruction: processes, a cluster, chunks, and who is told how far it is."""

from collections.abc import Callable
from contextlib import AbstractContextManager
from dataclasses import dataclass, replace
from typing import TypeVar

from shapepose_fg.pipeline.cluster import cluster
from shapepose_fg.pipeline.workers import Pool, suitable_workers, workers

Shared = TypeVar("Shared")
Progress = Callable[[int, int], None]
"""Called with the number of frames that are done and the number of all."""
_FRAMES_WORTH_A_WORKER = 100
"""A recording must have this many for each worker: a window is a hundred, and it is what is handed out."""


@dataclass(frozen=True)
class Execution:
    """What runs a reconstruction. Only `chunk_frames` may change the result."""

    workers: int | None = 1
    """Processes that solve windows; 1: this one does, None: as many as pay."""
    cluster: str | None = None
    """Address of a Dask scheduler whose processes solve instead; `local` for `workers` processes of Dask's own."""
    sharing: int = 1
    """How many runs share the cluster: each keeps its part of the work ready there."""
    chunk_frames: int | None = None
    """People are followed side by side, too, in chunks of about so many frames; identities are joined across the
    borders (`runs/chunks.py`). The result may differ by who was in hiding there."""
    progress: Progress | None = None
    """Told how far it is."""

    def worth(self, frames: int) -> "Execution":
        """Return a copy with the number of workers that pays for this many frames, where none is given."""
        count = suitable_workers(frames, _FRAMES_WORTH_A_WORKER) if self.workers is None else self.workers
        return replace(self, workers=count)

    def pool(self, shared: Shared, frames: int) -> AbstractContextManager[Pool[Shared]]:
        """The processes that take part in solving so many frames; all have what is `shared`."""
        count = self.worth(frames).workers or 0
        if self.cluster is None:
            return workers(count, shared)
        return cluster(None if self.cluster == "local" else self.cluster, count, shared, sharing=self.sharing)
