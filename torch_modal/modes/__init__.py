"""Work done once for each set of key-frames, in NumPy and SciPy: tetrahedra, modes, coarsening, cache."""
