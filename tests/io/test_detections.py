"""Detections from files: every candidate and affinity arrives, and each bad file gives the sentence
promised.
"""

import json
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from shapepose_fg.core.errors import InputError
from shapepose_fg.core.skeleton import BODY_25
from shapepose_fg.io.calibration import read_rig
from shapepose_fg.io.camera_names import match_names
from shapepose_fg.io.detections import read_detections

LIMBS = BODY_25.limbs


def test_text_gives_every_candidate_and_affinity(text_folder, recordings, rig):
    table = read_detections(text_folder, rig)
    assert len(table) == 3
    assert table.skeleton is BODY_25
    for frame, detections in enumerate(table):
        affinities = 0
        for view, (name, camera) in enumerate(zip(rig.names, rig.cameras, strict=True)):
            rows_of = [
                np.flatnonzero((detections.view == view) & (detections.joint == joint))
                for joint in range(25)
            ]
            for joint, values in enumerate(recordings[name].joints[frame]):
                rows = rows_of[joint]
                pixels = camera.undistort(
                    values[:2].T * [1000, 800]
                )  # the format divides by size - 1
                np.testing.assert_allclose(detections.xy[rows], pixels, atol=1e-9)
                np.testing.assert_array_equal(detections.confidence[rows], values[2])
            for (a, b), matrix in zip(LIMBS, recordings[name].affinities[frame], strict=True):
                for i, k in zip(*np.nonzero(matrix), strict=True):
                    found = np.all(detections.pairs == [rows_of[a][i], rows_of[b][k]], axis=1)
                    np.testing.assert_array_equal(detections.affinity[found], [matrix[i, k]])
                    affinities += 1
        assert len(detections.affinity) == affinities  # none besides these


def test_a_frame_in_which_a_view_saw_nothing(text_folder, rig):
    table = read_detections(text_folder, rig)
    assert len(table[1]) == 0
    assert len(table[1].affinity) == 0
    assert {*table[0].view.tolist()} == {0, 1}


def test_nobody_at_all(tmp_path, rig):
    for name in rig.names:
        (tmp_path / f"{name}.txt").write_text("4 2\n" + "0\n" * 50)
    table = read_detections(tmp_path, rig)
    assert [len(frame) for frame in table] == [0, 0]


def test_frames_are_counted_from_either_end(text_folder, rig):
    table = read_detections(text_folder, rig)
    np.testing.assert_array_equal(table[-1].xy, table[2].xy)
    with pytest.raises(IndexError, match="frame 3 is not among the 3 frames"):
        table[3]


def test_the_folder_above_serves_too_and_other_cameras_are_passed_over(text_folder, rig):
    shutil.copy(text_folder / "left.txt", text_folder / "ceiling.txt")
    table = read_detections(text_folder.parent, rig)
    np.testing.assert_array_equal(table[0].xy, read_detections(text_folder, rig)[0].xy)
    assert max(frame.view.max(initial=0) for frame in table) == 1


def test_scores_that_overshoot_a_little_are_one(text_folder, rig):
    edit(text_folder / "left.txt", token(text_folder, "the score of the first neck"), "1.02")
    assert read_detections(text_folder, rig)[0].confidence.max() == 1.0


def token(folder: Path, what: str) -> int:
    """Which number of left.txt is meant. Frame 0 has 0 noses, then 3 necks: 4 3 | 0 | 3 x x x y y y
    s s s.
    """
    return {
        "frames": 1,
        "necks": 3,
        "x": 4,
        "y": 7,
        "the score of the first neck": 10,
        "elbows": 14,
    }[what]


def edit(path: Path, index: int, word: str | None) -> None:
    """Replace number `index` of the file by `word`, or take it out, and keep the lines."""
    count = 0
    lines = []
    for line in path.read_text().splitlines():
        words = line.split()
        if count <= index < count + len(words):
            words[index - count : index - count + 1] = [] if word is None else [word]
            index = -1
        count += len(line.split())
        lines.append(" ".join(words))
    path.write_text("\n".join(lines) + "\n")


