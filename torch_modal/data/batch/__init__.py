"""Modal bases of every key-frame set of a folder tree."""
