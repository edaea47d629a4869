"""Joint angles as tables, and files for OpenSim."""

import csv
from dataclasses import replace
from xml.etree import ElementTree

import numpy as np
import pytest

from shapepose_fg.biomechanics.joint_angles import NAMES, joint_angles
from shapepose_fg.core.reconstruction import Reconstruction
from shapepose_fg.io.export.registry import FORMATS, export_result
from shapepose_fg.simulation import built_in_scene
from shapepose_fg.simulation.files import truth_of


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """Two people in eight frames, one of whom has no body in two of them, exported."""
    folder = tmp_path_factory.mktemp("angles")
    scene = built_in_scene(people=2).part(range(8))
    people = truth_of(scene)
    covariance = np.broadcast_to(0.01**2 * np.eye(3), (*people.joints.shape, 3)).copy()
    covariance[:, people.joint_names == "LWrist"] *= 100
    columns = {name: np.array(getattr(people, name)) for name in people.ROWS}
    gone = (people.person == 1) & (people.frame >= 6)
    columns["betas"][gone] = np.nan
    columns["status"] = np.where(gone, "body undetermined", "ok")
    columns["known"][:] = 1
    columns |= {"covariance": covariance}
    people = Reconstruction(joint_names=people.joint_names, **columns)
    people.save(folder, scene.rig)
    export_result(folder, [FORMATS["angles"], FORMATS["opensim"]], folder / "export")
    return folder


def test_a_table_of_angles(folder):
    with (folder / "export" / "angles.csv").open() as stream:
        lines = list(csv.DictReader(stream))
    assert len(lines) == 14
    people = Reconstruction.load(folder)
    angles = joint_angles(people, "z")
    row = np.flatnonzero((people.frame == 3) & (people.person == 1))[0]
    (line,) = (each for each in lines if (each["frame"], each["person"]) == ("3", "1"))
    for name in NAMES:
        place = NAMES.index(name)
        assert float(line[f"{name}_deg"]) == pytest.approx(angles.degrees[row, place], abs=6e-4)
        assert float(line[f"{name}_sigma_deg"]) == pytest.approx(angles.sigma[row, place], abs=6e-4)
    assert float(line["time_s"]) == pytest.approx(3 / 25)


def test_a_motion_for_opensim(folder):
    lines = (folder / "export" / "person_1_angles.mot").read_text().splitlines()
    head, table = lines[: lines.index("endheader")], lines[lines.index("endheader") + 1 :]
    names = table[0].split("\t")
    assert "inDegrees=yes" in head and f"nColumns={len(names)}" in head and "nRows=6" in head
    assert (
        names[0] == "time" and len(table) == 7 and {len(row.split("\t")) for row in table} == {30}
    )
    values = dict(zip(names, np.loadtxt(table[1:]).T, strict=True))
    people = Reconstruction.load(folder)
    rows = np.flatnonzero((people.person == 1) & (people.frame < 6))
    angles = joint_angles(people.rows(rows), "z").degrees
    for coordinate, name in (
        ("knee_angle_r", "right_knee_flexion"),
        ("hip_rotation_l", "left_hip_rotation"),
        ("ankle_angle_l", "left_ankle_flexion"),
        ("elbow_flex_r", "right_elbow_flexion"),
    ):
        np.testing.assert_allclose(values[coordinate], angles[:, NAMES.index(name)], atol=1e-5)
    extension = -angles[:, NAMES.index("trunk_flexion")]
    np.testing.assert_allclose(values["lumbar_extension"], extension, atol=1e-5)
    assert (values["pelvis_ty"] > 0.5).all()


def test_set_ups_of_scaling_and_inverse_kinematics(folder):
    export = folder / "export"
    scale = ElementTree.parse(export / "person_0_scale.xml").getroot()
    assert scale.findtext(".//marker_set_file") == "Markers_Body25.xml"
    assert (export / scale.findtext(".//ModelScaler/marker_file")).is_file()
    markers = set((export / "person_0.trc").read_text().splitlines()[3].split())
    pairs = [each.text.split() for each in scale.iter("markers")]
    assert len(pairs) == 13 and {name for pair in pairs for name in pair} <= markers
    scaled = {each.get("name") for each in scale.iter("BodyScale")}
    assert {"femur_r", "tibia_l", "torso", "humerus_l", "ulna_r", "calcn_r"} <= scaled
    ik = ElementTree.parse(export / "person_0_ik.xml").getroot()
    assert ik.findtext(".//model_file") == scale.findtext(".//output_model_file")
    weight = {each.get("name"): float(each.findtext("weight")) for each in ik.iter("IKMarkerTask")}
    assert weight["RKnee"] == pytest.approx(1) and weight["LWrist"] == pytest.approx(0.01)
    assert set(weight) <= markers


def test_markers_without_covariances_have_equal_weights(folder, tmp_path):
    people = Reconstruction.load(folder)
    joints = np.array(people.joints)
    joints[:, people.joint_names == "Nose"] = np.nan
    unknown = replace(people, joints=joints, covariance=np.full_like(people.covariance, np.nan),
                      known=np.zeros_like(people.known))  # fmt: skip
    unknown.save(tmp_path, built_in_scene(people=2).rig)
    export_result(tmp_path, [FORMATS["opensim"]], tmp_path)
    ik = ElementTree.parse(tmp_path / "person_0_ik.xml").getroot()
    weight = {each.get("name"): float(each.findtext("weight")) for each in ik.iter("IKMarkerTask")}
    assert weight.pop("Nose") == 0 and set(weight.values()) == {1.0}
