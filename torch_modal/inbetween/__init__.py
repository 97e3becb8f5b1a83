"""In-betweens of pairs of key-frames, for flat batches."""
