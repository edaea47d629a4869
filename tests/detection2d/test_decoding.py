import numpy as np
import pytest

from shapepose_fg.detection2d.decoding import decode, line_integrals, peaks
from shapepose_fg.detection2d.heat_maps import NetworkLayout, layouts

LAYOUT = layouts()["tf-pose"]


def gaussians(places: np.ndarray, size: tuple[int, int], sigma: float = 1.1) -> np.ndarray:
    """(H, W) the highest of Gaussians at `places` (N, 2) x, y in cells; `size` is (W, H)."""
    x, y = np.meshgrid(np.arange(size[0]), np.arange(size[1]))
    squared = (x - places[:, 0, None, None]) ** 2 + (y - places[:, 1, None, None]) ** 2
    return np.exp(-squared / (2 * sigma**2)).max(axis=0).astype(np.float32)


def people_output(
    people: np.ndarray, layout: NetworkLayout, size: tuple[int, int] = (60, 40)
) -> np.ndarray:
    """(C, H, W) what a perfect network gives of people (P, J, 2), cells: peaks of 0.9, fields 3
    cells wide.
    """
    output = np.zeros((layout.channels, size[1], size[0]), dtype=np.float32)
    x, y = np.meshgrid(np.arange(size[0]), np.arange(size[1]))
    for joint in range(len(layout.text.joints)):
        output[joint] = 0.9 * gaussians(people[:, joint], size)
    for limb, (a, b) in enumerate(layout.text.limbs):
        for person in people:
            along = person[b] - person[a]
            length = np.linalg.norm(along)
            unit = along / length
            to = np.stack([x, y], axis=-1) - person[a]
            t, off = to @ unit, np.abs(to @ np.array([-unit[1], unit[0]]))
            on = (t > -1) & (t < length + 1) & (off < 1.5)
            for axis in range(2):
                output[len(layout.text.joints) + 1 + 2 * limb + axis][on] = 0.8 * unit[axis]
    return output


@pytest.mark.parametrize("seed", range(3))
def test_peaks_lie_between_cells_as_the_gaussians_do(seed):
    rng = np.random.default_rng(seed)
    columns, rows = np.meshgrid(np.arange(6, 54, 12), np.arange(6, 36, 10))
    places = np.column_stack([columns.ravel(), rows.ravel()]) + rng.uniform(
        -0.5, 0.5, (columns.size, 2)
    )
    heat = np.stack([0.8 * gaussians(places, (60, 40)), np.zeros((40, 60), np.float32)])
    joint, xy, score = peaks(heat, 0.1)
    assert joint.tolist() == [0] * len(places)
    distance = np.linalg.norm(xy[:, None] - places[None], axis=-1).min(axis=1)
    assert distance.max() < 0.02  # a Gaussian's own parabola: exact but for float32
    np.testing.assert_allclose(score, 0.8, atol=0.01)


def test_a_plateau_is_one_peak_and_the_edge_has_peaks_too():
    heat = np.zeros((1, 8, 8), dtype=np.float32)
    heat[0, 3:5, 3:5] = 0.7
    heat[0, 0, 7] = 0.5
    joint, xy, score = peaks(heat, 0.1)
    assert len(joint) == 2
    np.testing.assert_allclose(sorted(score), [0.5, 0.7], atol=0.35)
    assert np.abs(xy - [[7, 0]]).max(axis=1).min() <= 0.5


@pytest.mark.parametrize("name", layouts())
def test_two_people_are_linked_to_themselves_alone(name):
    layout = layouts()[name]
    rng = np.random.default_rng(3)
    # 30 apart and 8 wide: a line to the other's joint runs along no limb, as one between two level
    # limbs would.
    one = np.column_stack(
        [
            rng.uniform(11, 19, len(layout.text.joints)),
            rng.permutation(len(layout.text.joints)) * 1.4 + 2,
        ]
    )
    people = one + np.array([[[0.0, 0.0]], [[30.0, 1.0]]])
    found = decode(people_output(people, layout), layout.text)
    truth = people[:, found.joint]
    whose = np.linalg.norm(truth - found.xy, axis=-1).argmin(axis=0)
    assert np.linalg.norm(truth[whose, np.arange(len(found))] - found.xy, axis=1).max() < 0.2
    assert np.bincount(found.joint, minlength=len(layout.text.joints)).tolist() == [2] * len(
        layout.text.joints
    )
    first, second = found.pairs.T
    ends = np.array(layout.text.limbs)[found.limb]
    assert (found.joint[first] == ends[:, 0]).all() and (found.joint[second] == ends[:, 1]).all()
    own = whose[first] == whose[second]
    assert own.sum() == 2 * len(layout.text.limbs)
    assert found.affinity[own].min() > 0.6  # the fields' 0.8, less their ends
    assert (~own).sum() == 0


def test_a_line_across_the_field_has_no_affinity():
    fields = np.zeros((2, 20, 20), dtype=np.float32)
    fields[0] = 1.0
    limb = np.zeros(3, dtype=np.intp)
    start, end = np.array([[2.0, 5], [5, 2], [15, 5]]), np.array([[15.0, 5], [5, 15], [2, 5]])
    np.testing.assert_allclose(line_integrals(fields, start, end, limb), [1, 0, 0], atol=1e-6)


def test_what_is_no_number_and_an_empty_output_give_nobody():
    output = np.full((LAYOUT.channels, 12, 16), np.nan, dtype=np.float32)
    for each in (output, np.zeros_like(output)):
        found = decode(each, LAYOUT.text)
        assert len(found) == 0 and found.pairs.shape == (0, 2)


def test_leaving_candidates_out_keeps_the_pairs_between_the_rest():
    rng = np.random.default_rng(5)
    one = np.column_stack([rng.uniform(6, 24, 18), np.arange(18) * 2.0 + 2])
    found = decode(people_output(one[None], LAYOUT), LAYOUT.text)
    part = found.moved(found.xy, found.joint != 1)
    assert 1 not in part.joint
    assert len(part.pairs) == (~(np.array(LAYOUT.text.limbs) == 1).any(axis=1)).sum()
    assert (part.joint[part.pairs] == np.array(LAYOUT.text.limbs)[part.limb]).all()
