"""Your own detector: 17 COCO keypoints per person and picture, as arrays."""

import matplotlib.pyplot as plt
import numpy as np
from drawing import draw_people, room, save

from shapepose_fg import reconstruct
from shapepose_fg.core.detections import Detections, Recording
from shapepose_fg.core.reconstruction import Known
from shapepose_fg.core.skeleton import BODY_25
from shapepose_fg.simulation import built_in_scene

SIDES = "Eye Ear Shoulder Elbow Wrist Hip Knee Ankle".split()
COCO = ["Nose", *(side + joint for joint in SIDES for side in "LR")]
PLACE = [BODY_25.index(name) for name in COCO]
scene = built_in_scene(people=3, frames=12)
noise = np.random.default_rng(0)


def detect(frame, view):
    """Your network: (people, 17, 3) x, y, score. Here the truth, 3 px off, a tenth missing."""
    xy, _ = scene.rig.project(scene.truth_at(frame))
    keypoints = np.concatenate([xy[view][:, PLACE], np.full((3, 17, 1), 0.9)], axis=-1)
    keypoints[..., :2] += noise.normal(0, 3, keypoints[..., :2].shape)
    keypoints[noise.random((3, 17)) < 0.1, 2] = 0
    return keypoints


def detections_of(frame):
    """All views of a frame: one row per keypoint that was seen, and pairs that are a limb."""
    view, joint, points, pairs = [], [], [], []
    for number, camera in enumerate(scene.rig.cameras):
        for person in detect(frame, number):
            row = np.full(25, -1)
            for place, keypoint in zip(PLACE, person, strict=True):
                if keypoint[2] > 0:
                    row[place] = len(points)
                    view.append(number)
                    joint.append(place)
                    points.append([*camera.undistort(keypoint[None, :2])[0], keypoint[2]])
            pairs += [(row[a], row[b]) for a, b in BODY_25.limbs if min(row[a], row[b]) >= 0]
    x, y, score = np.array(points).T
    links = np.array(pairs).reshape(-1, 2)
    return Detections(
        np.array(view), np.array(joint), np.c_[x, y], score, links, np.ones(len(links))
    )


recording = Recording(BODY_25, [detections_of(frame) for frame in range(len(scene))])
people = reconstruct(recording, scene.rig)
heel = people.known[:, BODY_25.index("LHeel")]
print("the left heel is known from:", *{Known(each).name for each in heel.tolist()})

truth = scene.truth_at(11)
figure = plt.figure(figsize=(8, 6))
axes = room(figure, truth, title="from 17 keypoints; grey: the truth, feet too")
draw_people(axes, truth, colours=("#bbbbbb",), linewidth=5)
draw_people(axes, people.at(11).joints, linewidth=2)
save(figure)
