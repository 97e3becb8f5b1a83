"""Tetrahedral meshes, their pieces, and meshers."""

import threading
from typing import NamedTuple, Protocol

import numpy as np

from torch_modal.arrays import AnyArray, BoolArray, FloatArray, IntArray
from torch_modal.errors import ModalAnalysisError
from torch_modal.geometry.connectivity import label_pieces
from torch_modal.geometry.surface import Surface

EDGES = np.array([(0, 1), (0, 2), (0, 3), (1, 2), (1, 3), (2, 3)])
"""Corners at the ends of the edges of a tetrahedron. *Shape:* ``(6, 2)``."""
FACES = np.array([(1, 2, 3), (0, 2, 3), (0, 1, 3), (0, 1, 2)])
"""Corners of the faces of a tetrahedron. *Shape:* ``(4, 3)``."""
SMALL_AMOUNT = 0.01
"""Largest volume (or area, of a surface) of a small piece, as a fraction of the whole."""
SMALL_SIZE = 0.1
"""Largest extent of a small piece, as a fraction of the diagonal; longer thin pieces are limbs or wires."""
MOST_DEBRIS = 0.2
"""Largest volume fraction of debris; with more, the body itself consists of pieces."""


class Tetrahedra(NamedTuple):
    """A tetrahedral mesh.

    Attributes:
        vertices: Positions. *Shape:* ``(N, 3)``.
        tets: Vertex indices; meshers give positive volumes. *Shape:* ``(T, 4)``.
        inside: Fraction of each tetrahedron inside the surface; None for 1. *Shape:* ``(T,)``.
    """

    vertices: FloatArray
    tets: IntArray
    inside: FloatArray | None = None

    def arrays(self) -> dict[str, AnyArray]:
        """The arrays by name, without those that are None."""
        return {name: array for name, array in self._asdict().items() if array is not None}


class MesherError(ModalAnalysisError):
    """The mesher failed, which other modes do not make good; the message names the mesh, the reason and a remedy."""


class Mesher(Protocol):
    """Fills surfaces with tetrahedra."""

    def key(self) -> dict[str, object]:
        """Cache key besides the surface: name, settings and versions, as numbers, strings or None."""
        ...

    def fill(self, surface: Surface, stop: threading.Event) -> Tetrahedra:
        """Fill a surface with tetrahedra, in its units.

        Args:
            surface: A closed surface, or one that is nearly closed.
            stop: Event that cancels the work.

        Raises:
            MesherError: It failed.
            StoppedError: ``stop`` was set.
        """
        ...


def tet_volumes(tetrahedra: Tetrahedra) -> FloatArray:
    """Signed volumes. *Shape:* ``(T,)``."""
    origin, *others = np.moveaxis(tetrahedra.vertices, 1, 0)[:, tetrahedra.tets.T].transpose(1, 0, 2)
    (a, b, c), (d, e, f), (g, h, i) = (other - origin for other in others)
    return (a * (e * i - f * h) + b * (f * g - d * i) + c * (d * h - e * g)) / 6


def solid_volumes(tetrahedra: Tetrahedra) -> FloatArray:
    """Absolute volume of each tetrahedron times its inside fraction. *Shape:* ``(T,)``."""
    volumes = np.abs(tet_volumes(tetrahedra))
    return volumes if tetrahedra.inside is None else volumes * tetrahedra.inside


def edge_lengths(tetrahedra: Tetrahedra) -> FloatArray:
    """Length of each edge, once. *Shape:* ``(E,)``."""
    edges = np.unique(np.sort(tetrahedra.tets[:, EDGES].reshape(-1, 2), axis=1), axis=0)
    lengths: FloatArray = np.linalg.norm(np.diff(tetrahedra.vertices[edges], axis=1)[:, 0], axis=1)
    return lengths


