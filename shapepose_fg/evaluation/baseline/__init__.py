"""A method without a body, to compare with: people grouped in 2D, matched between views, triangulated."""
