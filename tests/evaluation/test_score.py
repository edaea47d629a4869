"""`evaluate`: people in the layouts of data sets, scored against a truth."""

import json
from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from shapepose_fg.cli.main import main
from shapepose_fg.core.errors import InputError
from shapepose_fg.core.joint_names import keypoint_names
from shapepose_fg.core.skeleton import BODY_25, SKELETONS, SMPL_24
from shapepose_fg.evaluation.metrics import PlainPeople
from shapepose_fg.evaluation.score import aligned, score
from shapepose_fg.evaluation.shelf import SHELF_JOINTS
from shapepose_fg.evaluation.truth import read_people
from shapepose_fg.io.export.registry import FORMATS, export_result
from shapepose_fg.simulation import built_in_scene
from shapepose_fg.simulation.files import truth_of

COVARIANCE = 0.02**2 * np.eye(3)


@pytest.fixture(scope="module")
def truth():
    """The people of the built-in scene in 12 frames."""
    return truth_of(built_in_scene().part(range(12)))


def plain(truth, **more):
    return PlainPeople(truth.frame, truth.joints, truth.person, BODY_25.joints, **more)


def noisy(truth, sigma_m=0.02):
    rng = np.random.default_rng(0)
    joints = truth.joints + sigma_m * rng.normal(size=truth.joints.shape)
    covariance = np.broadcast_to(COVARIANCE, (*joints.shape, 3))
    return replace(plain(truth), joints=joints, covariance=covariance)


def evaluate(*arguments):
    with pytest.raises(SystemExit) as end:
        main(["evaluate", *map(str, arguments)])
    return end.value.code


def test_the_truth_itself_is_perfect(truth):
    made = score(plain(truth), plain(truth))
    perfect = dict.fromkeys("pcp recall mota idf1 hota det_a ass_a".split(), 100.0)
    errors = {"mpjpe_mm": 0.0, "pa_mpjpe_mm": 0.0}
    figures = {name: value for name, value in made.figures.items() if "inside" not in name}
    assert figures == pytest.approx(perfect | errors, abs=1e-9)
    assert np.isnan(made.figures["inside_95"])  # without covariances
    assert made.frames == 12 and set(made.joints) == set(BODY_25.joints)


def test_noise_is_measured(truth):
    """2 cm per axis: the mean length of the error is sigma sqrt(8 / pi)."""
    made = score(noisy(truth), plain(truth)).figures
    assert made["mpjpe_mm"] == pytest.approx(20 * np.sqrt(8 / np.pi), rel=0.05)
    assert made["pa_mpjpe_mm"] < made["mpjpe_mm"]
    assert made["inside_50"] == pytest.approx(50, abs=6)
    assert made["inside_95"] == pytest.approx(95, abs=3)
    small = score(noisy(truth, 0.04), plain(truth)).figures
    assert small["inside_95"] < 70


def test_swapped_identities_and_strangers_count(truth):
    middle = truth.frame >= 6
    swapped = replace(plain(truth), person=np.where(middle, (truth.person + 1) % 4, truth.person))
    made = score(swapped, plain(truth))
    assert made.figures["mpjpe_mm"] == 0 and made.tracks.switches == 4
    assert made.figures["mota"] == pytest.approx(100 * (1 - 4 / 48))
    assert made.figures["idf1"] == pytest.approx(50)
    stranger = truth.frame[truth.person == 0]
    more = PlainPeople(
        np.concatenate([truth.frame, stranger]),
        np.concatenate([truth.joints, truth.joints[truth.person == 0] + 5]),
        np.concatenate([truth.person, np.full(12, 9)]),
    )
    made = score(more, plain(truth))
    assert made.tracks.false_positives == 12
    assert made.figures["mota"] == pytest.approx(75)
    unnamed = score(replace(more, identified=False), plain(truth))
    assert unnamed.tracks is None and np.isnan(unnamed.figures["idf1"])
    assert unnamed.figures["pcp"] == 100


