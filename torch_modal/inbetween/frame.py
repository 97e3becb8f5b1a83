"""Between the caller's coordinates and the frame in which an in-between is sought."""

from collections.abc import Callable, Sequence
from functools import partial
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from torch_modal.autograd import applied, lasting
from torch_modal.backends.torch.alignment import Alignment
from torch_modal.geometry.canonical import canonical_scale
from torch_modal.geometry.connectivity import vertex_areas
from torch_modal.geometry.rigid import best_fit
from torch_modal.inbetween.columns import Columns, Directions
from torch_modal.inbetween.resolution import resolving
from torch_modal.precompute.coarsening import Coarsening, Collapses

Collapsing = Callable[[int, int], Coarsening]

# Combinations of columns whose squared norm is below this part of the largest are rounding, not directions.
DEPENDENT = 1e-9


class Coarse(nn.Module):
    """The coarse mesh on which the energy is evaluated, and the restriction to it.

    Args:
        shapes: In the frame, float64 on the CPU. *Shape:* ``(K, V, 3)``.
        faces: Vertex indices. *Shape:* ``(F, 3)``.
        n_faces: Of the coarse mesh, or more, where that does not resolve the modes or pieces.
        weights: Of the vertices. *Shape:* ``(V,)``.
        collapses: As for :func:`torch_modal.precompute.coarsening.coarsen`.
        modes: Of the shapes, which the coarse mesh should resolve; none if it does not matter. *Shape:* ``(k, V, 3)``.
    """

    faces: Tensor
    weights: Tensor
    clusters: Tensor
    members: Tensor
    first_member: Tensor
    shares_of_members: Tensor

    def __init__(
        self,
        shapes: Tensor,
        faces: Tensor,
        n_faces: int,
        weights: Tensor,
        collapses: Collapsing | None,
        modes: Sequence[Tensor],
    ) -> None:
        super().__init__()
        coarsening = resolving(shapes, faces, n_faces, collapses, modes)
        clusters = torch.from_numpy(coarsening.clusters).clamp_min(0)
        member = torch.from_numpy(coarsening.clusters >= 0).double()
        per_cluster = torch.zeros(coarsening.n_vertices, dtype=torch.float64)

        self.n_vertices = coarsening.n_vertices
        self.register_buffer("faces", torch.from_numpy(coarsening.faces), persistent=False)
        self.register_buffer("weights", per_cluster.index_add(0, clusters, weights), persistent=False)
        self.register_buffer("clusters", clusters, persistent=False)
        shares = member / per_cluster.index_add(0, clusters, member)[clusters]
        #: Fine vertices in the order of their clusters, and where each cluster begins there.
        self.register_buffer("members", torch.argsort(clusters, stable=True), persistent=False)
        sizes = torch.bincount(clusters, minlength=self.n_vertices)
        self.register_buffer("first_member", sizes.cumsum(0) - sizes, persistent=False)
        self.register_buffer("shares_of_members", shares[self.members], persistent=False)
        #: Rigid motions of the mean of the shapes, to first order.
        fields = _rigid_fields(shapes.mean(0))
        coarse = self.restrict(fields)
        mix = self.orthonormal(coarse)
        self.rigid = Columns([mix], [Directions(fields)], torch.tensordot(mix, coarse, 1), self.weights)

    def restrict(self, x: Tensor) -> Tensor:
        """Cluster averages, linear in ``x``. *Shape:* ``(..., V, 3) -> (..., V_coarse, 3)``."""
        flat = x.reshape(-1, *x.shape[-2:])
        means = applied(_ClusterMeans, flat, self.members, self.first_member, self.shares_of_members, self.clusters)
        return means.reshape(*x.shape[:-2], self.n_vertices, 3)

    def orthonormal(self, coarse: Tensor, most: int | None = None) -> Tensor:
        """Combinations of coarse directions that are orthonormal; dependent ones are dropped. *Shape:* ``(n, m)``.

        Args:
            coarse: *Shape:* ``(m, V_coarse, 3)``.
            most: How many at most: those that the directions have most in common.
        """
        weighted = (coarse * self.weights[:, None]).flatten(1)
        values, vectors = torch.linalg.eigh(weighted @ coarse.flatten(1).mT)
        keep = values > DEPENDENT * values.amax().clamp_min(torch.finfo(values.dtype).tiny)
        return (vectors[:, keep] / values[keep].sqrt()).mT[-most if most else None :]


