"""SLAM with people: a robot's drift is corrected by the people whom it and fixed cameras see."""

import gtsam
import matplotlib.pyplot as plt
import numpy as np
from drawing import save

import factors as fg
from shapepose_fg.simulation import built_in_scene

scene = built_in_scene(people=2, cameras=4, frames=100)
fixed = [fg.make_camera(camera.K, camera.wTc) for camera in scene.rig.cameras[:2]]
eye = scene.rig.cameras[2]  # on the robot, which moves sideways
ODOMETRY = np.repeat([0.005, 0.02], 3)  # sigmas of a step: radians, metres
lens, noise = fg.make_calibration(eye.K), np.random.default_rng(0)


def true_pose(frame):
    """World from the robot's camera."""
    return gtsam.Pose3(eye.wTc).compose(gtsam.Pose3(gtsam.Rot3(), [0.005 * frame, 0.0, 0.0]))


def sighting(person, frame):
    """What the three cameras see of a person, 4 px off; in practice the tracked detections."""
    joints = scene.truth_at(frame)[person]
    cameras = [*fixed, gtsam.PinholeCameraCal3_S2(true_pose(frame), lens)]
    xy = np.array([[camera.project(joint) for camera in cameras] for joint in joints])
    return fg.Sighting(
        person, frame, frame / 25, joints + noise.normal(0, 0.03, joints.shape),
        xy + noise.normal(0, 4, xy.shape), np.full(xy.shape[:2], 4.0), np.full(len(joints), 0.5),
        [*fixed, fg.PosedCamera(lens, gtsam.symbol("x", frame), gtsam.Pose3())],
    )  # fmt: skip


settings = gtsam.ISAM2Params()
settings.setRelinearizeThreshold(0.01)
settings.relinearizeSkip = 1
isam, people = gtsam.ISAM2(settings), fg.PeopleInGraph(fg.KeySpace("p"), link_s=0.3)
drifting, error = true_pose(0), []
for frame in range(0, len(scene), 5):
    new = people.add([sighting(0, frame), sighting(1, frame)])
    here = gtsam.symbol("x", frame)
    if frame == 0:
        new.graph.addPriorPose3(here, drifting, fg.isotropic(6, 0.001))
    else:
        step = true_pose(frame - 5).between(true_pose(frame)).retract(noise.normal(0, ODOMETRY))
        drifting, before = drifting.compose(step), gtsam.symbol("x", frame - 5)
        new.graph.add(gtsam.BetweenFactorPose3(before, here, step, fg.diagonal(ODOMETRY)))
    new.values.insert(here, drifting)
    isam.update(new.graph, new.values)
    poses = drifting, isam.calculateEstimate().atPose3(here)
    error.append([1000 * pose.range(true_pose(frame)) for pose in poses])
print("last error, mm: odometry {:.0f}, with people {:.0f}".format(*error[-1]))

figure, axes = plt.subplots(figsize=(8, 4))
axes.plot(error, "o-", label=("odometry alone", "with people"))
axes.set(xlabel="step of 0.2 s", ylabel="error of the robot's position, mm", ylim=(0, None))
axes.legend()
save(figure)