BAD_NUMBERS = [
    (
        "necks",
        "-1",
        (
            "line 6: frame 0 must give the number of candidates of Neck, got -1; there is a number "
            "too few"
        ),
    ),
    ("necks", "1.5", "line 6: frame 0 must give the number of candidates of Neck, got 1.5"),
    ("x", None, " must give the number of candidates of"),
    ("x", "nan", "line 7: 'nan' is not a finite number; write the detections again"),
    ("x", "inf", "line 7: 'inf' is not a finite number"),
    ("x", "0,5", "line 7: '0,5' is not a finite number"),
    ("x", "512", "line 7: a candidate is at (512, 0."),
    ("x", "-0.3", "frame 0 has a joint at pixel (-300, "),
    ("y", "7.5", "divide x by width - 1 and y by height - 1"),
    (
        "the score of the first neck",
        "1.2",
        "line 9: a candidate's score must lie between 0 and 1, got 1.2; write",
    ),
    (
        "the score of the first neck",
        "-0.1",
        "line 9: a candidate's score must lie between 0 and 1, got -0.1",
    ),
    (
        "frames",
        "4",
        "the file ends in frame 3 of 4, where the number of candidates of Nose should be; copy",
    ),
    (
        "frames",
        "1",
        "numbers after the last of the 1 frames; correct the number of frames in line 1",
    ),
    ("frames", "0", "line 1: the number of frames must be 1 or more, got 0"),
    ("frames", "1e300", "the file ends in frame 3 of 1"),
    ("necks", "1e300", "the file ends in frame 0 of 3, where the candidates of Neck should be"),
]


@pytest.mark.parametrize(("what", "word", "sentence"), BAD_NUMBERS)
def test_bad_number(text_folder, rig, what, word, sentence):
    edit(text_folder / "left.txt", token(text_folder, what), word)
    refuses(text_folder, rig, text_folder / "left.txt", sentence)


@pytest.mark.parametrize(
    ("kind", "sentence"),
    [
        (
            "2",
            (
                "line 1: skeleton type 2 (SKEL15) is not supported, only 4 (BODY_25) and 3 "
                "(COCO_18); run the"
            ),
        ),
        ("0", "skeleton type 0 (SKEL19) is not supported"),
        ("25", "skeleton type 25 is not supported"),
        ("4.5", "skeleton type 4.5 is not supported"),
    ],
)
def test_other_skeletons(text_folder, rig, kind, sentence):
    edit(text_folder / "right.txt", 0, kind)
    refuses(text_folder, rig, text_folder / "right.txt", sentence)


def test_truncated_text_names_frame_and_what_is_missing(text_folder, rig):
    path = text_folder / "left.txt"
    lines = path.read_text().rstrip().splitlines()
    path.write_text("\n".join(lines[:7]) + "\n")
    refuses(
        text_folder,
        rig,
        path,
        "the file ends in frame 0 of 3, where the candidates of Neck should be",
    )
    path.write_text("\n".join(lines[:-1]) + "\n")
    refuses(
        text_folder,
        rig,
        path,
        "line",
        "frame 2 of 3, where the affinities of RHip-RKnee should be; copy",
    )
    path.write_text("4")
    refuses(text_folder, rig, path, "the first line must hold skeleton type and number of frames")
    path.write_text("")
    refuses(text_folder, rig, path, "the file is empty")


def test_frame_counts_that_differ(text_folder, recordings, rig):
    recordings["right"].joints.pop()
    recordings["right"].affinities.pop()
    (text_folder / "right.txt").write_text(recordings["right"].text())
    table = read_detections(text_folder, rig)
    assert len(table) == 2 and set(table[0].view.tolist()) == {0, 1}
    assert (
        "(left.txt has 3, 0 to 2, right.txt has 2, 0 to 1); the 2 common ones, 0 to 1, are used"
        in table.notes[-1]
    )
    assert len(read_detections(text_folder, rig, own_frames=True)) == 3


def test_missing_camera(text_folder, rig):
    (text_folder / "right.txt").unlink()
    refuses(
        text_folder,
        rig,
        text_folder / "right.txt",
        'camera "right" are missing',
        "contains left.txt; add them",
    )


def test_no_detections(tmp_path, text_folder, rig):
    (tmp_path / "readme.md").write_text("nothing in it")
    (tmp_path / "empty").mkdir()
    refuses(
        tmp_path,
        rig,
        tmp_path,
        "no detections of the cameras left right; it contains empty readme.md recording",
    )
    refuses(
        tmp_path / "empty",
        rig,
        tmp_path / "empty",
        "it contains nothing; give the folder with <camera>.txt",
    )
    refuses(tmp_path / "nowhere", rig, tmp_path / "nowhere", "there is no such folder")
    left = text_folder / "left.txt"
    refuses(
        left, rig, left, "this is a file; give the folder that holds the detections of all cameras"
    )


