"""A surface filled with tetrahedra, by fTetWild in a process of its own."""

import signal
import subprocess
import sys
import tempfile
import threading
import time
import zipfile
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from torch_modal.geometry.connectivity import connected_pieces, vertex_areas
from torch_modal.geometry.inspect import signed_volume
from torch_modal.io.processes import describe_exit, end_process, last_line
from torch_modal.precompute.parallel import StoppedError
from torch_modal.precompute.surface import DIAGONAL, outward

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]

WORKER = Path(__file__).resolve().with_name("_tetwild_worker.py")
EDGES_PER_THICKNESS = 0.65
EDGE_RANGE = (0.018, 0.04)
"""Slender shapes need finer tetrahedra: with one across a limb it is far too stiff. Bulky ones would get too many."""

MESHER_RAISED = 3
"""Exit code of the worker when the mesher itself raised, and not, say, its import."""
_OWN_FAILURES = {MESHER_RAISED, *(-getattr(signal, name, 0) for name in ("SIGSEGV", "SIGFPE"))}
"""Ends that the surface brings about. Others may not come again: SIGKILL is sent from outside, and SIGABRT is how C++
ends where memory or threads run out."""

SMALL_VOLUME = 0.01
"""Of a small piece, as a fraction of the whole, and"""
SMALL_SIZE = 0.1
"""its extent, as a fraction of the bounding-box diagonal; a long piece is a limb or a wire, however thin."""
MOST_DEBRIS = 0.2
"""Of the volume: where more hangs on other pieces, the body itself is in pieces."""


class Tetrahedra(NamedTuple):
    """A tetrahedral mesh.

    Attributes:
        vertices: Positions. *Shape:* ``(N, 3)``.
        tets: Vertex indices; as they are made, volumes are positive. *Shape:* ``(T, 4)``.
        inside: Fraction of each tetrahedron that is inside the surface; None if all of them are. *Shape:* ``(T,)``.
    """

    vertices: FloatArray
    tets: IntArray
    inside: FloatArray | None = None


