"""The graph of a solved window says what is reported: values, marginals, and what one makes of
it.
"""

from dataclasses import replace

import gtsam
import numpy as np
import pytest

from factors import isotropic, load_graph, save_graph
from shapepose_fg.core.errors import InputError
from shapepose_fg.core.skeleton import BODY_25
from shapepose_fg.estimation.window_solution import PersonGraph
from shapepose_fg.pipeline.pipeline import PipelineConfig, reconstruct
from shapepose_fg.results.solve_again import window_solutions
from shapepose_fg.simulation import built_in_scene, simulate

WRIST, OTHER_WRIST = BODY_25.index("RWrist"), BODY_25.index("LWrist")


@pytest.fixture(scope="module")
def scene():
    return built_in_scene(people=2, cameras=3, frames=12)


@pytest.fixture(scope="module")
def people(scene):
    return reconstruct(simulate(scene), scene.rig)


def solutions(people, scene, extra_factors=None) -> list[PersonGraph]:
    return list(window_solutions(people, scene.rig, extra_factors=extra_factors))


def ratios(solution: PersonGraph) -> np.ndarray:
    """(K,) sigmas of the graph's marginals over the reported ones, of all known joints."""
    found = gtsam.Marginals(solution.graph, solution.values)
    known = np.isfinite(solution.covariance).all(axis=(2, 3))
    graph = np.array(
        [np.trace(found.marginalCovariance(key)) for key in solution.keys[known].tolist()]
    )
    return np.sqrt(graph / np.trace(solution.covariance[known], axis1=1, axis2=2))


def alike(found: list[PersonGraph]) -> float:
    """Share of all known joints whose sigma in the graph is the reported one to 5 %."""
    return float((np.abs(np.concatenate([ratios(each) for each in found]) - 1) < 0.05).mean())


@pytest.mark.slow
def test_marginals_are_the_reported_covariances_and_values_the_reported_joints(people, scene):
    found = solutions(people, scene)
    assert len(found) == len(np.unique(people.person))
    assert alike(found) > 0.9
    for solution in found:
        known = np.isfinite(solution.joints).all(axis=2)
        assert known.mean() > 0.95 and len(solution.frames) == 12
        mine = next(
            people.rows(people.person == person)
            for person in np.unique(people.person)
            if np.nanmax(np.abs(people.joints[people.person == person] - solution.joints)) < 1e-9
        )
        at = np.array([solution.values.atPoint3(key) for key in solution.keys[known].tolist()])
        # Solving ends when joints move by less than 2 mm.
        off_m = np.abs(at - mine.joints[known]).max(axis=1)
        assert np.quantile(off_m, 0.9) < 5e-3 and off_m.max() < 0.02
        assert solution.person == mine.person[0] and np.array_equal(solution.frames, mine.frame)
        assert (np.abs(ratios(solution) - 1) < 0.01).mean() > 0.95


@pytest.mark.slow
def test_frame_by_frame_every_frame_has_a_graph_of_its_own(scene):
    """A number is no identity there: rows of the same number in two frames are not tied by
    motion.
    """
    alone = reconstruct(
        simulate(scene), scene.rig, replace(PipelineConfig(), temporal=False), frames=range(3)
    )
    found = solutions(alone, scene)
    assert sorted(int(each.frames[0]) for each in found) == sorted(alone.frame.tolist())
    assert alike(found) > 0.9
    for solution in found:
        assert len(solution.frames) == 1
        row = (alone.frame == solution.frames[0]) & (alone.person == solution.person)
        np.testing.assert_array_equal(solution.joints, alone.joints[row])
        known = np.isfinite(solution.covariance).all(axis=(2, 3))
        at = np.array([solution.values.atPoint3(key) for key in solution.keys[known].tolist()])
        np.testing.assert_allclose(at, solution.joints[known], atol=3e-3)


def test_what_a_graph_cannot_be_made_of_is_refused(people, scene):
    with pytest.raises(ValueError, match="reconstruct the recording again"):
        next(window_solutions(replace(people, observations=None), scene.rig))
    with pytest.raises(InputError, match="configuration is missing"):
        next(window_solutions(replace(people, run={}), scene.rig))


