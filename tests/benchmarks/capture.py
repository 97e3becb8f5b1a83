"""How much of the mode space of a fine reference other settings hold; a part of precompute.py."""

import time
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np
import scipy.sparse as sp
import torch
from numpy.typing import NDArray
from quadratic import at_points, quadratic_modes
from solids import embed_surface, lumped_mass

import torch_modal as tm
from torch_modal.geometry.connectivity import vertex_areas
from torch_modal.io.cache import Arrays, Cache
from torch_modal.precompute.eigen import lowest_modes
from torch_modal.precompute.embedding import closest_tetrahedra
from torch_modal.precompute.lattice import USUAL_EDGE, lattice
from torch_modal.precompute.modes import QUALITIES
from torch_modal.precompute.stiffness import HessianForm, arap_hessian, hat_gradients, mass_matrix
from torch_modal.precompute.surface import CanonicalSurface
from torch_modal.precompute.tetrahedra import Tetrahedra
from torch_modal.precompute.tetwild import TetrahedraSettings, tetrahedralize

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]

N_MODES = 30
ASKED = 0.95
FULL = TetrahedraSettings(edge_length_fac=0.03, epsilon=2e-3, stop_energy=10.0, max_surface_faces=10**8)
LINEAR_REFERENCE = TetrahedraSettings(edge_length_fac=0.0125, epsilon=5e-4, stop_energy=10.0, max_surface_faces=10**8)
QUADRATIC_REFERENCE = TetrahedraSettings(edge_length_fac=0.022, epsilon=5e-4, stop_energy=10.0, max_surface_faces=10**8)

HEAD = """
| mesh | setting | vertices | meshing, s | captured, quadratic reference | captured, linear reference | shell energy |
|---|---|---|---|---|---|---|"""


@dataclass(frozen=True)
class Found:
    """Modes on the surface, ``(3U, k)``, and what their tetrahedra were like."""

    modes: FloatArray
    seconds: float
    n_vertices: int


