"""What can be done with a saved result: list its tracks, correct them, solve people again, explain
joints.
"""
