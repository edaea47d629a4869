"""Detections of people in the files of many programs: the same candidates, whatever the format."""

import json
import re
import unicodedata
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from shapepose_fg.core.camera import Camera, Rig
from shapepose_fg.core.errors import InputError
from shapepose_fg.core.skeleton import (
    BODY_25,
    COCO_17,
    COCO_18,
    COCO_133,
    HALPE_26,
    SKELETONS,
    Skeleton,
)
from shapepose_fg.io.calibration import read_rig
from shapepose_fg.io.detection_table import DetectionTable
from shapepose_fg.io.detections import read_detections, reading
from shapepose_fg.io.detections.people import CameraPeople, PeopleBlock
from shapepose_fg.io.skeleton_file import read_skeleton
from shapepose_fg.proposal.people_2d import group_people

DATA = Path(__file__).parent / "data"
K = np.array([[1000.0, 0, 500], [0, 1000, 400], [0, 0, 1]])


def two_cameras(*names: str) -> Rig:
    poses = [np.eye(4) for _ in names]
    for index, pose in enumerate(poses):
        pose[0, 3] = index
    return Rig(
        tuple(Camera(name, K, pose, (1001, 801)) for name, pose in zip(names, poses, strict=True)),
        "-y",
    )


@pytest.fixture
def rig() -> Rig:
    return two_cameras("left", "right")


# People of three frames by camera: two, nobody, one. A score of 0 is a joint that was not seen.
def people_of(skeleton: Skeleton) -> dict[str, list[list[NDArray[np.float64]]]]:
    rng = np.random.default_rng(0)

    def person() -> NDArray[np.float64]:
        count = skeleton.keypoint_count
        values = np.column_stack(
            [rng.uniform(100, 700, (count, 2)).round(2), rng.uniform(0.3, 0.9, count).round(3)]
        )
        values[rng.random(count) < 0.2] = 0
        return values

    return {name: [[person(), person()], [], [person()]] for name in ("left", "right")}


def openpose(folder: Path, people: dict) -> None:
    for name, frames in people.items():
        (folder / name).mkdir()
        for number, found in enumerate(frames):
            content = {
                "version": 1.3,
                "people": [{"pose_keypoints_2d": each.ravel().tolist()} for each in found],
            }
            (folder / name / f"{name}_{number:012d}_keypoints.json").write_text(json.dumps(content))


def pose2sim(folder: Path, people: dict) -> None:
    """As RTMLib's people are written: NaN instead of zeros, an empty person, other names."""
    for name, frames in people.items():
        (folder / f"{name}_json").mkdir()
        for number, found in enumerate(frames):
            rows = [np.where(each[:, 2:] > 0, each, np.nan).ravel().tolist() for each in found]
            content = {
                "version": 1.3,
                "people": [{}, *({"person_id": [-1], "pose_keypoints_2d": row} for row in rows)],
            }
            (folder / f"{name}_json" / f"{name}_{number:06d}.json").write_text(json.dumps(content))


def coco(folder: Path, people: dict) -> None:
    for name, frames in people.items():
        results = [
            {"image_id": number, "category_id": 1, "keypoints": each.ravel().tolist(), "score": 0.9}
            for number, found in enumerate(frames)
            for each in found
        ]
        (folder / f"{name}.json").write_text(json.dumps(results[::-1]))


def coco_data_set(folder: Path, people: dict) -> None:
    """With ids that are no frame numbers, and pictures of them."""
    for name, frames in people.items():
        images = [
            {"id": 700 - number, "file_name": f"{name}/img_{number:05d}.jpg"}
            for number in range(len(frames))
        ]
        annotations = [
            {"image_id": 700 - number, "keypoints": each.ravel().tolist()}
            for number, found in enumerate(frames)
            for each in found
        ]
        (folder / f"{name}.json").write_text(
            json.dumps({"images": images, "annotations": annotations})
        )


