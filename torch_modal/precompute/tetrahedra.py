"""Tetrahedral meshes, and what makes them of surfaces."""

import threading
from typing import Any, NamedTuple, Protocol

import numpy as np

from torch_modal.arrays import BoolArray, FloatArray, IntArray
from torch_modal.geometry.connectivity import connected_pieces
from torch_modal.precompute.surface import CanonicalSurface

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


class TetrahedralizationError(RuntimeError):
    """No usable tetrahedra came out; the message says for which mesh, why, and what to do.

    Attributes:
        fails_until: The same call fails again with any timeout up to this, in seconds: infinity where the mesher
            cannot do it, zero where it was not its fault.
    """

    fails_until: float = 0.0


class Mesher(Protocol):
    """Fills surfaces with tetrahedra. Its attributes are its settings.

    A mesher is one file; an entry in :data:`~torch_modal.precompute.filling.MESHERS` gives it a name.
    """

    def key(self) -> dict[str, Any]:
        """What the tetrahedra depend on besides the surface: name, settings, versions. Numbers, strings or None."""
        ...

    def fill(self, surface: CanonicalSurface, timeout: float, stop: threading.Event) -> Tetrahedra:
        """Tetrahedra in the units of the surface.

        Args:
            surface: A closed surface, or one that is nearly closed.
            timeout: Seconds that it may take; one that is quick need not look.
            stop: Set when the tetrahedra are no longer wanted.

        Raises:
            TetrahedralizationError: There are none.
            StoppedError: Somebody set ``stop``.
        """
        ...


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


def is_small(tetrahedra: Tetrahedra, piece: IntArray) -> BoolArray:
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


def kept_tetrahedra(tetrahedra: Tetrahedra, kept: BoolArray) -> Tetrahedra:
    """Some of the tetrahedra, with the vertices that they use."""
    used, compact = np.unique(tetrahedra.tets[kept], return_inverse=True)
    inside = None if tetrahedra.inside is None else tetrahedra.inside[kept]
    return Tetrahedra(tetrahedra.vertices[used], compact.reshape(-1, 4), inside)
