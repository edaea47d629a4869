"""GTSAM factors for people seen by calibrated cameras: keys, noise, projection, body priors,
motion, contact.

The package imports only GTSAM and NumPy. Builders take keys, arrays and noise, and return native
`gtsam.NonlinearFactor`s for a graph of your own. Units: metres in the world, pixels in the image;
cameras look along +z, x right, y down.
"""

from factors.body_prior import body_prior_factor, body_prior_factors
from factors.body_shape import shape_factors
from factors.contact import standing_factors
from factors.graph_files import draw_graph, load_graph, save_graph
from factors.joining import Increment, PeopleInGraph, PosedCamera, Sighting, reported_factor
from factors.key_space import KeySpace
from factors.keys import (
    CameraKey,
    JointKey,
    body_keys,
    camera_key,
    camera_keys,
    format_key,
    joint_key,
    joint_keys,
    offset_key,
    offset_keys,
    reported_keys,
    shape_key,
    split_camera_key,
    split_key,
    state_keys,
    velocity_key,
    velocity_keys,
)
from factors.lasting import (
    lasting_blocks,
    lasting_difference_factors,
    lasting_prior_factors,
    offset_factors,
)
from factors.linear import jacobian_factor, linear_factor
from factors.motion import (
    CONSTANT_ACCELERATION,
    CONSTANT_VELOCITY,
    MEASURED_S,
    MOTIONS,
    Motion,
    matrices,
    motion_covariance,
    motion_factors,
)
from factors.noise import (
    DEFAULT_WIDTH_SIGMA,
    Kernel,
    KernelName,
    diagonal,
    gaussian,
    isotropic,
    isotropic_models,
    kernel_weight,
    robust,
    robust_kernel,
    sigma_px,
)
from factors.odometry import odometry_factors
from factors.pinhole import project_with_jacobian, to_pixels
from factors.projection import (
    in_front,
    inlier_gate,
    make_calibration,
    make_camera,
    moving_projection_factors,
    posed_projection_factor,
    posed_projection_factors,
    projection_factor,
    projection_factors,
)
from factors.rank import determined, joint_information
from factors.testing import assert_jacobian, assert_zero_at_truth

__all__ = [
    "CONSTANT_ACCELERATION",
    "CONSTANT_VELOCITY",
    "DEFAULT_WIDTH_SIGMA",
    "MEASURED_S",
    "MOTIONS",
    "CameraKey",
    "Increment",
    "JointKey",
    "Kernel",
    "KernelName",
    "KeySpace",
    "Motion",
    "PeopleInGraph",
    "PosedCamera",
    "Sighting",
    "assert_jacobian",
    "assert_zero_at_truth",
    "body_keys",
    "body_prior_factor",
    "body_prior_factors",
    "camera_key",
    "camera_keys",
    "determined",
    "diagonal",
    "draw_graph",
    "format_key",
    "gaussian",
    "in_front",
    "inlier_gate",
    "isotropic",
    "isotropic_models",
    "jacobian_factor",
    "joint_information",
    "joint_key",
    "joint_keys",
    "kernel_weight",
    "lasting_blocks",
    "lasting_difference_factors",
    "lasting_prior_factors",
    "linear_factor",
    "load_graph",
    "make_calibration",
    "make_camera",
    "matrices",
    "motion_covariance",
    "motion_factors",
    "moving_projection_factors",
    "odometry_factors",
    "offset_factors",
    "offset_key",
    "offset_keys",
    "posed_projection_factor",
    "posed_projection_factors",
    "project_with_jacobian",
    "projection_factor",
    "projection_factors",
    "reported_factor",
    "reported_keys",
    "robust",
    "robust_kernel",
    "save_graph",
    "shape_factors",
    "shape_key",
    "sigma_px",
    "split_camera_key",
    "split_key",
    "standing_factors",
    "state_keys",
    "to_pixels",
    "velocity_key",
    "velocity_keys",
]
