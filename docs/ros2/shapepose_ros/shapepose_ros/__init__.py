"""ROS 2 node of shapepose-fg."""
