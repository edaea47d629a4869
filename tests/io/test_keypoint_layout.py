"""Which joints keypoints are: names in the files, a project's settings, the user's word, their
number.
"""

import json
from pathlib import Path

import numpy as np
import pytest

from shapepose_fg.body.fitting.priors import PosePrior
from shapepose_fg.body.model.body_model import BodyModel, BodyParameters
from shapepose_fg.core.camera import Camera, Rig
from shapepose_fg.core.detections import Recording
from shapepose_fg.core.errors import InputError
from shapepose_fg.core.frame_times import FrameTimes
from shapepose_fg.core.joint_names import keypoint_names
from shapepose_fg.core.skeleton import BODY_25, COCO_17, SKELETONS
from shapepose_fg.io.calibration import read_rig
from shapepose_fg.io.detections import read_detections
from shapepose_fg.io.pose2sim_project import read_pose2sim_project
from shapepose_fg.pipeline.pipeline import reconstruct

K = np.array([[1000.0, 0, 500], [0, 1000, 400], [0, 0, 1]])


@pytest.fixture
def rig() -> Rig:
    poses = [np.eye(4), np.eye(4)]
    poses[1][0, 3] = 1
    return Rig(
        tuple(Camera(name, K, pose, (1001, 801)) for name, pose in zip("ab", poses, strict=True)),
        "-y",
    )


def spelt(point: str) -> str:
    """A joint as COCO and MMPose spell it."""
    if point in ("head", "Head", "spine2"):
        return {"head": "upper_neck", "Head": "head_top", "spine2": "spine"}[point]
    return (
        {"R": "right_", "L": "left_"}.get(point[0], "") + point[1:].lower()
        if point[1:2].isupper()
        else point
    )


def person(names: list[str]) -> list[list[float]]:
    """x and y of a standing person's joints, each told by its place."""
    return [[300.0 + 7 * place, 200.0 + 3 * place] for place in range(len(names))]


def data_set(names: list[str] | None, count: int) -> dict:
    found = {"id": 1, "name": "person"} | ({} if names is None else {"keypoints": names})
    keypoints = [value for xy in person([""] * count) for value in (*xy, 0.9)]
    return {
        "images": [{"id": 5, "file_name": "img_000000.jpg"}],
        "annotations": [{"image_id": 5, "category_id": 1, "keypoints": keypoints}],
        "categories": [{"id": 2, "name": "dog", "keypoints": ["nose", "tail"]}, found],
    }


def video(meta: dict, count: int) -> dict:
    instance = {"keypoints": person([""] * count), "keypoint_scores": [0.9] * count}
    return {"meta_info": meta, "instance_info": [{"frame_id": 1, "instances": [instance]}]}


