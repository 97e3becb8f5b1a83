"""Strains of faces of a motion; strains that vibration modes cause, and scales of modes that give a strain of one."""

from collections.abc import Sequence

import torch
from torch import Tensor

from torch_modal.elastic import formulas
from torch_modal.elastic.bend import SquaredBend
from torch_modal.elastic.shell import ShellEnergy
from torch_modal.geometry.canonical import size
from torch_modal.geometry.connectivity import Connectivity
from torch_modal.geometry.triangle_frames import FLAT, frames_of, principal_stretches
from torch_modal.geometry.vectors import pick
from torch_modal.io.files import csv_bytes
from torch_modal.modes.basis import ModalBasis
from torch_modal.modes.sheet import THICKNESS

# Eigenvalues below this fraction of the largest belong to loose pieces that move without deforming: no elastic modes.
_NOT_ELASTIC = 1e-8


def mode_scales(basis: ModalBasis, faces: Tensor) -> Tensor:
    r"""Factors of the modes, proportional to :math:`1 / \sqrt{\lambda}`; zero for modes that do not deform.

    Independent standard normal amplitudes of modes so scaled give an expected root mean square strain of one: of the
    edges, or, of sheets, where bending strains their sides more than that, of their sides. *Shape:* ``(k,)``, float64.
    """
    x, values = basis.reference.double(), basis.eigenvalues.double()
    mesh = Connectivity(faces.numpy(), basis.n_vertices)
    scales = torch.where(values > _NOT_ELASTIC * values.amax(), values, torch.inf).rsqrt()
    modes, edges = basis.modes.double() * scales[:, None, None], torch.tensor(mesh.edges)
    strains = edge_strains(modes.movedim(-1, 0).contiguous(), x, edges)
    lengths = (x[edges[:, 1]] - x[edges[:, 0]]).square().sum(-1)
    expected = _rms_strain(strains, torch.ones_like(lengths))
    bending, areas = _bending_strains(modes, x, mesh)
    by_bending = _rms_strain(bending, areas)
    if by_bending > _rms_strain(strains, lengths):  # a sheet, which bends without a change of length
        expected = by_bending
    return scales / expected.clamp_min(torch.finfo(torch.float64).tiny)


def strain_table(names: Sequence[str], shapes: Tensor, faces: Tensor) -> bytes:
    """Volume of each shape, and area and principal strains of each face relative to the first shape, as CSV.

    Strains are changes of length over the length at rest. *Shape:* ``(N, V, 3), (F, 3)``.
    """
    rest, volumes = frames_of(shapes[:1], faces), ShellEnergy(faces).measure(shapes).volume.tolist()
    flat = rest.slenderness[0] <= FLAT
    table: list[list[object]] = [["shape", "volume", "face", "area", "least strain", "largest strain"]]
    for name, volume, shape in zip(names, volumes, shapes, strict=True):
        now = frames_of(shape[None], faces)
        strains = [(value[0] - 1).masked_fill(flat, torch.nan).tolist() for value in principal_stretches(rest, now)]
        for face, (area, *both) in enumerate(zip((0.5 * now.twice_areas[0]).tolist(), *strains, strict=True)):
            shown = ["" if value != value else f"{value:.6f}" for value in both]
            table.append([name, f"{volume:.8g}", face, f"{area:.6g}", *shown])
    return csv_bytes(table)


def edge_strains(displacement: Tensor, x: Tensor, edges: Tensor) -> Tensor:
    """Strains of edges under linear displacements. *Shape:* ``(3, B, V), (V, 3), (E, 2) -> (B, E)``."""
    i, j = edges.unbind(1)
    side = (x[j] - x[i]).mT[:, None]
    along = ((pick(displacement, j) - pick(displacement, i)) * side).sum(0)
    return along / side.square().sum(0).clamp_min(torch.finfo(side.dtype).tiny)


def _rms_strain(strains: Tensor, weights: Tensor) -> Tensor:
    """Expected root mean square for standard normal amplitudes. *Shape:* ``(k, n), (n,) -> ()``."""
    return (strains.square() @ weights / weights.sum()).sum().sqrt()


def _bending_strains(modes: Tensor, x: Tensor, mesh: Connectivity) -> tuple[Tensor, Tensor]:
    """Strain of a sheet's sides across each hinge, and its area. *Shape:* ``(k, V, 3), (V, 3) -> (k, H), (H,)``."""
    first, *others = (torch.cat([x[None], modes])[:, corner] for corner in torch.tensor(mesh.hinges).unbind(1))
    vectors = torch.stack([other - first for other in others]).movedim(-1, 1)
    rest, moves = vectors[:, :, 0], vectors[:, :, 1:]
    angles = (SquaredBend().linearise(rest)[1][:, :, None] * moves).sum((0, 1))
    e, a, b = rest
    tiny = torch.finfo(x.dtype).tiny
    areas = formulas.triangle_area(e, a) + formulas.triangle_area(e, b)
    apart = 2 * areas / (3 * formulas.length(e)).clamp_min(tiny)  # of the centroids
    thickness = THICKNESS * size(x.numpy(), mesh.faces)
    return 0.5 * thickness * angles / apart.clamp_min(tiny), areas
