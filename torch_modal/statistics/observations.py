"""Points that a shape should meet, and an energy that pulls its vertices there."""

from typing import NamedTuple

import torch
from torch import Tensor

from torch_modal.backends.torch.fine_steps import FurtherDerivatives


class Observations(NamedTuple):
    """Points with the vertices that should be there."""

    points: Tensor
    """*Shape:* ``(n, 3)``."""
    vertices: Tensor
    """*Shape:* ``(n,)``."""
    weights: Tensor
    """How much each counts. *Shape:* ``(n,)``."""

    def seen(self, x: Tensor) -> Tensor:
        """The vertices of a shape. *Shape:* ``(V, 3) -> (n, 3)``."""
        return x[self.vertices]


class Pulls:
    """``stiffness sum_i weights_i |x_i - p_i|^2``, as an energy beside that of the terms, of one shape.

    Args:
        to: The observations.
        stiffness: Per squared length.
    """

    def __init__(self, to: Observations, stiffness: float) -> None:
        self.to, self.factors = to, stiffness * to.weights

    def value(self, x: Tensor) -> Tensor:
        """*Shape:* ``(1, V, 3) -> (1,)``."""
        return (self.factors * (self.to.seen(x[0]) - self.to.points).square().sum(-1)).sum()[None]

    def at(self, x: Tensor) -> FurtherDerivatives:
        """*Shape:* ``(1, V, 3)``."""
        off = self.to.seen(x[0]) - self.to.points
        packed = x.new_zeros(x.shape[1], 6)
        eye = packed.new_tensor([1, 0, 0, 1, 0, 1])
        packed = packed.index_add(0, self.to.vertices, 2 * self.factors[:, None] * eye)
        value = (self.factors * off.square().sum(-1)).sum()[None]
        return FurtherDerivatives(
            value, self._spread(off, x), packed[None], lambda f: self._spread(f[0][self.to.vertices], f)
        )

    def _spread(self, at_vertices: Tensor, like: Tensor) -> Tensor:
        """From the observed vertices to all, doubled. *Shape:* ``(n, 3) -> (1, V, 3)``."""
        return torch.zeros_like(like[0]).index_add(0, self.to.vertices, 2 * self.factors[:, None] * at_vertices)[None]


def checked_observations(points: Tensor, vertices: Tensor, n_vertices: int) -> Tensor:
    """The vertices on the CPU.

    Raises:
        ValueError: Points or vertices that do not fit.
    """
    if points.dim() < 2 or points.shape[-1] != 3 or points.shape[-2] < 3 or not points.is_floating_point():
        raise ValueError(
            f"points are floating-point of the shape (..., n, 3), with n of 3 or more; got {tuple(points.shape)} of "
            f"{points.dtype}"
        )
    if not bool(points.detach().isfinite().all()):
        raise ValueError("points hold numbers that are not finite; leave out those that were not observed")
    numbers = torch.as_tensor(vertices).cpu()
    if numbers.shape != points.shape[-2:-1] or numbers.is_floating_point() or numbers.dtype == torch.bool:
        raise ValueError(
            f"vertices hold one vertex index for each of {points.shape[-2]} points; got {tuple(numbers.shape)} of "
            f"{numbers.dtype}"
        )
    if len(numbers.unique()) < 3:
        raise ValueError(f"a pose follows from three vertices or more; got {len(numbers.unique())}")
    if not bool(((numbers >= 0) & (numbers < n_vertices)).all()):
        raise ValueError(f"vertices lie in 0 to {n_vertices - 1}; got {int(numbers.min())} to {int(numbers.max())}")
    return numbers.long()


def checked_weights(near: int | Tensor | None, n: int) -> Tensor:
    """Weights of n shapes that add up to one. *Shape:* ``(n,)``, float64.

    Raises:
        ValueError: They do not, or there is no such shape.
    """
    if near is None:
        return torch.full((n,), 1 / n, dtype=torch.float64)
    if isinstance(near, int):
        if not -n <= near < n:
            raise ValueError(f"near is one of {n} key-frames; got {near}")
        return torch.eye(n, dtype=torch.float64)[near]
    weights = torch.as_tensor(near).detach().to("cpu", torch.float64)
    if weights.shape != (n,) or not bool(((weights >= 0).all()) & ((weights.sum() - 1).abs() < 1e-5)):
        raise ValueError(f"near holds {n} weights, none below zero, that add up to one; got {near}")
    return weights
