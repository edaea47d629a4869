"""What clues make of covariances: worked out by hand, and on joints that were led astray."""

from dataclasses import replace

import numpy as np

from shapepose_fg.body.fitting.fitter import JointTargets
from shapepose_fg.core.skeleton import BODY_25
from shapepose_fg.estimation.covariance_calibration import Calibration, CovarianceFeatures
from shapepose_fg.estimation.linearisation import squared_distance

I3 = np.eye(3)


def clues(**changed):
    """One joint, known to 2 cm, that nothing speaks against."""
    nothing = np.zeros((1, 1, 3, 3))
    plain = CovarianceFeatures(
        np.zeros(1, dtype=int), np.zeros((1, 1, 3)), np.full((1, 1), 2),
        np.full((1, 1, 3, 3), 4e-4 * I3), np.zeros((1, 1)), nothing, nothing, nothing,
    )  # fmt: skip
    return replace(plain, **changed)


def test_each_clue_widens_what_it_speaks_of():
    calibration = Calibration(
        np.array([0.8]), power=0.5, unseen=2.0, association=7.0, draft=2.0, exchange=0.5, person=0.4
    )
    plain = calibration.covariance(clues())
    np.testing.assert_allclose(plain[0, 0], 0.8 * 4e-4 * I3)
    np.testing.assert_allclose(
        calibration.covariance(clues(disagreement=np.full((1, 1), 3.0))), 2 * plain
    )
    unseen = {"views": np.zeros((1, 1), dtype=int)}
    np.testing.assert_allclose(
        calibration.covariance(clues(**unseen)), plain, err_msg="it is known to 2 cm"
    )
    for times, most in (
        (2.0, 2.0),
        (10.0, 4.0),
    ):  # the person is known to so many times 2 cm; 4 is the most
        wider = {"covariance": times**2 * clues().covariance}
        whole = np.exp(0.4 * np.log(most) ** 2) * times**2 * plain
        np.testing.assert_allclose(calibration.covariance(clues(**wider)), whole)
        carried = min(times, 3.0) ** 2
        np.testing.assert_allclose(
            calibration.covariance(clues(**unseen, **wider)), carried * whole
        )
    along_x = np.diag([0.01, 0, 0])[None, None]
    for name, weight in (("association", 7.0), ("draft", 2.0), ("exchange", 0.5)):
        np.testing.assert_allclose(
            calibration.covariance(clues(**{name: along_x})), plain + weight * along_x
        )


def test_the_numbers_that_ship():
    """Both sides alike, joints that are not named as the mean; whoever is sure and agreed with is
    narrowed.
    """
    found = Calibration.load((*BODY_25.joints, "Tail"))
    by_name = dict(zip((*BODY_25.joints, "Tail"), found.scale.tolist(), strict=True))
    assert all(
        by_name["L" + name[1:]] == scale for name, scale in by_name.items() if name.startswith("R")
    )
    assert min(found.scale) < by_name["Tail"] < max(found.scale) < 1.5
    assert by_name["Nose"] < by_name["RHip"], (
        "a detector's hip is off for as long as somebody stands"
    )
    assert 0 < found.power < 2 and 0 < found.unseen < 2 and 0 < found.person < 2
    assert found.association > 1, "doubts of neighbouring joints and frames are one"
    assert 0 < found.exchange < 1, "a probability"
    assert found.draft > 0


def test_disagreement_is_the_distance_in_both_sigmas():
    """10 cm between a joint of 3 cm and a body of 4 cm is two sigmas. A body that says nothing
    contradicts nobody, and nobody contradicts a joint that is not known.
    """
    joints = np.zeros((1, 3, 3))
    joints[0, 2] = np.nan
    covariance = np.broadcast_to(9e-4 * I3, (1, 3, 3, 3))
    prior = np.full((1, 3, 3), np.nan)
    prior[0, [0, 2]] = [0.1, 0, 0]
    information = np.zeros((1, 3, 3, 3))
    information[0, [0, 2]] = I3 / 16e-4
    np.testing.assert_allclose(
        np.nan_to_num(squared_distance(JointTargets(prior, information), joints, covariance)),
        [[4.0, 0, 0]],
        atol=1e-12,
    )
