"""Cameras from people: checked, calibrated, refined, synchronised, and found while they move."""
