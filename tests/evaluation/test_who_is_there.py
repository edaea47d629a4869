"""The table of who is there: a row for recordings that differ by seeds, and one for each number of cameras."""

import numpy as np

from shapepose_fg.evaluation.experiments import who_is_there
from shapepose_fg.evaluation.experiments.scale import Stretch

CLASSES = ("seen", "one_view", "no_view", "unseen")


def figures(f1: float, joints: int, inside: float, alone: float | None = None) -> dict:
    found = {"f1": f1, "idf1": f1, "f1_alone": alone, "people_missed": 1, "people": 10, "cpu_ms": 5.0}
    found |= {"rows_of_nobody": 2, "longest_of_nobody": int(100 - f1)}
    for name in CLASSES:
        found |= {f"joints_{name}": joints, f"{name}_inside_50": inside, f"{name}_inside_95": inside}
        found |= {f"{name}_log_score": 1.0}
    return found


def test_seeds_are_pooled_and_so_are_cameras():
    cameras = {"crowd, 3 cameras, 10 Hz": 3, "crowd, 3 cameras, 30 Hz": 3, "crowd, 4 cameras, 30 Hz": 4}
    slow, fast, more = cameras
    measured = {f"{slow}, 1": figures(90, 100, 80), f"{slow}, 2": figures(80, 300, 40)}
    measured |= {f"{fast}, 1": figures(97, 400, 50, alone=60), f"{more}, 1": figures(99, 0, 0, alone=70)}
    rows = {
        row.split("|")[1].strip(): [cell.strip() for cell in row.split("|")[2:-1]]
        for row in who_is_there._table(cameras, measured)
    }
    assert rows[slow][:9] == ["85.00", "80.00", "-", "85.00", "80.00", "2 of 20", "4", "20", "5"]
    assert rows[slow][9] == "50 / 50 / 1.00 (400)", "each joint counts once"
    assert rows["**all, 3 cameras**"][:3] == ["89.00", "80.00", "-"]
    assert rows["**all, 3 cameras**"][9] == "50 / 50 / 1.00 (800)"
    assert rows[more] == rows["**all, 4 cameras**"] and rows[more][2] == "70.0" and rows[more][9] == "-"


def test_a_case_is_drawn_by_its_seed_at_its_rate():
    slow = who_is_there._drawn(Stretch("demo", range(6), cameras=2, people=2, fps=10.0), 7)
    assert slow.scene.fps == 10.0 and len(slow.detections) == 6
    other = who_is_there._drawn(slow, 8)
    assert np.abs(slow.scene.keypoints - other.scene.keypoints).max() > 0.05


def test_after_a_cut_everybody_is_somebody_else(monkeypatch):
    monkeypatch.setattr(who_is_there, "cuts_of", lambda _: (2, 4))
    truth = who_is_there._by_segment(Stretch("demo", range(6), cameras=2, people=2))
    assert [np.unique(truth.person[truth.frame == frame]).tolist() for frame in range(6)] == [
        [0, 1],
        [0, 1],
        [2, 3],
        [2, 3],
        [4, 5],
        [4, 5],
    ]