def test_only_frames_that_both_cover_are_scored(truth):
    part = replace(plain(truth), covered=[range(0, 4)])
    kept = truth.frame < 3
    part = replace(part, frame=truth.frame[kept], joints=truth.joints[kept],
                   person=truth.person[kept])  # fmt: skip
    made = score(part, plain(truth))
    assert (
        made.frames == 4 and made.tracks.misses == 4
    )  # the run covers frame 3, and is empty there
    assert score(part, plain(truth), range(2)).tracks.misses == 0
    whole = replace(part, covered=[range(10**12)])  # what a file says is not expanded
    assert score(whole, replace(plain(truth), covered=[range(10**12)])).frames == 12
    assert score(whole, plain(truth), range(2, 10**12)).frames == 10
    with pytest.raises(InputError, match="annotated frames: 0-11"):
        score(part, plain(truth), range(20, 30))
    early = replace(plain(truth), frame=plain(truth).frame - 100)
    with pytest.raises(InputError, match="before frame 0, check --offset"):
        score(part, replace(early, covered=None))
    nobody = plain(truth)
    nobody = replace(
        nobody, frame=nobody.frame[:0], person=nobody.person[:0], joints=nobody.joints[:0]
    )
    with pytest.raises(InputError, match="the truth has no people, check --truth"):
        score(part, replace(nobody, covered=None))


def test_alignment_undoes_a_similarity():
    rng = np.random.default_rng(1)
    joints = rng.normal(size=(3, 10, 3))
    turn = Rotation.random(3, random_state=2).as_matrix()
    moved = 1.3 * joints @ turn.swapaxes(1, 2) + [1, 2, 3]
    moved[0, 4] = np.nan
    back = aligned(moved, joints)
    np.testing.assert_allclose(np.delete(back[0], 4, 0), np.delete(joints[0], 4, 0), atol=1e-9)
    np.testing.assert_allclose(back[1:], joints[1:], atol=1e-9)
    assert np.linalg.norm(aligned(joints * [1, 1, -1], joints) - joints, axis=2).mean() > 0.1
    moved[0, 2:] = np.nan
    assert np.isnan(aligned(moved, joints)[0]).all()


@pytest.mark.parametrize("layout", ["COCO_17", "H36M_17", "LSP_14", "MPII_16", "SMPL_24"])
def test_joint_orders_are_mapped_by_name(truth, tmp_path, layout):
    """Joints of a layout in its own order are those of the same name."""
    names = SMPL_24 if layout == "SMPL_24" else keypoint_names(SKELETONS[layout])
    limbs = {"left_hip": "LHip", "right_knee": "RKnee", "left_wrist": "LWrist", "pelvis": "MidHip"}
    there = [limbs.get(name, name) for name in names]
    joints = np.full((len(truth), len(names), 3), np.nan)
    for place, name in enumerate(there):
        if name in BODY_25.joints:
            joints[:, place] = truth.joints[:, BODY_25.index(name)]
    file = tmp_path / "truth.npz"
    np.savez(file, joints=joints.reshape(12, 4, -1, 3), layout=layout)
    made = score(plain(truth), read_people(file))
    assert made.figures["mpjpe_mm"] < 1e-6
    assert {"LHip", "RKnee", "LWrist"} <= set(made.joints)


def write_actors(path, frames):
    """actorsGT.mat as Belagiannis et al. wrote it: cells of actors, of frames, of (14, 3)."""
    from scipy.io import savemat

    actors = np.empty((1, len(frames)), dtype=object)
    for n, actor in enumerate(frames):
        cells = np.empty((len(actor), 1), dtype=object)
        for frame, joints in enumerate(actor):
            absent = np.zeros((1, frame % 2))  # both forms occur
            cells[frame, 0] = absent if joints is None else joints
        actors[0, n] = cells
    savemat(path, {"actor3D": actors, "other": np.eye(3)}, do_compression=True)


def test_actors_of_shelf_and_campus(tmp_path):
    rng = np.random.default_rng(0)
    joints = 0.3 * rng.normal(size=(2, 3, 14, 3))
    file = tmp_path / "actorsGT.mat"
    write_actors(file, [[joints[0, 0], None, joints[0, 2]], [None, *joints[1, 1:]]])
    people = read_people(file)
    assert people.frame.tolist() == [0, 2, 1, 2] and people.person.tolist() == [0, 0, 1, 1]
    assert people.joint_names == SHELF_JOINTS and not people.complete
    np.testing.assert_allclose(people.joints[3, :14], joints[1, 2])
    np.testing.assert_allclose(people.joints[3, 14], joints[1, 2, 2:4].mean(axis=0))


SIDES = {"R": -0.2, "L": 0.2}


def standing(names):
    """A person who faces +y with z up, left towards -x, in metres; joints by name."""
    heights = {"Head": 1.75, "HeadTop": 1.8, "Nose": 1.6, "Eye": 1.65, "Ear": 1.64, "Neck": 1.45}
    heights |= {"Shoulder": 1.4, "Elbow": 1.15, "Wrist": 0.9, "Hip": 0.95, "MidHip": 0.95}
    heights |= {"Knee": 0.5, "Ankle": 0.1}
    forward = {"Nose": 0.15, "Eye": 0.12}
    xyz = []
    for name in names:
        part = name if name in heights else name[1:]
        xyz.append([-SIDES.get(name[0] if part != name else "", 0.0), forward.get(part, 0.0),
                    heights[part]])  # fmt: skip
    return np.array(xyz)


