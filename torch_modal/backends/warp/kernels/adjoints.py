"""Kernels whose adjoints Warp generates, in a module of their own: what takes no gradients does not wait for these.

An adjoint repeats the work on an element first. What the kernel itself stores or adds is left out then, but what a
function that it calls does (``add_sides``) is done once more: such results are given scratch memory.
"""

import warp as wp

from torch_modal.backends.warp.kernels import rotations

trajectory_edges = wp.kernel(rotations.trajectory_edges.func, module=__name__, enable_backward=True)
