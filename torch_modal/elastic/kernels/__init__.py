"""Kernels for NVIDIA Warp: the terms of Eq. 5 and local rotations, each element read once and written once.

What they compute is what :mod:`torch_modal.elastic` and :mod:`torch_modal.geometry.local_rotations` compute in many
passes over all elements, and is tested equal to it. Each module is compiled and loaded for itself, when one of its
kernels is first launched. Importing one needs the package ``warp-lang``;
:func:`torch_modal.elastic.kernels.launch.kernels` alone does.

A thread takes as many elements as there are, every ``threads``-th from its own on: all of a sample on a CPU, where what
is the same for all of them is then worked out once, and one on a GPU
(:func:`torch_modal.elastic.kernels.launch.launch`). What elements sum up, a thread adds once.

Arrays are flat: entry ``s * n + i`` is the i-th of the n vertices, edges or faces of sample ``s``. A record belongs to
an edge and to its hinge, where there is one: the vertices ``(i, j, k, l)`` of a row of
:attr:`~torch_modal.geometry.connectivity.Connectivity.hinges`, with ``k = -1`` where there is none.
"""
