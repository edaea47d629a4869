"""The held-back sequences, and means of stretches."""

import pytest

from shapepose_fg.evaluation.experiments.held_back import held_back, stretches_of
from shapepose_fg.evaluation.experiments.over_time import with_mean
from shapepose_fg.evaluation.experiments.scale import Scale
from shapepose_fg.simulation.sequences import Sequence
from shapepose_fg.simulation.training.split import split_of


def test_nothing_was_learnt_from_anybody_in_them(shared_data):
    """By the clips that each sequence says it is made of: 60 and 61 dance, all others are test subjects."""
    mocap = shared_data / "cmu_mocap" / "cmu_smpl24.npz"
    for stretch in stretches_of(mocap):
        scene = stretch.scene
        assert isinstance(scene, Sequence) and scene.cuts == () and len(scene) == 300
        subjects = {clip.split("_")[0] for clips in scene.clips for clip in clips}
        assert len(subjects) > 2 and {split_of(subject) for subject in subjects} == {"test"}
    assert len(held_back(Scale(data=shared_data.parent)).cases) == 6  # pyright: ignore[reportOptionalMemberAccess]


def test_the_mean_of_shares_of_joints_is_over_joints():
    """Of six joints all are inside, of two a half: seven of eight. A stretch without such joints has no say."""
    scores = {
        "a": {"f1": 90.0, "joints_unseen": 6, "unseen_inside_50": 100.0},
        "b": {"f1": 80.0, "joints_unseen": 2, "unseen_inside_50": 50.0},
        "c": {"f1": 100.0, "joints_unseen": 0, "unseen_inside_50": None},
    }
    mean = with_mean(scores)["mean"]
    assert mean["f1"] == pytest.approx(90.0)
    assert mean["unseen_inside_50"] == pytest.approx(100 * 7 / 8)
