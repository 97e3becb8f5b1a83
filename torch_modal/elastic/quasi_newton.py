"""A step of BFGS by a kernel, which does what dozens of small operations do in torch."""

from typing import Any

from torch import Tensor

from torch_modal.elastic.energy import energy_rounding
from torch_modal.elastic.kernels.launch import kernels, launch


def update(state: Any, shortest: float, value: Tensor, slope: Tensor) -> Any:
    """:func:`torch_modal.elastic.minimise.bfgs_update` in float64 on the CPU, in place, with one thread per sample."""
    n_samples, n = state.a.shape[:2]
    args = [
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
    args += [state.energy, state.gradient, state.norm, state.inverse, state.length, state.n_steps]
    launch(kernels("quasi_newton").update, (n_samples,), [*args, value.new_empty(n_samples, n)])
    return state
