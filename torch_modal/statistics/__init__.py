"""Statistics of a handful of shapes: mean, components, further members, and poses that meet observations."""