def test_openpose_people_become_candidates(openpose_folder, rig):
    table = read_detections(openpose_folder, rig)
    assert len(table) == 3
    assert [len(frame) for frame in table] == [16, 0, 50]
    first = table[0]
    left = first.view == 0
    assert [BODY_25.joints[joint] for joint in first.joint[left]] == (
        "Nose Neck Neck MidHip MidHip RHip LHip LKnee".split()
    )
    # Person 0 has the limbs Neck-MidHip, MidHip-RHip, Neck-Nose; person 1 Neck-MidHip, MidHip-LHip,
    # LHip-LKnee.
    pairs = {tuple(pair) for pair in first.pairs[first.view[first.pairs[:, 0]] == 0].tolist()}
    assert pairs == {(1, 3), (3, 5), (1, 0), (2, 4), (4, 6), (6, 7)}
    assert np.all(first.affinity == 1)
    # A whole person has all 26 limbs in each view.
    assert len(table[2].affinity) == 2 * len(LIMBS)
    assert np.all(table[2].view[table[2].pairs[:, 0]] == table[2].view[table[2].pairs[:, 1]])


def test_openpose_points_are_undistorted_once(openpose_folder, rig):
    file = openpose_folder / "right" / "video_000000000009_keypoints.json"
    measured = np.reshape(json.loads(file.read_text())["people"][0]["pose_keypoints_2d"], (25, 3))
    detections = read_detections(openpose_folder, rig)[2]
    right = detections.view == 1
    np.testing.assert_allclose(
        detections.xy[right], rig.cameras[1].undistort(measured[:, :2]), atol=1e-9
    )
    np.testing.assert_array_equal(detections.confidence[right], measured[:, 2])
    np.testing.assert_array_equal(detections.xy[~right], measured[:, :2])


def test_openpose_frames_may_be_missing_in_between_and_it_is_said(openpose_folder, rig):
    for name in ("left", "right"):  # the last frame's person in the middle one, too
        last = openpose_folder / name / "video_000000000009_keypoints.json"
        last.with_name("video_000000000008_keypoints.json").write_text(last.read_text())
    whole = read_detections(openpose_folder, rig)
    (openpose_folder / "right" / "video_000000000008_keypoints.json").unlink()
    table = read_detections(openpose_folder, rig)
    assert len(table) == len(whole) == 3
    assert set(whole[1].view.tolist()) == {0, 1} and set(table[1].view.tolist()) == {0}
    for frame in (0, 2):
        np.testing.assert_array_equal(table[frame].xy, whole[frame].xy)
    assert (
        f"{openpose_folder / 'right'}: 1 frame has no file (frame 8); no people are read there"
        in table.notes
    )
    assert not any("no file" in note for note in whole.notes)


def test_openpose_numbers_that_are_no_frames_are_refused(openpose_folder, rig):
    last = openpose_folder / "right" / "video_000000000009_keypoints.json"
    last.rename(last.with_name("video_20261121_keypoints.json"))
    refuses(
        openpose_folder, rig, openpose_folder / "right", "3 files are numbered from 7 to 20261121"
    )


def test_openpose_frame_counts_that_differ(openpose_folder, rig):
    (openpose_folder / "right" / "video_000000000009_keypoints.json").unlink()
    table = read_detections(openpose_folder, rig)
    assert (
        len(table) == 2
        and "(left has 3, 7 to 9, right has 2, 7 to 8); the 2 common ones" in table.notes[-1]
    )


