"""The pipeline from detections to a result: windows, processes, chunks, resuming."""
