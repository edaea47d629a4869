"""What all rooms speak of: cameras, skeletons, detections, observations, times, results."""
