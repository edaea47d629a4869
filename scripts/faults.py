"""Kill, fill, race: what `shapepose-fg reconstruct` keeps of its work: python scripts/faults.py --kills 200.

A run of the built-in scene (300 frames) is made once without a fault. Then it is disturbed:

--kills 200   SIGKILL at random moments of the whole run, the writing of the results included. After each kill
              the windows that are kept must be those of the first run. It goes on with `--resume`, is killed
              again, and so on. In the end all files must be those of the first run, to the byte; of run.json
              all but the times. With --once each run is killed once, and goes on to its end: a result a kill.
--full 20     The disk is full at a random byte of what the run writes in all. It must end with one sentence and
              exit code 2; what it says is kept must be there, to the byte; an earlier result beside it must be
              whole or replaced whole; when there is room again `--resume` must end with the files of the first
              run. A tmpfs is filled, in a mount namespace of its own (Linux; `unshare` of util-linux).
--races 40    Two runs start into one folder within 50 ms, new ones or such that go on. One is refused in a
              sentence, the other ends with the files of the first run. And 8 processes enter and leave a folder
              500 times each.

Prints a line for each and a summary; exit code 1 where something is not as it must be. Runs are forks of this
process, where torch is loaded already; the first run is the command itself.
"""

import argparse
import os
import random
import signal
import subprocess
import sys
import tempfile
import time
from collections import Counter
from pathlib import Path

os.environ["OMP_NUM_THREADS"] = "1"  # before torch is loaded: the forks must not share its threads

from fault_runs import WINDOW, Command, Run, Watched, emptied, parts, phase, state

from shapepose_fg.core.errors import InputError
from shapepose_fg.core.reconstruction import Reconstruction
from shapepose_fg.core.storage.output_folder import only_run_in
from shapepose_fg.pipeline.runs.manifest import PARTS, frames_done

_INSIDE = "SHAPEPOSE_FAULTS_INSIDE"
"""Set in the mount namespace where a disk may be filled."""
_DISK = 64 << 20


