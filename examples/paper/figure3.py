"""Figure 3: the first eight modes of a beam, from its surface and from the solid inside.

A surface alone has modes that pinch and shrivel it. The surface's are those of as-rigid-as-possible edges (Huang et al.
2009, uniform weights), the solid's those of :func:`torch_modal.extract_modes`. Printed is the part of the enclosed
volume that each mode changes, at the same size of motion.
"""

from collections.abc import Sequence
from pathlib import Path

import _paths  # noqa: F401
import numpy as np
import torch
import trimesh
from results import Table, wanted
from torch import Tensor

import torch_modal as tm

N_MODES, AMPLITUDE = 8, 0.12
COLUMNS = ["volume changed", *(f"mode {i + 1}" for i in range(N_MODES))]
CHECK = "solid surface"


def beam() -> tuple[Tensor, Tensor]:
    """A bar of 4 x 1 x 0.6, of even triangles."""
    mesh = trimesh.creation.box((4.0, 1.0, 0.6)).subdivide_to_size(0.34)
    mesh.merge_vertices()
    return torch.from_numpy(np.array(mesh.vertices)), torch.from_numpy(np.array(mesh.faces, dtype=np.int64))


def surface_modes(x: Tensor, faces: Tensor, n: int) -> Tensor:
    """Of ``sum_i sum_j |u_j - u_i - w_i x e_ij|^2``, rotations eliminated. *Shape:* ``(n, V, 3)``."""
    v = len(x)
    pairs = torch.cat([faces[:, [0, 1]], faces[:, [1, 2]], faces[:, [2, 0]]])
    i, j = torch.cat([pairs, pairs.flip(1)]).unique(dim=0).T
    edges = x[j] - x[i]
    eye, m = torch.eye(3, dtype=x.dtype), len(i)
    skew = torch.linalg.cross(eye[None].expand(m, 3, 3), edges[:, None].expand(m, 3, 3)).mT  # w x e = skew w
    rows = torch.arange(3 * m).reshape(m, 3)
    a = torch.zeros(3 * m, 3 * v, dtype=x.dtype)
    b = torch.zeros(3 * m, 3 * v, dtype=x.dtype)
    axes = torch.arange(3)
    a[rows, 3 * j[:, None] + axes] = 1
    a[rows, 3 * i[:, None] + axes] = -1
    for axis in range(3):
        b[rows, (3 * i + axis)[:, None].expand(m, 3)] = skew[:, :, axis]
    c = b.mT @ b
    stiffness = a.mT @ a - (a.mT @ b) @ torch.linalg.solve(c, b.mT @ a)
    return torch.linalg.eigh(stiffness).eigenvectors[:, 6 : 6 + n].mT.unflatten(1, (v, 3))


def main(table: Table, out: Path | None, only: Sequence[str]) -> None:
    """Draw both rows, and say how much volume they change."""
    x, faces = beam()
    methods = {
        "solid": lambda: tm.extract_modes(x, faces, N_MODES, mesher="lattice").modes,
        "surface": lambda: surface_modes(x, faces, N_MODES),
    }
    rows, energy = {}, tm.ShellEnergy(faces)
    for name, method in methods.items():
        if wanted(name, only):
            modes = method()
            modes = modes / modes.norm(dim=-1).amax(1)[:, None, None]
            rows[name] = x + AMPLITUDE * 4 * modes
            volume = energy.measure(torch.cat([x[None], x + 0.02 * modes, x - 0.02 * modes])).volume
            # Half the sum of both sides is of second order: turns cost that much too.
            first = (volume[1 : N_MODES + 1] - volume[N_MODES + 1 :]).abs() / 2 / volume[0] / 0.02
            table.add(name, *(f"{float(change):.3f}" for change in first))
    if out:
        file, every = out / "paper-figure3.png", range(N_MODES)
        titles = [f"mode {i + 1}" for i in every]
        tm.render_sequence(rows, faces, file, every, titles, every)
