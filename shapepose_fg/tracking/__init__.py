"""Who is who over time: people are followed from frame to frame by their joints in 3D and their 2D detections."""
