"""The body: SMPL's format, its points on the skin, rotations, and where a detector's joints lie on it."""
