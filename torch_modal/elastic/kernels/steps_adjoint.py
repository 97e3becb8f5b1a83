"""Adjoints of the kernels of conjugate gradients, which Warp generates."""

import warp as wp

from torch_modal.elastic.kernels import steps

begin, advance, turn = (wp.kernel(kernel.func, module=__name__) for kernel in (steps.begin, steps.advance, steps.turn))
