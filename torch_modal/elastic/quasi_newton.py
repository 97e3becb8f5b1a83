"""A step of BFGS by a kernel, which does what dozens of small operations do in torch."""

import torch
from torch import Tensor

from torch_modal.elastic.energy import energy_rounding
from torch_modal.elastic.kernels.launch import kernels, launch
from torch_modal.elastic.minimise import SHORTEST_STEP, State, bfgs_update


def update(state: State, value: Tensor, slope: Tensor) -> State:
    """:func:`torch_modal.elastic.minimise.bfgs_update`; in float64 on the CPU in place, with one thread per sample."""
    if value.device.type != "cpu" or {state.a.dtype, slope.dtype} != {torch.float64}:
        return bfgs_update(state, value, slope)
    args = [slope.shape[1], value, slope, 1 + energy_rounding(value.dtype), SHORTEST_STEP, *state[1:-1]]
    launch(kernels("quasi_newton").update, (len(value),), [*args, torch.empty_like(slope)])
    return state
