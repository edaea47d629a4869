"""An archive of recordings: a table of them, reconstructed on many processes, one queue of work for all."""