@dataclass(frozen=True)
class TetrahedraSettings:
    """How fine the tetrahedra are. The defaults take about 2 s on meshes of 3k to 27k faces.

    Attributes:
        edge_length_fac: Ideal edge length as a fraction of the bounding-box diagonal; None takes about two
            thirds of the mean thickness (twice the volume over the area), from 0.018 to 0.04. The lattice has cubes of
            three quarters of it, or of the largest of these; larger ones where there would be too many.
        epsilon: How far the tetrahedra may leave the surface, as a fraction of the bounding-box diagonal.
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
        """The edge length for a surface, as a fraction of its bounding-box diagonal.

        Args:
            points: *Shape:* ``(V, 3)``.
            faces: *Shape:* ``(F, 3)``.
        """
        if self.edge_length_fac is not None:
            return self.edge_length_fac
        volume = abs(signed_volume(points - points.mean(axis=0), faces))
        thickness = 2 * volume / vertex_areas(points, faces).sum() / np.linalg.norm(np.ptp(points, axis=0))
        return float(np.clip(EDGES_PER_THICKNESS * thickness, *EDGE_RANGE))


class TetrahedralizationError(RuntimeError):
    """No usable tetrahedra came out; the message says for which mesh, why, and what to do.

    Attributes:
        fails_until: The same call fails again with any timeout up to this, in seconds: infinity where the mesher
            cannot do it, zero where it was not its fault.
    """

    fails_until: float = 0.0


def tetrahedralize(
    vertices: FloatArray,
    faces: IntArray,
    settings: TetrahedraSettings | None = None,
    *,
    timeout: float = 600.0,
    stop: threading.Event | None = None,
) -> Tetrahedra:
    """Fill a closed surface with tetrahedra.

    fTetWild makes a new surface mesh within its tolerance, so the vertices of the surface are not among those
    of the result: embed them with :func:`~torch_modal.precompute.embedding.embed_surface`. It is not
    deterministic either: two calls give two meshes. It runs in a child process, so a crash or a hang of it
    becomes an exception here, and threads and data-loader workers may call this function.

    Args:
        vertices: Positions, any units. *Shape:* ``(V, 3)``.
        faces: Vertex indices of a closed surface; vertices outside all faces are left out. *Shape:*
            ``(F, 3)``.
        settings: How fine the tetrahedra are.
        timeout: Seconds after which the child process is killed.
        stop: It is killed as soon as somebody sets this, too.

    Returns:
        Tetrahedra in the units of ``vertices``: positive volumes, every vertex used.

    Raises:
        TetrahedralizationError: The child process crashed, took longer than ``timeout``, or gave no
            tetrahedra or ones that do not fill the surface.
        StoppedError: Somebody set ``stop``.
    """
    settings = settings or TetrahedraSettings()
    used, compact = np.unique(faces, return_inverse=True)
    surface = vertices[used]
    center = (surface.min(axis=0) + surface.max(axis=0)) / 2
    scale = DIAGONAL / np.linalg.norm(surface.max(axis=0) - surface.min(axis=0))
    surface = (surface - center) * scale

    failure = _Failure(len(vertices), len(faces))
    compact = outward(surface, compact.reshape(-1, 3))
    settings = replace(settings, edge_length_fac=settings.edge_length(surface, compact))
    raw = _run_worker(surface, compact, settings, timeout, stop or threading.Event(), failure)
    tetrahedra = without_debris(oriented(raw))
    _check_fills(tetrahedra, surface, settings, failure)
    return Tetrahedra(tetrahedra.vertices / scale + center, tetrahedra.tets)


def tet_volumes(tetrahedra: Tetrahedra) -> FloatArray:
    """Signed volumes. *Shape:* ``(T,)``."""
    origin, *others = np.moveaxis(tetrahedra.vertices, 1, 0)[:, tetrahedra.tets.T].transpose(1, 0, 2)
    (a, b, c), (d, e, f), (g, h, i) = (other - origin for other in others)
    return (a * (e * i - f * h) + b * (f * g - d * i) + c * (d * h - e * g)) / 6


def solid_volumes(tetrahedra: Tetrahedra) -> FloatArray:
    """Volume of the part of each tetrahedron that is solid; inverted ones count like others. *Shape:* ``(T,)``."""
    volumes = np.abs(tet_volumes(tetrahedra))
    return volumes if tetrahedra.inside is None else volumes * tetrahedra.inside


def oriented(tetrahedra: Tetrahedra) -> Tetrahedra:
    """The same mesh with positive volumes, without flat tetrahedra and unused vertices."""
    volumes = tet_volumes(tetrahedra)
    tets = tetrahedra.tets.copy()
    tets[volumes < 0] = tets[volumes < 0][:, [1, 0, 2, 3]]
    edges = tetrahedra.vertices[tets[:, 1:]] - tetrahedra.vertices[tets[:, :1]]
    # A volume below rounding in units of the tetrahedron's own size has no usable gradients.
    flat = np.abs(volumes) <= 1e-12 * np.linalg.norm(edges, axis=2).max(axis=1, initial=0.0) ** 3
    return kept_tetrahedra(Tetrahedra(tetrahedra.vertices, tets, tetrahedra.inside), ~flat)


def without_debris(tetrahedra: Tetrahedra) -> Tetrahedra:
    """The same mesh without small pieces that hang on others by a vertex or an edge only.

    fTetWild leaves them along the rims of open surfaces. They swing freely, and each adds zero modes.
    """
    tets = tetrahedra.tets
    if len(tets) == 0:
        return tetrahedra
    piece = pieces_by_sides(tets)
    n = piece.max() + 1
    vertex, user = np.divmod(np.unique(tets.reshape(-1) * n + np.repeat(piece, 4)), n)
    hinge = np.bincount(vertex)[vertex] > 1  # a vertex of two pieces or more
    volumes = np.bincount(piece, np.abs(tet_volumes(tetrahedra)))
    debris = (volumes < SMALL_VOLUME * volumes.sum()) & (np.bincount(user, hinge, n) > 0)
    if volumes[debris].sum() > MOST_DEBRIS * volumes.sum():
        return tetrahedra
    return kept_tetrahedra(tetrahedra, ~debris[piece])


def is_small(tetrahedra: Tetrahedra, piece: IntArray) -> NDArray[np.bool_]:
    """Which pieces have little volume and are short; never the largest.

    Args:
        tetrahedra: Of ``P`` pieces.
        piece: The piece of each tetrahedron. *Shape:* ``(T,)``.

    Returns:
        *Shape:* ``(P,)``.
    """
    volumes = np.bincount(piece, solid_volumes(tetrahedra))
    low, high = (np.full((len(volumes), 3), bound) for bound in (np.inf, -np.inf))
    corners = tetrahedra.vertices[tetrahedra.tets]
    np.minimum.at(low, piece, corners.min(axis=1))
    np.maximum.at(high, piece, corners.max(axis=1))
    extent = np.linalg.norm(high - low, axis=1)
    small = (volumes < SMALL_VOLUME * volumes.sum()) & (
        extent < SMALL_SIZE * np.linalg.norm(high.max(axis=0) - low.min(axis=0))
    )
    small[volumes.argmax()] = False
    return small


def loose_pieces(tetrahedra: Tetrahedra) -> IntArray:
    """Which piece each vertex belongs to; pieces share no vertex. *Shape:* ``(N,)``."""
    pairs = np.stack([np.repeat(tetrahedra.tets[:, 0], 3), tetrahedra.tets[:, 1:].reshape(-1)], axis=1)
    return connected_pieces(pairs, len(tetrahedra.vertices))


def pieces_by_sides(tets: IntArray) -> IntArray:
    """Which piece each tetrahedron belongs to; those that share a side are in one. *Shape:* ``(T, 4) -> (T,)``."""
    a, b, c, d = np.sort(tets, axis=1).T
    n = tets.max(initial=0) + 1
    # Three vertices as one number, which two million of them do not overflow.
    sides = np.concatenate([(p * n + q) * n + r for p, q, r in ((b, c, d), (a, c, d), (a, b, d), (a, b, c))])
    order = np.argsort(sides)
    shared = np.diff(sides[order]) == 0
    owner = order % max(len(tets), 1)
    return connected_pieces(np.stack([owner[:-1][shared], owner[1:][shared]], axis=1), len(tets))


def kept_tetrahedra(tetrahedra: Tetrahedra, kept: NDArray[np.bool_]) -> Tetrahedra:
    """Some of the tetrahedra, with the vertices that they use."""
    used, compact = np.unique(tetrahedra.tets[kept], return_inverse=True)
    inside = None if tetrahedra.inside is None else tetrahedra.inside[kept]
    return Tetrahedra(tetrahedra.vertices[used], compact.reshape(-1, 4), inside)


class _Failure(NamedTuple):
    """The mesh that an error message speaks about."""

    n_vertices: int
    n_faces: int

    def error(self, why: str, advice: str, fails_until: float = np.inf) -> TetrahedralizationError:
        mesh = f"a mesh of {self.n_vertices} vertices and {self.n_faces} faces"
        error = TetrahedralizationError(f"cannot fill {mesh} with tetrahedra: {why}. {advice}")
        error.fails_until = fails_until
        return error


def _run_worker(
    surface: FloatArray,
    faces: IntArray,
    settings: TetrahedraSettings,
    timeout: float,
    stop: threading.Event,
    failure: _Failure,
) -> Tetrahedra:
    """Hand the surface to the worker process, wait for it, read what it wrote."""
    if not sys.executable:
        raise failure.error(
            "sys.executable is empty, so no worker process can be started", "Run in a normal interpreter", 0.0
        )
    with tempfile.TemporaryDirectory(prefix="torch_modal-", ignore_cleanup_errors=True) as folder:
        job, result, log = (Path(folder) / name for name in ("job.npz", "result.npz", "log.txt"))
        np.savez(job, vertices=surface, faces=faces, timeout=timeout, **asdict(settings))
        command = [sys.executable, str(WORKER), str(job), str(result)]
        # Output goes to a file: a pipe that nobody empties would block the child.
        with log.open("wb") as output:
            process = subprocess.Popen(
                command,
                stdin=subprocess.DEVNULL,
                stdout=output,
                stderr=subprocess.STDOUT,
                cwd=folder,  # fTetWild leaves a __tracked_surface.stl where it runs
                # Its own process group: it is killed as a whole, and Ctrl-C reaches only this process.
                start_new_session=True,
            )
        try:
            code = _wait(process, timeout, stop)
        finally:
            end_process(process)  # also on KeyboardInterrupt
        if code is None:
            raise failure.error(
                f"no result after the timeout of {timeout:g} s",
                "Give a longer timeout, a larger edge_length_fac, or a surface without self-intersections",
                timeout,
            )
        if code != 0:
            tail = last_line(log.read_text(errors="replace"))
            raise failure.error(
                f"the worker process ended with {describe_exit(code)}" + (f" ({tail})" if tail else ""),
                "Check the surface for self-intersections and degenerate faces, or try other settings",
                np.inf if code in _OWN_FAILURES else 0.0,
            )
        try:
            with np.load(result) as arrays:
                return Tetrahedra(arrays["vertices"], arrays["tets"])
        except (OSError, KeyError, ValueError, zipfile.BadZipFile) as error:
            raise failure.error(f"the worker process left no readable result ({error})", "Try again", 0.0) from error


def _wait(process: subprocess.Popen[bytes], timeout: float, stop: threading.Event) -> int | None:
    """The exit code, or None after ``timeout`` seconds.

    Polled: for ``stop``, and as a wait in one piece cannot be interrupted by Ctrl-C on every platform.
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


