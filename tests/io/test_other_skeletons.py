"""The whole way from another detector's files: people of the built-in scene, written as COCO's
results.
"""

import json

import numpy as np
import pytest

from shapepose_fg import read_detections, read_rig, reconstruct, write_rig
from shapepose_fg.core.skeleton import BODY_25, COCO_17, HALPE_26, Skeleton
from shapepose_fg.proposal.people_2d import group_people
from shapepose_fg.simulation import built_in_scene, simulate
from tests.marks import slow

FRAMES = 4


def written(folder, skeleton: Skeleton) -> None:
    """The scene's people as the simulated detector saw and grouped them, without what the skeleton
    lacks.
    """
    scene = built_in_scene(frames=FRAMES)
    detections = simulate(scene)
    names = [skeleton.joints[joint] for joint in (skeleton.keypoints or range(len(skeleton)))]
    column = {BODY_25.index(name): names.index(name) for name in names if name in BODY_25.joints}
    results: dict[str, list] = {camera.name: [] for camera in scene.rig.cameras}
    for frame in range(FRAMES):
        found = detections[frame]
        for members in group_people(found):
            camera = scene.rig.cameras[found.view[members[0]]]
            keypoints = np.zeros((len(names), 3))
            for row in members:
                if found.joint[row] in column:
                    xy = camera.distort(found.xy[row][None])[0]
                    keypoints[column[found.joint[row]]] = [*xy, found.confidence[row]]
            if np.count_nonzero(keypoints[:, 2]) >= 3:
                results[camera.name].append(
                    {"image_id": frame, "keypoints": keypoints.ravel().tolist()}
                )
    for name, people in results.items():
        (folder / f"{name}.json").write_text(json.dumps(people))
    write_rig(scene.rig, folder / "rig.json")


@pytest.mark.parametrize("skeleton", [COCO_17, *slow(HALPE_26)], ids=["COCO_17", "HALPE_26"])
def test_everybody_is_found(tmp_path, skeleton):
    written(tmp_path, skeleton)
    rig = read_rig(tmp_path / "rig.json")
    people = reconstruct(read_detections(tmp_path, rig), rig)
    scene = built_in_scene(frames=FRAMES)
    assert tuple(people.joint_names) == skeleton.joints
    assert set(people.status.tolist()) == {"ok"}
    assert np.bincount(people.frame).tolist() == [scene.people] * FRAMES
    shared = [name for name in skeleton.joints if name in BODY_25.joints]
    ours = people.joints[:, [skeleton.index(name) for name in shared]]
    errors = []
    for frame in range(FRAMES):
        truth = scene.truth_at(frame)[:, [BODY_25.index(name) for name in shared]]
        apart = np.linalg.norm(ours[people.frame == frame][:, None] - truth[None], axis=-1).mean(
            axis=-1
        )
        assert sorted(apart.argmin(axis=1)) == list(range(scene.people))
        errors += apart.min(axis=1).tolist()
    # 18 mm in twelve frames, 19 with BODY_25 of the same scene; a person exchanged would be 500 mm
    # off.
    assert np.mean(errors) < 0.03
    assert np.isfinite(people.betas).all()