def test_published_orders_of_joints(tmp_path):
    """Files written by hand, joint by joint in the order of the data set's own description."""
    ankles_first = np.array([
        [0.2, 0, 0.1], [0.2, 0, 0.5], [0.2, 0, 0.95],           # right ankle, knee, hip
        [-0.2, 0, 0.95], [-0.2, 0, 0.5], [-0.2, 0, 0.1],        # left hip, knee, ankle
        [0.2, 0, 0.9], [0.2, 0, 1.15], [0.2, 0, 1.4],           # right wrist, elbow, shoulder
        [-0.2, 0, 1.4], [-0.2, 0, 1.15], [-0.2, 0, 0.9],        # left shoulder, elbow, wrist
        [0, 0, 1.45], [0, 0, 1.8],                              # bottom and top of the head
    ])  # fmt: skip
    write_actors(tmp_path / "actorsGT.mat", [[ankles_first, None], [None, None]])
    people = read_people(tmp_path / "actorsGT.mat")
    np.testing.assert_allclose(people.joints[0], standing(people.joint_names), atol=1e-9)

    # Panoptic: x, y, z in cm and a confidence for each joint; y points down. Neck, nose, middle of
    # the hips, left arm, left leg, right arm, right leg, left eye and ear, right eye and ear.
    scene = [0, -145, 0, 0.7, 0, -160, 15, 0.6, 0, -95, 0, 0.4,
             -20, -140, 0, 0.6, -20, -115, 0, 0.6, -20, -90, 0, 0.6,
             -20, -95, 0, 0.4, -20, -50, 0, 0.5, -20, -10, 0, 0.5,
             20, -140, 0, 0.6, 20, -115, 0, 0.6, 0, 0, 0, -1,
             20, -95, 0, 0.3, 20, -50, 0, 0.4, 20, -10, 0, 0.5,
             -20, -165, 12, 0.5, -20, -164, 0, 0.5,
             20, -165, 12, 0.4, 20, -164, 0, 0.5]  # fmt: skip
    text = {"version": 0.7, "univTime": 53541.542, "fpsType": "hd_29_97",
            "bodies": [{"id": 3, "joints19": scene}]}  # fmt: skip
    (tmp_path / "body3DScene_00000120.json").write_text(json.dumps(text))
    people = read_people(tmp_path)
    turned = people.joints[0] @ np.array([[1, 0, 0], [0, 0, -1], [0, 1, 0]])
    wrist = people.joint_names.index("RWrist")
    assert people.person.tolist() == [3] and np.isnan(turned[wrist]).all()
    there = [joint for joint in range(19) if joint != wrist]
    np.testing.assert_allclose(turned[there], standing(people.joint_names)[there], atol=1e-9)

    # Human3.6M: hip, right leg, left leg, spine, thorax, nose, head, left arm, right arm.
    order = ("MidHip RHip RKnee RAnkle LHip LKnee LAnkle Neck Neck Nose Head LShoulder LElbow "
             "LWrist RShoulder RElbow RWrist").split()  # fmt: skip
    np.savez(tmp_path / "h36m.npz", joints=standing(order)[None], layout="h36m")
    people = read_people(tmp_path / "h36m.npz")
    for name in ("RAnkle", "LKnee", "LWrist", "RElbow", "MidHip"):
        np.testing.assert_allclose(people.joints[0, people.joint_names.index(name)],
                                   standing([name])[0])  # fmt: skip
    np.savez(tmp_path / "h36m.npz", joints=1000 * standing(order)[None], layout="h36m")
    with pytest.raises(InputError, match="check the unit"):
        read_people(tmp_path / "h36m.npz")


