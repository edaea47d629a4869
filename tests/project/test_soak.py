"""`scripts/soak.py`: what it makes of its looks at a run, and a short run."""

import importlib.util
import re
import sys
from pathlib import Path

import numpy as np
import pytest

_FILE = Path(__file__).parents[2] / "scripts" / "soak.py"
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


@pytest.mark.slow
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
