"""Detects people's joints in pictures: networks, and their outputs as candidates with part affinities."""
