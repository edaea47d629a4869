"""From several calibrated cameras to every person in the room in 3D, with a body."""
