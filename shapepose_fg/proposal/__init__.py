"""Stage I, single-frame: finds people and associates 2D detections with them (section 3.1 of the
paper).
"""
