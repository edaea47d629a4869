"""Recordings, some at a time: who is next, who failed and is tried again, who is given up."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from multiprocessing.connection import wait
from pathlib import Path
from time import monotonic

from shapepose_fg.cli.batch.leader import Assignment, Leader
from shapepose_fg.cli.batch.standing import Standing, Standings
from shapepose_fg.cli.batch.summary import Bars
from shapepose_fg.cli.batch.table import Entry
from shapepose_fg.cli.reconstruct.request import Ended
from shapepose_fg.pipeline.runs.manifest import PARTS

ATTEMPTS = 2
"""A recording that has failed so often is left, and the others go on."""


@dataclass(frozen=True)
class Campaign:
    """What is to be done, and with what."""

    entries: Sequence[Entry]
    """All recordings."""
    sizes: Mapping[str, int]
    """Bytes of each one's detections."""
    output: Path
    """The folder of all results."""
    cluster: str
    """Address of the scheduler."""
    at_once: int
    """So many recordings are led at a time."""

    def run(self, standings: Standings, watcher: Bars) -> None:
        """Do what is not done; `standings` has how each ended.

        The largest come first, so that none is alone at the end; whoever failed comes again after all others.
        """
        leaders: list[Leader] = []
        try:
            while True:
                while len(leaders) < self.at_once and (entry := self._next(standings, leaders)) is not None:
                    watcher.began(entry.name)
                    leaders.append(Leader(self._assignment(entry, standings)))
                if len(leaders) == 0:
                    break
                for ready in wait([leader.told for leader in leaders]):
                    leader = next(each for each in leaders if each.told is ready)
                    if self._heard(leader, standings, watcher):
                        leaders.remove(leader)
        finally:
            for leader in leaders:
                leader.ask_to_stop()
            for leader in leaders:
                found = leader.end()
                if found is not None:  # it was done when it was asked to stop
                    standings.set(leader.assignment.name, self._done(leader, found, standings))

    def _next(self, standings: Standings, leaders: Sequence[Leader]) -> Entry | None:
        """Who is begun next; those whose turn cannot come are given up."""
        led = {leader.assignment.name for leader in leaders}
        found: list[Entry] = []
        for entry in self.entries:
            own = standings.of[entry.name]
            if own.status != "waiting" or entry.name in led:
                continue
            before = None if entry.after is None else standings.of[entry.after].status
            if before == "failed":
                reason = f"it begins with the shapes that {entry.after} leaves, which failed; see there"
                standings.set(entry.name, own.failed(reason, 0.0, 0))
            elif before in (None, "done"):
                found.append(entry)
        return min(
            found, key=lambda each: (standings.of[each.name].attempts, -self.sizes[each.name]), default=None
        )

    def _assignment(self, entry: Entry, standings: Standings) -> Assignment:
        """What its leader is to do."""
        folder, restart = self.output / entry.name, standings.of[entry.name].anew
        resume = not restart and (folder / PARTS).exists()
        return Assignment(entry.name, entry.request, folder, self.cluster, self.at_once, resume, restart)

    def _heard(self, leader: Leader, standings: Standings, watcher: Bars) -> bool:
        """Take in what a leader tells; whether it has ended."""
        name, told = leader.assignment.name, leader.next()
        if isinstance(told, tuple):
            if standings.of[name].anew:  # what is kept now is this run's own
                standings.set(name, replace(standings.of[name], anew=False))
            watcher.frames(name, *told)
            return False
        leader.end()
        if isinstance(told, Ended):
            standings.set(name, self._done(leader, told, standings))
            watcher.ended(name, failed=None, again=False)
        else:
            now = standings.of[name].failed(told.reason, monotonic() - leader.began, ATTEMPTS)
            standings.set(name, now)
            watcher.ended(name, failed=told.reason, again=now.status == "waiting")
        return True

    def _done(self, leader: Leader, found: Ended, standings: Standings) -> Standing:
        """How a recording stands that is done."""
        return standings.of[leader.assignment.name].done(found, monotonic() - leader.began)