def _check_fills(tetrahedra: Tetrahedra, surface: FloatArray, settings: TetrahedraSettings, failure: _Failure) -> None:
    """Refuse a mesh that is empty, not finite, or does not reach all of the surface (diagonal 100)."""
    advice = (
        "Check that the surface is closed, its winding consistent, and no part thinner than "
        f"{100 * settings.epsilon:g} % of the diagonal, or give a smaller epsilon"
    )
    if len(tetrahedra.tets) == 0:
        raise failure.error("the result is empty", advice)
    if not np.isfinite(tetrahedra.vertices).all():
        raise failure.error("the result has coordinates that are not finite", advice)
    # Vertices on the new surface are about one edge length apart, so no point of the old one is further away.
    reach = DIAGONAL * (0.05 + 2 * (settings.edge_length_fac or EDGE_RANGE[1]))
    distance = cKDTree(tetrahedra.vertices).query(surface)[0]
    n_far = int((distance > reach).sum())
    if n_far:
        raise failure.error(
            f"{n_far} of its vertices are further than {reach:g} % of the diagonal from the result",
            advice + ", or raise max_surface_faces if small parts were lost in the decimation",
        )
    low, high = surface.min(axis=0) - reach, surface.max(axis=0) + reach
    if (tetrahedra.vertices < low).any() or (tetrahedra.vertices > high).any():
        raise failure.error("the result reaches far beyond the surface", advice)
