"""Stage I, one frame: who is there, and whose are the 2D detections (section 3.1 of the paper)."""