class Frame(Alignment):
    """The scale of 100, the alignment of two bases or more, and the coarse mesh that the energy is evaluated on.

    Args:
        shapes: The references of the bases, float64 on the CPU, checked. *Shape:* ``(K, V, 3)``.
        faces: Vertex indices, likewise. *Shape:* ``(F, 3)``.
        coarse_faces: Number of faces of the coarse mesh.
        weights: Of the vertices in alignments. Default: their mean areas. *Shape:* ``(V,)``.
        collapses: What is shared of the edge collapses of both, given them in the frame. Default: nothing.
        modes: Of the bases, which the coarse mesh should resolve. *Shape of each:* ``(k, V, 3)``.
    """

    faces: Tensor
    turns: Tensor

    def __init__(
        self,
        shapes: Tensor,
        faces: Tensor,
        coarse_faces: int,
        weights: Tensor | None = None,
        collapses: Callable[[NDArray[np.float64]], Collapsing] | None = None,
        modes: Sequence[Tensor] = (),
    ) -> None:
        scale = torch.tensor(canonical_scale(shapes.numpy(), faces.numpy()), dtype=shapes.dtype)
        weights = mean_areas(shapes, faces) if weights is None else weights
        turns = [best_fit(x, shapes[0], weights) for x in shapes[1:]]
        centre = turns[0].target
        turned = [turn.apply(x) - centre for turn, x in zip(turns, shapes[1:], strict=True)]
        references = torch.stack([shapes[0] - centre, *turned]) * scale
        super().__init__(references[0].clone(), scale, weights)
        self.register_buffer("faces", faces, persistent=False)
        #: From the bases after the first to the frame. *Shape:* ``(K - 1, 3, 3)``.
        self.register_buffer("turns", torch.stack([turn.rotation for turn in turns]), persistent=False)
        own = None if collapses is None else collapses(references.numpy())
        turned_modes = [part.turned(part.given) for part in self.modes(*modes)] if modes else []
        self._coarse: Any = None
        self._make: Any = partial(Coarse, references, faces, coarse_faces, weights, own, turned_modes)

    @property
    def coarse(self) -> Coarse:
        """Tables that only minimisations need, built on first use."""
        if self._coarse is None:
            self._coarse, self._make = lasting(self._make)(), None
        return self._coarse  # type: ignore[no-any-return]

    def _apply(self, fn: Callable[[Tensor], Tensor], recurse: bool = True) -> "Frame":
        """Nothing is made in a lower precision, or on another device, than float64 on the CPU."""
        after = fn(self.reference)
        if (after.dtype, after.device) != (self.reference.dtype, self.reference.device):
            self.coarse  # noqa: B018
        return super()._apply(fn, recurse)

    @property
    def rigid(self) -> Columns:
        """Rigid motions of the mean of the references, to first order."""
        return self.coarse.rigid

    def modes(self, first: Tensor, *others: Tensor) -> list[Directions]:
        """Modes of the bases, in this frame; their scale does not matter. *Shape of each:* ``(k, V, 3)``."""
        return [Directions(first), *(Directions(x, turn) for x, turn in zip(others, self.turns, strict=True))]

    def coarsen(self, x: Tensor) -> Tensor:
        """Cluster averages, linear in ``x``. *Shape:* ``(..., V, 3) -> (..., V_coarse, 3)``."""
        return self.coarse.restrict(x)

    def split(self, coarse: Tensor, columns: Columns) -> tuple[Tensor, Tensor]:
        """Amplitudes of columns in coarse directions, and the remainder. *Shape:* ``(..., n), (..., V_coarse, 3)``."""
        amplitudes = coarse.flatten(-2) @ columns.weighted
        return amplitudes, coarse - (amplitudes @ columns.coarse.flatten(1)).unflatten(-1, (-1, 3))

    def elastic_columns(self, *directions: Directions) -> Columns:
        """Independent combinations of directions, without rigid motions, orthonormal on the coarse mesh.

        The energy does not see translations, and rotations only to second order: left in, they are null directions of
        its Hessian. Modes of two key-frames are partly the same: what is dependent is dropped here, explicitly.

        Args:
            directions: Of any scale.

        Returns:
            No more columns than two of the parts have directions: of more parts, what most of them have in common.
        """
        counts = sorted(len(part.given) for part in directions)
        restricted = torch.cat([part.turned(self.coarsen(part.given)) for part in directions])
        rigid, coarse = self.split(restricted, self.rigid)
        sizes = torch.linalg.norm(coarse.flatten(1), dim=1)[:, None].clamp_min(torch.finfo(coarse.dtype).tiny)
        mix = self.coarse.orthonormal(coarse / sizes[:, None], sum(counts[-2:])) / sizes.T
        mixes = [*mix.split([len(part.given) for part in directions], 1), -(mix @ rigid)]
        parts = [*directions, Directions(self.rigid.fine)]
        return Columns(mixes, parts, torch.tensordot(mix, coarse, 1), self.coarse.weights)