def test_a_motion_of_amass(tmp_path):
    """SMPL+H's 156 values, z up, at 120 Hz: the root's rotation is first, and the body stands."""
    poses = np.zeros((8, 156))
    poses[:, :3] = [np.pi / 2, 0, 0]  # SMPL's y up to the file's z up: faces -y
    motion = {"poses": poses, "trans": np.tile([1.0, 2.0, 1.2], (8, 1)), "betas": np.zeros(16),
              "gender": "neutral", "mocap_framerate": 120.0, "dmpls": np.zeros((8, 8))}  # fmt: skip
    np.savez(tmp_path / "walk_poses.npz", **motion, body="shapepose-fg open body")
    people = read_people(tmp_path / "walk_poses.npz", up="z", fps=30.0)
    assert people.frame.tolist() == [0, 1]
    at = dict(zip(people.joint_names, people.joints[0], strict=True))
    assert at["Neck"][2] - at["LAnkle"][2] > 1.1  # it stands,
    assert at["LShoulder"][0] - at["RShoulder"][0] > 0.2 and at["Nose"][1] < at["Neck"][1]
    assert np.linalg.norm(at["MidHip"][:2] - [1, 2]) < 0.2
    newer = {**motion, "poses": np.zeros((8, 165)), "mocap_frame_rate": 120.0}
    np.savez(tmp_path / "walk_stageii.npz", **newer, body="shapepose-fg open body")
    with pytest.raises(InputError, match="SMPL-X"):
        read_people(tmp_path / "walk_stageii.npz", up="z")


def test_a_damaged_matlab_file_is_one_sentence(tmp_path):
    """Cut at any place, with any byte changed, and cells in cells that would exhaust the stack."""
    file = tmp_path / "actorsGT.mat"
    write_actors(file, [[np.ones((14, 3)), None]])
    whole, rng = file.read_bytes(), np.random.default_rng(0)
    for _ in range(300):
        content = bytearray(whole[: rng.integers(len(whole) + 1)])
        if len(content) > 128 and rng.random() < 0.7:
            content[rng.integers(128, len(content))] = rng.integers(256)
        file.write_bytes(content)
        try:
            read_people(file)
        except InputError as error:
            assert str(file) in str(error)
    head = whole[:128]
    deep = b""
    for _ in range(50):
        flags = (6).to_bytes(4, "little") + (8).to_bytes(4, "little") + bytes([1, *[0] * 7])
        shape = (5).to_bytes(4, "little") + (8).to_bytes(4, "little") + bytes([1, 0, 0, 0] * 2)
        name = (1).to_bytes(4, "little") + (7).to_bytes(4, "little") + b"actor3D\0"
        inner = flags + shape + name + deep
        deep = (14).to_bytes(4, "little") + len(inner).to_bytes(4, "little") + inner
    file.write_bytes(head + deep)
    with pytest.raises(InputError, match="MATLAB"):
        read_people(file)


def write_panoptic(folder, truth, names):
    for frame in np.unique(truth.frame).tolist():
        bodies = []
        for row in np.flatnonzero(truth.frame == frame):
            xyz = 100 * truth.joints[row, [BODY_25.index(name) for name in names]]
            values = np.concatenate([xyz, np.full((len(names), 1), 0.9)], axis=1)
            values[4, 3] = -1
            bodies.append({"id": int(truth.person[row]), "joints19": values.ravel().tolist()})
        file = folder / f"body3DScene_{frame + 100:08d}.json"
        file.write_text(json.dumps({"version": 0.7, "univTime": 1.0, "bodies": bodies}))


PANOPTIC = (
    "Neck Nose MidHip LShoulder LElbow LWrist LHip LKnee LAnkle RShoulder RElbow RWrist RHip "
    "RKnee RAnkle LEye LEar REye REar"
).split()


def test_panoptic(truth, tmp_path, capsys):
    """Centimetres, numbers of frames from the files' names, a joint that was not reconstructed."""
    folder = tmp_path / "panoptic" / "hdPose3d_stage1_coco19"
    folder.mkdir(parents=True)
    write_panoptic(folder, truth, PANOPTIC)
    people = read_people(folder.parent)
    assert people.frame.min() == 100 and np.isnan(people.joints[:, 4]).all()
    truth.with_run(frames=[0, 12]).save(tmp_path / "result")
    arguments = (tmp_path / "result", "--truth", folder.parent, "--offset", "100")
    assert evaluate(*arguments, "--format", "json") == 0
    made = json.loads(capsys.readouterr().out)
    assert made["mpjpe_mm"] < 1e-6 and made["hota"] == 100 and len(made["joints"]) == 19
    assert made["pcp_limb"]["left upper arm"] is None  # its elbow is not in the truth
    assert evaluate(tmp_path / "result", "--truth", folder.parent) == 2
    assert "annotated frames: 100-111" in " ".join(capsys.readouterr().err.split())
    (folder / "body3DScene_00000100.json").write_text('{"bodies": [{"id": 1}]}')
    with pytest.raises(InputError, match=r"00000100\.json: bodies must have id"):
        read_people(folder)


