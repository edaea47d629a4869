"""Two people who hand each other a box: factors between their wrists, and what becomes of the
result.
"""

from dataclasses import replace

import gtsam
import numpy as np
import pytest

from factors import isotropic
from shapepose_fg import PipelineConfig, Reconstruction, explain, reconstruct
from shapepose_fg.cli.main import main
from shapepose_fg.core.skeleton import BODY_25
from shapepose_fg.pipeline.config import WindowConfig
from shapepose_fg.results.solve_again import Solver, solve_rows, window_solutions
from shapepose_fg.results.uncertainty import JointAt, distance
from shapepose_fg.simulation import built_in_scene, simulate

R, L = BODY_25.index("RWrist"), BODY_25.index("LWrist")
FRAMES, SIGMA_M = 10, 0.005
SEEDS = range(2)


def scene_of(seed: int):
    return built_in_scene(seed=seed, people=2, cameras=4, frames=FRAMES)


class Box:
    """r = (left wrist of one person - right wrist of the other) - d, with d as it is in truth: a
    box between them.

    Whose wrist is whose is chosen by place, as rows have no identities frame by frame.
    """

    def __init__(self, scene) -> None:
        self.truth = scene.keypoints

    def __call__(self, window, keys):
        for other in window.partners:
            for t, u in zip(*window.shared(other), strict=True):
                truth = self.truth[window.frames[t]]
                away = [
                    np.linalg.norm(each - truth[0, R])
                    for each in (window.first[t, R], other.first[u, R])
                ]
                ends = (
                    (other.keys[u, R], keys[t, L])
                    if away[0] > away[1]
                    else (keys[t, R], other.keys[u, L])
                )
                apart = truth[1, L] - truth[0, R]
                yield gtsam.BetweenFactorPoint3(
                    int(ends[0]), int(ends[1]), apart, isotropic(3, SIGMA_M)
                )


@pytest.fixture(scope="module")
def scene():
    return scene_of(0)


@pytest.fixture(scope="module")
def joined(scene) -> Reconstruction:
    return reconstruct(simulate(scene, seed=0), scene.rig, extra_factors=Box(scene))


def ends_of(people: Reconstruction, truth: np.ndarray, frame: int) -> tuple[int, int]:
    """Rows of the two people whom the box joins in a frame."""
    rows = np.flatnonzero(people.frame == frame)
    away = np.linalg.norm(people.joints[rows][:, None] - truth[frame][None], axis=-1).mean(axis=-1)
    return int(rows[away[:, 0].argmin()]), int(rows[away[:, 1].argmin()])


def errors(people: Reconstruction, truth: np.ndarray) -> tuple[float, float]:
    """Mean error of both wrists, and of what lies between them, metres."""
    ends = [
        (people.joints[a, R], people.joints[b, L])
        for a, b in (ends_of(people, truth, f) for f in range(FRAMES))
    ]
    off = [(one - truth[f, 0, R], other - truth[f, 1, L]) for f, (one, other) in enumerate(ends)]
    each = np.linalg.norm(np.array(off), axis=-1).mean()
    return float(each), float(np.linalg.norm([other - one for one, other in off], axis=-1).mean())


@pytest.mark.slow
@pytest.mark.parametrize("temporal", [True, False])
def test_a_box_between_two_people_is_held_and_both_wrists_are_nearer_to_the_truth(temporal):
    config, found = replace(PipelineConfig(), temporal=temporal), []
    for seed in SEEDS:
        scene = scene_of(seed)
        recording = simulate(scene, seed=seed)
        people = [
            reconstruct(recording, scene.rig, config, extra_factors=factors)
            for factors in (None, Box(scene))
        ]
        assert (
            people[1].run["extra_factors"] == {"Box": {"made": FRAMES, "inactive": 0}}
            or not temporal
        )
        assert set(people[1].status.tolist()) <= {"ok", *people[0].status.tolist()}
        found.append([errors(each, scene.keypoints) for each in people])
    (alone, between), (tied, box) = np.mean(found, axis=0)
    assert box < 2 * SIGMA_M < between / 2
    # Half of the variance goes where both are known equally well: a factor of 0.7.
    assert tied < 0.9 * alone


