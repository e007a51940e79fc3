"""What becomes of files when a run is killed, interrupted, or out of disk."""