def written(folder: Path, *contents: dict) -> Path:
    for name, content in zip("ab", contents * (2 // len(contents)), strict=True):
        (folder / f"{name}.json").write_text(json.dumps(content))
    return folder


def places(table) -> dict[str, float]:
    """The column of each joint of the first camera's first person, which tells its place among the
    keypoints.
    """
    first = table[0].only(table[0].view == 0)
    made = [joint for joint, _, _ in table.skeleton.middles]
    return {
        table.skeleton.joints[joint]: round((x - 300) / 7)
        for joint, x in zip(first.joint.tolist(), first.xy[:, 0].tolist(), strict=True)
        if joint not in made
    }


NAMED = [each for each in SKELETONS.values() if all(keypoint_names(each))]


@pytest.mark.parametrize("skeleton", NAMED, ids=lambda each: each.name)
@pytest.mark.parametrize("write", ["data set", "video"])
def test_names_in_the_file_are_obeyed_in_any_order(tmp_path, rig, skeleton, write):
    order = np.random.default_rng(3).permutation(skeleton.keypoint_count)
    names = [keypoint_names(skeleton)[place] for place in order]
    spelled = [spelt(name) for name in names]
    meta = {
        "dataset_name": "coco",
        "keypoint_id2name": {str(n): name for n, name in enumerate(spelled)},
    }
    content = data_set(spelled, len(names)) if write == "data set" else video(meta, len(names))
    table = read_detections(written(tmp_path, content), rig)
    assert places(table) == {name: place for place, name in enumerate(names)}
    assert any("names its joints" in note for note in table.notes)


def test_a_data_set_s_name_is_obeyed(tmp_path, rig):
    assert (
        read_detections(written(tmp_path, video({"dataset_name": "h36m"}, 17)), rig).skeleton.name
        == "H36M_17"
    )
    assert (
        read_detections(written(tmp_path, video({"dataset_name": "coco"}, 17)), rig).skeleton
        is COCO_17
    )
    table = read_detections(written(tmp_path, video({"dataset_name": "horse10"}, 17)), rig)
    assert any("names horse10, which is no known layout" in note for note in table.notes)


def test_joints_that_a_body_lacks_are_passed_over_and_said(tmp_path, rig):
    names = [*keypoint_names(COCO_17), "mouth_left", "left_thumb"]
    table = read_detections(written(tmp_path, data_set(names, 19)), rig)
    assert table.skeleton.joints == COCO_17.joints
    assert any("ignored: mouth_left left_thumb" in note for note in table.notes)


def test_names_that_cannot_be_are_refused(tmp_path, rig):
    def refused(*contents: dict, **options) -> str:
        with pytest.raises(InputError) as caught:
            read_detections(written(tmp_path, *contents), rig, **options)
        return str(caught.value)

    names = keypoint_names(COCO_17)
    assert "names 17 joints, but its people have 18 keypoints" in refused(data_set(names, 18))
    assert "there is no RHip and no LHip" in refused(
        data_set([n if "Hip" not in n else "tail" for n in names], 17)
    )
    other = [names[0], *names[:0:-1]]
    assert "b.json names other joints than" in refused(data_set(names, 17), data_set(other, 17))
    assert "but BODY_25 has 25" in refused(data_set(names, 17), skeleton="BODY_25")


def test_the_user_s_word_goes_before_the_file_s_and_it_is_said(tmp_path, rig):
    table = read_detections(
        written(tmp_path, data_set(keypoint_names(COCO_17)[::-1], 17)), rig, "COCO_17"
    )
    assert table.skeleton is COCO_17
    assert any(
        "names its joints, but they are read as COCO_17, as requested" in note
        for note in table.notes
    )


@pytest.mark.parametrize(
    "names", [None, [], [f"kp{n}" for n in range(17)]], ids=["none", "empty", "numbers"]
)
def test_files_without_names_are_read_by_their_number(tmp_path, rig, names):
    table = read_detections(written(tmp_path, data_set(names, 17)), rig)
    assert table.skeleton is COCO_17
    assert any(
        "17 keypoints per person without joint names: read as COCO_17" in n for n in table.notes
    )


def test_mmpose_s_pictures_of_its_demo_are_read(tmp_path, rig):
    names = keypoint_names(SKELETONS["H36M_17"])
    meta = {"keypoint_id2name": {str(place): name for place, name in enumerate(names)}}
    for name in "ab":
        (tmp_path / name).mkdir()
        for frame in range(3):
            content = {
                "meta_info": meta,
                "instance_info": video({}, 17)["instance_info"][0]["instances"],
            }
            (tmp_path / name / f"results_{frame:06d}.json").write_text(json.dumps(content))
    table = read_detections(tmp_path, rig)
    assert len(table) == 3 and places(table) == {name: place for place, name in enumerate(names)}
    file = tmp_path / "a" / "results_000002.json"
    file.write_text(json.dumps({"meta_info": {"dataset_name": "coco"}, "instance_info": []}))
    with pytest.raises(InputError, match="names other joints than the first file"):
        read_detections(tmp_path, rig)


def project(folder: Path, pose: str, count: int = 25) -> Path:
    """A Pose2Sim project whose people have `count` keypoints, and [pose] says `pose`."""
    (folder / "calibration").mkdir(parents=True)
    table = (
        '[{0}]\nname = "{0}"\nsize = [1001.0, 801.0]\n'
        "matrix = [[1000.0, 0, 500], [0, 1000.0, 400], [0, 0, 1]]\n"
        "distortions = [0.0, 0.0, 0.0, 0.0]\nrotation = [0.0, 0.0, 0.0]\n"
        "translation = [{1}, 0.0, 0.0]\n"
        "fisheye = false\n"
    )
    calibration = table.format("a", "0.0") + table.format("b", "1.0")
    (folder / "calibration" / "Calib.toml").write_text(calibration)
    (folder / "Config.toml").write_text(f"{pose}\n[project]\nframe_rate = 30\n")
    values = [value for xy in person([""] * count) for value in (*xy, 0.9)]
    for name in "ab":
        (folder / "pose" / f"{name}_json").mkdir(parents=True)
        file = folder / "pose" / f"{name}_json" / f"{name}_000000.json"
        file.write_text(json.dumps({"people": [{"pose_keypoints_2d": values}]}))
    return folder


CUSTOM = """
[pose]
pose_model = "MINE"
[pose.MINE]
name = "CHip"
id = "None"
  [[pose.MINE.children]]
  name = "RHip"
  id = 3
    [[pose.MINE.children.children]]
    name = "RKnee"
    id = "4"
  [[pose.MINE.children]]
  name = "LHip"
  id = 2
  [[pose.MINE.children]]
  name = "RShoulder"
  id = 0
  [[pose.MINE.children]]
  name = "LShoulder"
  id = 1
"""


@pytest.mark.parametrize(
    ("pose", "count", "name", "said"),
    [
        ("[pose]\npose_model = 'BODY_25B'", 25, "BODY_25B", "pose.pose_model names BODY_25B"),
        ("[pose]\npose_model = 'Body_with_feet'", 26, "HALPE_26", "names Body_with_feet"),
        ("[pose]\npose_model = 'COCO'", 18, "COCO_18", "names COCO"),
        ("[pose]\npose_model = 'MPII'", 15, "MPI_15", "names MPII"),
        ("[pose]\npose_model = 'BLAZEPOSE'", 33, "BLAZEPOSE_33", "names BLAZEPOSE"),
        (
            "[pose]\npose_model = 'Body_with_feet'",
            17,
            "COCO_17",
            "which has 26 keypoints instead of 17",
        ),
        ("[pose]\npose_model = 'unheard_of'", 17, "COCO_17", "which is no known layout"),
        ("[pose]\n", 17, "COCO_17", "without joint names"),
        (CUSTOM, 8, "NAMED_8", "names its joints"),
    ],
)
def test_a_project_s_pose_model_is_obeyed(tmp_path, pose, count, name, said):
    found = read_pose2sim_project(project(tmp_path / "trial", pose, count))
    table = read_detections(found.detections, read_rig(found.calibration), found.joints)
    assert table.skeleton.name == name and any(said in note for note in table.notes)
    if name == "NAMED_8":
        assert places(table) == {"RShoulder": 0, "LShoulder": 1, "LHip": 2, "RHip": 3, "RKnee": 4}


def test_a_project_that_makes_no_sense_is_refused(tmp_path):
    with pytest.raises(InputError, match="pose must be a table"):
        read_pose2sim_project(project(tmp_path / "trial", "pose = 3"))


def test_human36m_s_names_in_a_real_coco_file(shared_cases):
    rig = read_rig(shared_cases / "body25b" / "Calib_qca.toml")
    table = read_detections(shared_cases / "h36m_coco" / "detections_end_to_end", rig)
    assert {"MidHip", "LHip", "RHip", "Neck", "Head", "LAnkle", "RWrist"} <= set(
        table.skeleton.joints
    )
    # The feet are where people stand: the lowest in every picture.
    frame = table[0]
    ankles = np.isin(frame.joint, [table.skeleton.index("LAnkle"), table.skeleton.index("RAnkle")])
    assert frame.xy[ankles, 1].min() > frame.xy[~ankles, 1].mean()


def test_mmpose_s_cases(shared_cases, rig):
    table = read_detections(shared_cases / "mmpose" / "mm_video_h36m", rig_of(rig, (1920, 1080)))
    assert "spine2" in table.skeleton.joints and "Nose" not in table.skeleton.joints
    table = read_detections(shared_cases / "mmpose" / "mm_image_demo", rig_of(rig, (1920, 1080)))
    assert table.skeleton is COCO_17 and len(table) == 20


def rig_of(rig: Rig, size: tuple[int, int]) -> Rig:
    return Rig(tuple(Camera(each.name, each.K, each.wTc, size) for each in rig.cameras), rig.up)


def looks(points: list[str], people: int, seed: int) -> np.ndarray:
    """(N, K, 3) people in many poses before a camera 4 m away, pixels; some joints are not seen."""
    rng = np.random.default_rng(seed)
    known = [point or "Nose" for point in points]
    body = BodyModel.default().with_keypoints(tuple(dict.fromkeys(known)))
    turn = np.column_stack(
        [rng.normal(0, 0.2, people), rng.uniform(-3, 3, people), np.zeros(people)]
    )
    poses, nowhere = PosePrior.default().sample(rng, people), np.zeros((people, 3))
    xyz = body.keypoints(BodyParameters(rng.normal(0, 0.7, (people, 10)), turn, poses, nowhere))
    xyz = xyz[:, [body.keypoint_names.index(point) for point in known]]
    xy = (
        [500, 400]
        + np.array([300, -300]) * xyz[..., :2] / (xyz[..., 2:] / 4 + 1)
        + rng.normal(0, 4, xyz[..., :2].shape)
    )
    xy[:, [not point for point in points]] += rng.normal(0, 20, 2)
    score = np.where(rng.random(xy.shape[:2]) < 0.1, 0.0, 0.8)
    return np.concatenate([xy, score[..., None]], axis=2) * (score[..., None] > 0)


def results(folder: Path, **people: np.ndarray) -> Path:
    """COCO's results of each camera, a person a frame."""
    for name, found in people.items():
        rows = [{"image_id": t, "keypoints": each.ravel().tolist()} for t, each in enumerate(found)]
        (folder / f"{name}.json").write_text(json.dumps(rows))
    return folder


SHARED = [
    each
    for each in SKELETONS.values()
    if sum(e.keypoint_count == each.keypoint_count for e in SKELETONS.values()) > 1
]


@pytest.mark.parametrize("skeleton", SHARED, ids=lambda each: each.name)
def test_how_people_look_tells_layouts_of_one_number_apart(tmp_path, rig, skeleton):
    names = keypoint_names(skeleton)
    table = read_detections(results(tmp_path, a=looks(names, 200, 1), b=looks(names, 200, 2)), rig)
    # POSETRACK_17 has COCO's joints, but for two of the head.
    assert table.skeleton.name == skeleton.name or (skeleton.name, table.skeleton.name) == (
        "POSETRACK_17",
        "COCO_17",
    )
    assert any(
        f"without joint names: read as {table.skeleton.name}" in note for note in table.notes
    )


def test_a_few_people_are_enough_for_layouts_that_differ_much(tmp_path, rig):
    names = keypoint_names(SKELETONS["BODY_25B"])
    table = read_detections(results(tmp_path, a=looks(names, 4, 1), b=looks(names, 4, 2)), rig)
    assert table.skeleton.name == "BODY_25B" and "not as BODY_25" in " ".join(table.notes)


def test_people_who_look_like_no_layout_leave_the_most_usual_and_it_is_said(tmp_path, rig):
    mixed = looks(keypoint_names(SKELETONS["BODY_25B"]), 60, 1)[
        :, np.random.default_rng(0).permutation(25)
    ]
    mixed[..., :2] = np.random.default_rng(1).uniform(200, 600, mixed[..., :2].shape)
    table = read_detections(results(tmp_path, a=mixed, b=mixed), rig)
    assert table.skeleton is BODY_25 and any(
        "people look like none of them" in note for note in table.notes
    )


def test_cameras_of_two_models_are_refused(tmp_path, rig):
    one, other = (looks(keypoint_names(SKELETONS[name]), 60, 1) for name in ("BODY_25", "BODY_25B"))
    with pytest.raises(
        InputError,
        match=r"arranged as BODY_25, those of .* as BODY_25B; give the detections",
    ):
        read_detections(results(tmp_path, a=one, b=other), rig)


def test_openpose_s_body_25b_is_recognised(shared_cases):
    """Real detections: read as BODY_25 wrists are half a metre off."""
    rig = read_rig(shared_cases / "body25b" / "Calib_qca.toml")
    table = read_detections(shared_cases / "body25b" / "detections", rig)
    assert table.skeleton.name == "BODY_25B" and {"Neck", "MidHip"} <= set(table.skeleton.joints)


@pytest.mark.parametrize(
    ("folder", "name"),
    [
        ("mvor/openpose", "COCO_17"),
        ("mvor/rtpose", "COCO_17"),
        ("mvor/alphapose", "MPII_16"),
        ("pose2sim_single/openpose", "BODY_25"),
    ],
)
def test_real_recordings_are_what_they_are(shared_data, folder, name):
    rig = read_rig(shared_data / folder.split("/")[0] / "rig.json")
    assert read_detections(shared_data / folder, rig).skeleton.name == name


def test_names_are_text_of_strangers(tmp_path, rig):
    """Names do not reach the terminal as they are, nor take long."""
    names = [*keypoint_names(COCO_17), "\x1b[31mred\nline", "(" * 200_000, "left_" * 50_000]
    table = read_detections(written(tmp_path, data_set(names, 20)), rig)
    said = " ".join(table.notes)
    assert said.isprintable() and len(said) < 2000 and table.skeleton.joints == COCO_17.joints
    table = read_detections(written(tmp_path, video({"dataset_name": "\x1b" * 5000}, 17)), rig)
    assert " ".join(table.notes).isprintable()


def median_error_m(people, joints: np.ndarray, names: list[str]) -> float:
    """Median over joints and frames of the distance to one person's (T, K, 3) joints, of who is
    nearest.
    """
    shared = [
        name
        for name in people.joint_names.tolist()
        if name in names and name not in ("Neck", "Head")
    ]
    found = people.joints[:, [people.joint_names.tolist().index(name) for name in shared]]
    wanted = joints[people.frame][:, [names.index(name) for name in shared]]
    apart = np.linalg.norm(found - wanted, axis=2)
    return min(
        float(np.nanmedian(apart[people.person == each])) for each in np.unique(people.person)
    )


@pytest.mark.slow
@pytest.mark.parametrize("folder", ["body25b/detections", "h36m_coco/detections_end_to_end"])
def test_real_people_are_where_pose2sim_has_them(shared_cases, folder):
    """Pose2Sim's own result of the same detections: 24 mm away, 500 mm with joints of other
    names.
    """
    rows = (shared_cases / "body25b" / "demo_0-100.trc").read_text().split("\n")
    names = [name for name in rows[3].split("\t")[2:] if name.strip()]
    values = [
        [float(value or "nan") for value in row.split("\t")[2:]] for row in rows[5:] if row.strip()
    ]
    truth = np.array([row[: 3 * len(names)] for row in values]).reshape(len(values), -1, 3)[
        ..., [2, 0, 1]
    ]
    rig = read_rig(shared_cases / "body25b" / "Calib_qca.toml")
    detections = read_detections(shared_cases / folder, rig)
    frames = Recording(detections.skeleton, [detections[t] for t in range(40)])
    people = reconstruct(frames, rig, times=FrameTimes.from_fps(60, 40))
    assert median_error_m(people, truth, names) < 0.06
