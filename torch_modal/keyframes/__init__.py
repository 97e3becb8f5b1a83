"""The border: key-frames from files and arrays, checked."""