def test_openpose_first_numbers_that_differ(openpose_folder, rig):
    for number in (9, 8, 7):
        name = "video_{:012d}_keypoints.json"
        folder = openpose_folder / "right"
        (folder / name.format(number)).rename(folder / name.format(number + 1))
    whole = read_detections(openpose_folder, rig, own_frames=False)
    assert (
        len(whole) == 2
        and "(left has 3, 7 to 9, right has 3, 8 to 10); the 2 common ones" in whole.notes[-1]
    )
    # Frame 8 is the second of the left camera and the first of the right one.
    assert np.bincount(whole[0].view).tolist() == [0, 8] and np.bincount(
        whole[1].view
    ).tolist() == [25]
    every = read_detections(openpose_folder, rig, own_frames=True)
    assert (
        len(every) == 4
        and "frame 0 has number 7 in the files (left has 3, 7 to 9, right has 3" in every.notes[-1]
    )
    assert [np.bincount(frame.view, minlength=2).tolist() for frame in every] == [
        [8, 0],
        [0, 8],
        [25, 0],
        [0, 25],
    ]


def test_openpose_numbers_without_a_frame_in_common(openpose_folder, rig):
    for number in (7, 8, 9):
        name = "video_{:012d}_keypoints.json"
        folder = openpose_folder / "right"
        (folder / name.format(number)).rename(folder / name.format(number + 50))
    refuses(
        openpose_folder,
        rig,
        openpose_folder,
        (
            "no frame exists for all cameras (left has 3, 7 to 9, right has 3, 57 to 59); give the "
            "same frames"
        ),
    )


def test_openpose_two_recordings_in_a_folder(openpose_folder, rig):
    folder = openpose_folder / "left"
    shutil.copy(
        folder / "video_000000000008_keypoints.json", folder / "walk_000000000008_keypoints.json"
    )
    refuses(
        openpose_folder,
        rig,
        folder / "walk_000000000008_keypoints.json",
        "frame 8 is also in video_",
    )


def test_openpose_missing_or_empty_camera(openpose_folder, rig):
    shutil.rmtree(openpose_folder / "right")
    refuses(
        openpose_folder,
        rig,
        openpose_folder / "right",
        'camera "right" are missing',
        "contains left; add them",
    )
    (openpose_folder / "right").mkdir()
    refuses(
        openpose_folder,
        rig,
        openpose_folder / "right",
        "no *_keypoints.json (OpenPose) or *_000000.json",
    )


def person(values: object) -> str:
    return json.dumps({"people": [{"pose_keypoints_2d": values}]})


FULL = [500.0, 400.0, 0.5] * 25
BAD_JSON = [
    (
        person([0.5] * 74),
        (
            "people[0].pose_keypoints_2d must hold x, y and score of each keypoint, got 74 "
            "numbers; run"
        ),
    ),
    (
        person([*FULL[:-1], "0.5"]),
        "people[0].pose_keypoints_2d[74] must be a number, got text '0.5'",
    ),
    (
        person([float("inf"), *FULL[1:]]),
        "must be a finite number, got Infinity; run OpenPose again",
    ),
    (json.dumps({"people": [{"pose_keypoints": FULL}]}), "people[0].pose_keypoints_2d is missing"),
    (json.dumps({"people": {}}), "people must be a list, got an object"),
    (json.dumps({}), "people is missing"),
    (json.dumps([]), "people is missing in a list of 0"),
    (person(FULL)[:100], "line 1 column 101"),
    ("", "the file is empty"),
]


@pytest.mark.parametrize(("text", "sentence"), BAD_JSON)
def test_bad_openpose_file(openpose_folder, rig, text, sentence):
    file = openpose_folder / "left" / "video_000000000008_keypoints.json"
    file.write_text(text)
    refuses(openpose_folder, rig, file, sentence)


def test_openpose_parts_of_the_picture_instead_of_pixels(openpose_folder, rig):
    for file in (openpose_folder / "left").iterdir():
        file.write_text(person([0.4, 0.5, 0.5] * 25))
    refuses(
        openpose_folder,
        rig,
        openpose_folder / "left",
        "recognised as OpenPose's JSON, but all keypoints are between -1 and 1",
        "run OpenPose again with --write_json --keypoint_scale 0",
    )


def test_openpose_of_larger_pictures(openpose_folder, rig):
    (openpose_folder / "left" / "video_000000000008_keypoints.json").write_text(
        person([1800.0, 900.0, 0.5] * 25)
    )
    refuses(
        openpose_folder,
        rig,
        openpose_folder / "left",
        (
            "frame 1 has a joint at pixel (1800, 900), far outside the 1001 x 801 picture of the "
            "calibration"
        ),
        "give detections from pictures of the calibrated size",
    )


