"""`shapepose-fg batch`: reconstructs all recordings of a table, on processes of this machine or of
a Dask cluster.
"""

import time
from contextlib import ExitStack
from pathlib import Path
from typing import TYPE_CHECKING

import typer

from shapepose_fg.cli.options import (
    REQUIRED,
    RESULT,
    RUN,
    RunOptions,
    Workers,
    argument,
    grouped,
    option,
)
from shapepose_fg.cli.stopping import Stopped
from shapepose_fg.cli.terminal import bars, note, show, show_written, warn
from shapepose_fg.core.errors import InputError
from shapepose_fg.core.result_files import PEOPLE
from shapepose_fg.core.result_files import RUN as RUN_FILE
from shapepose_fg.core.storage.output_folder import only_run_in

if TYPE_CHECKING:
    from shapepose_fg.cli.batch.status import RecordingStatus
    from shapepose_fg.cli.batch.table import Entry
    from shapepose_fg.pipeline.cluster import Scheduler

BATCH = "batch.json"


@grouped
def batch(
    running: RunOptions,
    table: Path = argument("RECORDINGS.TOML", "Table of the recordings (docs/batch.md)."),
    output: Path = option(
        RESULT, "Folder for batch.json and a folder of results per recording.", REQUIRED
    ),
    at_once: Workers | None = option(
        RUN,
        "Number of recordings processed at once; by default as many as keep all processes busy.",
    ),
) -> None:
    """Reconstruct all recordings of a table; each result has the same bytes as that of
    `reconstruct`.

    After two failures, a recording is skipped, and the others continue. Exit code 1 if a recording
    failed, otherwise 0.
    """
    from shapepose_fg.cli.batch.table import read_table

    running.check()
    entries = read_table(table)
    with only_run_in(output, [BATCH]):
        _run(table, entries, output, running, at_once)


def _run(
    table: Path, entries: "list[Entry]", output: Path, running: RunOptions, at_once: int | None
) -> None:
    """Run the batch in a folder that is locked for other processes."""
    from shapepose_fg.cli.batch.runner import BatchRunner, look_at_all
    from shapepose_fg.cli.batch.status import Bars, BatchStatus
    from shapepose_fg.pipeline.cluster import local_cluster, look_at
    from shapepose_fg.pipeline.workers import cores

    begin = time.monotonic()
    of = status_of(entries, output, resume=running.resume, restart=running.restart)
    batch_status = BatchStatus(output / BATCH, str(table), of)
    todo = [entry for entry in entries if batch_status.of[entry.name].status == "waiting"]
    sizes = look_at_all(table, todo, output, continued=running.resume or running.restart)
    if len(todo) > 0:
        with ExitStack() as opened:
            is_local = running.cluster in (None, "local")
            if is_local:
                scheduler = opened.enter_context(
                    local_cluster(running.workers or cores(), dashboard=True)
                )
            else:
                scheduler = look_at(str(running.cluster))
            # A coordinator keeps five workers busy if it does the tracking itself, and ten
            # otherwise. While one recording is being read or written, another one fills the queue.
            most = max(2, min(1 + scheduler.processes // 6, cores()))
            count = min(at_once or most, len(todo))
            done = (
                ""
                if len(todo) == len(entries)
                else f", {len(entries) - len(todo)} of them are already done"
            )
            _say(scheduler, f"{len(entries)} recordings{done}", count, is_local=is_local)
            batch_status.write()
            runner = BatchRunner(entries, sizes, output, scheduler.address, count)
            try:
                with bars() as shown:
                    runner.run(batch_status, Bars(shown, batch_status))
            except Stopped as stop:
                done = len(batch_status.names("done"))
                where = (
                    f"{done} of {len(entries)} recordings are done in {output}; continue with "
                    "--resume"
                )
                raise Stopped(stop.number, where) from None
    show(batch_status.summary(time.monotonic() - begin))
    show_written([str(output / BATCH)])
    for name in (failed := batch_status.names("failed")):
        warn(f"{name}: {batch_status.of[name].reasons[-1]}")
    if len(failed) > 0:
        raise typer.Exit(1)


def status_of(
    entries: "list[Entry]", output: Path, *, resume: bool, restart: bool
) -> "dict[str, RecordingStatus]":
    """The status of every recording; with `restart`, or if its options have changed, it is
    restarted from the beginning.
    """
    from shapepose_fg.cli.batch.status import RecordingStatus, read_status
    from shapepose_fg.cli.batch.table import options_of

    file = output / BATCH
    if file.exists() and not (resume or restart):
        raise InputError(
            f"{file}: this folder has a batch already; continue with --resume, or start again "
            "with --restart"
        )
    if resume and not file.exists():
        note(f"{output}: there is no batch to resume; a new one is started")
    before = read_status(file) if resume and file.exists() else {}
    found: dict[str, RecordingStatus] = {}
    for entry in entries:
        wanted = options_of(entry.request)
        old = before.get(entry.name, RecordingStatus(wanted, anew=restart))
        finished = all((output / entry.name / name).is_file() for name in (PEOPLE, RUN_FILE))
        changed = old.asked != wanted
        if changed:
            note(f"{entry.name}: its options in the table have changed; it is reconstructed again")
        is_done = not changed and old.status == "done" and finished
        found[entry.name] = old if is_done else RecordingStatus(wanted, anew=changed or old.anew)
    return found


def _say(scheduler: "Scheduler", what: str, at_once: int, *, is_local: bool) -> None:
    """Print what will be done, and where its progress is shown."""
    place = "here" if is_local else f"at {scheduler.address}"
    print(
        f"{what}; {scheduler.processes} processes {place}, {at_once} recordings at once", flush=True
    )
    if scheduler.processes == 0:
        note(
            f"no worker process has connected to {scheduler.address} yet; start one with `dask "
            "worker`"
        )
    if scheduler.dashboard is not None:
        print(f"what every process does: {scheduler.dashboard}", flush=True)
    elif is_local:
        note(
            "Dask's dashboard, which shows what every process does, needs bokeh: pip install "
            '"dask[dashboard]"'
        )
