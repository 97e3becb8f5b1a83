"""fTetWild in a child process: conforming tetrahedra inside a surface."""

import contextlib
import signal
import subprocess
import sys
import tempfile
import threading
import time
import zipfile
from dataclasses import asdict, dataclass, field, replace
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

import numpy as np
from scipy.spatial import cKDTree

from torch_modal.arrays import FloatArray, IntArray
from torch_modal.geometry.canonical import CANONICAL_SIZE
from torch_modal.geometry.connectivity import vertex_areas
from torch_modal.geometry.inspect import signed_volume
from torch_modal.precompute.parallel import StoppedError
from torch_modal.precompute.processes import describe_exit, end_process, last_line
from torch_modal.precompute.surface import CanonicalSurface, outward
from torch_modal.precompute.tetrahedra import Tetrahedra, TetrahedralizationError, oriented, without_debris

WORKER = Path(__file__).resolve().with_name("_tetwild_worker.py")
EDGES_PER_THICKNESS = 0.65
EDGE_RANGE = (0.018, 0.04)
"""Range of default edge lengths: one tetrahedron across a limb is far too stiff, bulky bodies need no finer ones."""

MESHER_RAISED = 3
"""Exit code of the worker if the mesher itself raised an exception."""
_OWN_FAILURES = {MESHER_RAISED, *(-getattr(signal, name, 0) for name in ("SIGSEGV", "SIGFPE"))}
"""Exit codes that the surface causes. Others may not recur: SIGKILL comes from outside, and C++ raises SIGABRT when
memory or threads run out."""


@dataclass(frozen=True)
class TetrahedraSettings:
    """How fine the tetrahedra are. The defaults take about 2 s on meshes of 3k to 27k faces.

    Attributes:
        edge_length_fac: Ideal edge length as a fraction of the bounding-box diagonal; None takes about two
            thirds of the mean thickness (twice the volume over the area), from 0.018 to 0.04. The lattice has cubes of
            three quarters of it (default 0.04); larger ones if there would be too many.
        epsilon: Largest distance of the tetrahedra's surface from the input, as a fraction of the diagonal.
        stop_energy: Quality at which fTetWild stops improving; lower is better and slower (its own default is
            10).
        max_surface_faces: The surface is decimated to about this many faces first.

    Raises:
        ValueError: A number is out of range (fTetWild hangs on an ``epsilon`` of zero, for example).
    """

    edge_length_fac: float | None = None
    epsilon: float = 4e-3
    stop_energy: float = 200.0
    max_surface_faces: int = 1500

    def __post_init__(self) -> None:
        for name, low, high in (
            ("edge_length_fac", 2e-3, 1.0),
            ("epsilon", 1e-5, 0.1),
            ("stop_energy", 4.0, 1e6),
            ("max_surface_faces", 100, 10**8),
        ):
            value = getattr(self, name)
            if value is not None and not low <= value <= high:
                raise ValueError(f"{name} is {value}; give a number from {low:g} to {high:g}")

    def edge_length(self, points: FloatArray, faces: IntArray) -> float:
        """Edge length for a surface, as a fraction of its bounding-box diagonal.

        Args:
            points: *Shape:* ``(V, 3)``.
            faces: *Shape:* ``(F, 3)``.
        """
        if self.edge_length_fac is not None:
            return self.edge_length_fac
        volume = abs(signed_volume(points - points.mean(axis=0), faces))
        thickness = 2 * volume / vertex_areas(points, faces).sum() / np.linalg.norm(np.ptp(points, axis=0))
        return float(np.clip(EDGES_PER_THICKNESS * thickness, *EDGE_RANGE))


@dataclass(frozen=True)
class TetWild:
    """The mesher ``"tetwild"``: :func:`tetrahedralize`."""

    settings: TetrahedraSettings = field(default_factory=TetrahedraSettings)

    def key(self) -> dict[str, Any]:
        """Settings, and the versions of the packages."""
        return {
            **asdict(self.settings),
            **{name: _installed(name) for name in ("pytetwild", "fast-simplification")},
            "mesher": "tetwild",
        }

    def fill(self, surface: CanonicalSurface, timeout: float, stop: threading.Event) -> Tetrahedra:
        """Tetrahedra that fill the surface."""
        return tetrahedralize(surface.points, surface.faces, self.settings, timeout=timeout, stop=stop)


def _installed(name: str) -> str | None:
    with contextlib.suppress(PackageNotFoundError):
        return version(name)
    return None  # the worker reports it


