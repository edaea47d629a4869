"""Files for OpenSim: set-ups of scaling and inverse kinematics for the markers of a TRC, and joint
angles as a motion (MOT).

The set-ups name the model and the marker set of Pose2Sim (BSD-3), which are not included: copy them
from the folder `OpenSim_Setup` of that package.
"""

from xml.etree import ElementTree

import numpy as np

from shapepose_fg.biomechanics.joint_angles import OPENSIM, joint_angles
from shapepose_fg.body.model.body_model import BodyModel
from shapepose_fg.core.skeleton import SKELETONS
from shapepose_fg.io.export.markers import Markers, markers_of, write_trc
from shapepose_fg.io.export.registry import Job, MarkerSet, Written
from shapepose_fg.io.export.take import Take, opensim_axes

MODEL = "Model_Pose2Sim_simple.osim"
"""Pose2Sim's model of the whole body."""
_MARKER_FILES = {
    "BODY_25": "Body25", "BODY_25B": "Body25b", "BODY_135": "Body135", "COCO_17": "Coco17",
    "COCO_133": "Coco133", "HALPE_26": "Halpe26", "HALPE_68": "Halpe68_136",
    "HALPE_136": "Halpe68_136", "BLAZEPOSE_33": "BlazePose",
}  # fmt: skip
"""Pose2Sim's marker sets by skeleton."""
_SIDED = {
    "thigh": ("Hip Knee", "femur patella"),
    "shank": ("Knee Ankle", "tibia"),
    "foot": ("Heel BigToe", "talus calcn toes"),
    "arm": ("Shoulder Elbow", "humerus"),
    "forearm": ("Elbow Wrist", "ulna radius hand"),
}
"""Markers whose distance scales bodies of the model, without side; sides are scaled alike."""
_MIDDLE = {
    "torso": (
        ("LShoulder LHip", "RShoulder RHip"),
        "torso lumbar1 lumbar2 lumbar3 lumbar4 lumbar5",
    ),
    "pelvis": (("RHip LHip",), "pelvis sacrum"),
}
_MEASUREMENTS = _MIDDLE | {
    name: (
        tuple(" ".join(side + marker for marker in pair.split()) for side in "RL"),
        " ".join(f"{body}_{side}" for body in bodies.split() for side in "rl"),
    )
    for name, (pair, bodies) in _SIDED.items()
}
"""Pairs of markers, and the bodies of the model that their distances scale."""
_NAMES = {
    "knee_flexion": "knee_angle", "ankle_flexion": "ankle_angle",
    "ankle_inversion": "subtalar_angle", "elbow_flexion": "elbow_flex",
}  # fmt: skip
"""OpenSim's names of coordinates that are not those of `OPENSIM`."""
_LEFT_OUT = ("knee_adduction", "knee_rotation", "ankle_rotation", "elbow_carrying",
             "elbow_pronation")  # fmt: skip
"""Angles that OpenSim's models do not have, or that joints without hands do not determine."""


def write_opensim(job: Job) -> Written:
    """Write for each person a TRC, the set-ups `person_1_scale.xml` and `person_1_ik.xml`, and the
    angles as `person_1_angles.mot`.
    """
    written, take = write_trc(job), job.take
    names = take.people.joint_names.tolist()
    marker_file = next(
        (f"Markers_{file}.xml" for layout, file in _MARKER_FILES.items()
         if SKELETONS[layout].joints == tuple(names)),
        None,
    )  # fmt: skip
    for place, who in enumerate(take.persons.tolist()):
        markers = markers_of(take, place, MarkerSet.OPENSIM)
        if len(markers.frames) == 0:
            continue
        name, span = f"person_{who}", take.times_s[markers.frames[[0, -1]]]
        for part, tool in (
            ("scale", _scale_tool(name, markers, span.tolist(), marker_file or "markers.xml")),
            ("ik", _ik_tool(name, markers, span.tolist())),
        ):
            document = ElementTree.Element("OpenSimDocument", Version="40000")
            document.append(tool)
            ElementTree.indent(document)
            text = ElementTree.tostring(document, encoding="unicode", xml_declaration=True)
            written.add(job.folder / f"{name}_{part}.xml", text + "\n")
        motion = mot_text(take, place, BodyModel(job.arrays), f"{name}_angles")
        if motion is not None:
            written.add(job.folder / f"{name}_angles.mot", motion)
    needed = f"{MODEL} and {marker_file or 'a marker set, as markers.xml,'}"
    written.notes.append(f"opensim: copy {needed} from Pose2Sim's OpenSim_Setup beside the files")
    return written


