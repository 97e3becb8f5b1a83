"""Dense sequences and smooth paths through key-frames."""
