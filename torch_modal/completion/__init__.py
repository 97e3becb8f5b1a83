"""A motion from whole, partial and noisy samples."""
