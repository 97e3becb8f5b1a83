"""How far shapes are from the truth, and rows of tables."""

import torch
from torch import Tensor

import torch_modal as tm
from torch_modal.geometry.connectivity import Connectivity


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
    diagonal = (truth.amax(-2) - truth.amin(-2)).norm(dim=-1).mean()
    return 100 * float((tm.align(x, truth) - truth).norm(dim=-1).mean() / diagonal)


def percents(*errors: float) -> list[str]:
    """Cells of a table."""
    return [f"{error:.2f} %" for error in errors]