@pytest.mark.slow
def test_shelf_against_a_plain_reading(shared_data):
    rig = read_rig(shared_data / "shelf" / "calibration.json")
    table = read_detections(shared_data / "shelf", rig)
    assert len(table) == 301
    numbers = iter((shared_data / "shelf" / "detection" / "3.txt").read_text().split())
    assert [next(numbers), next(numbers)] == ["4", "301"]
    for detections in table:
        candidates, rows_of = 0, []
        for joint in range(25):
            count = int(next(numbers))
            x, y, score = ([float(next(numbers)) for _ in range(count)] for _ in range(3))
            rows = np.flatnonzero((detections.view == 3) & (detections.joint == joint))
            np.testing.assert_allclose(
                detections.xy[rows] / [1031, 775], np.transpose([x, y]).reshape(-1, 2)
            )
            np.testing.assert_array_equal(detections.confidence[rows], np.minimum(score, 1))
            rows_of.append(rows)
            candidates += count
        given = {}
        for a, b in LIMBS:
            for i in rows_of[a].tolist():
                for k in rows_of[b].tolist():
                    given[i, k] = float(next(numbers))
        mine = detections.view[detections.pairs[:, 0]] == 3
        found = dict(
            zip(
                map(tuple, detections.pairs[mine].tolist()),
                detections.affinity[mine].tolist(),
                strict=True,
            )
        )
        assert found == {pair: affinity for pair, affinity in given.items() if affinity > 0}
        assert candidates == np.count_nonzero(detections.view == 3)


def refuses(path: Path, rig, place: Path, *parts: str) -> None:
    """Reading `path` gives one line that names `place` and holds `parts`."""
    with pytest.raises(InputError) as caught:
        read_detections(path, rig)
    message = str(caught.value)
    assert message.startswith(f"{place}")
    assert "\n" not in message
    for part in parts:
        assert part in message


def test_a_corner_of_a_wide_lens_does_not_cost_the_recording(shared_cases):
    """One toe of 25 joints lies where a real lens with one coefficient cannot be undistorted."""
    rig = read_rig(shared_cases / "lens_corner" / "calibration.toml", unit="mm", up="-y")
    table = read_detections(shared_cases / "lens_corner" / "detections", rig)
    assert len(table) == 60 and len(table[0]) == 72 and 22 not in table[0].joint
    assert (
        sum("cannot be inverted; 60 joints of 1500 (4.0%) left out" in note for note in table.notes)
        == 3
    )


def test_a_lens_that_bends_most_joints_away_is_named(shared_cases):
    rig = read_rig(shared_cases / "lens_corner" / "calibration.toml", unit="mm", up="-y")
    wrong = [
        replace(each, distortion=20 * each.distortion) if n == 1 else each
        for n, each in enumerate(rig.cameras)
    ]
    with pytest.raises(
        InputError,
        match=r"Cam2 cannot be inverted; this holds for .* of this camera; check the"
        r" distortion",
    ):
        read_detections(
            shared_cases / "lens_corner" / "detections", replace(rig, cameras=tuple(wrong))
        )


def test_folders_of_unequal_length(shared_cases):
    rig = read_rig(shared_cases / "unequal" / "calibration.json")
    table = read_detections(shared_cases / "unequal" / "det", rig)
    assert len(table) == 11 and "the 11 common ones, 0 to 10, are used" in table.notes[-1]


@pytest.mark.parametrize(
    ("cameras", "names", "expected"),
    [
        (["23087", "23088"], ["walk_Miqus_2_23088", "walk_Miqus_1_23087"], [1, 0]),
        (["int_cam1", "int_cam2"], ["cam02", "cam01"], [1, 0]),
        (["2022-09-19_synced_Cam1", "2022-09-19_synced_Cam2"], ["view_02", "view_01"], [1, 0]),
        (
            ["2025-04-23_camera_0", "2025-04-23_camera_1"],
            ["camera_0", "camera_1", "camera_2"],
            [0, 1],
        ),
        (["Left", "Right"], ["right_cam", "left_cam"], [1, 0]),
        (["a1", "a2"], ["walk_3_x", "walk_4_x"], None),
        (["left", "right"], ["front", "back"], None),
        (["cam1", "cam2"], ["trial1", "trial2", "trial_1"], None),
    ],
)
def test_cameras_are_told_by_parts_of_names(cameras, names, expected):
    assert match_names(cameras, names) == expected
