"""The truth of a scene in the form of a result: what a perfect reconstruction would be."""

import numpy as np

from shapepose_fg.core.reconstruction import Reconstruction, Status
from shapepose_fg.core.skeleton import BODY_25
from shapepose_fg.simulation.scene import Scene


def truth_of(scene: Scene) -> Reconstruction:
    """Everybody in every frame of `scene`, row by row as `person` 0 to P - 1, frame 0 first.

    Joints and bodies are exact: covariances are zero and confidences one. Velocities and how joints are known are
    not given: nothing says what was visible.
    """
    T, P = scene.motion.transl.shape[:2]
    N = T * P
    return Reconstruction(
        frame=np.repeat(np.arange(T), P),
        person=np.tile(np.arange(P), T),
        time_s=np.repeat(np.arange(T) / scene.fps, P),
        joint_names=np.array(BODY_25.joints),
        joints=scene.keypoints.reshape(N, len(BODY_25), 3),
        covariance=np.zeros((N, len(BODY_25), 3, 3)),
        confidence=np.ones((N, len(BODY_25))),
        betas=np.tile(scene.motion.betas, (T, 1)),
        global_orient=scene.motion.global_orient.reshape(N, 3),
        body_pose=scene.motion.body_pose.reshape(N, 23, 3),
        transl=scene.motion.transl.reshape(N, 3),
        status=np.full(N, str(Status.OK)),
    )
