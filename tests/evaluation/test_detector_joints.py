"""What learning the detector's joints is worth: the figures tell offsets from none, on real footage, too."""

import numpy as np

from shapepose_fg.evaluation.experiments.detector_joints import DETECTORS, detector_joints, detector_joints_shelf
from shapepose_fg.evaluation.experiments.scale import Scale


def test_figures_are_against_the_joints_that_the_detector_means():
    """Six frames: a detector 18 to 46 mm off is met to half of that, or the truth would be the wrong one."""
    experiment = detector_joints(Scale(quick=True))
    assert len(experiment.cases) == len(DETECTORS)
    for case in experiment.cases:
        found = case.measure()
        assert len(found) == 4
        for figures in found.values():
            assert figures["f1"] > 95 and figures["mpjpe_mm"] < 25


def test_groups_and_detectors_have_rows_of_their_own():
    experiment = detector_joints(Scale(quick=True))
    names = [case.name for case in experiment.cases]

    def figures(value: float) -> dict:
        keys = [f"{mode}, {label}" for mode in ("over time", "frame by frame") for label in ("without", "learnt")]
        return {
            key: {"f1": 90 + value + place, "mpjpe_mm": 10 * value, "doubtful_mm": [value, 3 * value, 8 * value]}
            for place, key in enumerate(keys)
        }

    rows = experiment.table({name: figures(1.0 + place) for place, name in enumerate(names)})[2:]
    assert len(rows) == 4
    assert rows[0].endswith("| 91.00 | 10.0 | 4.0 (3.0) | 92.00 | 10.0 | 4.0 (3.0) |")
    assert rows[3].endswith("| 94.00 | 20.0 | 8.0 (6.0) | 95.00 | 20.0 | 8.0 (6.0) |")
    assert "the body's joints" in rows[0] and "joints of its own" in rows[3]


def test_one_half_of_shelf_teaches_what_helps_in_the_other(shared_data):
    experiment = detector_joints_shelf(Scale(data=shared_data.parent))
    assert experiment is not None
    halves = experiment.cases[0].measure()
    for half in ("first half", "second half"):
        without, learnt = (np.array(halves[f"{half}, {label}"]) for label in ("without", "learnt"))
        assert (learnt < without - 1.0).all()  # mean and median, by more than a millimetre
