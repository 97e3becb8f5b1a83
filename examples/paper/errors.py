"""How far shapes are from the truth, and rows of tables."""

import torch
from torch import Tensor

from torch_modal.geometry.connectivity import Connectivity
from torch_modal.geometry.rigid import best_fit


def lengths(x: Tensor, faces: Tensor) -> Tensor:
    """Of all edges. *Shape:* ``(..., V, 3) -> (..., E)``."""
    i, j = torch.tensor(Connectivity(faces.numpy(), x.shape[-2]).edges).T
    return (x[..., i, :] - x[..., j, :]).norm(dim=-1)


def edge_error(x: Tensor, truth: Tensor, faces: Tensor) -> float:
    """Mean of ``|l - l_true| / l_true`` in per cent. *Shape:* ``(..., V, 3)``."""
    wanted = lengths(truth, faces)
    return 100 * float(((lengths(x, faces) - wanted).abs() / wanted).mean())


def vertex_error(x: Tensor, truth: Tensor) -> float:
    """Mean distance after the best rigid motion of each, in per cent of the diagonal. *Shape:* ``(T, V, 3)``."""
    weights = torch.ones(x.shape[-2], dtype=x.dtype)
    diagonal = (truth.amax(-2) - truth.amin(-2)).norm(dim=-1).mean()
    return 100 * float((best_fit(x, truth, weights).apply(x) - truth).norm(dim=-1).mean() / diagonal)


def percents(*errors: float) -> list[str]:
    """Cells of a table."""
    return [f"{error:.2f} %" for error in errors]
