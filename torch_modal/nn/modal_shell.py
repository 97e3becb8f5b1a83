"""Eq. 5 for a shape that moves in an affine space: value, gradient and both Hessians in the amplitudes.

First derivatives are local (3 numbers of an edge, 9 of a hinge) and are gathered through the columns of the space,
which are the same for a whole batch. The second-order term of all measures together reduces to one symmetric 3 x 3
matrix per edge and one vector per face, see :class:`_Curvature`.
"""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor, nn
from torch.func import jvp, vmap

from torch_modal import mesh
from torch_modal.nn.shell import (
    Measures,
    Rest,
    ShellEnergy,
    cross,
    dihedral_gradient,
    length_gradient,
)

# The second-order term of a batch passes through an array of this many bytes at a time.
_CHUNK_BYTES = 2**26


class Derivatives(NamedTuple):
    """Derivatives of an energy in the amplitudes ``a``."""

    gradient: Tensor
    """*Shape:* ``(B, n)``."""
    gauss_newton: Tensor
    """``2 J^T J``, always positive semi-definite. *Shape:* ``(B, n, n)``."""
    second_order: Tensor | None
    """What the full Hessian has more than Gauss-Newton's. *Shape:* ``(B, n, n)``."""
    resolution: Tensor
    """Gradient norm that the rounding of the positions alone explains. *Shape:* ``(B,)``."""


class Reference(NamedTuple):
    """A rest shape that pulls, and how strongly."""

    rest: Rest
    pull: Tensor
    """Factor of its energy. *Shape:* ``(B,)``."""


class Placement(NamedTuple):
    """The affine space of each sample: ``x(a) = base + columns a[:n] (+ extra a[n])``."""

    base: Tensor
    """*Shape:* ``(B, V, 3)``."""
    extra: Tensor | None
    """A column of the sample's own. *Shape:* ``(B, V, 3)``."""
    references: Sequence[Reference]


