"""Keeping the parts of a surface from passing through each other."""
