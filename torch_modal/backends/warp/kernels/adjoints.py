"""Kernels whose adjoints Warp generates, in a module of their own: what takes no gradients does not wait for these.

An adjoint repeats the work on an element first. What the kernel itself stores or adds is left out then, but what a
function that it calls does (``add_sides``, ``enclosed``) is done once more: such results are given scratch memory.
"""

import warp as wp

from torch_modal.backends.warp.kernels import rotations, shell


def _with_adjoint(kernel: wp.Kernel) -> wp.Kernel:
    return wp.kernel(kernel.func, module=__name__, enable_backward=True)


trajectory_edges = _with_adjoint(rotations.trajectory_edges)
sizes = _with_adjoint(shell.sizes)
rest_sums = _with_adjoint(shell.rest_sums)
merge = _with_adjoint(shell.merge)
linearise = _with_adjoint(shell.linearise)
