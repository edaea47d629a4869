"""Poses of cameras from people, with or without their start times."""
