"""Draws a result over the pictures from which it was made."""
