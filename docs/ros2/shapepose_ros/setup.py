"""Build file of the ROS 2 package; `shapepose-fg` itself is installed with pip."""

from setuptools import setup

NAME = "shapepose_ros"

setup(
    name=NAME,
    version="0.1.0",
    packages=[NAME],
    data_files=[
        ("share/ament_index/resource_index/packages", [f"resource/{NAME}"]),
        (f"share/{NAME}", ["package.xml"]),
        (f"share/{NAME}/launch", ["launch/people.launch.py"]),
        (f"share/{NAME}/config", ["config/people.yaml"]),
    ],
    install_requires=["setuptools"],
    maintainer="shapepose-fg",
    maintainer_email="maintainers@example.org",
    description="A node that reconstructs people in 3D from 2D detections of several cameras.",
    license="MIT",
    entry_points={"console_scripts": ["people = shapepose_ros.people_node:main"]},
)
