"""What one view shows to be wrong of its own detections: people found twice, joints on the
picture's border.
"""

from dataclasses import replace

import numpy as np
import pytest

from shapepose_fg.core.camera import Rig
from shapepose_fg.core.detections import Detections
from shapepose_fg.proposal.view_faults import clipped, doubled, without_faults


def joined(first: Detections, second: Detections) -> Detections:
    """The detections of both, the second ones last."""
    names = ("view", "joint", "xy", "confidence", "affinity")
    columns = {
        name: np.concatenate([getattr(first, name), getattr(second, name)]) for name in names
    }
    return Detections(**columns, pairs=np.concatenate([first.pairs, second.pairs + len(first)]))


@pytest.fixture
def seen(five_cameras, two_people, seen_exactly) -> Detections:
    return seen_exactly(five_cameras, two_people)


def test_what_is_right_stays(seen, five_cameras):
    assert without_faults(seen, five_cameras) is seen


@pytest.mark.parametrize("away_px", [0.0, 2.0, 5.0])
def test_who_is_found_twice_in_some_views_is_found_once(seen, five_cameras, away_px):
    """A second box around a person: joints a few pixels off, a little less certain, some of them
    missing.
    """
    rng = np.random.default_rng(0)
    ends = np.isin(seen.joint, [4, 7, *range(15, 25)])
    twice = seen.only((seen.view < 3) & ((rng.random(len(seen)) < 0.6) | ~ends))
    turn = rng.uniform(0, 2 * np.pi, len(twice))
    away = away_px * np.stack([np.cos(turn), np.sin(turn)], axis=1)
    every = joined(seen, replace(twice, xy=twice.xy + away, confidence=0.95 * twice.confidence))
    again = doubled(every, five_cameras)
    assert again[len(seen) :].mean() > 0.9 and not again[: len(seen)].any()
    order = rng.permutation(len(every))
    np.testing.assert_array_equal(doubled(every.rows(order), five_cameras), again[order])


def test_people_behind_each_other_are_two(five_cameras, two_people, seen_exactly):
    """One stands behind the other in the same pose, in line with a camera, 40 cm farther away."""
    away = five_cameras.centres[0] - two_people[0, 8]
    away[2] = 0.0
    close = np.stack([two_people[0], two_people[0] - 0.4 * away / np.linalg.norm(away)])
    assert not doubled(seen_exactly(five_cameras, close), five_cameras).any()


def on_the_line(seen: Detections, view: int, height: float) -> tuple[Detections, np.ndarray]:
    """The detections where a view's picture ends at a height, below which joints are put on it."""
    below = (seen.view == view) & (seen.xy[:, 1] > height)
    xy = seen.xy.copy()
    xy[below, 1] = height
    return replace(seen, xy=xy), below


def between(y, share):
    """A height that about a `share` of joints at `y` (N,) are below: in a gap, where no joint is by
    chance.
    """
    least, most = (np.quantile(y, min(max(1 - share + shift, 0), 1)) for shift in (-0.1, 0.1))
    near = np.sort(y[(least <= y) & (y <= most)])
    widest = int(np.argmax(np.diff(near)))
    return float(near[widest : widest + 2].mean())


@pytest.mark.parametrize("share", [0.3, 0.6])
def test_joints_on_the_border_of_a_part_of_the_picture_say_nothing(seen, five_cameras, share):
    found, below = on_the_line(seen, 2, between(seen.xy[seen.view == 2, 1], share))
    np.testing.assert_array_equal(
        clipped(found, five_cameras)[seen.view == 2], below[seen.view == 2]
    )


def test_joints_on_the_edge_of_the_picture_say_nothing_even_alone(seen, five_cameras):
    width, height = five_cameras.cameras[1].image_size
    for at in ([0.0, 200.0], [width - 1.0, 200.0], [300.0, 0.5], [300.0, height], [-3.0, 100.0]):
        xy = seen.xy.copy()
        one = int(np.flatnonzero(seen.view == 1)[0])
        xy[one] = at
        assert np.flatnonzero(clipped(replace(seen, xy=xy), five_cameras)).tolist() == [one]


def test_the_border_is_one_of_the_picture_as_the_lens_gives_it(seen, five_cameras):
    """The line is straight before the lens is taken out of the detections, and bent after it."""
    cameras = [
        replace(each, distortion=np.array([-0.2, 0.05, 0.0, 0.0, 0.0]))
        for each in five_cameras.cameras
    ]
    rig = Rig(tuple(cameras), five_cameras.up)
    raw = np.stack(
        [cameras[v].distort(xy[None])[0] for v, xy in zip(seen.view, seen.xy, strict=True)]
    )
    cut, below = on_the_line(replace(seen, xy=raw), 2, between(raw[seen.view == 2, 1], 0.4))
    straight = np.stack(
        [cameras[v].undistort(xy[None])[0] for v, xy in zip(cut.view, cut.xy, strict=True)]
    )
    # Of this view: in another the two highest of a hundred joints may be equally high by chance.
    found = clipped(replace(cut, xy=straight), rig)
    np.testing.assert_array_equal(found[cut.view == 2], below[cut.view == 2])


def test_a_detector_that_rounds_to_a_grid_has_no_such_line(seen, five_cameras):
    """Both feet in the lowest row of cells are no border."""
    coarse = replace(seen, xy=8.0 * np.round(seen.xy / 8.0))
    assert not clipped(coarse, five_cameras).any()
