"""Body fitting from joints: energy, fitters, and predictions of joints without their
own targets.
"""
