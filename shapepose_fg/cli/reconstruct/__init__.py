"""The command that reconstructs a recording."""
