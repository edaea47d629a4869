"""The body: SMPL's format, skinned points, rotations, and the offsets of a detector's joints."""
