"""fTetWild in a child process: conforming tetrahedra inside a surface."""

import sys
import tempfile
import threading
import zipfile
from dataclasses import asdict, dataclass, replace
from importlib.metadata import version
from pathlib import Path

import numpy as np
from scipy.spatial import cKDTree

from torch_modal.geometry.decimation import decimate
from torch_modal.geometry.surface import Surface
from torch_modal.modes.lattice import Lattice
from torch_modal.modes.processes import ChildError, run_child
from torch_modal.modes.surface import clearances, self_proximity
from torch_modal.modes.tetrahedra import MesherError, Tetrahedra, edge_lengths, orient, without_debris
from torch_modal.progress import logger

WORKER = Path(__file__).resolve().with_name("_tetwild_worker.py")
EDGES_PER_THICKNESS = 0.65
EDGE_RANGE = (0.012, 0.03)
"""Range of default edge lengths: one tetrahedron across a limb is far too stiff; with 0.04, eigenvalues of a fist vary
by 7 % from run to run, with 0.03 by 3 %."""
LONGEST_MEAN = 1.1
"""Largest mean edge length, relative to the ideal one, of a result whose edges were split; usual are 0.96 and less."""
LEAST_ENERGY = 4.0
"""Smallest stop energy; a regular tetrahedron has 3."""
BETTER = 0.1
"""Factor of the stop energy where they were not."""
VERSION = 2
"""Of the results, in the key of the cache."""
THIN_PART = 0.05
"""Part of the area with the least thickness, which gives the default edge length."""
TOUCHING = 0.03
"""Self-proximity above which a lattice fuses so much that modes are too stiff: closed fists have 0.037 and more."""
PATIENCE = 10.0
"""Processor time that ``"auto"`` gives fTetWild, in seconds: fists take 1 to 3, bodies of many parts minutes."""


