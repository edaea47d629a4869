"""Offsets of a detector's joints from the body's, estimated without ground truth."""