def alphapose(folder: Path, people: dict) -> None:
    for name, frames in people.items():
        results = [
            {
                "image_id": f"{number}.jpg",
                "category_id": 1,
                "keypoints": each.ravel().tolist(),
                "score": 2.9,
                "idx": 1,
            }
            for number, found in enumerate(frames)
            for each in found
        ]
        (folder / name).mkdir()
        (folder / name / "alphapose-results.json").write_text(json.dumps(results))


def instances(found: list) -> list[dict]:
    return [
        {
            "keypoints": each[:, :2].tolist(),
            "keypoint_scores": each[:, 2].tolist(),
            "bbox_score": 0.9,
        }
        for each in found
    ]


def mmpose_video(folder: Path, people: dict) -> None:
    for name, frames in people.items():
        content = [
            {"frame_id": number, "instances": instances(found)}
            for number, found in enumerate(frames)
        ]
        (folder / f"{name}.json").write_text(json.dumps(content))


def mmpose_demo(folder: Path, people: dict) -> None:
    for name, frames in people.items():
        info = [
            {"frame_id": number, "instances": instances(found)}
            for number, found in enumerate(frames, 1)
        ]
        content = {"meta_info": {"dataset_name": "coco"}, "instance_info": info}
        (folder / f"results_{name}.json").write_text(json.dumps(content))


def mmpose_pictures(folder: Path, people: dict) -> None:
    for name, frames in people.items():
        (folder / name).mkdir()
        for number, found in enumerate(frames):
            (folder / name / f"{number:06d}.json").write_text(json.dumps(instances(found)))


WRITERS = {
    "OpenPose": openpose,
    "Pose2Sim": pose2sim,
    "COCO": coco,
    "COCO data set": coco_data_set,
    "AlphaPose": alphapose,
    "MMPose, video": mmpose_video,
    "MMPose, demo": mmpose_demo,
    "MMPose, pictures": mmpose_pictures,
}


def expected_joints(
    person: NDArray[np.float64], skeleton: Skeleton
) -> dict[str, NDArray[np.float64]]:
    """Joints by name that must come out of a person, middles too, worked out by hand."""
    places = range(len(skeleton)) if skeleton.keypoints is None else skeleton.keypoints
    found = {
        skeleton.joints[joint]: values
        for joint, values in zip(places, person, strict=True)
        if joint >= 0 and values[2] > 0
    }
    for name, side in (("Neck", "Shoulder"), ("MidHip", "Hip")):
        if name not in [skeleton.joints[joint] for joint in places if joint >= 0]:
            ends = [found.get(f"R{side}"), found.get(f"L{side}")]
            if ends[0] is not None and ends[1] is not None:
                middle = (ends[0] + ends[1]) / 2
                found[name] = np.append(middle[:2], min(ends[0][2], ends[1][2]))
    return found


USUAL = {each.keypoint_count: each for each in reversed(SKELETONS.values())}
"""What a number of keypoints is taken as where nothing else tells."""


@pytest.mark.parametrize("skeleton", USUAL.values(), ids=lambda each: each.name)
@pytest.mark.parametrize("program", WRITERS)
def test_every_joint_and_limb_arrives(tmp_path, rig, program, skeleton):
    people = people_of(skeleton)
    WRITERS[program](tmp_path, people)
    table = read_detections(tmp_path, rig)
    assert table.skeleton is skeleton and len(table) == 3
    for frame, detections in enumerate(table):
        groups = group_people(detections)
        for view, name in enumerate(rig.names):
            mine = [members for members in groups if detections.view[members[0]] == view]
            wanted = [expected_joints(person, skeleton) for person in people[name][frame]]
            # No limb may lead to a joint whose neighbours were all missed: it then is a group of
            # its own.
            assert sum(map(len, mine)) == sum(map(len, wanted))
            rows = np.flatnonzero(detections.view == view)
            got = {
                (skeleton.joints[detections.joint[row]], *detections.xy[row].round(6).tolist()): row
                for row in rows
            }
            for person in wanted:
                place = {}
                for joint, values in person.items():
                    row = got[(joint, *values[:2].round(6).tolist())]
                    assert detections.confidence[row] == pytest.approx(values[2])
                    place[joint] = row
                links = {
                    (place[skeleton.joints[a]], place[skeleton.joints[b]])
                    for a, b in skeleton.limbs
                    if skeleton.joints[a] in place and skeleton.joints[b] in place
                }
                own = np.isin(detections.pairs[:, 0], list(place.values()))
                assert {tuple(pair) for pair in detections.pairs[own].tolist()} == links
    assert all(np.all(frame.affinity == 1) for frame in table)


