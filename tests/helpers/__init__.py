"""Shapes, files, inputs and small programs that the tests and the benchmarks share."""
