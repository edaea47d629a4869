"""A method without a body, of our own, to compare with: people grouped in 2D, matched between views, triangulated."""
