"""Key-frames filled with tetrahedra: meshed once for the whole set where that works."""

import contextlib
import threading
from collections.abc import Callable
from dataclasses import asdict, dataclass, field, replace
from functools import cached_property
from importlib.metadata import PackageNotFoundError, version
from typing import Any, Literal

import numpy as np
import scipy.sparse as sp
from numpy.typing import NDArray

from torch_modal.geometry.connectivity import connected_pieces
from torch_modal.io.cache import Arrays, Cache
from torch_modal.precompute.carrying import Carrier
from torch_modal.precompute.embedding import Neighbours, find_neighbours, fit_weights
from torch_modal.precompute.lattice import is_too_fine, lattice
from torch_modal.precompute.proximity import parting, self_proximity
from torch_modal.precompute.stiffness import mass_matrix
from torch_modal.precompute.surface import CanonicalSurface
from torch_modal.precompute.tetrahedra import (
    EDGE_RANGE,
    Tetrahedra,
    TetrahedralizationError,
    TetrahedraSettings,
    kept_tetrahedra,
    loose_pieces,
    pieces_by_sides,
    solid_volumes,
    tetrahedralize,
)

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]
Mesher = Literal["lattice", "tetwild"]
MESHERS: tuple[Mesher, ...] = ("lattice", "tetwild")

LATTICE_VERSION = "whole"
"""Tetrahedra that other versions of the package have kept are not those of this one."""
CUBE = 0.75
"""Edge of the lattice's cubes at the surface, over the largest that fTetWild is asked for."""
COARSER = 1.1
"""Factor of that edge until there are not too many cubes."""
TURN = np.array([[2.0, -1.0, 2.0], [2.0, 2.0, -1.0], [-1.0, 2.0, 2.0]]) / 3
"""A turn after which no axis is along or across another."""

MOST_PARTING = 0.014
"""Where parts that touch come further apart, carrying is not tried (:func:`~torch_modal.precompute.proximity.parting`).
On all pairs of the samples and of five data sets tetrahedra survived up to 0.0105, and never from 0.0127 on."""


@dataclass(frozen=True)
class Body:
    """A key-frame with tetrahedra of its own.

    Attributes:
        surface: The key-frame.
        tetrahedra: In the units of the surface.
    """

    surface: CanonicalSurface
    tetrahedra: Tetrahedra
    _lock: threading.RLock = field(default_factory=threading.RLock, init=False, repr=False, compare=False)

    @property
    def neighbours(self) -> Neighbours:
        """What each point of the surface hangs on."""
        with self._lock:
            return self._neighbours

    @property
    def carrier(self) -> Carrier:
        """What takes the tetrahedra to other key-frames."""
        with self._lock:
            return self._carrier

    @cached_property
    def _neighbours(self) -> Neighbours:
        return find_neighbours(self.surface.points, self.tetrahedra, self.surface.normals)

    @cached_property
    def _carrier(self) -> Carrier:
        weights = fit_weights(self.surface.points, self.tetrahedra.vertices, self.neighbours)
        return Carrier(self.tetrahedra, self.surface.points, self.surface.faces, weights)


@dataclass(frozen=True)
class Filling:
    """Tetrahedra in the pose of a key-frame: its own, or those of another.

    Mass and neighbours are those of the pose that the tetrahedra were made in: there none is inverted, and no point
    is nearer to another limb than to its own.

    Attributes:
        body: The key-frame that the tetrahedra were made for.
        surface: The key-frame that they are in the pose of.
        tetrahedra: In that pose, in the units of the surface.
    """

    body: Body
    surface: CanonicalSurface
    tetrahedra: Tetrahedra

    def mass(self) -> sp.csr_matrix:
        """Mass matrix at a density of 1 in this pose. *Shape:* ``(N, N)``."""
        rest = self.body.tetrahedra
        return mass_matrix(rest) * (solid_volumes(self.tetrahedra).sum() / solid_volumes(rest).sum())

    def weights(self) -> sp.csr_matrix:
        """How the surface hangs on the tetrahedra. *Shape:* ``(U, N)``."""
        return fit_weights(self.surface.points, self.tetrahedra.vertices, self.body.neighbours)

    def content(self) -> Arrays:
        """Everything that modes depend on, for the cache."""
        rest = {f"rest_{name}": array for name, array in _as_arrays(self.body.tetrahedra).items()}
        surfaces = {"points": self.surface.points, "faces": self.surface.faces, "rest_points": self.body.surface.points}
        return {**surfaces, **rest, "vertices": self.tetrahedra.vertices}


