"""Random transforms of shapes that keep their labels right."""
