"""`scripts/soak.py`: what it makes of its looks at a run, and a short run."""

import importlib.util
import re
import sys
from pathlib import Path

import numpy as np
import pytest

from shapepose_fg.core.reconstruction import Reconstruction
from shapepose_fg.evaluation.speed import BackAndForth
from shapepose_fg.io.write_detections import write_association
from shapepose_fg.simulation import built_in_scene, simulate

_FILE = Path(__file__).parents[1] / "scripts" / "soak.py"
_SPEC = importlib.util.spec_from_file_location("soak", _FILE)
assert _SPEC is not None and _SPEC.loader is not None
soak = importlib.util.module_from_spec(_SPEC)
sys.modules["soak"] = soak
_SPEC.loader.exec_module(soak)


def samples(memory_mb, frame_s):
    """A look per window of 10 frames, after 3 looks at reading; memory and time by window."""
    cpu = np.concatenate([[1.0, 2.0, 3.0], 3 + np.cumsum(10 * np.asarray(frame_s))])
    memory = [100, 200, 300, *memory_mb]
    return [
        soak.Sample(max(0, n - 2), int(1e6 * each), int(2e6 * each), float(spent))
        for n, (each, spent) in enumerate(zip(memory, cpu, strict=True))
    ]


@pytest.mark.parametrize(
    ("memory", "frame_s", "code", "said"),
    [
        (np.full(12, 300.0), np.full(12, 0.05), 0, ["flat: 300 MB", "flat: 50 ms a frame"]),
        (np.linspace(300, 360, 12), np.full(12, 0.05), 1, ["GROWS: 3", "flat: 50 ms"]),
        (np.full(12, 300.0), np.linspace(0.05, 0.06, 12), 1, ["flat: 300 MB", "GROWS: 5"]),
        (np.linspace(360, 300, 12), np.full(12, 0.05), 0, ["flat: 3"]),
        (np.full(6, 300.0), np.full(6, 0.05), 1, ["too few rounds to judge"]),
    ],
)
def test_rounds_are_judged(capsys, memory, frame_s, code, said):
    """Rounds of two windows; the first is left out, whatever it is."""
    memory[:2], frame_s[:2] = 500, 0.5
    rounds = soak.rounds_of(samples(memory, frame_s), 10, 20, 10 * len(memory))
    assert [each.stop for each in rounds] == list(range(20, 10 * len(memory) + 1, 20))
    assert rounds[1].memory_mb == pytest.approx(memory[2:4].mean())
    assert rounds[1].frame_ms == pytest.approx(1e3 * frame_s[2:4].mean())
    assert soak.judged(rounds[1:], 0.05) == code
    out = capsys.readouterr().out
    assert all(each in out for each in said)


@pytest.mark.skipif(not Path("/proc/self/status").exists(), reason="looks at processes as Linux shows them")
def test_a_short_run(tmp_path, capsys):
    """144 frames of one person. Memory is judged, to 20 % because they are few; what a frame takes is only said:
    that depends on what else the machine does.
    """
    words = "--frames 144 --loop 12 --people 1 --cameras 2 --batch-frames 24 --tolerance 100 --folder"
    assert soak.main([*words.split(), str(tmp_path)]) == 0
    out = capsys.readouterr().out
    change = re.search(r"flat: [\d.]+ MB, changes by ([-+.\d]+) %", out)
    assert change is not None and abs(float(change[1])) < 20
    assert "144 frames of 1 people and 2 cameras" in out
    assert out.count("to frame") >= 4 and " ms a frame, changes by " in out
    assert all(
        re.search(rf"{stage}: up to \d+ MB, with pages of files \d+; \d+ s of", out)
        for stage in ("reading", "ending")
    )
    assert (tmp_path / "out" / "people.npz").is_file()


@pytest.mark.parametrize("frames", [3, 8, 21, 24])
def test_the_recording_is_the_loop_back_and_forth(tmp_path, frames):
    """Copied text is what writing every frame gives, whether the length is a multiple of the loop or not."""
    scene = built_in_scene(people=1, cameras=2, frames=4)
    loop = simulate(scene)
    soak.write_recording(loop, scene.rig, frames, tmp_path / "copied")
    write_association(BackAndForth(loop, frames), scene.rig, tmp_path / "written")
    for camera in scene.rig.names:
        copied, written = (
            tmp_path / folder / "detection" / f"{camera}.txt" for folder in ("copied/recording", "written")
        )
        assert copied.read_bytes() == written.read_bytes()


@pytest.mark.skipif(not Path("/proc/self/status").exists(), reason="looks at processes as Linux shows them")
def test_the_end_of_a_recording_of_which_the_beginning_was_solved(tmp_path, capsys):
    """96 frames are solved, four times there and back; the result is of 240, at their times, with one shape."""
    words = "--frames 240 --loop 12 --people 1 --cameras 2 --batch-frames 24 --tolerance 100 --solve 4 --folder"
    soak.main([*words.split(), str(tmp_path)])
    assert "ending: up to " in capsys.readouterr().out
    people = Reconstruction.load(tmp_path / "out")
    (number,) = np.unique(people.person)
    mine = people.rows(people.person == number)
    assert mine.frame.tolist() == [*range(240)] and mine.time_s == pytest.approx(mine.frame / 25)
    np.testing.assert_array_equal(mine.joints[96:192], mine.joints[:96])
    assert np.ptp(mine.betas, axis=0).max() == 0


def test_windows_that_do_not_repeat_are_not_copied():
    with pytest.raises(SystemExit):
        soak.main("--frames 240 --loop 12 --batch-frames 36 --solve 3".split())