@dataclass(frozen=True)
class TetWild:
    """The mesher ``"tetwild"``: fTetWild in a child process.

    fTetWild remeshes the surface within its tolerance, and inserts its triangles in a random order, which cannot be
    seeded. Where the first mesh already has the quality, it stops before edges are split to the ideal length: such
    results are far too stiff, and it runs again with a lower ``stop_energy``. In a process of its own, crashes and
    hangs become exceptions, and threads and data-loader workers may use it.

    Attributes:
        edge_length_fac: Ideal edge length as a fraction of the bounding-box diagonal; None takes about two thirds of
            the mean thickness (twice the volume over the area), or of the thinnest 5 % of the area unless parts
            touch, from 0.012 to 0.03.
        epsilon: Largest distance of the tetrahedra's surface from the input, as a fraction of the diagonal.
        stop_energy: Quality at which fTetWild stops improving; lower is better and slower (its own default is 10).
        max_surface_faces: The surface is decimated to about this many faces first.
        timeout: Seconds for a key-frame, after which the child process is killed.
        processor_time: The same, of the processor, whatever else the machine computes; without effect on Windows.

    Raises:
        ValueError: A number is out of range (fTetWild hangs on an ``epsilon`` of zero, for example).
    """

    edge_length_fac: float | None = None
    epsilon: float = 4e-3
    stop_energy: float = 200.0
    max_surface_faces: int = 1500
    timeout: float = 600.0
    processor_time: float = np.inf

    def __post_init__(self) -> None:
        for name, low, high in (
            ("edge_length_fac", 2e-3, 1.0),
            ("epsilon", 1e-5, 0.1),
            ("stop_energy", LEAST_ENERGY, 1e6),
            ("max_surface_faces", 100, 10**8),
            ("timeout", 0.0, np.inf),
            ("processor_time", 0.0, np.inf),
        ):
            value = getattr(self, name)
            if value is not None and not low <= value <= high:
                raise ValueError(f"{name} is {value}; give a number from {low:g} to {high:g}")

    def key(self) -> dict[str, object]:
        """Settings, and the versions of the packages."""
        settings = {name: value for name, value in asdict(self).items() if name not in ("timeout", "processor_time")}
        versions = {name: version(name) for name in ("pytetwild", "fast-simplification")}
        return {"mesher": "tetwild", **settings, **versions, "version": VERSION}

    def fill(self, surface: Surface, stop: threading.Event) -> Tetrahedra:
        """Fill a closed surface with tetrahedra of positive volume.

        Raises:
            MesherError: The child process crashed, took longer than the timeout, or gave no tetrahedra or
                ones that do not fill the surface.
            StoppedError: ``stop`` was set, and the child process killed.
        """
        points, faces = surface.vertices, surface.faces
        diagonal = float(np.linalg.norm(np.ptp(points, axis=0)))
        edge_length_fac = self.edge_length_fac
        if edge_length_fac is None:
            thickness = surface.thickness
            if self_proximity(surface) <= TOUCHING:  # otherwise, the overlap of two parts is measured
                thin = clearances(surface)[0]
                order = np.argsort(thin)
                areas = surface.face_areas[order].cumsum()
                thickness = min(thickness, thin[order][np.searchsorted(areas, THIN_PART * areas[-1])])
            edge_length_fac = float(np.clip(EDGES_PER_THICKNESS * thickness / diagonal, *EDGE_RANGE))
        try:
            for stop_energy in (self.stop_energy, max(BETTER * self.stop_energy, LEAST_ENERGY)):
                settings = replace(self, edge_length_fac=edge_length_fac, stop_energy=stop_energy)
                tetrahedra = without_debris(orient(_run_worker(surface, settings, stop)))
                if len(tetrahedra.tets) == 0:
                    raise ValueError("the result is empty")
                if edge_lengths(tetrahedra).mean() <= LONGEST_MEAN * edge_length_fac * diagonal:
                    break
            # Vertices on the new surface are about one edge length apart, so no point of the old one is further away.
            reach = diagonal * (0.05 + 2 * edge_length_fac)
            if not np.abs(tetrahedra.vertices).max() <= np.abs(points).max() + reach:
                raise ValueError("the result reaches far beyond the surface")
            if n_far := int((cKDTree(tetrahedra.vertices).query(points)[0] > reach).sum()):
                raise ValueError(f"{n_far} of its vertices are far from the result")
        except (ChildError, OSError, KeyError, ValueError, zipfile.BadZipFile) as error:
            raise MesherError(
                f"cannot fill a mesh of {len(points)} vertices and {len(faces)} faces with tetrahedra: {error}. Check "
                "that the surface is closed, its winding consistent, without self-intersections, and no part thinner "
                f"than {100 * self.epsilon:g} % of the diagonal; or give a longer timeout or processor_time, a smaller "
                "epsilon, another edge_length_fac, or a larger max_surface_faces if small parts were lost"
            ) from error
        return tetrahedra


@dataclass(frozen=True)
class Auto:
    """The mesher ``"auto"``: a lattice, but fTetWild where parts of the surface touch, unless it fails or is slow."""

    def key(self) -> dict[str, object]:
        """The keys of both meshers."""
        return {**Lattice().key(), **{f"touching_{name}": value for name, value in TetWild().key().items()}}

    def fill(self, surface: Surface, stop: threading.Event) -> Tetrahedra:
        """Fill a surface with tetrahedra."""
        if self_proximity(surface) > TOUCHING:
            try:
                return TetWild(processor_time=PATIENCE).fill(surface, stop)
            except MesherError as error:
                logger.info("a lattice, in which parts that touch are joined: %s", error)
        return Lattice().fill(surface, stop)


def _run_worker(surface: Surface, settings: TetWild, stop: threading.Event) -> Tetrahedra:
    """Run the worker process on a surface, decimated, and read its result."""
    points, faces = surface.vertices, surface.faces
    if len(faces) > settings.max_surface_faces:
        points, faces, _ = decimate(points, faces, settings.max_surface_faces)
    with tempfile.TemporaryDirectory(prefix="torch_modal-", ignore_cleanup_errors=True) as folder:
        job, result = (Path(folder) / name for name in ("job.npz", "result.npz"))
        np.savez(job, vertices=points, faces=faces, **asdict(settings))
        # In the folder, as fTetWild leaves a __tracked_surface.stl where it runs.
        run_child([sys.executable, str(WORKER), str(job), str(result)], Path(folder), settings.timeout, stop)
        with result.open("rb") as file, np.load(file) as arrays:  # np.load leaves damaged files open
            return Tetrahedra(arrays["vertices"], arrays["tets"])
