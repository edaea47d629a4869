"""Types that all folders share: cameras, skeletons, detections, observations, times, results."""