@dataclass(frozen=True)
class Filler:
    """How surfaces are filled with tetrahedra; by several threads at once if need be.

    Attributes:
        settings: How fine the tetrahedra are.
        mesher: ``"lattice"`` or ``"tetwild"``.
        timeout: Seconds that the child process of fTetWild may take.
        cache: Where tetrahedra are kept.
        stop: Set when they are no longer wanted: children are killed then.
    """

    settings: TetrahedraSettings
    mesher: Mesher
    timeout: float
    cache: Cache
    stop: threading.Event = field(default_factory=threading.Event)

    def body(self, surface: CanonicalSurface) -> Body:
        """The surface with tetrahedra of its own.

        Raises:
            TetrahedralizationError: No mesher could fill it.
        """
        make = self._by_lattice if self.mesher == "lattice" else self._by_tetwild
        kept = self._kept(surface, lambda: _as_arrays(make(surface)))
        return _without_idle(Body(surface, Tetrahedra(**kept)))

    def _by_lattice(self, surface: CanonicalSurface) -> Tetrahedra:
        """By the lattice; in another direction, too, where that falls into pieces.

        A thin wall that lies along the cubes' sides is in tetrahedra that hardly share any.
        """
        cube = CUBE * (self.settings.edge_length_fac or EDGE_RANGE[1])
        while is_too_fine(surface, cube):
            cube *= COARSER
        found = lattice(surface, cube)
        pairs = np.concatenate([surface.faces[:, :2], surface.faces[:, 1:]])
        most = connected_pieces(pairs, len(surface.points)).max()
        if pieces_by_sides(found.tets).max() <= most:
            return found
        turned = lattice(replace(surface, points=surface.points @ TURN.T), cube)
        if pieces_by_sides(turned.tets).max() >= pieces_by_sides(found.tets).max():
            return found
        return turned._replace(vertices=turned.vertices @ TURN)

    def _by_tetwild(self, surface: CanonicalSurface) -> Tetrahedra:
        """By fTetWild, unless it is known to fail: nobody should wait for the same failure twice."""
        inputs, parameters = _content(surface), {**asdict(self.settings), **_mesher_versions()}
        if (failure := self.cache.find("failure", inputs, parameters)) is not None:
            self._raise_known(failure)
        try:
            return tetrahedralize(surface.points, surface.faces, self.settings, timeout=self.timeout, stop=self.stop)
        except TetrahedralizationError as error:
            if error.fails_until > 0:
                reason = np.frombuffer(str(error).encode(), dtype=np.uint8)
                self.cache.keep(
                    "failure", inputs, parameters, {"reason": reason, "fails_until": np.array([error.fails_until])}
                )
            raise

    def _raise_known(self, failure: Arrays) -> None:
        """Raise what an earlier run found, if the timeout is no longer than it was."""
        fails_until = float(failure["fails_until"][0])
        if self.timeout > fails_until:
            return
        longer = f"give a timeout of more than {fails_until:g} s, " if np.isfinite(fails_until) else ""
        raise TetrahedralizationError(
            f"{failure['reason'].tobytes().decode()}. An earlier run found this for the same surface and settings, and "
            f"it was not tried again; to try again, {longer}clear the cache in {self.cache.folder} (torch-modal cache "
            "--clear), or do without it"
        )

    def _kept(self, surface: CanonicalSurface, make: Callable[[], Arrays]) -> Arrays:
        versions = _mesher_versions() if self.mesher == "tetwild" else {"lattice": LATTICE_VERSION}
        parameters = {**asdict(self.settings), **versions, "mesher": self.mesher}
        return dict(self.cache.get("tetrahedra", _content(surface), parameters, make))

    def carried(self, body: Body, surface: CanonicalSurface) -> Filling | None:
        """The body in the pose of another key-frame, or None if its tetrahedra do not survive that."""

        def compute() -> dict[str, NDArray[Any]]:
            try:
                result = body.carrier.carry(surface.points)
            except (RuntimeError, np.linalg.LinAlgError):  # of SuperLU, NumPy or SciPy: a matrix that is singular
                return {"vertices": body.tetrahedra.vertices, "is_good": np.array([False])}
            return {"vertices": result.tetrahedra.vertices, "is_good": np.array([result.is_good])}

        inputs = {"points": surface.points, "faces": surface.faces, "rest_points": body.surface.points}
        kept = self.cache.get("carried", {**inputs, **_as_arrays(body.tetrahedra)}, {}, compute)
        if not kept["is_good"][0]:
            return None
        return Filling(body, surface, body.tetrahedra._replace(vertices=kept["vertices"]))


def _without_idle(body: Body) -> Body:
    """The body without pieces of tetrahedra that nothing of its surface hangs on."""
    piece = loose_pieces(body.tetrahedra)
    if piece.max() == 0:
        return body
    bears = np.zeros(piece.max() + 1, dtype=bool)
    bears[piece[body.neighbours.vertex[body.neighbours.kernel > 0]]] = True
    if bears.all():
        return body
    return Body(body.surface, kept_tetrahedra(body.tetrahedra, bears[piece[body.tetrahedra.tets[:, 0]]]))


def _mesher_versions() -> dict[str, str | None]:
    """What the result of fTetWild depends on beside the surface and the settings, for the cache."""

    def installed(name: str) -> str | None:
        with contextlib.suppress(PackageNotFoundError):
            return version(name)
        return None  # the worker will say so

    return {name: installed(name) for name in ("pytetwild", "fast-simplification")}


def _content(surface: CanonicalSurface) -> Arrays:
    """What tetrahedra depend on, for the cache."""
    return {"points": surface.points, "faces": surface.faces}


def _as_arrays(tetrahedra: Tetrahedra) -> dict[str, NDArray[Any]]:
    return {name: array for name, array in tetrahedra._asdict().items() if array is not None}


def meshing_order(surfaces: list[CanonicalSurface]) -> list[int]:
    """Key-frames in the order in which they should be filled: the one that touches itself least comes first."""
    return [int(i) for i in np.argsort([self_proximity(surface) for surface in surfaces], kind="stable")]


def is_torn(rest: CanonicalSurface, posed: CanonicalSurface) -> bool:
    """Whether it is known beforehand that tetrahedra of one pose do not survive being carried to another."""
    return parting(rest, posed) > MOST_PARTING