def test_pose2sim_s_own_writer(rig):
    """Files that Pose2Sim 0.10.49 wrote: HALPE_26, a person of NaN, an empty one, scores over 1 and
    below 0.
    """
    table = read_detections(DATA / "pose2sim", two_cameras("cam01", "cam02"))
    assert table.skeleton is HALPE_26
    # One whole person in frame 0; in frame 2 one whose first two joints have scores of 1.3 and
    # -0.1.
    assert [np.bincount(frame.view, minlength=2).tolist() for frame in table] == [
        [26, 26],
        [0, 0],
        [25, 25],
    ]
    assert max(frame.confidence.max(initial=0) for frame in table) == 1.0
    note, layout = table.notes
    assert layout.startswith("26 keypoints per person without joint names: read as HALPE_26")
    assert "scores reach 1.3, so they are not probabilities" in note


def test_cameras_are_told_by_their_numbers_where_names_differ():
    table = read_detections(DATA / "pose2sim", two_cameras("int_cam2_img", "int_cam1_img"))
    straight = read_detections(DATA / "pose2sim", two_cameras("cam01", "cam02"))
    assert "int_cam2_img is cam02_json, int_cam1_img is cam01_json" in table.notes[0]
    first = straight[0].view == 0
    np.testing.assert_array_equal(table[0].xy[table[0].view == 1], straight[0].xy[first])
    with pytest.raises(
        InputError,
        match="no detections of the cameras cam 1 a, other; it contains cam01_json cam02_json",
    ):
        read_detections(DATA / "pose2sim", two_cameras("cam 1 a,", "other"))


def test_cameras_are_told_by_their_names_within_others(tmp_path):
    rig = two_cameras("23087", "1")
    people = people_of(BODY_25)
    names = {"left": "walk3_Miqus_2_23087", "right": "walk3_Miqus_1_23088"}
    pose2sim(tmp_path, {names[name]: frames for name, frames in people.items()})
    with pytest.raises(InputError, match="no detections of the cameras 23087 walk3; it contains"):
        read_detections(tmp_path, two_cameras("23087", "walk3"))  # which stands in both
    note, _ = read_detections(tmp_path, rig).notes
    assert note.endswith("23087 is walk3_Miqus_2_23087_json, 1 is walk3_Miqus_1_23088_json")


def test_middles_are_said(tmp_path, rig):
    coco(tmp_path, people_of(COCO_17))
    assert read_detections(tmp_path, rig).notes[1:] == (
        (
            "COCO_17 has no Neck and no MidHip: each is the midpoint of two joints, if both were "
            "detected"
        ),
    )


def test_scores_of_other_kinds(tmp_path, rig):
    people = people_of(BODY_25)
    for each in (person for frames in people.values() for found in frames for person in found):
        each[:, 2] *= 100
    openpose(tmp_path, people)
    table = read_detections(tmp_path, rig)
    every = np.concatenate(
        [person[:, 2] for frames in people.values() for found in frames for person in found]
    )
    scale = np.quantile(every[every > 0], 0.99)
    found = np.concatenate([frame.confidence for frame in table])
    np.testing.assert_allclose(np.sort(found), np.sort(np.minimum(every[every > 0] / scale, 1)))
    assert f"divided by {scale:.3g}, their 99 % quantile, and clipped to 1" in table.notes[0]


