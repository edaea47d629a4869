"""People and detections as ROS 2 messages, without ROS."""
