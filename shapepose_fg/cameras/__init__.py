"""Checks, calibrates, refines and synchronises cameras with the people that they see."""