def test_coco_s_visibilities(tmp_path, rig):
    people = people_of(COCO_17)
    for each in (person for frames in people.values() for found in frames for person in found):
        each[:, 2] = np.where(each[:, 2] > 0.6, 2, np.where(each[:, 2] > 0, 1, 0))
    coco(tmp_path, people)
    table = read_detections(tmp_path, rig)
    assert {score for frame in table for score in frame.confidence.tolist()} == {0.5, 1.0}
    assert "COCO visibilities" in table.notes[0]


def test_frames_that_only_some_cameras_list(tmp_path, rig):
    """COCO's results have no line for a frame without people: the other cameras tell that it was
    there.
    """
    people = people_of(COCO_17)
    people["right"] = [[], people["right"][0], []]
    coco(tmp_path, people)
    table = read_detections(tmp_path, rig)
    assert [sorted(set(frame.view.tolist())) for frame in table] == [[0], [1], [0]]


def test_pictures_without_people_are_frames_where_the_file_lists_them(tmp_path, rig):
    """Of 50 pictures, people are in 37 to 39: frame 37 of the result is picture 37."""
    person = people_of(COCO_17)["left"][0][0]
    frames = [[person] if number in (37, 38, 39) else [] for number in range(50)]
    coco_data_set(tmp_path, dict.fromkeys(rig.names, frames))
    table = read_detections(tmp_path, rig)
    assert [number for number, frame in enumerate(table) if len(frame) > 0] == [37, 38, 39] and len(
        table
    ) == 50
    assert not any("frame 0 has number" in note for note in table.notes)


@pytest.mark.parametrize("write", [coco, alphapose])
def test_lists_that_begin_without_people_keep_their_numbers(tmp_path, rig, write):
    person = people_of(COCO_17)["left"][0][0]
    write(tmp_path, dict.fromkeys(rig.names, [[]] * 37 + [[person]] * 3))
    table = read_detections(tmp_path, rig)
    assert [number for number, frame in enumerate(table) if len(frame) > 0] == [37, 38, 39] and len(
        table
    ) == 40
    assert table.first == 37 and not any("number" in note for note in table.notes)


def test_numbers_too_high_for_frames_count_from_the_first_and_it_is_said(tmp_path, rig):
    keypoints = people_of(COCO_17)["left"][0][0].ravel().tolist()
    found = [{"image_id": 10_128_340_000 + number, "keypoints": keypoints} for number in range(3)]
    for name in rig.names:
        (tmp_path / f"{name}.json").write_text(json.dumps(found))
    table = read_detections(tmp_path, rig)
    assert len(table) == 3 and table.first == 0
    assert "frame 0 has number 10128340000 in the files" in table.notes


def test_numbers_in_are_numbers_out_of_an_operating_room(shared_data):
    """MVOR's second detector sees nobody in the first moment; the truth of moment 1 is then in
    frame 1.
    """
    rig = read_rig(shared_data / "mvor" / "rig.json")
    tables = [read_detections(shared_data / "mvor" / name, rig) for name in ("openpose", "rtpose")]
    assert [len(table) for table in tables] == [387, 387] and [table.first for table in tables] == [
        0,
        1,
    ]
    for view, name in enumerate(rig.names):
        found = json.loads((shared_data / "mvor" / "rtpose" / f"{name}.json").read_text())
        numbers = {each["image_id"] for each in found}
        assert {t for t, frame in enumerate(tables[1]) if view in frame.view} == numbers


def test_what_macos_leaves_beside_a_file_is_no_frame(tmp_path, rig):
    openpose(tmp_path, people_of(COCO_18))
    (tmp_path / "left" / "._left_000000000000_keypoints.json").write_bytes(b"\0\5\26\7")
    assert len(read_detections(tmp_path, rig)) == 3


