"""Files for OpenSim: set-ups of scaling and inverse kinematics for the markers of a TRC, and joint
angles as a motion (MOT).

The set-ups name the model and the marker set of Pose2Sim (BSD-3), which are not included: copy them
from the folder `OpenSim_Setup` of that package.
"""

from collections.abc import Iterable
from xml.etree import ElementTree
from xml.sax.saxutils import quoteattr

import numpy as np

from shapepose_fg.biomechanics.joint_angles import OPENSIM, joint_angles
from shapepose_fg.body.model.body_model import BodyModel
from shapepose_fg.core.skeleton import SKELETONS
from shapepose_fg.core.world_axes import opensim_axes
from shapepose_fg.io.export.markers import Markers, markers_of, write_trc
from shapepose_fg.io.export.registry import Job, MarkerSet, Written
from shapepose_fg.io.export.take import Take

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
    for place, identity in enumerate(take.persons.tolist()):
        markers = markers_of(take, place, MarkerSet.OPENSIM)
        if len(markers.frames) == 0:
            continue
        name = f"person_{identity}"
        span = "{:.6f} {:.6f}".format(*take.times_s[markers.frames[[0, -1]]])
        scale = _scale_tool(name, markers, span, marker_file or "markers.xml")
        for part, tool in {"scale": scale, "ik": _ik_tool(name, markers, span)}.items():
            document = f'<OpenSimDocument Version="40000">{tool}</OpenSimDocument>'
            root = ElementTree.fromstring(document.replace("\n", ""))
            ElementTree.indent(root)
            text = ElementTree.tostring(root, encoding="unicode", xml_declaration=True)
            written.add(job.folder / f"{name}_{part}.xml", text + "\n")
        motion = mot_text(take, place, job.model, f"{name}_angles")
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
    index = np.flatnonzero(np.isfinite(angles.degrees[:, 0]))
    if len(index) == 0:
        return None
    people, rows = people.rows(index), rows[index]
    degrees = np.unwrap(angles.degrees[index], axis=0, period=360)
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


def _set(name: str, objects: Iterable[str]) -> str:
    """A set of objects in OpenSim's XML."""
    return f"<{name}><objects>{''.join(objects)}</objects></{name}>"


def _scale_tool(name: str, markers: Markers, span: str, marker_file: str) -> str:
    """Scaling of the model by distances of markers, over the whole recording."""
    measurements = list[str]()
    for what, (pairs, bodies) in _MEASUREMENTS.items():
        present = [pair for pair in pairs if set(pair.split()) <= set(markers.names)]
        each = (f"<MarkerPair><markers>{pair}</markers></MarkerPair>" for pair in present)
        scaled = (f'<BodyScale name="{body}"><axes>X Y Z</axes></BodyScale>'
                  for body in bodies.split())  # fmt: skip
        if present:
            parts = _set("MarkerPairSet", each) + _set("BodyScaleSet", scaled)
            measurements.append(
                f'<Measurement name="{what}"><apply>true</apply>{parts}</Measurement>'
            )
    return f"""<ScaleTool name="{name}">
<GenericModelMaker><model_file>{MODEL}</model_file>
<marker_set_file>{marker_file}</marker_set_file></GenericModelMaker>
<ModelScaler><apply>true</apply><scaling_order>measurements</scaling_order>
{_set("MeasurementSet", measurements)}
<marker_file>{name}.trc</marker_file><time_range>{span}</time_range>
<preserve_mass_distribution>true</preserve_mass_distribution>
<output_model_file>{name}.osim</output_model_file></ModelScaler>
<MarkerPlacer><apply>false</apply></MarkerPlacer></ScaleTool>"""


def _ik_tool(name: str, markers: Markers, span: str) -> str:
    """The settings of OpenSim's inverse kinematics; the weight of a marker is its inverse
    variance, relative to the median marker.
    """
    sigma = np.where(markers.present & np.isfinite(markers.sigma_m), markers.sigma_m, np.inf)
    spread = np.median(sigma[markers.frames], axis=0)
    usual = np.median(spread[np.isfinite(spread)]) if np.isfinite(spread).any() else 1.0
    ratio = usual / np.where(np.isfinite(spread), np.maximum(spread, 1e-6), usual)
    weights = np.where(markers.present.any(axis=0), ratio**2, 0).clip(0, 10)
    tasks = (
        f"<IKMarkerTask name={quoteattr(marker)}><apply>{str(weight > 0).lower()}</apply>"
        f"<weight>{weight:.3f}</weight></IKMarkerTask>"
        for marker, weight in zip(markers.names, weights.tolist(), strict=True)
    )
    return f"""<InverseKinematicsTool name="{name}"><model_file>{name}.osim</model_file>
{_set("IKTaskSet", tasks)}
<marker_file>{name}.trc</marker_file><time_range>{span}</time_range>
<report_errors>true</report_errors><output_motion_file>{name}_ik.mot</output_motion_file>
</InverseKinematicsTool>"""