def tetrahedralize(
    vertices: FloatArray,
    faces: IntArray,
    settings: TetrahedraSettings | None = None,
    *,
    timeout: float = 600.0,
    stop: threading.Event | None = None,
) -> Tetrahedra:
    """Fill a closed surface with tetrahedra.

    fTetWild remeshes the surface within its tolerance, so the vertices of the surface are not among those
    of the result: embed them with :func:`~torch_modal.precompute.embedding.fit_weights`. It is not
    deterministic. It runs in a child process: crashes and hangs become exceptions, and threads and data-loader workers
    may call this function.

    Args:
        vertices: Positions, any units. *Shape:* ``(V, 3)``.
        faces: Vertex indices of a closed surface; unreferenced vertices are ignored. *Shape:*
            ``(F, 3)``.
        settings: How fine the tetrahedra are.
        timeout: Seconds after which the child process is killed.
        stop: Event that kills it.

    Returns:
        Tetrahedra in the units of ``vertices``: positive volumes, every vertex used.

    Raises:
        TetrahedralizationError: The child process crashed, took longer than ``timeout``, or gave no
            tetrahedra or ones that do not fill the surface.
        StoppedError: ``stop`` was set.
    """
    settings = settings or TetrahedraSettings()
    used, compact = np.unique(faces, return_inverse=True)
    surface = vertices[used]
    center = (surface.min(axis=0) + surface.max(axis=0)) / 2
    scale = CANONICAL_SIZE / np.linalg.norm(surface.max(axis=0) - surface.min(axis=0))
    surface = (surface - center) * scale

    compact = outward(surface, compact.reshape(-1, 3))
    settings = replace(settings, edge_length_fac=settings.edge_length(surface, compact))
    try:
        raw = _run_worker(surface, compact, settings, timeout, stop or threading.Event())
        tetrahedra = without_debris(oriented(raw))
        _check_fills(tetrahedra, surface, settings)
    except TetrahedralizationError as error:
        mesh = f"a mesh of {len(vertices)} vertices and {len(faces)} faces"
        raise TetrahedralizationError(f"cannot fill {mesh} with tetrahedra: {error}", error.fails_until) from error
    return Tetrahedra(tetrahedra.vertices / scale + center, tetrahedra.tets)


def _run_worker(
    surface: FloatArray,
    faces: IntArray,
    settings: TetrahedraSettings,
    timeout: float,
    stop: threading.Event,
) -> Tetrahedra:
    """Run the worker process on the surface and read its result."""
    if not sys.executable:
        raise TetrahedralizationError(
            "sys.executable is empty, so no worker process can be started. Run in a normal interpreter"
        )
    with tempfile.TemporaryDirectory(prefix="torch_modal-", ignore_cleanup_errors=True) as folder:
        job, result, log = (Path(folder) / name for name in ("job.npz", "result.npz", "log.txt"))
        np.savez(job, vertices=surface, faces=faces, timeout=timeout, **asdict(settings))
        command = [sys.executable, str(WORKER), str(job), str(result)]
        # Output goes to a file: a full pipe would block the child.
        with log.open("wb") as output:
            process = subprocess.Popen(
                command,
                stdin=subprocess.DEVNULL,
                stdout=output,
                stderr=subprocess.STDOUT,
                cwd=folder,  # fTetWild leaves a __tracked_surface.stl where it runs
                # A separate process group can be killed as a whole, and Ctrl-C reaches only this process.
                start_new_session=True,
            )
        try:
            code = _wait(process, timeout, stop)
        finally:
            end_process(process)  # also on KeyboardInterrupt
        if code is None:
            raise TetrahedralizationError(
                f"no result after the timeout of {timeout:g} s. "
                "Give a longer timeout, a larger edge_length_fac, or a surface without self-intersections",
                timeout,
            )
        if code != 0:
            tail = last_line(log.read_text(errors="replace"))
            raise TetrahedralizationError(
                f"the worker process ended with {describe_exit(code)}{f' ({tail})' if tail else ''}. "
                "Check the surface for self-intersections and degenerate faces, or try other settings",
                np.inf if code in _OWN_FAILURES else 0.0,
            )
        try:
            with np.load(result) as arrays:
                return Tetrahedra(arrays["vertices"], arrays["tets"])
        except (OSError, KeyError, ValueError, zipfile.BadZipFile) as error:
            raise TetrahedralizationError(f"the worker process left no readable result ({error}). Try again") from error


def _wait(process: subprocess.Popen[bytes], timeout: float, stop: threading.Event) -> int | None:
    """The exit code, or None after ``timeout`` seconds.

    Polls for ``stop``, and because Ctrl-C cannot interrupt a single wait on every platform.
    """
    end = time.monotonic() + timeout
    while True:
        try:
            return process.wait(timeout=min(max(end - time.monotonic(), 0.0), 0.2))
        except subprocess.TimeoutExpired:
            if stop.is_set():
                raise StoppedError from None
            if time.monotonic() >= end:
                return None


def _check_fills(tetrahedra: Tetrahedra, surface: FloatArray, settings: TetrahedraSettings) -> None:
    """Reject a mesh that is empty, not finite, or does not cover the surface (diagonal 100)."""
    advice = (
        "Check that the surface is closed, its winding consistent, and no part thinner than "
        f"{100 * settings.epsilon:g} % of the diagonal, or give a smaller epsilon"
    )
    if len(tetrahedra.tets) == 0:
        raise TetrahedralizationError(f"the result is empty. {advice}", np.inf)
    if not np.isfinite(tetrahedra.vertices).all():
        raise TetrahedralizationError(f"the result has coordinates that are not finite. {advice}", np.inf)
    # Vertices on the new surface are about one edge length apart, so no point of the old one is further away.
    reach = CANONICAL_SIZE * (0.05 + 2 * (settings.edge_length_fac or EDGE_RANGE[1]))
    distance = cKDTree(tetrahedra.vertices).query(surface)[0]
    n_far = int((distance > reach).sum())
    if n_far:
        raise TetrahedralizationError(
            f"{n_far} of its vertices are further than {reach:g} % of the diagonal from the result. {advice}, or raise "
            "max_surface_faces if small parts were lost in the decimation",
            np.inf,
        )
    low, high = surface.min(axis=0) - reach, surface.max(axis=0) + reach
    if (tetrahedra.vertices < low).any() or (tetrahedra.vertices > high).any():
        raise TetrahedralizationError(f"the result reaches far beyond the surface. {advice}", np.inf)
