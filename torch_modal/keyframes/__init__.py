"""The border: key-frames from arrays, checked."""
