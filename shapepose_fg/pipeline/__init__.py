"""The whole way, from detections to a result: windows, processes, chunks, resuming."""
