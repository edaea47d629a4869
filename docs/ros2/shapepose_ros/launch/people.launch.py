"""Start the node: `ros2 launch shapepose_ros people.launch.py calibration:=/my/rig.json`."""

from launch import LaunchDescription
from launch.actions import DeclareLaunchArgument
from launch.substitutions import LaunchConfiguration, PathJoinSubstitution
from launch_ros.actions import Node
from launch_ros.parameter_descriptions import ParameterValue
from launch_ros.substitutions import FindPackageShare


def generate_launch_description() -> LaunchDescription:
    """One node, with the parameters of a file and those that are given on the command line."""
    parameters = PathJoinSubstitution([FindPackageShare("shapepose_ros"), "config", "people.yaml"])
    given = LaunchConfiguration
    return LaunchDescription(
        [
            DeclareLaunchArgument("parameters", default_value=parameters, description="YAML file"),
            DeclareLaunchArgument("calibration", description="calibration of the cameras"),
            DeclareLaunchArgument("skeleton", default_value="BODY_25", description="layout"),
            DeclareLaunchArgument("use_sim_time", default_value="false", description="use /clock"),
            Node(
                package="shapepose_ros",
                executable="people",
                output="screen",
                parameters=[
                    given("parameters"),
                    {
                        "calibration": ParameterValue(given("calibration"), value_type=str),
                        "skeleton": ParameterValue(given("skeleton"), value_type=str),
                        "use_sim_time": ParameterValue(given("use_sim_time"), value_type=bool),
                    },
                ],
            ),
        ]
    )