def mot_text(take: Take, person: int, model: BodyModel, name: str) -> str | None:
    """The angles of one person in the coordinates of OpenSim's models, degrees, and the position of
    the pelvis, metres; None for a person without a body.
    """
    rows = np.flatnonzero(take.rows[person] >= 0)
    people = take.people.rows(take.rows[person][rows])
    angles = joint_angles(people, take.up, model, OPENSIM)
    there = np.flatnonzero(np.isfinite(angles.degrees[:, 0]))
    if len(there) == 0:
        return None
    people, rows = people.rows(there), rows[there]
    degrees = np.unwrap(angles.degrees[there], axis=0, period=360)
    values = {"time": take.times_s[rows]}
    for name_of, column in zip(angles.names, degrees.T, strict=True):
        joint, side = name_of, ""
        for prefix in ("right_", "left_"):
            if name_of.startswith(prefix):
                joint, side = name_of.removeprefix(prefix), f"_{prefix[0]}"
        if joint not in _LEFT_OUT:
            values[_NAMES.get(joint, joint) + side] = column
    pelvis = model.rest_pelvis(people.betas) + people.transl
    values |= dict(zip(("pelvis_tx", "pelvis_ty", "pelvis_tz"),
                       opensim_axes(take.up) @ pelvis.T, strict=True))  # fmt: skip
    head = [name, "version=1", f"nRows={len(rows)}", f"nColumns={len(values)}", "inDegrees=yes",
            "endheader", "\t".join(values)]  # fmt: skip
    lines = (
        "\t".join(f"{value:.6f}" for value in row) for row in zip(*values.values(), strict=True)
    )
    return "\n".join([*head, *lines]) + "\n"


def _element(tag: str, *parts: object, **attributes: str) -> ElementTree.Element:
    """An element with a text, or with elements inside."""
    made = ElementTree.Element(tag, attributes)
    for part in parts:
        if isinstance(part, ElementTree.Element):
            made.append(part)
        else:
            made.text = str(part)
    return made


def _objects(tag: str, parts: list[ElementTree.Element]) -> ElementTree.Element:
    """A set of objects."""
    return _element(tag, _element("objects", *parts))


def _scale_tool(
    name: str, markers: Markers, span: list[float], marker_file: str
) -> ElementTree.Element:
    """Scaling of the model by distances of markers, over the whole recording."""
    measurements = []
    for what, (pairs, bodies) in _MEASUREMENTS.items():
        there = [pair for pair in pairs if set(pair.split()) <= set(markers.names)]
        scaled = [_element("BodyScale", _element("axes", "X Y Z"), name=body)
                  for body in bodies.split()]  # fmt: skip
        if there:
            each = [_element("MarkerPair", _element("markers", pair)) for pair in there]
            parts = (_objects("MarkerPairSet", each), _objects("BodyScaleSet", scaled))
            measurements.append(
                _element("Measurement", _element("apply", "true"), *parts, name=what)
            )
    period = _element("time_range", f"{span[0]:.6f} {span[1]:.6f}")
    maker = (_element("model_file", MODEL), _element("marker_set_file", marker_file))
    scaler = (
        _element("apply", "true"),
        _element("scaling_order", "measurements"),
        _objects("MeasurementSet", measurements),
        _element("marker_file", f"{name}.trc"),
        period,
        _element("preserve_mass_distribution", "true"),
        _element("output_model_file", f"{name}.osim"),
    )
    placer = _element("MarkerPlacer", _element("apply", "false"))
    return _element("ScaleTool", _element("GenericModelMaker", *maker),
                    _element("ModelScaler", *scaler), placer, name=name)  # fmt: skip


def _ik_tool(name: str, markers: Markers, span: list[float]) -> ElementTree.Element:
    """Inverse kinematics; the weight of a marker is its inverse variance, relative to the median
    marker.
    """
    spread = np.nanmedian(np.where(markers.there, markers.sigma_m, np.nan)[markers.frames], axis=0)
    weights = np.nan_to_num((np.nanmedian(spread) / spread) ** 2, nan=0.0).clip(0, 10)
    tasks = [
        _element("IKMarkerTask", _element("apply", str(weight > 0).lower()),
                 _element("weight", f"{weight:.3f}"), name=marker)
        for marker, weight in zip(markers.names, weights.tolist(), strict=True)
    ]  # fmt: skip
    return _element(
        "InverseKinematicsTool",
        _element("model_file", f"{name}.osim"),
        _objects("IKTaskSet", tasks),
        _element("marker_file", f"{name}.trc"),
        _element("time_range", f"{span[0]:.6f} {span[1]:.6f}"),
        _element("report_errors", "true"),
        _element("output_motion_file", f"{name}_ik.mot"),
        name=name,
    )
