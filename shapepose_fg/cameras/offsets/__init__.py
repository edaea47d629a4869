"""Time offsets between cameras, from people."""
