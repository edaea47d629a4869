"""An archive on a machine's processes: interrupted, gone on with, and to the byte what each alone
gives.
"""

import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

from shapepose_fg.cli.batch.table import read_table
from shapepose_fg.cli.main import main
from shapepose_fg.cli.reconstruct.request import prepare
from shapepose_fg.cli.reconstruct.run import carry_out
from shapepose_fg.cli.stopping import Stopped
from shapepose_fg.core.errors import InputError
from shapepose_fg.core.frame_times import FrameTimes
from shapepose_fg.estimation.detector_offsets import OffsetConfig
from shapepose_fg.io.calibration import read_rig
from shapepose_fg.io.config import toml_text
from shapepose_fg.io.detections import read_detections
from shapepose_fg.pipeline.execution import Execution
from shapepose_fg.pipeline.pipeline import PipelineConfig, reconstruct
from shapepose_fg.pipeline.runs.manifest import frames_done
from shapepose_fg.pipeline.windows import WindowConfig
from shapepose_fg.simulation import built_in_scene, simulate
from shapepose_fg.simulation.files import write_simulated
from shapepose_fg.tracking.identities import FollowingConfig

CONFIG = PipelineConfig(
    batch_frames=6,
    following=FollowingConfig(look_ahead_s=0.15),
    windows=WindowConfig(overlap_s=0.1),
    offsets=OffsetConfig(source="none"),
)
TABLE = """
[defaults]
config = "settings.toml"
calibration = "long/rig.json"
report = false
check = false

[recordings.long]
detections = "long/openpose"
fps = 25
cuts = [18]
chunk_frames = 12

[recordings.short]
calibration = "short/rig.json"
detections = "short/openpose"

[recordings.broken]
detections = "broken"
"""


@pytest.fixture(scope="module")
def archive(tmp_path_factory) -> Path:
    """Two recordings, one with a cut and in chunks, and one with files that break off."""
    folder = tmp_path_factory.mktemp("archive")
    for seed, (name, frames) in enumerate((("long", 30), ("short", 8)), start=1):
        scene = built_in_scene(seed=seed, people=2, cameras=3, frames=frames)
        write_simulated(scene, simulate(scene, seed=seed), folder / name, "openpose")
    for camera in (folder / "long" / "openpose").iterdir():
        (folder / "broken" / camera.name).mkdir(parents=True)
        first = min(camera.iterdir())
        (folder / "broken" / camera.name / first.name).write_text(first.read_text()[:-20])
    (folder / "settings.toml").write_text(toml_text(CONFIG))
    (folder / "recordings.toml").write_text(TABLE)
    return folder


def finished(*words: str | Path) -> int:
    with pytest.raises(SystemExit) as ended:
        main(["batch", *map(str, words)])
    return ended.value.code


def stopped_behind_a_chunk(archive: Path, folder: Path) -> None:
    """Leave the parts of a run of the recording `long`, without which it could not go on."""
    asked = {entry.name: entry.request for entry in read_table(archive / "recordings.toml")}["long"]

    def stop(done: int, _: int) -> None:
        if done >= 12:
            raise Stopped(signal.SIGTERM)

    with pytest.raises(Stopped):
        carry_out(prepare(asked, folder), Execution(progress=stop), restart=True)
    assert frames_done(folder) == 12


