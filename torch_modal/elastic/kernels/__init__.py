"""Kernels for NVIDIA Warp: the terms of Eq. 5 and local rotations, each element read once and written once.

Each module is compiled when one of its kernels is first launched. All but ``launch`` and ``function`` import Warp.

A thread takes the elements ``i, i + threads, i + 2 threads, ...``: all of a sample on a CPU, and one on a GPU. Arrays
are flat: entry ``s * n + i`` is the i-th of the n vertices, edges or faces of sample ``s``.
"""
