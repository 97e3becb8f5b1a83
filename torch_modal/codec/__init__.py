"""A motion as key-frames and amplitudes of vibration modes, and its file."""
