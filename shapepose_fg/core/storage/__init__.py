"""Arrays in files: written in columns, read without running anything."""