@pytest.mark.slow
@pytest.mark.skipif(os.name != "posix", reason="stops processes by POSIX signals")
def test_an_archive_is_interrupted_goes_on_and_is_what_each_recording_alone_gives(
    archive, tmp_path, capsys
):
    pytest.importorskip("distributed", reason="Dask is an extra")
    words = [archive / "recordings.toml", "--output", tmp_path, "--workers", "1", "--at-once", "1"]
    command = [sys.executable, "-m", "shapepose_fg", "batch", *map(str, words)]
    first = subprocess.Popen(
        command,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        start_new_session=True,
        preexec_fn=lambda: signal.signal(signal.SIGINT, signal.SIG_DFL),
    )
    log, deadline = tmp_path / "long" / "log.txt", time.monotonic() + 300
    while not log.exists():
        assert first.poll() is None and time.monotonic() < deadline, first.communicate()
        time.sleep(0.01)
    os.killpg(first.pid, signal.SIGINT)  # as a terminal does, to all of its processes
    _, said = first.communicate(timeout=120)
    assert first.returncode == 130, said
    assert (
        f"recordings are done in {tmp_path}; continue with --resume" in said
        and "Traceback" not in said
    )
    stopped_behind_a_chunk(archive, tmp_path / "long")
    assert finished(*words) == 2
    assert (
        "this folder has a batch already; continue with --resume, or start again with --restart"
        in capsys.readouterr().err
    )
    assert finished(*words, "--resume") == 1, "one of them failed"
    said = capsys.readouterr()
    batch_status = json.loads((tmp_path / "batch.json").read_text())
    assert (batch_status["done"], batch_status["failed"]) == (2, 1)
    assert (
        batch_status["recordings"]["long"]["frames"] == 30
        and batch_status["recordings"]["long"]["people"] >= 2
    )
    broken = batch_status["recordings"]["broken"]
    assert broken["attempts"] == 2 and broken["reasons"][0] == broken["reasons"][1]
    assert "the file ends too early" in broken["reasons"][0]
    assert (
        f"broken: {broken['reasons'][0]}"[:60] in " ".join(said.err.split())
        and "2 done, 1 failed" in said.out
    )
    assert "parts" not in {file.name for file in (tmp_path / "long").iterdir()}
    for name, more in (("long", {"cuts": (18,)}), ("short", {})):
        rig = read_rig(archive / name / "rig.json")
        seen = read_detections(archive / name / "openpose", rig)
        times = FrameTimes.from_fps(25.0, len(seen)) if name == "long" else None
        execution = Execution(chunk_frames=12 if name == "long" else None)
        reconstruct(seen, rig, CONFIG, times=times, execution=execution, **more).save(
            tmp_path / "alone" / name
        )
        for file in ("people.npz", "observations.npz"):
            assert (tmp_path / name / file).read_bytes() == (
                tmp_path / "alone" / name / file
            ).read_bytes(), file


def test_what_can_be_known_before_is_said_before(archive, tmp_path, capsys, monkeypatch):
    monkeypatch.setattr(
        "shapepose_fg.pipeline.cluster.local_cluster",
        lambda *_, **__: pytest.fail("no work may begin"),
    )
    table = archive / "wrong.toml"

    def said(text: str, *more: str) -> str:
        table.write_text(TABLE + text)
        assert finished(table, "--output", tmp_path / "out", *more) == 2
        err = capsys.readouterr().err
        assert err.count("\n") == 1
        return err

    assert "wrong.toml: recording a: " in (err := said('[recordings.a]\ndetections = "none"'))
    assert f"{archive / 'none'}: there is no such folder" in err
    two = said(
        '[recordings.a]\ndetections = "none"\n[recordings.b]\ntimestamps = "none"\ndetections = '
        '"short"'
    )
    assert "(other recordings with problems: b)" in two
    own = '[recordings.a]\ndetections = "long/openpose"\n'
    assert "--fps and --timestamps: both determine the times of frames" in said(
        own + 'fps = 25\ntimestamps = "settings.toml"'
    )
    assert "--chunk-frames 3: must be 6 (batch_frames) or more" in said(own + "chunk_frames = 3")
    assert "--shapes: shapes need people over time" in said(
        own + 'shapes = "s.npz"\ntemporal = false'
    )
    assert "--frames 3: must be A:B" in said(own + 'frames = "3"')
    assert "body.pkl: there is no such file" in said(own + 'body = "body.pkl"')
    assert "fps must be at least 0.001, got 0" in said(own + "fps = 0")
    (tmp_path / "out" / "a" / "people.npz").mkdir(parents=True)
    assert "people.npz: this is a folder, but a file must be written here" in said(own)
    (tmp_path / "out" / "a" / "people.npz").rmdir()
    (tmp_path / "out" / "a" / "parts").mkdir()
    assert "there is an interrupted run; continue with --resume" in said(own)
    assert "give one" in said(own, "--cluster", "tcp://x:1", "--workers", "2")
    monkeypatch.setattr("shutil.disk_usage", lambda _: type("Usage", (), {"free": 10}))
    (tmp_path / "out" / "a" / "parts").rmdir()
    assert "of disk space, and 10 bytes are free; free some space" in said(own)


def test_another_program_on_a_worker_is_noticed(monkeypatch):
    from shapepose_fg.pipeline import cluster

    class Client:
        def __init__(self, theirs):
            self.theirs = theirs

        def run(self, _, on_error):
            return {"tcp://a:1": own, "tcp://b:2": self.theirs}

    own = cluster.this_program()
    for theirs, words in (
        (
            {**own, "numpy": "1.0"},
            r"its process tcp://b:2 has another version of numpy \(1\.0 there, .* here\)",
        ),
        (
            {**own, "shapepose-fg itself": "x"},
            "has another version of shapepose-fg itself; install the same version there",
        ),
        (
            ModuleNotFoundError("No module named 'shapepose_fg'"),
            r"cannot run this program \(No module named",
        ),
    ):
        with pytest.raises(InputError, match=words):
            cluster.refuse_other_programs(Client(theirs), "tcp://s:1")
    cluster.refuse_other_programs(Client(own), "tcp://s:1")
