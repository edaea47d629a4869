"""Which frames are shown, by rules; and that pages are drawn."""

import cv2
import numpy as np
import pytest

from shapepose_fg.core.skeleton import BODY_25
from shapepose_fg.evaluation.experiments.others import PlainPeople
from shapepose_fg.evaluation.experiments.scale import Stretch
from shapepose_fg.evaluation.pictures.choice import (
    Beside,
    Rows,
    closest_contact,
    farthest,
    mean_error,
    missing,
    most,
    odd_limbs,
    oddest,
)
from shapepose_fg.evaluation.pictures.close_up import clear_views
from shapepose_fg.evaluation.pictures.pages import draw_before_after, draw_failures, draw_methods

STRETCH = Stretch("demo", range(30))
WRIST = BODY_25.index("RWrist")


@pytest.fixture(scope="module")
def rows():
    """Everybody in every frame; three of them spoiled, each in a way of its own."""
    frame, person = (each.ravel() for each in np.meshgrid(np.arange(30), np.arange(4), indexing="ij"))
    final = STRETCH.scene.keypoints[frame, person]
    initial = final.copy()
    initial[17, 2:6] = np.nan
    initial[40, WRIST] += (0.0, 0.0, 0.9)
    elbow = BODY_25.index("LElbow")
    initial[71, BODY_25.index("LWrist")] = 3 * final[71, BODY_25.index("LWrist")] - 2 * final[71, elbow]
    return Rows(STRETCH, frame, person, {"initial": initial, "final": final})


def test_each_rule_finds_what_it_is_about(rows):
    assert missing(rows)[17] == 4 and most(rows, missing) == [17]
    assert farthest(rows)[40] == pytest.approx(0.9) and most(rows, farthest) == [40]
    assert mean_error(rows)[40] == pytest.approx(0.9 / 25)
    # A forearm of three times its length; that of row 40 is the next, by how far the wrist was moved.
    assert odd_limbs(rows.first, rows.truth)[71, 3] == pytest.approx(2.0)
    assert most(rows, oddest) == [71] and most(rows, oddest, without=[71]) == [40]


def test_examples_are_of_other_people_or_moments(rows):
    def value(rows: Rows) -> np.ndarray:
        return np.where(rows.person == 2, 100.0 - rows.frame, -rows.frame - rows.person)

    chosen = most(rows, value, 3)
    # Person 2 in frame 0; again a second (25 frames) later; then nobody else of person 2.
    assert [(rows.frame[row], rows.person[row]) for row in chosen] == [(0, 2), (25, 2), (0, 0)]


def test_the_clearest_view_is_one_that_sees_the_person_and_the_next_is_across():
    scene = STRETCH.scene
    bodies = scene.vertices_at(0)
    first, second = clear_views(scene.rig, bodies, scene.body.faces, [1])
    axes = scene.rig.cTw[:, 2, :3]
    assert abs(axes[first] @ axes[second]) < 0.5
    alone, _ = clear_views(scene.rig, bodies[1:2], scene.body.faces, [0])
    sizes = [np.linalg.norm(scene.rig.centres[view] - bodies[1].mean(axis=0)) for view in (alone, second)]
    assert sizes[0] < 6.0  # in the room: nobody stands before somebody who is alone


def test_the_closest_contact_is_chosen_by_the_truth_alone():
    frame, (first, second) = closest_contact(STRETCH)
    joints = STRETCH.scene.keypoints
    apart = np.median(np.linalg.norm(joints[:, :, None] - joints[:, None], axis=-1), axis=-1)
    apart[:, np.arange(4), np.arange(4)] = np.inf
    assert first < second and apart[frame, first, second] == apart.min()


def test_methods_beside_each_other_count_what_is_wrong_with_the_pair(tmp_path):
    pytest.importorskip("matplotlib")
    frame, pair = closest_contact(STRETCH)
    true = STRETCH.scene.keypoints[frame]
    one_lost = true[[person for person in range(4) if person != pair[1]]].copy()
    own = sorted(set(range(4)) - {pair[1]}).index(pair[0])
    one_lost[own, WRIST] += (0.0, 0.0, 0.4)
    here = np.full(4, frame)
    people = {
        "the truth": PlainPeople(here, true),
        "one lost": PlainPeople(here[:3], one_lost),
        "nobody at all": PlainPeople(here[:0], true[:0]),
    }
    beside = Beside(STRETCH, frame, pair, people)
    np.testing.assert_array_equal(beside.of_the_pair("the truth"), true[list(pair)])
    found = beside.of_the_pair("one lost")
    assert np.isnan(found[1]).all() and np.linalg.norm(found[0] - true[pair[0]], axis=-1).max() == pytest.approx(
        0.4
    )
    assert np.isnan(beside.of_the_pair("nobody at all")).all()
    draw_methods(tmp_path / "methods.png", [beside])
    picture = cv2.imread(str(tmp_path / "methods.png")).astype(int)
    columns = [picture[90:370, 8 + 278 * place : 268 + 278 * place] for place in range(3)]
    orange = [(np.abs(each - (0x1E, 0x87, 0xE8)).max(axis=-1) < 30).sum() for each in columns]
    assert orange[0] == 0 < orange[1] < orange[2]  # none, one person's and two people's joints are missing


def test_pages_are_drawn(rows, tmp_path):
    pytest.importorskip("matplotlib")
    few = Rows(rows.stretch, rows.frame[:80], rows.person[:80], {n: each[:80] for n, each in rows.joints.items()})
    draw_before_after(tmp_path / "pairs.png", [few])
    draw_failures(tmp_path / "failures.png", [few], each=1)
    pairs, failures = (cv2.imread(str(tmp_path / f"{name}.png")) for name in ("pairs", "failures"))
    assert pairs is not None and failures is not None
    assert pairs.shape[1] > 500 and pairs.shape[0] > 900 and failures.shape[0] > 600
    initial, final = pairs[100:380, 10:275].astype(int), pairs[100:380, 288:553].astype(int)
    assert np.abs(initial - final).max() > 100  # orange circles and what is missing