def test_files_with_a_suffix_in_capitals(tmp_path, rig):
    """As programs on Windows write them: a file per frame, or one per camera."""
    openpose(tmp_path, people_of(COCO_18))
    wanted = read_detections(tmp_path, rig)
    for file in tmp_path.glob("*/*.json"):
        file.rename(file.with_suffix(".JSON"))
    found = read_detections(tmp_path, rig)
    assert len(found) == len(wanted) and found.notes == wanted.notes
    np.testing.assert_array_equal(found[0].xy, wanted[0].xy)
    assert reading.camera_names(tmp_path) == ["left", "right"]
    (tmp_path / "whole").mkdir()
    coco(tmp_path / "whole", people_of(COCO_17))
    for file in (tmp_path / "whole").glob("*.json"):
        file.rename(file.with_suffix(".JSON"))
    assert len(read_detections(tmp_path / "whole", rig)) == 3


@pytest.mark.parametrize("form", ["NFC", "NFD"])
def test_names_of_cameras_in_another_unicode_form(tmp_path, rig, form):
    """As macOS writes them; the calibration has the other form."""
    names = "Größe", "カメラ ガ"
    other = {"NFC": "NFD", "NFD": "NFC"}[form]
    there = [unicodedata.normalize(form, name) for name in names]
    cameras = [
        replace(camera, name=unicodedata.normalize(other, name))
        for camera, name in zip(rig.cameras, names, strict=True)
    ]
    people = people_of(COCO_18)
    openpose(tmp_path, dict(zip(there, people.values(), strict=True)))
    assert len(read_detections(tmp_path, replace(rig, cameras=tuple(cameras)))) == 3


def test_scores_that_are_all_zero_are_noted(tmp_path, rig):
    people = people_of(COCO_18)
    for frames in people.values():
        for each in [one for found in frames for one in found]:
            each[:, 2] = 0
    openpose(tmp_path, people)
    (said,) = [each for each in read_detections(tmp_path, rig).notes if "scores" in each]
    assert said.startswith("all scores are 0, so that no joint counts as detected")


def test_text_as_windows_writes_it(tmp_path, rig):
    openpose(tmp_path, people_of(COCO_18))
    file = tmp_path / "left" / "left_000000000001_keypoints.json"
    text = file.read_text()
    file.write_text(text, encoding="utf-8-sig")
    assert len(read_detections(tmp_path, rig)) == 3
    file.write_text(text, encoding="utf-16")
    refuses(tmp_path, rig, f"{file.name}: this is UTF-16 text; save it as UTF-8")


def test_a_number_that_no_frame_has(tmp_path, rig):
    openpose(tmp_path, people_of(COCO_18))
    for file in (tmp_path / "left").iterdir():
        file.unlink()
    (tmp_path / "left" / "100000000000000000000_keypoints.json").write_text('{"people": []}')
    refuses(tmp_path, rig, "100000000000000000000_keypoints.json: this frame number")


USER = """
name = "ours"
keypoints = ["head", "", "r_sho", "l_sho", "r_hip", "l_hip", "r_wri", "l_wri"]
limbs = [["head", "neck"], ["neck", "r_sho"], ["neck", "l_sho"], ["neck", "MidHip"],
         ["r_sho", "r_wri"],
         ["l_sho", "l_wri"]]
mirror = [["r_sho", "l_sho"], ["r_hip", "l_hip"], ["r_wri", "l_wri"]]
anchor = ["r_hip", "l_hip"]

[middles]
neck = ["r_sho", "l_sho"]

[body]
head = "Nose"
neck = "Neck"
r_sho = "RShoulder"
l_sho = "LShoulder"
r_hip = "RHip"
l_hip = "LHip"
r_wri = "RWrist"
l_wri = "LWrist"
"""


