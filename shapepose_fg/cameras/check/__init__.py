"""The check of a set-up: whether cameras and detections are consistent, and the likely mistake if
not.
"""