class ModalShell(nn.Module):
    """Sum of Eq. 5 against several references, for shapes ``x(a)`` of an affine space.

    All references see the same lengths, angles and volume of ``x(a)``, so that one Jacobian serves all of them.

    Args:
        shell: The energy on the mesh that ``columns`` live on.
        columns: Directions of the space. *Shape:* ``(n, V, 3)``.
    """

    columns: Tensor
    hinge_columns: Tensor

    def __init__(self, shell: ShellEnergy, columns: Tensor) -> None:
        super().__init__()
        self.shell = shell
        self.curvature = _Curvature(shell, columns)
        self.register_buffer("columns", columns.permute(1, 2, 0).contiguous())
        spokes = shell.hinge_spokes(columns.movedim(-1, 0))
        self.register_buffer("hinge_columns", spokes.permute(3, 0, 1, 2).flatten(1, 2).contiguous())

    def shape(self, a: Tensor, placement: Placement) -> Tensor:
        """The shape ``x(a)``. *Shape:* ``(..., B, n) -> (..., B, V, 3)``."""
        n = self.columns.shape[-1]
        x = placement.base + (a[..., :n] @ self.columns.flatten(0, 1).mT).unflatten(-1, (-1, 3))
        return x if placement.extra is None else x + a[..., n, None, None] * placement.extra

    def value(self, a: Tensor, placement: Placement) -> Tensor:
        """Energy at ``a``. *Shape:* ``(..., B, n) -> (..., B)``."""
        measures = self.shell.measure(self.shape(a, placement))
        return sum(  # type: ignore[return-value]
            pull * self.shell.energy(measures, rest) for rest, pull in placement.references
        )

    def derivatives(self, a: Tensor, placement: Placement, second_order: bool = True) -> Derivatives:
        """Gradient and Hessians at ``a``.

        Args:
            a: Amplitudes. *Shape:* ``(B, n)``.
            placement: The space of each sample and its references.
            second_order: Whether the term beyond Gauss-Newton is wanted.
        """
        shell = self.shell
        x = self.shape(a, placement)
        slope, curvature = self._slopes(shell.measure(x), placement.references)

        rows = x.movedim(-1, 0).contiguous()
        edges, spokes = shell.edge_vectors(rows), shell.hinge_spokes(rows)
        edge_extra = hinge_extra = None
        if placement.extra is not None:
            extra_rows = placement.extra.movedim(-1, 0)
            edge_extra = shell.edge_vectors(extra_rows).movedim(0, -1)
            hinge_extra = shell.hinge_spokes(extra_rows).flatten(0, 1).movedim(0, -1)
        # Rows of the Jacobian are scaled before they pass through the columns, where they are few numbers.
        parts = (
            (length_gradient(edges), slope.length, curvature.length, self.curvature.edge_columns, edge_extra),
            (dihedral_gradient(spokes).flatten(0, 1), slope.angle, curvature.angle, self.hinge_columns, hinge_extra),
        )
        to_volume = self._volume_gradient(rows).movedim(0, -1).flatten(1)
        volume_row = to_volume @ self.columns.flatten(0, 1)
        if placement.extra is not None:
            volume_row = torch.cat([volume_row, (to_volume * placement.extra.flatten(1)).sum(-1, True)], -1)
        gradient = slope.volume[:, None] * volume_row
        gauss_newton = curvature.volume[:, None, None] * volume_row[:, :, None] * volume_row[:, None, :]
        for local, slopes, curvatures, columns, extra in parts:
            root = curvatures.clamp_min(torch.finfo(curvatures.dtype).tiny).sqrt()
            scaled = _through((root * local).movedim(0, -1), columns, extra)
            gradient = gradient + (scaled.mT @ (slopes / root)[..., None]).squeeze(-1)
            gauss_newton = gauss_newton + scaled.mT @ scaled
        stiffness = curvature.length.sum(-1) + curvature.angle.sum(-1) + curvature.volume
        stiffest = gauss_newton.diagonal(dim1=-2, dim2=-1).amax(-1)
        rounding = torch.finfo(x.dtype).eps * x.abs().amax((-1, -2))
        resolution = rounding * (stiffest * stiffness).sqrt()
        curved = self.second_order(a, placement) if second_order else None
        return Derivatives(gradient, gauss_newton, curved, resolution)

    def second_order(self, a: Tensor, placement: Placement) -> Tensor:
        """What the full Hessian has more than Gauss-Newton's. *Shape:* ``(B, n, n)``."""
        x = self.shape(a, placement)
        slope, _ = self._slopes(self.shell.measure(x), placement.references)
        return self.curvature(self.shell, x.movedim(-1, 0).contiguous(), slope, placement.extra)

    def slope(self, a: Tensor, direction: Tensor, placement: Placement) -> Tensor:
        """Derivative of the energy along a direction of amplitudes: what the adjoint is differentiated through.

        *Shape:* ``(B, n), (B, n) -> (B,)``.
        """
        shell = self.shell
        x = self.shape(a, placement)
        moved = self.shape(direction, placement) - placement.base
        rows, along = (y.movedim(-1, 0).contiguous() for y in (x, moved))
        slope, _ = self._slopes(shell.measure(x), placement.references)
        length = (length_gradient(shell.edge_vectors(rows)) * shell.edge_vectors(along)).sum(0)
        angle = (dihedral_gradient(shell.hinge_spokes(rows)) * shell.hinge_spokes(along)).sum((0, 1))
        volume = (self._volume_gradient(rows) * along).sum((0, -1))
        return (slope.length * length).sum(-1) + (slope.angle * angle).sum(-1) + slope.volume * volume

    def _volume_gradient(self, rows: Tensor) -> Tensor:
        """Gradient of :meth:`ShellEnergy.volume`. *Shape:* ``(3, B, V) -> (3, B, V)``."""
        shell = self.shell
        rows = rows - rows[..., shell.used].mean(-1, keepdim=True)
        a, b, c = (rows[..., corner] for corner in shell.faces.unbind(1))
        parts = [cross(*pair) for pair in ((b, c), (c, a), (a, b))]
        out = torch.zeros_like(rows).index_add(-1, shell.faces.T.flatten(), torch.cat(parts, -1)) / 6
        mean = out.sum(-1, keepdim=True) / len(shell.used)  # the centroid moves along; zero on a closed surface
        return out.index_add(-1, shell.used, -mean.expand(-1, -1, len(shell.used)).contiguous())

    def _slopes(self, measures: Measures, references: Sequence[Reference]) -> tuple[Measures, Measures]:
        """First and second derivative of the energy in each measure, summed over the references."""
        slopes, curvatures = [], []
        for rest, pull in references:
            differences = self.shell.differences(measures, rest)
            pulls = (pull[:, None], pull[:, None], pull)
            doubled = [2 * p * w for p, w in zip(pulls, rest.weights, strict=True)]
            slopes.append([w * d for w, d in zip(doubled, differences, strict=True)])
            curvatures.append(doubled)
        return (
            Measures(*(sum(parts) for parts in zip(*slopes, strict=True))),
            Measures(*(sum(parts) for parts in zip(*curvatures, strict=True))),
        )


