"""Whether cameras and detections fit each other, and what it looks like where they do not."""
