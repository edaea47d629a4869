"""An archive of recordings: reconstructs all recordings of a table on many processes, with a common
queue of work.
"""