def test_a_skeleton_of_the_user_s_own(tmp_path, rig):
    (tmp_path / "ours.toml").write_text(USER)
    rng = np.random.default_rng(0)
    person = np.column_stack([rng.uniform(100, 700, (8, 2)), rng.uniform(0.3, 0.9, 8)])
    openpose(tmp_path, {name: [[person]] for name in rig.names})
    table = read_detections(tmp_path, rig, tmp_path / "ours.toml")
    skeleton = table.skeleton
    assert skeleton.joints == tuple(
        "Nose RShoulder LShoulder RHip LHip RWrist LWrist Neck MidHip".split()
    )
    assert skeleton.anchor == (skeleton.index("RHip"), skeleton.index("LHip"))
    assert [
        skeleton.joints[skeleton.parents[skeleton.index(name)]]
        for name in ("Neck", "Nose", "RWrist")
    ] == [
        "MidHip",
        "Neck",
        "RShoulder",
    ]
    assert len(table[0]) == 2 * 9  # eight keypoints less one, and two middles
    hip = table[0].joint == skeleton.index("MidHip")
    np.testing.assert_allclose(table[0].xy[hip], np.tile(person[[4, 5], :2].mean(axis=0), (2, 1)))
    np.testing.assert_allclose(table[0].confidence[hip], person[[4, 5], 2].min())


def test_the_skeleton_of_the_documents(tmp_path):
    page = (Path(__file__).parents[2] / "docs" / "joints.md").read_text()
    (block,) = re.findall(r"```toml\n(name = .*?)```", page, flags=re.DOTALL)
    (tmp_path / "ours.toml").write_text(block)
    skeleton = read_skeleton(tmp_path / "ours.toml")
    assert skeleton.joints == tuple("Nose RShoulder LShoulder RHip LHip Neck MidHip".split())
    assert skeleton.keypoints == (0, -1, 1, 2, 3, 4)


BAD_SKELETONS = [
    (
        'head = "Nose"',
        'head = "Tail"',
        "the body has no point 'Tail'; write under [body] which of its points head is",
    ),
    ('["head", "neck"]', '["head", "throat"]', "ours has no joint 'throat'; it has Nose"),
    ('["r_sho", "r_wri"],', "", "no limbs connect the anchor MidHip with RWrist; add limbs"),
    ('anchor = ["r_hip", "l_hip"]', 'anchor = "head"', "ours has no joint 'MidHip'; it has Nose"),
    (
        'anchor = ["r_hip", "l_hip"]',
        'anchor = ["r_sho", "l_sho"]',
        "an anchor of two joints must be the right and the left hip",
    ),
    ('name = "ours"', "", "name is missing; docs/joints.md describes the file"),
    ('neck = "Neck"', 'nick = "Neck"', "body.nick is not a keypoint of ours; it has head"),
    ('r_wri = "RWrist"', 'r_wri = "LWrist"', "joint LWrist occurs twice"),
    ("limbs = [", "limbs = ", "cannot be read as TOML"),
    (
        'neck = ["r_sho", "l_sho"]',
        'neck = ["neck", "l_sho"]',
        "the midpoint Neck uses Neck, which must be a key",
    ),
    (
        'neck = ["r_sho", "l_sho"]',
        'neck = ["MidHip", "l_sho"]',
        "the midpoint Neck uses MidHip, which must be",
    ),
    (
        "[middles]",
        "core = []\n[middles]",
        "core must have at least one joint, by which a person is found",
    ),
]


@pytest.mark.parametrize(("old", "new", "sentence"), BAD_SKELETONS)
def test_bad_skeleton(tmp_path, rig, old, new, sentence):
    path = tmp_path / "ours.toml"
    assert old in USER
    path.write_text(USER.replace(old, new))
    openpose(tmp_path, people_of(COCO_18))
    with pytest.raises(InputError) as caught:
        read_detections(tmp_path, rig, path)
    assert str(caught.value).startswith(f"{path}: ") and sentence in str(caught.value)
    assert "\n" not in str(caught.value)


def test_a_named_skeleton(tmp_path, rig):
    openpose(tmp_path, people_of(COCO_133))
    assert read_detections(tmp_path, rig, "COCO_133").skeleton is COCO_133
    refuses(tmp_path, rig, "with 133 keypoints per person, but COCO_17 has 17", skeleton="COCO_17")
    with pytest.raises(
        InputError,
        match="COCO_99: this is neither a file nor a known skeleton; give a TOML file, or one of",
    ):
        read_detections(tmp_path, rig, "COCO_99")


