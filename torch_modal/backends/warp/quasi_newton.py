"""A step of BFGS by a kernel, which does what dozens of small operations do in torch."""

from typing import Any

from torch import Tensor

from torch_modal.backends.warp.launch import kernels, launch
from torch_modal.energy.energy import energy_rounding


def update(state: Any, shortest: float, value: Tensor, slope: Tensor) -> Any:
    """:func:`torch_modal.solve.minimise.updated` in float64 on the CPU, in place: one thread serves each sample."""
    n = state.a.shape[1]
    given = [
        n,
        value,
        slope,
        1 + energy_rounding(value.dtype),
        shortest,
        state.goal,
        state.rounding,
        state.a,
        state.there,
    ]
    given += [state.energy, state.gradient, state.norm, state.inverse, state.length, state.n_steps]
    launch(kernels("quasi_newton").update, (len(value),), [*given, value.new_empty(len(value), n)])
    return state
