"""4D Association's text with COCO's 18 joints: middle hips are made of candidates that nobody has
grouped.
"""

import numpy as np
import pytest

from shapepose_fg.core.errors import InputError
from shapepose_fg.core.skeleton import BODY_25, COCO_18
from shapepose_fg.io.detections import read_detections
from shapepose_fg.io.detections.association_text import TEXT_SKELETONS
from shapepose_fg.io.write_detections import association_lines

KIND = TEXT_SKELETONS["COCO_18"]
NECK, RHIP, LHIP, MIDHIP = (COCO_18.index(name) for name in ("Neck", "RHip", "LHip", "MidHip"))


def text(rig, frames: list[tuple[list, list]]) -> str:
    """Frames of candidates (joint, x, y, score) and pairs (first, second, affinity)."""
    lines = [f"3 {len(frames)}"]
    size = np.array(rig.cameras[0].image_size) - 1.0
    for candidates, links in frames:
        table = np.array(candidates, dtype=float).reshape(-1, 4)
        pairs = np.array(links, dtype=float).reshape(-1, 3)
        lines += association_lines(
            KIND,
            table[:, 0].astype(int),
            table[:, 1:3] / size,
            table[:, 3],
            pairs[:, :2].astype(int),
            pairs[:, 2],
        )
    return "\n".join(lines) + "\n"


@pytest.fixture
def read(five_cameras, tmp_path):
    def read(frames):
        for name in five_cameras.names:
            (tmp_path / f"{name}.txt").write_text(text(five_cameras, frames))
        return read_detections(tmp_path, five_cameras)

    return read


def test_hips_that_one_neck_links_have_a_middle(read):
    """Two people side by side; the right hip of the first is linked weakly to the other's neck
    too.
    """
    candidates = [
        (NECK, 100, 50, 0.9), (NECK, 200, 50, 0.8), (RHIP, 90, 150, 0.7), (RHIP, 190, 150, 0.6),
        (LHIP, 110, 150, 0.5), (LHIP, 210, 150, 0.9), (COCO_18.index("Nose"), 100, 20, 0.9),
    ]  # fmt: skip
    links = [(0, 2, 0.8), (0, 4, 0.6), (1, 3, 0.9), (1, 5, 0.7), (1, 2, 0.3), (0, 6, 0.5)]
    table = read([(candidates, links), ([], []), (candidates[:3], [(0, 2, 0.8)])])
    assert table.skeleton is COCO_18 and len(table) == 3
    assert "MidHip" in table.notes[0]
    first = table[0].only(table[0].view == 0)
    middles = np.flatnonzero(first.joint == MIDHIP)
    np.testing.assert_allclose(first.xy[middles], [[100, 150], [200, 150]], atol=1e-3)
    np.testing.assert_allclose(first.confidence[middles], [0.5, 0.6], atol=1e-6)
    ends = [
        (COCO_18.joints[joint], round(x))
        for joint, x in zip(first.joint.tolist(), first.xy[:, 0], strict=True)
    ]
    pairs = zip(first.pairs.tolist(), first.affinity.tolist(), strict=True)
    links = {(*ends[one], *ends[other]): affinity for (one, other), affinity in pairs}
    assert links == pytest.approx({
        ("Neck", 100, "MidHip", 100): 0.7, ("Neck", 200, "MidHip", 200): 0.8,
        ("MidHip", 100, "RHip", 90): 1, ("MidHip", 100, "LHip", 110): 1,
        ("MidHip", 200, "RHip", 190): 1, ("MidHip", 200, "LHip", 210): 1,
        ("Neck", 100, "Nose", 100): 0.5,
    })  # fmt: skip
    assert len(table[1]) == 0
    assert MIDHIP not in table[2].joint  # one hip has no middle


def test_random_candidates_come_back_in_order(read, five_cameras):
    """Every pair that a limb of the skeleton joins is kept, of many frames; order as `Detections`
    has it.
    """
    rng = np.random.default_rng(0)
    frames = []
    for _ in range(60):
        joint = np.sort(rng.choice([NECK, RHIP, LHIP, *range(18)], rng.integers(0, 40)))
        candidates = [(j, *rng.uniform(10, 400, 2), rng.uniform(0.1, 1)) for j in joint.tolist()]
        links = [
            (a, b, rng.uniform(0.1, 1))
            for first, second in KIND.limbs
            for a in np.flatnonzero(joint == first).tolist()
            for b in np.flatnonzero(joint == second).tolist()
            if rng.random() < 0.5
        ]
        frames.append((candidates, links))
    table = read(frames)
    limbs = set(COCO_18.limbs)
    made = 0
    for frame, (candidates, links) in enumerate(frames):
        found = table[frame].only(table[frame].view == 2)
        assert (np.diff(found.joint) >= 0).all()
        given = found.joint != MIDHIP
        assert given.sum() == len(candidates)
        np.testing.assert_allclose(
            np.sort(found.confidence[given]), np.sort([c[3] for c in candidates]), atol=1e-5
        )
        ends = [tuple(pair) for pair in found.joint[found.pairs].tolist()]
        assert set(ends) <= limbs
        whole = given[found.pairs].all(axis=1) if len(found.pairs) else np.zeros(0, bool)
        kept = [
            link for link in links if tuple(int(candidates[end][0]) for end in link[:2]) in limbs
        ]
        np.testing.assert_allclose(
            np.sort(found.affinity[whole]), np.sort([link[2] for link in kept]), atol=1e-5
        )
        middles = np.flatnonzero(~given)
        made += len(middles)
        for end in (RHIP, LHIP):  # each hip makes one middle at most
            hips = found.pairs[(found.joint[found.pairs] == (MIDHIP, end)).all(axis=1)]
            assert sorted(hips[:, 0]) == middles.tolist() and len(set(hips[:, 1])) == len(middles)
    assert made > 10


def test_cameras_of_two_skeletons_are_refused(read, five_cameras, tmp_path):
    read([([], [])])
    (tmp_path / f"{five_cameras.names[1]}.txt").write_text("4 1\n" + "0\n" * 25)
    with pytest.raises(
        InputError, match=r"has the joints of BODY_25, .* those of COCO_18; give the"
    ):
        read_detections(tmp_path, five_cameras)
    for name in five_cameras.names:
        (tmp_path / f"{name}.txt").write_text("3 1\n" + "0\n" * 18)
    with pytest.raises(InputError, match="these are joints of COCO_18, not of BODY_25"):
        read_detections(tmp_path, five_cameras, BODY_25)


def test_a_file_that_ends_too_early_is_named(read, five_cameras, tmp_path):
    read([([], [])])
    (tmp_path / f"{five_cameras.names[0]}.txt").write_text("3 1\n" + "0\n" * 17)
    with pytest.raises(
        InputError, match="the file ends in frame 0 of 1, where the number of candidates of LEar"
    ):
        read_detections(tmp_path, five_cameras)
