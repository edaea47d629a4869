"""Start the node: `ros2 launch shapepose_ros people.launch.py calibration:=/my/rig.json`."""

from typing import Any

from launch import LaunchContext, LaunchDescription
from launch.actions import DeclareLaunchArgument, OpaqueFunction
from launch.substitutions import LaunchConfiguration, PathJoinSubstitution
from launch_ros.actions import Node
from launch_ros.parameter_descriptions import ParameterValue
from launch_ros.substitutions import FindPackageShare

OWN = {
    "calibration": (str, "calibration of the cameras"),
    "skeleton": (str, "keypoint layout of the detector"),
    "use_sim_time": (bool, "use /clock"),
}
"""Parameters of the node that can be given on the command line; they override the file's."""


def generate_launch_description() -> LaunchDescription:
    """One node, with the parameters of a file and those that are given on the command line."""
    parameters = PathJoinSubstitution([FindPackageShare("shapepose_ros"), "config", "people.yaml"])
    return LaunchDescription(
        [
            DeclareLaunchArgument("parameters", default_value=parameters, description="YAML file"),
            *(
                DeclareLaunchArgument(name, default_value="", description=text)
                for name, (_, text) in OWN.items()
            ),
            OpaqueFunction(function=_nodes),
        ]
    )


def _nodes(context: LaunchContext) -> list[Node]:
    """The node; arguments that are not given leave the parameters of the file as they are."""
    own: dict[str, Any] = {
        name: ParameterValue(LaunchConfiguration(name), value_type=kind)
        for name, (kind, _) in OWN.items()
        if LaunchConfiguration(name).perform(context)
    }
    return [
        Node(
            package="shapepose_ros",
            executable="people",
            output="screen",
            parameters=[LaunchConfiguration("parameters"), *([own] if own else [])],
        )
    ]
