"""A reconstruction in progress: its solved windows, from which it can be resumed, and its
result.
"""