class Judge:
    """Compares modes on one surface.

    Args:
        surface: The surface.
        kept: Where references are kept from one run to the next, as they take minutes.
    """

    def __init__(self, surface: CanonicalSurface, kept: Cache) -> None:
        self.surface = surface
        self._kept = kept
        self._areas = np.repeat(np.sqrt(vertex_areas(surface.points, surface.faces)), 3)[:, None]
        rigid = [np.broadcast_to(axis, surface.points.shape) for axis in np.eye(3)]
        rigid += [np.cross(axis, surface.points) for axis in np.eye(3)]
        self._rigid = np.linalg.qr(self._areas * np.stack([r.reshape(-1) for r in rigid], axis=1))[0]
        self._shell = tm.ShellEnergy(torch.from_numpy(surface.faces.copy()))
        self.linear = self._reference(LINEAR_REFERENCE, self._linear)
        self.quadratic = self._reference(QUADRATIC_REFERENCE, self._quadratic)
        self._roughness = self._shell_energies(self.linear)

    def _reference(self, settings: TetrahedraSettings, solve: Callable[[Tetrahedra], FloatArray]) -> FloatArray:
        def compute() -> Arrays:
            points, faces = self.surface.points, self.surface.faces
            return {"modes": solve(tetrahedralize(points, faces, settings, timeout=3600))}

        content = {"points": self.surface.points, "faces": self.surface.faces}
        return self._kept.get("reference", content, {**asdict(settings), "modes": N_MODES}, compute)["modes"]

    def _linear(self, tetrahedra: Tetrahedra) -> FloatArray:
        """As fine as one can wait for, with the plainest method."""
        return self.at_surface(self.embedding(tetrahedra), solid_modes(tetrahedra, "element", lumped=True))

    def _quadratic(self, tetrahedra: Tetrahedra) -> FloatArray:
        """Hardly too stiff: the better truth."""
        solid = quadratic_modes(tetrahedra, N_MODES)
        return self.at_surface(at_points(self.surface.points, tetrahedra, solid.nodes), solid.modes)

    def embedding(self, tetrahedra: Tetrahedra) -> sp.csr_matrix:
        """The one that the package uses."""
        return embed_surface(self.surface.points, tetrahedra, self.surface.normals)

    def clamped_embedding(self, tetrahedra: Tetrahedra) -> sp.csr_matrix:
        """The usual one: barycentric coordinates in the closest tetrahedron, negative ones set to zero."""
        points = self.surface.points
        tets = closest_tetrahedra(points, tetrahedra)
        corners = tetrahedra.tets[tets]
        offset = points - tetrahedra.vertices[corners].mean(axis=1)
        weights = np.clip(0.25 + np.einsum("vi,vai->va", offset, hat_gradients(tetrahedra)[tets]), 0, None)
        weights /= weights.sum(axis=1, keepdims=True)
        rows = np.repeat(np.arange(len(corners)), 4)
        shape = (len(corners), len(tetrahedra.vertices))
        return sp.csr_matrix((weights.reshape(-1), (rows, corners.reshape(-1))), shape=shape)

    def at_surface(self, weights: sp.csr_matrix, modes: FloatArray) -> FloatArray:
        """Modes of a solid at the points of the surface. *Shape:* ``(3U, k)``."""
        return (weights @ modes.reshape(len(modes) // 3, -1)).reshape(3 * len(self.surface.points), -1)

    def captured(self, modes: FloatArray, reference: FloatArray) -> float:
        """The part of the reference's space in that of the modes, by area and without rigid motions."""
        return float(((self._span(modes).T @ self._span(reference)) ** 2).sum() / N_MODES)

    def roughness(self, modes: FloatArray) -> float:
        """Shell energy of a mode of unit size against the linear reference's, median over the modes."""
        return float(np.median(self._shell_energies(modes) / self._roughness))

    def _span(self, modes: FloatArray) -> FloatArray:
        weighted = self._areas * modes
        return np.linalg.qr(weighted - self._rigid @ (self._rigid.T @ weighted))[0]

    def _shell_energies(self, modes: FloatArray) -> FloatArray:
        rest = torch.from_numpy(self.surface.points)
        moved = [0.1 * column / np.sqrt((column**2).mean()) for column in modes.T]
        return np.array([float(self._shell(rest + torch.from_numpy(u.reshape(-1, 3)), rest)) for u in moved])


def solid_modes(tetrahedra: Tetrahedra, form: HessianForm = "edge", lumped: bool = False) -> FloatArray:
    """The lowest modes, as the package computes them by default."""
    mass = sp.diags(lumped_mass(tetrahedra)) if lumped else mass_matrix(tetrahedra)
    return lowest_modes(arap_hessian(tetrahedra, form), mass, tetrahedra.vertices, N_MODES).modes


def rows(judge: Judge, runs: int) -> list[tuple[str, list[Found]]]:
    """Modes by every setting; several times for the default, as fTetWild is not deterministic."""
    points, faces = judge.surface.points, judge.surface.faces

    def solved(fill: Callable[[], Tetrahedra]) -> tuple[Tetrahedra, Found]:
        start = time.perf_counter()
        tetrahedra = fill()
        seconds = time.perf_counter() - start
        modes = judge.at_surface(judge.embedding(tetrahedra), solid_modes(tetrahedra))
        return tetrahedra, Found(modes, seconds, len(tetrahedra.vertices))

    fast, fine = QUALITIES["fast"], QUALITIES["fine"]
    made = [solved(lambda: tetrahedralize(points, faces, fast)) for _ in range(runs)]
    found = [("**fast** (default; decimated)", [one for _, one in made])]
    usual, clamped = [], []
    for tetrahedra, one in made:
        modes = judge.at_surface(judge.clamped_embedding(tetrahedra), solid_modes(tetrahedra))
        clamped.append(Found(modes, one.seconds, one.n_vertices))
        modes = judge.at_surface(judge.embedding(tetrahedra), solid_modes(tetrahedra, "element", lumped=True))
        usual.append(Found(modes, one.seconds, one.n_vertices))
    found.append(("fast, clamped barycentric", clamped))
    found.append(("fast, element form and lumped mass", usual))
    found.append(
        ("full: not decimated, 3 %, `stop_energy=10`", [solved(lambda: tetrahedralize(points, faces, FULL))[1]])
    )
    found.append(("fine", [solved(lambda: tetrahedralize(points, faces, fine))[1]]))
    found.append(("lattice", [solved(lambda: lattice(judge.surface, USUAL_EDGE))[1]]))
    return found


def table(meshes: Sequence[tuple[str, FloatArray, IntArray]], runs: int, keep: Path | None) -> None:
    """Print the table, a row at a time, and whether the default captures what is asked for."""
    print(HEAD)
    least = 1.0
    for name, vertices, faces in meshes:
        judge = Judge(CanonicalSurface.of(vertices, faces), Cache(keep))
        for number, (setting, found) in enumerate(rows(judge, runs)):
            by_quadratic = [judge.captured(one.modes, judge.quadratic) for one in found]
            by_linear = [judge.captured(one.modes, judge.linear) for one in found]
            roughness = [judge.roughness(one.modes) for one in found]
            sizes, seconds = [one.n_vertices for one in found], [one.seconds for one in found]
            cells = [
                spread(values, digits)
                for values, digits in ((sizes, 0), (seconds, 1), (by_quadratic, 3), (by_linear, 3), (roughness, 2))
            ]
            print(f"| {name} | {setting} | " + " | ".join(cells) + " |", flush=True)
            if number == 0:
                least = min(least, *by_quadratic, *by_linear)
    print(f"\nthe default captures {least:.3f} or more in {runs} runs on each mesh [at least {ASKED}]")


def spread(values: Sequence[float], digits: int) -> str:
    """The smallest and the largest, or the only one."""
    low, high = f"{min(values):.{digits}f}", f"{max(values):.{digits}f}"
    return low if low == high else f"{low} to {high}"
