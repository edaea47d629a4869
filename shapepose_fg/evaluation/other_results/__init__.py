"""Results of other systems, read so that they are scored like ours."""
