"""What a handful of shapes has in common: mean, components, further members, and poses that meet observations."""