def refuses(folder: Path, rig: Rig, *parts: str, skeleton: str | None = None) -> None:
    with pytest.raises(InputError) as caught:
        read_detections(folder, rig, skeleton)
    message = str(caught.value)
    assert message.startswith(str(folder)) and "\n" not in message
    for part in parts:
        assert part in message


def test_unknown_numbers_of_keypoints(tmp_path, rig):
    openpose(tmp_path, {name: [[np.full((12, 3), 0.5) * 100]] for name in rig.names})
    refuses(
        tmp_path,
        rig,
        "recognised as OpenPose's JSON with 12 keypoints per person, which is not a known layout",
    )
    (tmp_path / "b").mkdir()
    coco(tmp_path / "b", {name: [[np.full((21, 3), 50.0)]] for name in rig.names})
    refuses(
        tmp_path / "b",
        rig,
        "COCO's keypoint results with 21 keypoints",
        "--skeleton",
        "26 (HALPE_26)",
    )


def test_people_of_two_models(tmp_path, rig):
    openpose(tmp_path, {"left": people_of(BODY_25)["left"], "right": people_of(COCO_18)["right"]})
    refuses(
        tmp_path,
        rig,
        "left has people of 25 keypoints",
        "right of 18; give the detections of one model",
    )
    (tmp_path / "b").mkdir()
    mixed = [[people_of(COCO_17)["left"][0][0], people_of(HALPE_26)["left"][0][0]]]
    coco(tmp_path / "b", {"left": mixed, "right": mixed})
    refuses(
        tmp_path / "b",
        rig,
        "recognised as COCO's keypoint results, but people have 17 and 26 keypoints; give the",
    )


BAD_FILES = [
    (
        '{"a": 1}',
        "recognised as JSON (an object), but a list of people with image_id (COCO, AlphaPose)",
    ),
    ("[{]", "line 1 column 3 is not JSON"),
    ('[{"image_id": 1}]', "[0].keypoints is missing; write the results again, in pixels"),
    (
        '[{"image_id": 1, "keypoints": [1, 2]}]',
        "[0].keypoints must hold x, y and score of each keypoint, got 2",
    ),
    (
        '[{"image_id": "a.jpg", "keypoints": [1, 2, 3]}]',
        "[0].image_id 'a.jpg' has no frame number; run AlphaPose",
    ),
    (
        '[{"frame_id": 0, "instances": [{"keypoints": [[1]], "keypoint_scores": [1]}]}]',
        "keypoints must hold x, y and score of each keypoint, got 2",
    ),
    (
        '[{"frame_id": 0, "instances": [{"keypoints": [], "keypoint_scores": [1]}]}]',
        "0 keypoints, but 1 keypoint_sc",
    ),
    ('[{"frame_id": -1, "instances": []}]', "[0].frame_id"),
    (
        '[{"image_id": 99999999999999, "keypoints": [1, 2, 3]}]',
        "[0].image_id '99999999999999' is not a frame number",
    ),
    (
        '[{"image_id": -5, "keypoints": [1, 2, 3]}]',
        "[0].image_id '-5' is not a frame number; write the results again",
    ),
    (
        (
            '[{"image_id": "a/7.jpg", "keypoints": [1, 2, 3]}, '
            '{"image_id": "b/7.jpg", "keypoints": '
            "[1, 2, 3]}]"
        ),
        "the pictures 'a/7.jpg' and 'b/7.jpg' have the same frame number 7; run AlphaPose again",
    ),
    ('{"images": [{"id": [1]}], "annotations": []}', "images[0].id must be a whole number or text"),
    ('{"annotations": 3}', "the file must be a list, got 3"),
]


