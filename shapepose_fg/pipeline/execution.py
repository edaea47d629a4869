"""Execution of a reconstruction: processes, a cluster, chunks, and a callback for progress."""

from collections.abc import Callable
from contextlib import AbstractContextManager
from dataclasses import dataclass, replace
from typing import TypeVar

from shapepose_fg.pipeline.cluster import cluster
from shapepose_fg.pipeline.workers import Pool, suitable_workers, workers

Shared = TypeVar("Shared")
Progress = Callable[[int, int], None]
"""Called with the number of frames that are done and the number of all frames. If trajectories of
moving cameras are refined first, this is half of the work on each frame."""


@dataclass(frozen=True)
class Execution:
    """Execution settings of a reconstruction. Only `chunk_frames` may change the result."""

    workers: int | None = 1
    """Number of processes that solve windows; 1: this process only, None: as many as useful."""
    cluster: str | None = None
    """Address of a Dask scheduler to solve on; `local` for `workers` processes of a temporary Dask
    cluster."""
    sharing: int = 1
    """Number of runs that share the cluster; each submits a corresponding share of the items that
    the cluster has at a time."""
    chunk_frames: int | None = None
    """Length of chunks with people tracked in parallel, frames; identities are joined across the
    borders (`runs/chunks.py`). The result may differ if people are occluded at a border. None: no
    chunks."""
    progress: Progress | None = None
    """Called while frames are solved."""

    def progress_over(self, frames: int) -> Callable[[int], object]:
        """A function to be called with the number of frames that are done, out of `frames`."""
        return lambda done: None if self.progress is None else self.progress(done, frames)

    def with_workers(self, frames: int) -> "Execution":
        """Return a copy with a suitable number of workers for this many frames, if none
        is given.
        """
        # Minimum number of frames of a recording per worker; work is distributed in
        # windows of a hundred.
        count = suitable_workers(frames, 100) if self.workers is None else self.workers
        return replace(self, workers=count)

    def pool(self, shared: Shared, frames: int) -> AbstractContextManager[Pool[Shared]]:
        """The processes for solving this many frames, each with `shared`."""
        count = self.with_workers(frames).workers or 0
        if self.cluster is None:
            return workers(count, shared)
        return cluster(
            None if self.cluster == "local" else self.cluster, count, shared, sharing=self.sharing
        )
