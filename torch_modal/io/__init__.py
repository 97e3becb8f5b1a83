"""Files: meshes, animations, samples."""