class _Curvature(nn.Module):
    r"""The second-order term :math:`\sum_q E'(q)\, \nabla^2 q` over all measures ``q``, in the amplitudes.

    A hinge angle has no mixed derivative between its two tips, so that each block of its Hessian lives on one triangle.
    A block ``G`` between two sides ``u, v`` of a triangle with the third side ``v - u`` splits into its symmetric part,
    where ``2 u.Gv = u.Gu + v.Gv - (v-u).G(v-u)`` leaves one matrix on each side, and its antisymmetric part, where
    ``u.(w x v)`` is the same for any two sides of the triangle in order: one vector ``w``. The volume of a closed
    surface is of the second kind; any other is closed with cones to its centroid.

    Args:
        shell: The energy.
        columns: Directions of the space. *Shape:* ``(n, V, 3)``.
    """

    closed_faces: Tensor
    hinge_sides: Tensor
    hinge_faces: Tensor
    hinge_signs: Tensor
    edge_columns: Tensor
    face_first: Tensor
    face_second: Tensor

    def __init__(self, shell: ShellEnergy, columns: Tensor) -> None:
        super().__init__()
        faces, edges, hinges = (t.cpu().numpy() for t in (shell.faces, shell.edges, shell.hinges))
        n_vertices = columns.shape[1]
        cone = np.array([[j, i, n_vertices] for i, j in mesh.boundary_chain(faces)]).reshape(-1, 3)
        self.register_buffer("closed_faces", torch.from_numpy(np.concatenate([faces, cone]).astype(np.int64)))
        i, j, k, m = hinges.T
        sides = [(i, j), (i, k), (i, m), (j, k), (j, m)]
        lookup = np.stack([mesh.edge_index(edges, p, q) for p, q in sides])
        self.register_buffer("hinge_sides", torch.from_numpy(lookup))
        owners, signs = zip(*(mesh.face_index(faces, *corners) for corners in ((i, j, k), (i, j, m))), strict=True)
        self.register_buffer("hinge_faces", torch.from_numpy(np.stack(owners)))
        self.register_buffer("hinge_signs", torch.from_numpy(np.stack(signs)).to(columns))

        def last(x: Tensor) -> Tensor:
            return x.permute(2, 0, 1).contiguous()

        rows = columns.movedim(-1, 0)
        self.register_buffer("edge_columns", last(shell.edge_vectors(rows)))
        first, second = self._face_sides(shell, rows)
        self.register_buffer("face_first", last(first))
        self.register_buffer("face_second", last(second))

    def _face_corners(self, shell: ShellEnergy, rows: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        """Corners of the closed surface. *Shape:* ``(3, ..., V) -> 3 of (3, ..., F_closed)``."""
        centre = rows[..., shell.used].mean(-1, keepdim=True)
        rows = torch.cat([rows, centre], -1)
        p, q, r = (rows[..., corner] for corner in self.closed_faces.unbind(1))
        return p, q, r

    def _face_sides(self, shell: ShellEnergy, rows: Tensor) -> tuple[Tensor, Tensor]:
        p, q, r = self._face_corners(shell, rows)
        return q - p, r - p

    def forward(self, shell: ShellEnergy, rows: Tensor, slope: Measures, extra: Tensor | None) -> Tensor:
        """The term for shapes with given slopes. *Shape:* ``(B, n, n)``.

        Args:
            shell: The energy that the term belongs to.
            rows: The shapes. *Shape:* ``(3, B, V)``.
            slope: Derivative of the energy in each measure.
            extra: The column of each sample's own. *Shape:* ``(B, V, 3)``.
        """
        on_edges, on_faces = self._local(shell, rows, slope)
        chunk = max(1, _CHUNK_BYTES // (self.edge_columns.numel() * self.edge_columns.element_size()))
        parts = zip(on_edges.split(chunk), on_faces.split(chunk), strict=True)
        inner = torch.cat([self._sandwich(*part) for part in parts])
        if extra is None:
            return inner
        extra_rows = extra.movedim(-1, 0)
        own_edges = shell.edge_vectors(extra_rows).movedim(0, -1)
        own_first, own_second = (side.movedim(0, -1) for side in self._face_sides(shell, extra_rows))
        bent = (on_edges @ own_edges[..., None]).squeeze(-1)
        turned_first = torch.linalg.cross(on_faces, own_first)
        turned_second = torch.linalg.cross(own_second, on_faces)
        border = (
            bent.flatten(1) @ self.edge_columns.flatten(0, 1)
            + turned_second.flatten(1) @ self.face_first.flatten(0, 1)
            + turned_first.flatten(1) @ self.face_second.flatten(0, 1)
        )
        corner = (own_edges * bent).sum((1, 2)) + 2 * (own_first * turned_second).sum((1, 2))
        upper = torch.cat([inner, border[..., None]], -1)
        lower = torch.cat([border, corner[:, None]], -1)
        return torch.cat([upper, lower[:, None]], 1)

    def _local(self, shell: ShellEnergy, rows: Tensor, slope: Measures) -> tuple[Tensor, Tensor]:
        """Matrices on edges ``(B, E, 3, 3)`` and vectors on faces ``(B, F_closed, 3)``."""
        stretch = slope.length * _length_hessian(shell.edge_vectors(rows))
        ee, ea, eb, aa, bb = slope.angle * _angle_hessian(shell.hinge_spokes(rows))
        sym_a, sym_b = 0.5 * (ea + ea.transpose(0, 1)), 0.5 * (eb + eb.transpose(0, 1))
        on_sides = torch.cat([ee + sym_a + sym_b, aa + sym_a, bb + sym_b, -sym_a, -sym_b], -1)
        on_edges = stretch.index_add(-1, self.hinge_sides.flatten(), on_sides)

        p, q, r = self._face_corners(shell, rows)
        on_faces = slope.volume[:, None] * (p + q + r - 3 * rows[..., shell.used].mean(-1, keepdim=True)) / 6
        twists = torch.cat([_axial(ea) * self.hinge_signs[0], _axial(eb) * self.hinge_signs[1]], -1)
        on_faces = on_faces.index_add(-1, self.hinge_faces.flatten(), twists)
        return on_edges.permute(2, 3, 0, 1), on_faces.movedim(0, -1)

    def _sandwich(self, on_edges: Tensor, on_faces: Tensor) -> Tensor:
        """Through the columns on both sides. *Shape:* ``(B, n, n)``."""
        edge_part = self.edge_columns.flatten(0, 1).mT @ _per_item(on_edges, self.edge_columns).flatten(1, 2)
        turned = _per_item(_cross_with(on_faces), self.face_second)
        face_part = self.face_first.flatten(0, 1).mT @ turned.flatten(1, 2)
        return edge_part + face_part + face_part.mT


def _cross_with(w: Tensor) -> Tensor:
    """The matrix that takes ``x`` to ``x cross w``. *Shape:* ``(..., 3) -> (..., 3, 3)``."""
    x, y, z = w.unbind(-1)
    zero = torch.zeros_like(x)
    return torch.stack([zero, z, -y, -z, zero, x, y, -x, zero], -1).unflatten(-1, (3, 3))


def _length_hessian(edges: Tensor) -> Tensor:
    """Hessians of edge lengths, from their gradient by ``torch.func``. *Shape:* ``(3, ...) -> (3, 3, ...)``."""
    return vmap(lambda unit: jvp(length_gradient, (edges,), (unit,))[1])(_unit_vectors(edges))


def _angle_hessian(spokes: Tensor) -> Tensor:
    """Blocks ``ee, ea, eb, aa, bb`` of the Hessians of dihedral angles, from their gradient by ``torch.func``.

    The block ``ab`` is zero, so that both tips are turned at once: six directions instead of nine. Blocks are indexed
    by row, then column. *Shape:* ``(3, 3, ...) -> (5, 3, 3, ...)``.
    """
    units = _unit_vectors(spokes[0])
    still = torch.zeros_like(units)
    along = torch.cat([torch.stack([units, still, still], 1), torch.stack([still, units, units], 1)])
    columns = vmap(lambda direction: jvp(dihedral_gradient, (spokes,), (direction,))[1])(along)
    by_edge, by_tips = columns[:3], columns[3:]
    # The e columns hold the blocks ee, ae and be: the last two are the transposes of ea and eb.
    ee, ea, eb = by_edge.unbind(1)
    return torch.stack([ee, ea, eb, by_tips[:, 1], by_tips[:, 2]])


def _unit_vectors(like: Tensor) -> Tensor:
    """The three constant fields of unit vectors. *Shape:* ``(3, ...) -> (3, 3, ...)``."""
    eye = torch.eye(3, dtype=like.dtype, device=like.device)
    return eye.reshape(3, 3, *[1] * (like.dim() - 1)).expand(3, *like.shape)


def _axial(g: Tensor) -> Tensor:
    """The vector of the antisymmetric part: ``u.Gv`` is ``w.(u x v)`` there. *Shape:* ``(3, 3, ...) -> (3, ...)``."""
    return 0.5 * torch.stack([g[1, 2] - g[2, 1], g[2, 0] - g[0, 2], g[0, 1] - g[1, 0]])


def _through(gradient: Tensor, columns: Tensor, extra: Tensor | None) -> Tensor:
    """Chain rule from local numbers to amplitudes. *Shape:* ``(B, M, c), (M, c, n) -> (B, M, n)``."""
    rows = _per_item(gradient[:, :, None], columns).squeeze(2)
    if extra is None:
        return rows
    return torch.cat([rows, (gradient * extra).sum(-1, keepdim=True)], -1)


def _per_item(left: Tensor, columns: Tensor) -> Tensor:
    """A product for each edge or hinge, of all samples at once. *Shape:* ``(B, M, r, c), (M, c, n) -> (B, M, r, n)``.

    Batched products of tiny matrices are fast in one dense block only; any other layout is copied matrix by matrix.
    """
    b, m, r, c = left.shape
    stacked = left.transpose(0, 1).reshape(m, b * r, c).contiguous()
    return (stacked @ columns).unflatten(1, (b, r)).transpose(0, 1)
