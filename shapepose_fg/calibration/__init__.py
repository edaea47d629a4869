"""Calibration from people: poses of the cameras, and their time offsets."""
