"""Pictures of a reconstruction."""

from shapepose_fg.viz.viewer.picture import demo_picture

__all__ = ["demo_picture"]
