"""Calibration files: reads the formats of many programs as a `Rig`, and writes this project's rig
file.
"""

from shapepose_fg.core.rig_file import RIG_FORMAT as RIG_FORMAT
from shapepose_fg.core.rig_file import write_rig as write_rig
from shapepose_fg.io.calibration.reading import read_rig as read_rig
from shapepose_fg.io.calibration.reading import with_first_poses as with_first_poses
from shapepose_fg.io.calibration.reading import with_trajectories as with_trajectories
from shapepose_fg.io.calibration.writing import check_target as check_target
from shapepose_fg.io.calibration.writing import write_like as write_like
from shapepose_fg.io.calibration.writing import write_pose2sim as write_pose2sim
from shapepose_fg.io.calibration.written import Unit as Unit
