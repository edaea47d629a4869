"""The picture of one frame of a result."""