def main() -> int:
    """Run what was asked for."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--kills", type=int, default=0, help="how many kills in all")
    parser.add_argument("--once", action="store_true", help="kill each run once only")
    parser.add_argument("--full", type=int, default=0, help="how often the disk is full")
    parser.add_argument("--races", type=int, default=0, help="how many pairs of runs")
    parser.add_argument("--frames", type=int, default=300, help="frames of the recording")
    parser.add_argument("--people", type=int, default=1, help="people in it")
    parser.add_argument("--cameras", type=int, default=3, help="cameras before it")
    parser.add_argument("--seed", type=int, default=0, help="of the moments")
    arguments = parser.parse_args()
    if arguments.kills + arguments.full + arguments.races == 0:
        parser.error("nothing to do: give --kills, --full or --races")
    if arguments.full > 0 and _INSIDE not in os.environ:
        return _in_a_namespace()
    rng = random.Random(arguments.seed)
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        command = Command.of_a_recording(folder, arguments.frames, arguments.people, arguments.cameras)
        seconds = command.run_as_a_user_does(folder / "whole")
        expected = state(folder / "whole")
        print(f"without a fault: {seconds:.1f} s, {len(expected)} files", flush=True)
        wrong = kill(command, folder, expected, arguments, rng) if arguments.kills > 0 else 0
        wrong += fill(command, folder, expected, arguments, rng) if arguments.full > 0 else 0
        wrong += (
            race(command, folder, arguments.races, rng) + race_for_the_lock(folder) if arguments.races > 0 else 0
        )
    return 1 if wrong > 0 else 0


def kill(
    command: Command, folder: Path, expected: dict[str, str], arguments: argparse.Namespace, rng: random.Random
) -> int:
    """Kill runs, each several times on its way; returns how many did not end with the expected files."""
    watched = Watched.on(command, folder / "watched", folder / "said")
    windows = watched.windows
    print(
        f"a forked run: {watched.seconds:.1f} s, {len(windows)} windows, {watched.ending_s:.1f} s after the last"
    )
    moments: Counter[str] = Counter()
    kills = runs = wrong = 0
    while kills < arguments.kills:
        out, more, own = folder / f"run{runs}", [], []
        while True:
            run = Run(command.into(out, *more), folder / "said")
            solved = len(parts(out)) == len(windows)
            if kills + len(own) >= arguments.kills or (arguments.once and len(own) > 0):
                code = run.wait()
            elif arguments.once:
                run.wait(rng.uniform(0.0, watched.seconds))
                code = run.kill()
            elif not (solved and rng.random() < 0.5):
                # A leg is a quarter of a run at the most, so that a run is killed all along its way.
                run.wait(rng.uniform(0.0, 1.1 * watched.ending_s if solved else 0.25 * watched.seconds))
                code = run.kill()
            else:
                code = run.wait()
            if code == 0:
                break
            if code != -signal.SIGKILL:
                print(f"run {runs}: exit code {code}: {run.said.read_text()}")
                return wrong + 1
            own.append(phase(out, len(windows)))
            if any(windows[name] != checksum for name, checksum in parts(out).items()):
                own[-1] += " LEFT ANOTHER WINDOW"
                wrong += 1
            more = ["--resume"]
        same = state(out) == expected
        moments.update(own)
        kills, runs, wrong = kills + len(own), runs + 1, wrong + (not same)
        print(f"run {runs}: {len(own)} kills ({', '.join(own)}): {'same' if same else 'DIFFERENT'}", flush=True)
    for what, count in sorted(moments.items()):
        print(f"  {count:3d} kills: {what}")
    print(f"kills: {kills} in {runs} runs, {wrong} things not as they must be", flush=True)
    return wrong


def fill(
    command: Command, folder: Path, expected: dict[str, str], arguments: argparse.Namespace, rng: random.Random
) -> int:
    """Let the disk be full at random bytes of a run; returns how many runs were not as they must be."""
    disk = folder / "disk"
    disk.mkdir()
    subprocess.run(["mount", "-t", "tmpfs", "-o", f"size={_DISK}", "tmpfs", str(disk)], check=True)
    out, ballast, wrong = disk / "out", disk / "ballast", 0
    try:
        watched = Watched.on(command, out, folder / "said")
        peak = watched.most_bytes
        earlier = command.with_options("--frames", f"0:{2 * WINDOW}", "--no-report", "--no-check")
        earlier.run_as_a_user_does(folder / "earlier")
        before = {file.name: file.read_bytes() for file in (folder / "earlier").iterdir()}
        print(f"a run takes {peak / 1e6:.1f} MB of a disk at the most", flush=True)
        for _ in range(arguments.full):
            emptied(out)
            ballast.unlink(missing_ok=True)
            for name, content in before.items():
                (out / name).write_bytes(content)
            room = rng.randrange(0, peak)
            run = Run(command.into(out), folder / "said")
            run.wait(until=(out / PARTS / "manifest.json").exists)  # before it, the run asks whether there is room
            _fill(ballast, room, out)
            code, said = run.wait(), run.said.read_text()
            faults = _faults(code, said, out, before, watched.windows, arguments.frames)
            ballast.unlink()
            again = Run(command.into(out, *(["--resume"] if code != 0 else [])), folder / "said")
            if code != 0 and (again.wait() != 0 or state(out) != expected):
                faults.append(f"does not go on to the same: {again.said.read_text()}")
            wrong += len(faults) > 0
            told = said.strip().splitlines()[-1].replace(str(disk), "") if said.strip() else ""
            print(f"full after {room / 1e6:.2f} MB: {'; '.join(faults) or 'as promised'}: {told}", flush=True)
    finally:
        subprocess.run(["umount", "--lazy", str(disk)], check=False)
    print(f"disk full: {arguments.full} times, {arguments.full - wrong} as promised, {wrong} not", flush=True)
    return wrong


def _used(out: Path) -> int:
    disk = os.statvfs(out.parent)
    return (disk.f_blocks - disk.f_bfree) * disk.f_frsize


def _fill(ballast: Path, room: int, out: Path) -> None:
    """Take all of the disk but what the run has used and `room` more."""
    free = os.statvfs(out.parent)
    take = max(0, free.f_bavail * free.f_frsize - max(0, room - _used(out)))
    with ballast.open("wb") as stream:
        os.posix_fallocate(stream.fileno(), 0, max(take, 1))


def _faults(
    code: int | None, said: str, out: Path, before: dict[str, bytes], solved: dict[str, str], frames: int
) -> list[str]:
    """What is wrong with a run that met a full disk."""
    if code == 0:
        return []  # it needed less
    faults = [] if code == 2 else [f"exit code {code}"]
    if "Traceback" in said or "No space left on device" not in said:
        faults.append(f"does not say that the disk is full: {said}")
    kept = frames_done(out)
    if f"{kept} of {frames} frames are kept" not in said and not (kept == 0 and "nothing is kept" in said):
        faults.append(f"{kept} frames are kept, and it says: {said}")
    if any(solved[name] != checksum for name, checksum in parts(out).items()):
        faults.append("a window that is kept is not what was solved")
    now = {name: (out / name).read_bytes() for name in ("people.npz", "observations.npz", "run.json")}
    try:
        Reconstruction.load(out)
    except InputError as error:
        faults.append(f"the result is torn: {error}")
    else:
        if now != {name: before[name] for name in now} and len(parts(out)) < len(solved):
            faults.append("an earlier result was changed before the new one was complete")
    return faults


def race(command: Command, folder: Path, pairs: int, rng: random.Random) -> int:
    """Let two runs at a time start into one folder; returns how many pairs were not as they must be."""
    short = command.with_options("--frames", f"0:{2 * WINDOW}", "--no-report", "--no-check")
    short.run_as_a_user_does(folder / "short")
    expected, wrong = state(folder / "short"), 0
    for n in range(pairs):
        out, options = folder / f"race{n}", []
        if n % 2 == 1:  # after a kill, both go on
            first = Run(short.into(out), folder / "said")
            first.wait(until=(out / PARTS / "part-000000.safetensors").exists)
            first.wait(rng.uniform(0.0, 0.3))
            options = ["--resume"] if first.kill() != 0 else []
        runs = []
        for which in range(2):
            runs.append(Run(short.into(out, *options), folder / f"said{which}"))
            time.sleep(rng.uniform(0.0, 0.05))
        codes = sorted(run.wait() or 0 for run in runs)
        said = " ".join(run.said.read_text() for run in runs)
        fine = codes == [0, 2] and "another run writes its results here" in said and "Traceback" not in said
        if not fine or state(out) != expected:
            wrong += 1
            print(f"race {n}: exit codes {codes}, {'same' if state(out) == expected else 'DIFFERENT'}: {said}")
    print(f"races: {pairs} pairs, {pairs - wrong} with one refused and the other's files whole, {wrong} not")
    return wrong


def race_for_the_lock(folder: Path, processes: int = 8, times: int = 500) -> int:
    """Let processes enter and leave a folder as runs do; returns how often two were in it."""
    out, inside, children = folder / "lock", folder / "inside", []
    for _ in range(processes):
        child = os.fork()
        if child == 0:
            os._exit(_enter(out, inside, times))
        children.append(child)
    both = sum(os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]) for child in children)
    left = [file.name for file in out.iterdir()]
    print(f"locks: {processes} processes, {times} times each: {both} met another; left: {left or 'nothing'}")
    return both + len(left)


def _enter(out: Path, inside: Path, times: int) -> int:
    """1 where somebody else was in the folder, too."""
    entered = 0
    while entered < times:
        try:
            with only_run_in(out, ["people.npz"]):
                entered += 1
                try:
                    os.close(os.open(inside, os.O_CREAT | os.O_EXCL))
                except FileExistsError:
                    return 1
                inside.unlink()
        except InputError:
            continue
    return 0


def _in_a_namespace() -> int:
    """Run the same again, where it may mount a disk of its own."""
    words = ["unshare", "--user", "--map-root-user", "--mount", sys.executable, *sys.argv]
    if subprocess.run([*words[:4], "true"], check=False, capture_output=True).returncode != 0:
        print("error: --full needs mount namespaces (Linux, unshare of util-linux, user namespaces allowed)")
        return 2
    return subprocess.run(words, env=os.environ | {_INSIDE: "1"}, check=False).returncode


if __name__ == "__main__":
    sys.exit(main())
