"""Biomechanics: joint angles of bodies, with covariances."""