class _ClusterMeans(torch.autograd.Function):
    """Sums over clusters, one after the other: ten times as fast as ``index_add``. *Shape:* ``(B, V, 3)``."""

    @staticmethod
    def forward(x: Tensor, members: Tensor, first_member: Tensor, shares: Tensor, clusters: Tensor) -> Tensor:
        # As a matrix it is transposed in blocks, several times as fast as by its dimensions.
        alone = len(x) == 1
        rows = x.detach()[0].contiguous() if alone else x.detach().flatten(1).T.contiguous().view(x.shape[1], -1)
        means = nn.functional.embedding_bag(members, rows, first_member, mode="sum", per_sample_weights=shares.detach())
        return means[None] if alone else means.unflatten(1, (3, len(x))).permute(2, 0, 1).contiguous()

    @staticmethod
    def setup_context(ctx: Any, inputs: tuple[Tensor, ...], output: Tensor) -> None:
        ctx.given = inputs[1:]

    @staticmethod
    def jvp(ctx: Any, tangent: Tensor, *_: None) -> Tensor:
        return _ClusterMeans.apply(tangent, *ctx.given)

    @staticmethod
    def backward(ctx: Any, *grads: Tensor) -> tuple[Tensor | None, ...]:
        members, _, shares, clusters = ctx.given
        received = shares[:, None] * grads[0].index_select(-2, clusters[members])
        return torch.zeros_like(received).index_copy(-2, members, received), None, None, None, None

    @staticmethod
    def vmap(info: Any, in_dims: tuple[Any, ...], x: Tensor, *given: Tensor) -> tuple[Tensor, int]:
        flat = x.movedim(in_dims[0], 0)
        return _ClusterMeans.apply(flat.flatten(0, 1), *given).unflatten(0, flat.shape[:2]), 0


def mean_areas(shapes: Tensor, faces: Tensor) -> Tensor:
    """Vertex areas of several shapes, as parts of the whole: none of them comes first. *Shape:* ``(K, V, 3)``."""
    areas = torch.stack([torch.from_numpy(vertex_areas(x.numpy(), faces.numpy())) for x in shapes])
    return (areas / areas.sum(1, keepdim=True)).mean(0)


def shared_collapses(faces: Tensor) -> Callable[..., Collapsing]:
    """Edge collapses of shapes that several pairs have, given by their places, each made once. *Shape:* ``(F, 3)``."""
    return Collapses(faces.numpy()).of


def _rigid_fields(x: Tensor) -> Tensor:
    """Translations and infinitesimal rotations of a shape. *Shape:* ``(V, 3) -> (6, V, 3)``."""
    axes = torch.eye(3, dtype=x.dtype, device=x.device)[:, None].expand(3, *x.shape)
    return torch.cat([axes, torch.linalg.cross(axes, x.expand(3, *x.shape))])