def test_errors_of_frames_correlate_less_the_farther_they_are_apart(people, scene):
    """Motion and a common shape connect frames: errors of neighbouring frames correlate in the
    graph.
    """
    near, far = [], []
    for solution in solutions(people, scene):
        found = gtsam.Marginals(solution.graph, solution.values)
        for keys in solution.keys[[4, 5, 11]].T.tolist():
            joint = found.jointMarginalCovariance(gtsam.KeyVector(keys))
            sizes = [np.trace(joint.at(key, key)) for key in keys]
            for other, correlations in ((1, near), (2, far)):
                both = np.trace(joint.at(keys[0], keys[other]))
                correlations.append(both / np.sqrt(sizes[0] * sizes[other]))
    assert (np.array(near) > far).mean() > 0.9
    assert 0.15 < np.mean(near) < 0.8 and -0.1 < np.mean(far) < 0.7 * np.mean(near)


def test_a_users_isam2_takes_a_person_and_learns_of_a_wrist(people, scene):
    """Somebody else sees a wrist 5 cm beside, to 1 cm: it goes there, and so does the frame after
    it.
    """
    solution = solutions(people, scene)[0]
    isam = gtsam.ISAM2()
    isam.update(solution.graph, solution.values)
    before, after = (int(solution.keys[frame, WRIST]) for frame in (6, 7))
    np.testing.assert_allclose(
        isam.marginalCovariance(before), solution.covariance[6, WRIST], rtol=0.05, atol=1e-6
    )
    seen = solution.joints[6, WRIST] + [0.05, 0.0, 0.0]
    more = gtsam.NonlinearFactorGraph()
    more.push_back(gtsam.PriorFactorPoint3(before, seen, isotropic(3, 0.01)))
    isam.update(more, gtsam.Values())
    now = isam.calculateEstimate()
    moved = [
        now.atPoint3(key)[0] - solution.joints[frame, WRIST, 0]
        for key, frame in ((before, 6), (after, 7))
    ]
    said = solution.covariance[6, WRIST, 0, 0]
    assert (
        moved[0] == pytest.approx(0.05 * said / (said + 1e-4), rel=0.2)
        and 0.1 * moved[0] < moved[1] < moved[0]
    )
    assert np.trace(isam.marginalCovariance(before)) < 3.1e-4


@pytest.mark.slow
def test_factors_of_ones_own_are_in_it(people, scene):
    def carries_a_box(window, keys):
        for right, left in keys[:, [WRIST, OTHER_WRIST]].tolist():
            yield gtsam.RangeFactor3(right, left, 0.40, isotropic(1, 0.01))

    found = solutions(people, scene, carries_a_box)
    assert alike(found) > 0.9
    for solution in found:
        width = np.linalg.norm(solution.joints[:, WRIST] - solution.joints[:, OTHER_WRIST], axis=1)
        assert np.abs(width - 0.4).max() < 0.03
        at = np.array([solution.values.atPoint3(key) for key in solution.keys[:, WRIST].tolist()])
        np.testing.assert_allclose(at, solution.joints[:, WRIST], atol=1e-9)


def bodies(solution: PersonGraph) -> set[int]:
    """Keys of the vectors of a graph."""
    return {*solution.window.body_keys.tolist(), solution.window.shape_key}


@pytest.mark.slow
def test_a_solved_graph_is_written_and_read_back(people, scene, tmp_path):
    solution = solutions(people, scene)[0]
    save_graph(tmp_path / "person.json", solution.graph, solution.values)
    graph, values = load_graph(tmp_path / "person.json")
    assert graph.size() == solution.graph.size() and values.equals(solution.values, 0.0)
    rng = np.random.default_rng(0)
    for _ in range(3):
        step = gtsam.VectorValues()
        for key in values.keys():  # noqa: SIM118
            size = solution.values.atVector(key).size if key in bodies(solution) else 3
            step.insert(key, rng.normal(0, 0.05, size))
        at = values.retract(step)
        assert graph.error(at) == pytest.approx(solution.graph.error(at), rel=1e-9)
        gradients = [each.linearize(at).gradientAtZero() for each in (graph, solution.graph)]
        apart = max(np.abs(gradients[0].at(key) - gradients[1].at(key)).max() for key in at.keys())  # noqa: SIM118
        # Gradients sum what projections of 1e3 px/m and sigmas of a pixel say.
        assert apart < 1e-9 * max(np.abs(gradients[1].at(key)).max() for key in at.keys())  # noqa: SIM118
