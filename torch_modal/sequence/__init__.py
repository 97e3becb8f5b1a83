"""From key-frames to a dense sequence."""