def test_amass_of_our_own_export(truth, tmp_path):
    """An exported motion, read again, has the joints of the result; without `frames`, it is
    thinned to the rate of the result.
    """
    people = replace(truth, person=truth.person + 1).with_run(frames=[0, 12])
    people.save(tmp_path, built_in_scene().rig)
    export_result(tmp_path, [FORMATS["amass"]], tmp_path / "export")
    with pytest.raises(InputError, match="--up"):
        read_people(tmp_path / "export")
    read = read_people(tmp_path / "export", up=built_in_scene().rig.up)
    made = score(plain(people), read)
    assert made.figures["mpjpe_mm"] < 1 and made.figures["hota"] == 100  # fingers are flat
    file = next((tmp_path / "export").glob("person_2*"))
    data = dict(np.load(file))
    double = {name: np.repeat(data[name], 2, axis=0) for name in ("poses", "trans")}
    file = tmp_path / "walk.npz"
    more = {"betas": data["betas"], "mocap_framerate": np.array(50.0)}
    np.savez(file, **double, **more, body=data["body"])
    read = read_people(file, up=built_in_scene().rig.up, fps=25.0)
    assert read.frame.tolist() == list(range(12))
    np.testing.assert_allclose(read.joints, people.joints[people.person == 2], atol=1e-3)
    np.savez(file, **double, **more)
    with pytest.raises(InputError, match=r"walk\.npz: its shape belongs to SMPL; .*--body"):
        read_people(file, up="z")


@pytest.mark.parametrize(
    ("arrays", "message"),
    [
        ({"joints": np.zeros((2, 17, 2)), "layout": "COCO_17"}, r"\(T, P, J, 3\)"),
        ({"joints": np.zeros((2, 5, 3)), "layout": "COCO_17"}, "must name the 5 joints"),
        ({"joints": np.zeros((2, 17, 3))}, "layout must be a known one"),
        ({"joints": np.full((2, 17, 3), 1e9), "layout": "coco"}, "check the unit"),
        ({"joints": np.full((2, 17, 3), np.nan), "layout": "coco"}, "no person in any frame"),
        ({"joints": np.zeros((2, 17, 3)), "layout": "coco", "frames": np.ones(3, int)}, "frames"),
        ({"other": np.zeros(3)}, r"\(T, P, J, 3\)"),
        ({"poses": np.zeros((2, 6)), "trans": np.zeros((2, 3))}, r"\(F, 66 or more\)"),
        ({"poses": np.zeros((2, 66)), "trans": np.zeros((2, 3))}, "SMPL"),
    ],
)
def test_unusable_truths_are_one_sentence(tmp_path, arrays, message):
    file = tmp_path / "truth.npz"
    np.savez(file, **arrays)
    with pytest.raises(InputError, match=message) as caught:
        read_people(file, up="z")
    assert str(file) in str(caught.value)


def test_pickled_arrays_are_refused(tmp_path):
    file = tmp_path / "truth.npz"
    np.savez(file, joints=np.array([{}], dtype=object))
    with pytest.raises(InputError, match="without pickled objects"):
        read_people(file)


def test_tables_for_papers(truth, tmp_path, capsys):
    """Several results in one table; characters that Markdown and LaTeX would read are escaped."""
    truth.save(tmp_path / "truth")
    for name in ("ours", "a_b"):
        truth.save(tmp_path / name)
    results = [tmp_path / "ours", tmp_path / "a_b", "--truth", tmp_path / "truth"]
    assert evaluate(*results) == 0
    assert "MPJPE, mm" in capsys.readouterr().out
    assert evaluate(*results, "--format", "markdown") == 0
    lines = capsys.readouterr().out.splitlines()
    assert lines[0].startswith("| result | PCP, % | MPJPE, mm |")
    assert lines[2].startswith(f"| {tmp_path / 'ours'} | 100.0 | 0.0 |")
    assert len({line.count("|") for line in lines[:4]}) == 1
    assert evaluate(*results, "--format", "latex") == 0
    text = capsys.readouterr().out
    assert r"a\_b & 100.0" in text and r"PCP, \%" in text and text.count(r"\toprule") == 3
    assert evaluate(*results, "--format", "json") == 0
    assert set(json.loads(capsys.readouterr().out)) == {str(each) for each in results[:2]}
    assert evaluate(*results, "--format", "html") == 2
    assert evaluate(*results[:2], "--truth", tmp_path) == 2
    assert "body3DScene" in capsys.readouterr().err
