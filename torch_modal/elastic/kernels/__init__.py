"""Kernels for NVIDIA Warp: the terms of Eq. 5 and local rotations, each element read once and written once.

They compute what :mod:`torch_modal.elastic` and :mod:`torch_modal.geometry.local_rotations` compute in many passes over
all elements, and are tested equal to it. Each module is compiled and loaded for itself, when one of its kernels is
first launched. Importing one needs the package ``warp-lang``; :mod:`torch_modal.elastic.kernels.launch` alone does.

A thread takes as many elements as there are, every ``threads``-th from its own on: all of a sample on a CPU, and one on
a GPU (:func:`torch_modal.elastic.kernels.launch.launch`). Arrays are flat: entry ``s * n + i`` is the i-th of the n
vertices, edges or faces of sample ``s``.
"""