@pytest.mark.parametrize(("text", "sentence"), BAD_FILES)
def test_bad_file_of_one_camera(tmp_path, rig, text, sentence):
    coco(tmp_path, people_of(COCO_17))
    (tmp_path / "right.json").write_text(text)
    with pytest.raises(InputError) as caught:
        read_detections(tmp_path, rig)
    assert str(caught.value).startswith(f"{tmp_path / 'right.json'}: ") and sentence in str(
        caught.value
    )
    assert "\n" not in str(caught.value)


def test_mmpose_pictures_that_do_not_fit(tmp_path, rig):
    mmpose_pictures(tmp_path, people_of(COCO_17))
    file = tmp_path / "left" / "000001.json"
    file.write_text('[{"keypoints": [[1, 2]], "keypoint_scores": [1, 1]}]')
    with pytest.raises(
        InputError, match=r"000001\.json: \[0\]: there are 1 keypoints, but 2 keypoint_scores"
    ):
        read_detections(tmp_path, rig)


def test_a_few_joints_far_outside_the_picture_are_left_out_and_said(tmp_path, rig):
    person = np.column_stack([np.full((25, 2), 300.0), np.full(25, 0.8)])
    stray = person.copy()
    stray[4, :2] = 5000
    openpose(tmp_path, {"left": [[person] * 4 + [stray]], "right": [[person] * 5]})
    table: DetectionTable = read_detections(tmp_path, rig)
    assert len(table[0]) == 249
    _, note = table.notes
    assert "frame 0 has a joint at pixel (5000, 5000), far outside the 1001 x 801" in note
    assert "1 joint of 125 (0.8%) left out" in note


def test_ids_of_pictures_that_are_no_frames(tmp_path, rig):
    coco(tmp_path, people_of(COCO_17))
    (tmp_path / "right.json").write_text(
        json.dumps([{"image_id": 900_100_200, "keypoints": [5.0, 5, 0.5] * 17}])
    )
    refuses(
        tmp_path,
        rig,
        "but its frames would run from 0 to 900100200; number the pictures by their frames",
    )


def test_nobody_anywhere(tmp_path, rig):
    openpose(tmp_path, {name: [[], []] for name in rig.names})
    assert [len(frame) for frame in read_detections(tmp_path, rig)] == [0, 0]
    (tmp_path / "b").mkdir()
    coco(tmp_path / "b", {name: [[]] for name in rig.names})
    refuses(tmp_path / "b", rig, "recognised as COCO's keypoint results, but no camera has a frame")


def test_a_format_of_the_user_s_own(tmp_path, rig):
    """An entry in the registry and a function: which files are whose, scores and skeletons are as
    of every other.
    """
    people = people_of(COCO_17)
    for name, frames in people.items():
        rows = [[frame, *person.ravel()] for frame, found in enumerate(frames) for person in found]
        np.savetxt(tmp_path / f"{name}.csv", np.array(rows), delimiter=",", fmt="%.17g")

    def read(file: Path, camera: Camera) -> CameraPeople:
        rows = np.loadtxt(file, delimiter=",", ndmin=2)
        block = PeopleBlock(rows[:, 0].astype(np.intp), rows[:, 1:].reshape(len(rows), -1, 3))
        return CameraPeople(file, "our CSV", iter([block]), 0, 2)

    ours = reading.DetectionFormat("our CSV", ("{}.csv",), read)
    reading.FORMATS.insert(0, ours)
    try:
        table = read_detections(tmp_path, rig)
    finally:
        reading.FORMATS.remove(ours)
    coco(tmp_path, people)
    expected = read_detections(tmp_path, rig)
    assert table.skeleton is COCO_17 and len(table) == len(expected) == 3
    for mine, theirs in zip(table, expected, strict=True):
        # That writer lists people in another order.
        np.testing.assert_allclose(*(np.sort(each.xy[:, 0]) for each in (mine, theirs)), atol=1e-9)
        assert len(mine.pairs) == len(theirs.pairs)
