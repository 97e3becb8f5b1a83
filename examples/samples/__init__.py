"""Sculpted bodies: the key-frames that come with the package, animals and bipeds of the examples and benchmarks."""