@pytest.mark.slow
def test_its_share_is_explained_and_the_sum_is_one(joined, scene):
    one, other = ends_of(joined, scene.keypoints, 5)
    who, whom = int(joined.person[one]), int(joined.person[other])
    asked = {"person": who, "joint": "RWrist", "frame": 5}
    told = explain(joined, scene.rig, **asked, extra_factors=Box(scene))
    assert [(each.name, each.others) for each in told.factors] == [
        ("Box", (f"person {whom}'s LWrist",))
    ]
    shares = [view.share for view in told.views] + [
        told.body_share,
        told.motion_share,
        told.factors[0].share,
    ]
    assert sum(shares) == pytest.approx(1, abs=1e-9) and min(shares) >= 0
    # The other's wrist is known as well as this one from three cameras, and the box better than
    # both.
    assert 0.2 < told.factors[0].share < 0.9
    assert any(
        f"Box (with person {whom}'s LWrist) {told.factors[0].share:.0%}" in each
        for each in told.words
    )
    silent = explain(joined, scene.rig, **asked)
    assert silent.factors == () and silent.missing_factors == ("Box",)
    assert any("do not include factors of Box" in each for each in silent.words)
    untied = explain(
        joined, scene.rig, person=who, joint="RKnee", frame=5, extra_factors=Box(scene)
    )
    assert untied.factors == () and untied.missing_factors == ()


@pytest.mark.slow
def test_it_goes_through_export_and_explain_of_the_shell(joined, scene, tmp_path, capsys):
    joined.save(tmp_path)
    who = int(joined.person[ends_of(joined, scene.keypoints, 5)[0]])
    for line in (
        ["export", tmp_path, "trc", "csv"],
        ["explain", tmp_path, who, "RWrist", "--frame", 5],
    ):
        with pytest.raises(SystemExit) as end:
            main(list(map(str, line)))
        assert end.value.code == 0
    assert "do not include factors of Box" in " ".join(capsys.readouterr().out.split())


@pytest.mark.slow
def test_the_errors_of_two_people_correlate_as_the_graph_says(joined, scene):
    graphs = list(window_solutions(joined, scene.rig, extra_factors=Box(scene)))
    assert [len(each.together) for each in graphs] == [2, 2]
    one, other = ends_of(joined, scene.keypoints, 5)
    ends = (
        JointAt(int(joined.person[one]), "RWrist", 5),
        JointAt(int(joined.person[other]), "LWrist", 5),
    )
    apart, tied = distance(joined, *ends), distance(joined, *ends, graphs=graphs)
    assert tied.sigma_m < 0.95 * apart.sigma_m
    knees = [replace(each, joint="RKnee") for each in ends]
    np.testing.assert_allclose(
        distance(joined, *knees, graphs=graphs).covariance,
        distance(joined, *knees).covariance,
        rtol=0.1,
        atol=1e-5,
    )
    # One graph has both; its marginals are those that are reported.
    marginals = gtsam.Marginals(graphs[0].graph, graphs[0].values)
    for each in graphs:
        wide = np.trace(marginals.marginalCovariance(int(each.keys[5, R])))
        assert wide == pytest.approx(np.trace(each.covariance[5, R]), rel=0.01)


@pytest.mark.slow
def test_people_are_named_where_a_result_is_solved_anew(joined, scene):
    """`window.track` is the result's person then; another's factors are on the same graph."""
    one, other = (int(joined.person[row]) for row in ends_of(joined, scene.keypoints, 5))
    seen = set[int]()

    def knees_touch(window, keys):
        seen.add(window.track)
        for partner in window.partners:
            assert {window.track, partner.track} == {one, other}
            mine, theirs = window.shared(partner)
            knee = BODY_25.index("RKnee")
            for a, b in zip(
                keys[mine, knee].tolist(), partner.keys[theirs, knee].tolist(), strict=True
            ):
                yield gtsam.RangeFactor3(a, b, 1.0, isotropic(1, 0.005))

    solved = solve_rows(joined, Solver.of(joined, scene.rig), [Box(scene), knees_touch])
    assert seen == {one, other} and len(solved) == len(joined)
    a, b = ((solved.person == who) & (solved.frame == 5) for who in (one, other))
    apart = np.linalg.norm(solved.joints[a] - solved.joints[b], axis=-1)[0, BODY_25.index("RKnee")]
    assert apart == pytest.approx(1.0, abs=0.03)


@pytest.mark.slow
def test_keyframes_have_the_factor(scene):
    fast = replace(PipelineConfig(), windows=replace(WindowConfig(), keyframe_s=0.1))
    people = reconstruct(simulate(scene, seed=0), scene.rig, fast, extra_factors=Box(scene))
    assert 0 < people.run["extra_factors"]["Box"]["made"] < FRAMES
    assert errors(people, scene.keypoints)[1] < 0.03


@pytest.mark.slow
def test_functions_whose_factors_do_nothing_are_said(scene):
    def of_nobody(window, keys):
        return [
            gtsam.RangeFactor3(1, 2, 1.0, isotropic(1, 1))
            for other in window.partners
            if other.track > 50
        ]

    with pytest.warns(UserWarning, match="of_nobody: none of its factors was made"):
        people = reconstruct(
            simulate(scene, seed=0), scene.rig, extra_factors=[of_nobody, Box(scene)]
        )
    assert people.run["extra_factors"] == {
        "of_nobody": {"made": 0, "inactive": 0},
        "Box": {"made": FRAMES, "inactive": 0},
    }
