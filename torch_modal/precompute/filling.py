"""Tetrahedra of key-frames: meshed once per set where possible."""

import threading
from collections.abc import Callable
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any

import numpy as np
import scipy.sparse as sp
from numpy.typing import NDArray

from torch_modal.io.cache import Arrays, Cache
from torch_modal.precompute.carrying import Carrier
from torch_modal.precompute.embedding import Neighbours, find_neighbours, fit_weights
from torch_modal.precompute.lattice import Lattice
from torch_modal.precompute.proximity import self_proximity
from torch_modal.precompute.stiffness import mass_matrix
from torch_modal.precompute.surface import CanonicalSurface
from torch_modal.precompute.tetrahedra import (
    Mesher,
    Tetrahedra,
    TetrahedralizationError,
    kept_tetrahedra,
    loose_pieces,
    solid_volumes,
)
from torch_modal.precompute.tetwild import TetrahedraSettings, TetWild

MESHERS: dict[str, Callable[[TetrahedraSettings], Mesher]] = {
    "lattice": lambda settings: Lattice(settings.edge_length_fac),
    "tetwild": TetWild,
}
"""Constructors of meshers by name."""


@dataclass(frozen=True)
class Body:
    """A key-frame with its own tetrahedra.

    Attributes:
        surface: The key-frame.
        tetrahedra: The volume mesh, in the units of the surface.
    """

    surface: CanonicalSurface
    tetrahedra: Tetrahedra
    _lock: threading.RLock = field(default_factory=threading.RLock, init=False, repr=False, compare=False)

    @property
    def neighbours(self) -> Neighbours:
        """Embedding of the surface in the tetrahedra."""
        with self._lock:
            return self._neighbours

    @property
    def carrier(self) -> Carrier:
        """Deformation of the tetrahedra to other key-frames."""
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
    """Tetrahedra in the pose of a key-frame: its own, or carried from another.

    Mass and embedding come from the rest pose, in which no tetrahedron is inverted and no point is closer to another
    limb than to its own.

    Attributes:
        body: The key-frame at rest.
        surface: The key-frame in this pose.
        tetrahedra: The volume mesh in this pose, in the units of the surface.
    """

    body: Body
    surface: CanonicalSurface
    tetrahedra: Tetrahedra

    def mass(self) -> sp.csr_matrix:
        """Mass matrix at a density of 1 in this pose. *Shape:* ``(N, N)``."""
        rest = self.body.tetrahedra
        return mass_matrix(rest) * (solid_volumes(self.tetrahedra).sum() / solid_volumes(rest).sum())

    def weights(self) -> sp.csr_matrix:
        """Embedding of the surface in the tetrahedra. *Shape:* ``(U, N)``."""
        return fit_weights(self.surface.points, self.tetrahedra.vertices, self.body.neighbours)

    def content(self) -> Arrays:
        """Cache inputs: everything that the modes depend on."""
        rest = {f"rest_{name}": array for name, array in _as_arrays(self.body.tetrahedra).items()}
        surfaces = {"points": self.surface.points, "faces": self.surface.faces, "rest_points": self.body.surface.points}
        return {**surfaces, **rest, "vertices": self.tetrahedra.vertices}


@dataclass(frozen=True)
class Filler:
    """Fills surfaces with tetrahedra through the cache. Thread-safe.

    Attributes:
        mesher: The mesher.
        timeout: Time limit for one surface, in seconds.
        cache: Storage of tetrahedra and failures.
        stop: Event that cancels the work and kills child processes.
    """

    mesher: Mesher
    timeout: float
    cache: Cache
    stop: threading.Event = field(default_factory=threading.Event)

    def body(self, surface: CanonicalSurface) -> Body:
        """Mesh a surface.

        Raises:
            TetrahedralizationError: The mesher failed.
        """
        key, inputs = self.mesher.key(), {"points": surface.points, "faces": surface.faces}
        stored = self.cache.get("tetrahedra", inputs, key, lambda: _as_arrays(self._made(surface, inputs, key)))
        return _without_unused_pieces(Body(surface, Tetrahedra(**stored)))

    def _made(self, surface: CanonicalSurface, inputs: Arrays, key: dict[str, Any]) -> Tetrahedra:
        """Run the mesher, unless it failed in an earlier run with at least as long a timeout."""
        key = {name: value for name, value in key.items() if name != "mesher"}
        failure = self.cache.find("failure", inputs, key)
        if failure is not None and self.timeout <= (fails_until := float(failure["fails_until"][0])):
            longer = f"give a timeout of more than {fails_until:g} s, " if np.isfinite(fails_until) else ""
            raise TetrahedralizationError(
                f"{failure['reason'].tobytes().decode()}. An earlier run found this for the same surface and settings, "
                f"and it was not tried again; to try again, {longer}clear the cache in {self.cache.folder} "
                "(torch-modal cache --clear), or do without it",
                fails_until,
            )
        try:
            return self.mesher.fill(surface, self.timeout, self.stop)
        except TetrahedralizationError as error:
            if error.fails_until > 0:
                reason = np.frombuffer(str(error).encode(), dtype=np.uint8)
                failure = {"reason": reason, "fails_until": np.array([error.fails_until])}
                self.cache.keep("failure", inputs, key, failure)
            raise

    def carried(self, body: Body, surface: CanonicalSurface) -> Filling | None:
        """Carry the tetrahedra to the pose of another key-frame; None if the result is too distorted."""

        def compute() -> dict[str, NDArray[Any]]:
            try:
                result = body.carrier.carry(surface.points)
            except (RuntimeError, np.linalg.LinAlgError):  # a singular matrix, in SuperLU, NumPy or SciPy
                return {"vertices": body.tetrahedra.vertices, "is_good": np.array([False])}
            return {"vertices": result.tetrahedra.vertices, "is_good": np.array([result.is_good])}

        inputs = {"points": surface.points, "faces": surface.faces, "rest_points": body.surface.points}
        kept = self.cache.get("carried", {**inputs, **_as_arrays(body.tetrahedra)}, {}, compute)
        if not kept["is_good"][0]:
            return None
        return Filling(body, surface, body.tetrahedra._replace(vertices=kept["vertices"]))


def _without_unused_pieces(body: Body) -> Body:
    """Remove pieces of tetrahedra in which no surface point is embedded."""
    piece = loose_pieces(body.tetrahedra)
    if piece.max() == 0:
        return body
    bears = np.zeros(piece.max() + 1, dtype=bool)
    bears[piece[body.neighbours.vertex[body.neighbours.kernel > 0]]] = True
    if bears.all():
        return body
    return Body(body.surface, kept_tetrahedra(body.tetrahedra, bears[piece[body.tetrahedra.tets[:, 0]]]))


def _as_arrays(tetrahedra: Tetrahedra) -> dict[str, NDArray[Any]]:
    return {name: array for name, array in tetrahedra._asdict().items() if array is not None}


def meshing_order(surfaces: list[CanonicalSurface]) -> list[int]:
    """Indices of the key-frames by ascending self-proximity."""
    return [int(i) for i in np.argsort([self_proximity(surface) for surface in surfaces], kind="stable")]
