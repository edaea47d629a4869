"""Detects people's joints in pictures: networks, and conversion of their outputs to candidates with
part affinities.
"""
