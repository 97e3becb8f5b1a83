"""Points that follow a shape."""

import math
import warnings
from functools import partial

import torch
from scipy import sparse
from torch import Tensor, nn

from torch_modal.autograd import full_precision, is_traced, linear_map, outside_inference_mode
from torch_modal.geometry.rigid import best_rotation
from torch_modal.geometry.triangle_frames import side_frames, sides
from torch_modal.geometry.vectors import cross, inverse, norm
from torch_modal.keyframes.arrays import check_tensor
from torch_modal.keyframes.check import check_arrays
from torch_modal.passengers.binding import bind_points

HIGHEST_BULGE = 0.0075
"""Bound on the distance of points from flat triangles whose corners turn apart, in diagonals of the reference."""


class Passengers(nn.Module):
    r"""Points that follow a carrier: markers, scans, splats, fine meshes, accessories.

    Each point is bound once, to the vertices of the nearest triangles, and moves with them and with the rotation of the
    surface around them:

    .. math::
        p'(x) = \sum_v w_v \left(x_v + R_v(x)\, (p - \bar x_v)\right)

    (embedded deformation, Sumner et al. 2007, with rotations that follow from the shape). Rigid motions are followed
    exactly, and so are the carrier's own vertices. Points within a triangle follow a surface that is rounder than it
    where its corners turn apart, by less than 0.75 % of the diagonal: the bulge :math:`\sum_v w_v R_v (q - \bar x_v)`
    at :math:`q = \sum_v w_v \bar x_v` is bounded. Parts that are near in space and not along the surface, such as
    fingers, do not pull on each other's points. The time is linear in the number of points.

    Results have the dtype and the device of the shapes, where the module has to be too (``.to``). Gradients reach the
    shapes.

    Args:
        reference: The carrier when the points are bound. *Shape:* ``(V, 3)``.
        faces: Vertex indices. *Shape:* ``(F, 3)``.
        points: In the coordinates of the reference. *Shape:* ``(P, 3)``.
        anchors: A vertex of the carrier that each point belongs to, or -1 where it is not known: the point follows the
            triangles there, even if others are nearer. *Shape:* ``(P,)``.
        weights: :attr:`weights` of passengers in another pose. Default: bound here. *Shape:* ``(P, V)``.

    Raises:
        ValueError: Shapes of the arguments do not fit, or numbers are not finite.
    """

    reference: Tensor
    faces: Tensor
    points: Tensor
    feet: Tensor
    highest: Tensor
    inverses: Tensor
    areas: Tensor
    per_area: Tensor
    starts: Tensor
    columns: Tensor
    values: Tensor
    transposed_starts: Tensor
    transposed_columns: Tensor
    transposed_values: Tensor

    @outside_inference_mode
    def __init__(
        self,
        reference: Tensor,
        faces: Tensor,
        points: Tensor,
        anchors: Tensor | None = None,
        *,
        weights: sparse.csr_matrix | None = None,
    ) -> None:
        super().__init__()
        for name, x in (("reference", reference), ("points", points)):
            check_tensor(name, x, "n", 3, finite=True)
        corners = torch.from_numpy(check_arrays(reference[None], faces)[2])
        if anchors is not None and (
            anchors.shape != points.shape[:1] or bool(((anchors < -1) | (anchors >= len(reference))).any())
        ):
            raise ValueError(f"anchors hold a vertex of {len(reference)} for each of {len(points)} points, or -1")
        rest, bound = (x.detach().double().cpu() for x in (reference, points))
        doubled = cross(*sides(rest.mT, corners))
        if not bool(doubled.any()):
            raise ValueError("no face of the reference has an area: there is no surface to follow")
        if weights is None:
            known = None if anchors is None else anchors.detach().cpu().numpy()
            weights = bind_points(bound.numpy(), rest.numpy(), corners.numpy(), known)
        frame = side_frames(rest.mT, corners).movedim(-1, 0)  # (F, 3, 3)
        area = 0.5 * norm(doubled)
        flat = area <= 1e-12 * area.mean()
        area = torch.where(flat, 0, area)
        total = area.new_zeros(len(rest)).index_add(0, corners.flatten(), area.repeat_interleave(3))
        inverses = torch.linalg.inv(torch.where(flat[:, None, None], torch.eye(3).to(frame), frame))
        buffers = {"reference": rest, "faces": corners, "points": bound}
        diagonal = (rest[corners].amax((0, 1)) - rest[corners].amin((0, 1))).norm()
        buffers |= {"feet": torch.from_numpy(weights @ rest.numpy()), "highest": HIGHEST_BULGE * diagonal}
        buffers |= {"inverses": inverses, "areas": area, "per_area": inverse(total, total <= 0)}
        # Weights by rows, and their transpose: torch would make it anew at each backward pass.
        for prefix, matrix in (("", weights), ("transposed_", weights.T.tocsr())):
            for name, array in (("starts", matrix.indptr), ("columns", matrix.indices), ("values", matrix.data)):
                buffers[prefix + name] = torch.from_numpy(array)
        for name, buffer in buffers.items():
            self.register_buffer(name, buffer, persistent=False)
        self.to(reference)

    @property
    def weights(self) -> sparse.csr_matrix:
        """Weights of the carrier's vertices for each point. *Shape:* ``(P, V)``."""
        arrays = (tensor.cpu().numpy() for tensor in (self.values, self.columns, self.starts))
        return sparse.csr_matrix(tuple(arrays), shape=(len(self), len(self.reference)))

    def __len__(self) -> int:
        return len(self.points)

    @full_precision
    def forward(self, shapes: Tensor) -> Tensor:
        """The points of each shape; NaN for a shape that is not finite. *Shape:* ``(..., V, 3) -> (..., P, 3)``.

        Raises:
            ValueError: Shapes of another carrier, dtype or device.
        """
        flat = self._flat(shapes)
        turns = best_rotation(self._deformation(flat))  # (B, V, 3, 3)
        # About the carrier's middle, for the sake of float32.
        middle = self.reference.mean(0)
        turned = torch.einsum("bvij,vj->bvi", turns, self.reference - middle)
        mixed = self._mix(torch.cat([turns.flatten(2), flat - middle, turned], -1))
        turn, foot = mixed[..., :9].unflatten(-1, (3, 3)), mixed[..., 9:12]
        bulge = (turn * (self.feet - middle)[:, None]).sum(-1) - mixed[..., 12:]
        bounded = bulge / (1 + (bulge / self.highest).square().sum(-1, keepdim=True)).sqrt()
        moved = foot + (turn * (self.points - self.feet)[:, None]).sum(-1) + bounded
        return (moved + middle).view(*shapes.shape[:-2], len(self), 3)

    @full_precision
    def rotations(self, shapes: Tensor) -> Tensor:
        """Rotation of the surface around each point. *Shape:* ``(..., V, 3) -> (..., P, 3, 3)``."""
        flat = self._flat(shapes)
        mixed = self._mix(best_rotation(self._deformation(flat)).flatten(2)).unflatten(-1, (3, 3))
        return best_rotation(mixed).view(*shapes.shape[:-2], len(self), 3, 3)

    @full_precision
    def gradients(self, shapes: Tensor) -> Tensor:
        """Deformation gradient around each point, of constant thickness. *Shape:* ``(..., V, 3) -> (..., P, 3, 3)``.

        A covariance ``C`` at a point becomes ``G C G^T``.
        """
        flat = self._flat(shapes)
        mixed = self._mix(self._deformation(flat).flatten(2)).unflatten(-1, (3, 3))
        return mixed.view(*shapes.shape[:-2], len(self), 3, 3)

    def _flat(self, shapes: Tensor) -> Tensor:
        check_tensor("shapes", shapes, "...", *self.reference.shape, device=self.reference.device)
        if shapes.dtype != self.reference.dtype:
            raise ValueError(
                f"shapes are {shapes.dtype}, the passengers {self.reference.dtype}; use passengers.to(shapes.dtype)"
            )
        # Unlike the shape's numel(), this keeps the batch of an export dynamic.
        flat = shapes.reshape(math.prod(shapes.shape[:-2]), *shapes.shape[-2:])
        return torch.where(flat.isfinite().all((1, 2), keepdim=True), flat, torch.nan)

    def _deformation(self, x: Tensor) -> Tensor:
        """Mean deformation gradient around each vertex. *Shape:* ``(B, V, 3) -> (B, V, 3, 3)``."""
        frame = side_frames(x.movedim(-1, 0).contiguous(), self.faces).movedim((0, 1), (-2, -1))  # (B, F, 3, 3)
        each = ((frame @ self.inverses) * self.areas[:, None, None]).flatten(2)
        summed = x.new_zeros(*x.shape[:2], 9)
        for corner in self.faces.T:
            summed = summed.index_add(1, corner, each)
        return (summed * self.per_area[:, None]).unflatten(-1, (3, 3))

    def _mix(self, values: Tensor) -> Tensor:
        """Weighted sums over the vertices that points follow. *Shape:* ``(B, V, n) -> (B, P, n)``."""
        if is_traced(values):  # sparse products cannot be traced
            counts = self.starts.diff().long()
            row = torch.arange(len(self), device=values.device).repeat_interleave(counts, output_size=len(self.values))
            each = values[:, self.columns.long()] * self.values[:, None]
            return values.new_zeros(values.shape[0], len(self), values.shape[2]).index_add(1, row, each)
        product = partial(_product, self.starts, self.columns, self.values)
        transposed = partial(_product, self.transposed_starts, self.transposed_columns, self.transposed_values)
        return linear_map(product, transposed, values)


def _product(starts: Tensor, columns: Tensor, values: Tensor, x: Tensor) -> Tensor:
    """Product of a sparse matrix of P rows and a dense one. *Shape:* ``(..., V, n) -> (..., P, n)``."""
    rows, n = x.movedim(-2, 0), len(starts) - 1
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", "Sparse CSR")  # "beta", since 2021
        matrix = torch.sparse_csr_tensor(starts, columns, values, (n, len(rows)), check_invariants=False)
    return (matrix @ rows.flatten(1)).view(n, *rows.shape[1:]).movedim(0, -2)