def orient(tetrahedra: Tetrahedra) -> Tetrahedra:
    """Orient tetrahedra to positive volumes; remove degenerate ones and unused vertices."""
    volumes = tet_volumes(tetrahedra)
    tets = tetrahedra.tets.copy()
    tets[volumes < 0] = tets[volumes < 0][:, [1, 0, 2, 3]]
    edges = tetrahedra.vertices[tets[:, 1:]] - tetrahedra.vertices[tets[:, :1]]
    # Volumes at the level of rounding give no usable gradients.
    flat = np.abs(volumes) <= 1e-12 * np.linalg.norm(edges, axis=2).max(axis=1, initial=0.0) ** 3
    return submesh(Tetrahedra(tetrahedra.vertices, tets, tetrahedra.inside), ~flat)


def without_debris(tetrahedra: Tetrahedra) -> Tetrahedra:
    """Remove small pieces that share only a vertex or an edge with others.

    fTetWild creates them along the boundary of open surfaces. Each adds zero modes.
    """
    tets = tetrahedra.tets
    if len(tets) == 0:
        return tetrahedra
    piece = face_connected_pieces(tets)
    n = piece.max() + 1
    vertex, user = np.divmod(np.unique(tets.reshape(-1) * n + np.repeat(piece, 4)), n)
    hinge = np.bincount(vertex)[vertex] > 1  # a vertex of two pieces or more
    volumes = np.bincount(piece, np.abs(tet_volumes(tetrahedra)))
    debris = (volumes < SMALL_AMOUNT * volumes.sum()) & (np.bincount(user, hinge, n) > 0)
    if volumes[debris].sum() > MOST_DEBRIS * volumes.sum():
        return tetrahedra
    return submesh(tetrahedra, ~debris[piece])


def small_pieces(amounts: AnyArray, corners: FloatArray, piece: IntArray) -> BoolArray:
    """True for pieces that have little volume or area, and little extent; false for the largest.

    From the amount of each piece, and the corners and pieces of elements. *Shape:* ``(P,), (M, n, 3), (M,) -> (P,)``.
    """
    low, high = (np.full((len(amounts), 3), bound) for bound in (np.inf, -np.inf))
    np.minimum.at(low, piece, corners.min(axis=1))
    np.maximum.at(high, piece, corners.max(axis=1))
    extent = np.linalg.norm(high - low, axis=1)
    small: BoolArray = (amounts < SMALL_AMOUNT * amounts.sum()) & (
        extent < SMALL_SIZE * np.linalg.norm(high.max(axis=0) - low.min(axis=0))
    )
    small[amounts.argmax()] = False
    return small


def loose_pieces(tetrahedra: Tetrahedra) -> IntArray:
    """Connected component of each vertex. *Shape:* ``(N,)``."""
    pairs = np.stack([np.repeat(tetrahedra.tets[:, 0], 3), tetrahedra.tets[:, 1:].reshape(-1)], axis=1)
    return label_pieces(pairs, len(tetrahedra.vertices))


def face_connected_pieces(tets: IntArray) -> IntArray:
    """Face-connected component of each tetrahedron. *Shape:* ``(T, 4) -> (T,)``."""
    t, n = len(tets), tets.max(initial=0) + 1
    # Packs three vertices into one integer; safe up to two million vertices.
    sides = np.sort(tets, axis=1)[:, FACES] @ [n * n, n, 1]
    side = np.unique(sides, return_inverse=True)[1].reshape(-1)
    return label_pieces(np.stack([np.repeat(np.arange(t), 4), t + side], axis=1), t + sides.size)[:t]


def submesh(tetrahedra: Tetrahedra, kept: BoolArray) -> Tetrahedra:
    """Submesh of some tetrahedra with their vertices."""
    used, compact = np.unique(tetrahedra.tets[kept], return_inverse=True)
    inside = None if tetrahedra.inside is None else tetrahedra.inside[kept]
    return Tetrahedra(tetrahedra.vertices[used], compact.reshape(-1, 4), inside)
