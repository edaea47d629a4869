"""Identities over time: people are tracked from frame to frame by their 3D joints and 2D
detections.
"""
