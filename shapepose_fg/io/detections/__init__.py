"""Reads 2D detections of every camera, from the files of many detectors, as candidates with part
affinities.
"""

from shapepose_fg.io.detections.reading import read_detections as read_detections
