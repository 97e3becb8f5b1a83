"""Minimisation in modal amplitudes, and the gradient of its solution."""
