"""Arrays in files: written column by column, and read without executing code."""
