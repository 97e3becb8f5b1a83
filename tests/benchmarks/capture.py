"""Modes against those of a fine reference: the space that they hold, and eigenvalues; parts of precompute.py."""

import threading
import time
from collections.abc import Callable, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path

import numpy as np
import scipy.sparse as sp
import torch
from numpy.typing import NDArray
from quadratic import at_points, quadratic_modes
from solids import eigenmodes, element_hessian, embed_surface, lumped_mass

import torch_modal as tm
from torch_modal.geometry.connectivity import vertex_areas
from torch_modal.io.cache import Arrays, Cache
from torch_modal.modes.extract import MESHERS
from torch_modal.modes.stiffness import arap_hessian, mass_matrix
from torch_modal.modes.surface import CanonicalSurface
from torch_modal.modes.tetrahedra import Mesher, Tetrahedra

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]

N_MODES, N_FIRST = 30, 3
ASKED = 0.95
EXACT = {"stop_energy": 10.0, "max_surface_faces": 10**8, "timeout": 3600.0}
FULL = tm.TetWild(0.03, 2e-3, **EXACT)
LINEAR_REFERENCE, QUADRATIC_REFERENCE = tm.TetWild(0.0125, 5e-4, **EXACT), tm.TetWild(0.022, 5e-4, **EXACT)

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

    def _reference(self, settings: tm.TetWild, solve: Callable[[Tetrahedra], FloatArray]) -> FloatArray:
        def compute() -> Arrays:
            return {"modes": solve(settings.fill(self.surface, threading.Event()))}

        content = {"points": self.surface.points, "faces": self.surface.faces}
        return self._kept.get("reference", content, {**asdict(settings), "modes": N_MODES}, compute)["modes"]

    def _linear(self, tetrahedra: Tetrahedra) -> FloatArray:
        """As fine as one can wait for, with the plainest method."""
        mass = sp.diags(lumped_mass(tetrahedra))
        modes = eigenmodes(element_hessian(tetrahedra), mass, tetrahedra.vertices, N_MODES).modes
        return self.at_surface(self.embedding(tetrahedra), modes)

    def _quadratic(self, tetrahedra: Tetrahedra) -> FloatArray:
        """Hardly too stiff: the better truth."""
        solid = quadratic_modes(tetrahedra, N_MODES)
        return self.at_surface(at_points(self.surface.points, tetrahedra, solid.nodes), solid.modes)

    def embedding(self, tetrahedra: Tetrahedra) -> sp.csr_matrix:
        """The one that the package uses."""
        return embed_surface(self.surface.points, tetrahedra, self.surface.normals)

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


def solid_modes(tetrahedra: Tetrahedra) -> FloatArray:
    """The lowest modes, as the package computes them by default."""
    return eigenmodes(arap_hessian(tetrahedra), mass_matrix(tetrahedra), tetrahedra.vertices, N_MODES).modes


def rows(judge: Judge, runs: int) -> list[tuple[str, list[Found]]]:
    """Modes by every mesher; several times for fTetWild, which is not deterministic."""

    def solved(mesher: Mesher) -> Found:
        start = time.perf_counter()
        tetrahedra = mesher.fill(judge.surface, threading.Event())
        seconds = time.perf_counter() - start
        modes = judge.at_surface(judge.embedding(tetrahedra), solid_modes(tetrahedra))
        return Found(modes, seconds, len(tetrahedra.vertices))

    return [
        ("fTetWild", [solved(tm.TetWild()) for _ in range(runs)]),
        ("fTetWild, not decimated, 3 %, `stop_energy=10`", [solved(FULL)]),
        ("lattice", [solved(tm.Lattice())]),
    ]


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


def stiffness(name: str, vertices: FloatArray, faces: IntArray, most: float, keep: Path | None) -> None:
    """Print the first eigenvalues by every mesher over those of quadratic tetrahedra, of a body hard to fill."""
    surface = CanonicalSurface.of(vertices, faces)

    def compute() -> Arrays:
        return {"eigenvalues": quadratic_modes(FULL.fill(surface, threading.Event()), N_FIRST).eigenvalues}

    content = {"points": surface.points, "faces": surface.faces}
    wanted = Cache(keep).get("stiffness", content, asdict(FULL), compute)["eigenvalues"]
    for mesher, form in (("auto", "edge"), ("lattice", "edge"), ("tetwild", "edge"), ("lattice", "vertex")):
        start = time.perf_counter()
        tetrahedra = MESHERS[mesher]().fill(surface, threading.Event())
        seconds = time.perf_counter() - start
        k, mass = arap_hessian(tetrahedra, form), mass_matrix(tetrahedra)  # type: ignore[arg-type]
        ratios = eigenmodes(k, mass, tetrahedra.vertices, N_FIRST).eigenvalues[-N_FIRST:] / wanted
        asked = f" [at most {most}]" if mesher == "auto" else ""
        shown = " ".join(f"{ratio:.3f}" for ratio in ratios)
        size = f"{len(tetrahedra.vertices)} vertices in {seconds:.1f} s"
        print(f"{name}, {mesher}, {form} form, {size}: eigenvalues over the reference {shown}{asked}", flush=True)


def spread(values: Sequence[float], digits: int) -> str:
    """The smallest and the largest, or the only one."""
    low, high = f"{min(values):.{digits}f}", f"{max(values):.{digits}f}"
    return low if low == high else f"{low} to {high}"
