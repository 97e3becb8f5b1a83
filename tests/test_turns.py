"""Exponential and logarithm of rotations against matrix functions, kornia and SciPy; derivatives where zero is divided."""
