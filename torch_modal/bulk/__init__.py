"""Bases of every key-frame set of a folder tree: one process a set, shared among machines, resumed where it stopped."""
