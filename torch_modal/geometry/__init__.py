"""Connectivity, rigid motions, rotations, triangle frames, normals and sparse systems."""
