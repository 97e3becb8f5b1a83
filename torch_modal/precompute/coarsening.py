"""One edge-collapse rule for all key-frames, and the cluster averages that it gives (section 3.2 of the paper)."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial

import numpy as np
from scipy import sparse

from torch_modal.arrays import FloatArray, IntArray
from torch_modal.geometry.connectivity import connected_pieces, double_areas
from torch_modal.geometry.decimation import decimate
from torch_modal.geometry.inspect import degenerate_faces, repeated_faces

# A triangle of less area than this part of its longest edge squared is a needle; an equilateral one has 0.43. If there
# is one, other numbers of faces are tried.
NEEDLE = 3e-3
MORE_FACES = (1.0, 1.1, 1.25, 1.4, 1.6)

# A closed piece with fewer faces bends without stretching, or vanishes, and then nothing keeps its shape.
FACES_OF_PIECE = 20
# Of more pieces than this only the largest are looked at.
MOST_PIECES = 100


@dataclass(frozen=True)
class Coarsening:
    """A partition of the fine vertices into clusters, each a vertex of the coarse mesh.

    The restriction of positions and of modes is the same cluster average, so ``restrict(x + phi a)`` is exactly
    ``restrict(x) + restrict(phi) a``. Positions that the simplification itself would place are never used: they solve
    quadrics anew for every pose and are not linear in it.
    """

    clusters: IntArray
    """Coarse vertex of each fine one, -1 for those that no face uses. *Shape:* ``(V,)``."""
    faces: IntArray
    """Faces of the coarse mesh. *Shape:* ``(F_coarse, 3)``."""

    @property
    def n_vertices(self) -> int:
        """Number of coarse vertices."""
        return int(self.clusters.max()) + 1

    def restriction(self) -> sparse.csr_matrix:
        """Matrix of the cluster average. *Shape:* ``(V_coarse, V)``."""
        members = np.flatnonzero(self.clusters >= 0)
        clusters = self.clusters[members]
        sizes = np.bincount(clusters, minlength=self.n_vertices)
        shape = (self.n_vertices, len(self.clusters))
        return sparse.csr_matrix((1.0 / sizes[clusters], (clusters, members)), shape=shape)

    def restrict(self, x: FloatArray) -> FloatArray:
        """Cluster averages. *Shape:* ``(..., V, 3) -> (..., V_coarse, 3)``."""
        lead = x.shape[:-2]
        columns = np.moveaxis(x.reshape(-1, *x.shape[-2:]), 1, 0).reshape(x.shape[-2], -1)
        coarse = (self.restriction() @ columns).reshape(self.n_vertices, -1, 3)
        return np.moveaxis(coarse, 0, 1).reshape(*lead, self.n_vertices, 3)


class Collapses:
    """Partitions by the edge collapses of single key-frames, each made once: pairs of key-frames share them.

    Args:
        faces: Vertex indices. *Shape:* ``(F, 3)``.
    """

    def __init__(self, faces: IntArray) -> None:
        self.faces = faces
        self._poses: dict[int, FloatArray] = {}
        self._known: dict[tuple[int, int], Coarsening] = {}

    def __call__(self, keyframe: int, n_faces: int) -> Coarsening:
        """The partition by one of them, to so many faces."""
        key = keyframe, n_faces
        if key not in self._known:
            self._known[key] = _collapse_once(self._poses[keyframe], self.faces, n_faces)
        return self._known[key]

    def of(self, places: Sequence[int], keyframes: FloatArray) -> Callable[[int, int], Coarsening]:
        """The same of some key-frames, at these places among all. A key-frame keeps the pose in which it first came.

        Args:
            places: One for each.
            keyframes: Vertex positions. *Shape:* ``(K, V, 3)``.
        """
        for place, points in zip(places, keyframes, strict=True):
            self._poses.setdefault(place, points)
        return partial(_renumbered, self, places)


def _renumbered(collapses: Collapses, chosen: Sequence[int], keyframe: int, n_faces: int) -> Coarsening:
    return collapses(chosen[keyframe], n_faces)


def _collapse_once(points: FloatArray, faces: IntArray, n_faces: int) -> Coarsening:
    """Partition by the edge collapses of one pose; pieces that nothing would be left of are collapsed alone."""
    root = _roots(points, faces, n_faces)
    coarse_faces = _left(root, faces)
    piece = connected_pieces(np.concatenate([faces[:, :2], faces[:, 1:]]), len(points))[faces[:, 0]]
    before = np.bincount(piece)
    if np.count_nonzero(before) > 1:
        owner = np.zeros(len(points), dtype=np.int64)
        owner[faces] = piece[:, None]
        after = np.bincount(owner[coarse_faces[:, 0]], minlength=len(before))
        poor = after < np.minimum(FACES_OF_PIECE, before)
        areas = np.bincount(piece, double_areas(points, faces), minlength=len(before))
        for i in np.argsort(-areas, kind="stable")[:MOST_PIECES]:
            if poor[i]:
                own = faces[piece == i]
                members = np.unique(own)
                compact = np.searchsorted(members, own)
                few = before[i] <= FACES_OF_PIECE
                root[members] = members if few else members[_roots(points[members], compact, FACES_OF_PIECE)]
        coarse_faces = _left(root, faces)
    # Roots that lost all their faces carry no energy: they are left out, as are vertices that never had one.
    used = np.unique(coarse_faces)
    index = np.full(len(points), -1)
    index[used] = np.arange(len(used))
    return Coarsening(index[root], index[coarse_faces])


def _roots(points: FloatArray, faces: IntArray, n_faces: int) -> IntArray:
    """The vertex that each becomes part of. *Shape:* ``(V,)``."""
    collapses = decimate(points, faces, n_faces).collapses
    root = np.arange(len(points))
    root[collapses[:, 1]] = collapses[:, 0]
    while not np.array_equal(root[root], root):
        root = root[root]
    return root


def _left(root: IntArray, faces: IntArray) -> IntArray:
    """The faces that are left, in terms of the vertices that stay. *Shape:* ``(F_coarse, 3)``."""
    left = root[faces]
    left = left[~degenerate_faces(left)]
    return left[~repeated_faces(left)]


def _fatness(keyframes: FloatArray, coarsening: Coarsening) -> tuple[float, float]:
    """How thin the coarse triangles get: area over longest edge squared, in the worst key-frame.

    Returns:
        Of the thinnest triangle, and the 1st percentile.
    """
    corners = coarsening.restrict(keyframes)[:, coarsening.faces]
    sides = corners - np.roll(corners, 1, axis=2)
    area = 0.5 * np.linalg.norm(np.cross(sides[..., 0, :], sides[..., 1, :]), axis=-1)
    longest = (sides**2).sum(-1).max(-1)
    fatness = area / np.maximum(longest, np.finfo(np.float64).tiny)
    return float(fatness.min()), float(np.percentile(fatness, 1, axis=-1).min())


def coarsen(
    keyframes: FloatArray,
    faces: IntArray,
    n_faces: int = 1000,
    collapses: Callable[[int, int], Coarsening] | None = None,
) -> Coarsening:
    """Partition the vertices of all key-frames by the edge collapses of one of them.

    Every key-frame is tried as the one that the collapses are chosen on; the partition is kept whose triangles stay
    fattest over all of them, as thin coarse triangles exaggerate bending and collapse on the way. Regular meshes of
    flat sides can end in triangles whose corners lie on a line: then somewhat more faces are tried.

    Args:
        keyframes: Vertex positions. *Shape:* ``(K, V, 3)``.
        faces: Vertex indices. *Shape:* ``(F, 3)``.
        n_faces: Faces of the coarse mesh; a mesh with no more than that is left as it is.
        collapses: Partitions by the edge collapses of each key-frame to a number of faces, where they are shared.

    Raises:
        ValueError: If ``n_faces`` is below 4.
    """
    if n_faces < 4:
        raise ValueError(f"a coarse mesh needs at least 4 faces, got n_faces={n_faces}")
    if len(faces) <= n_faces:
        used = np.unique(faces)
        index = np.full(keyframes.shape[1], -1)
        index[used] = np.arange(len(used))
        return Coarsening(index, index[faces])
    collapses = Collapses(faces).of(range(len(keyframes)), keyframes) if collapses is None else collapses
    found: list[tuple[float, Coarsening]] = []
    for n in (int(factor * n_faces) for factor in MORE_FACES):
        if n >= len(faces):
            break
        candidates = [collapses(i, n) for i in range(len(keyframes))]
        fatness = [_fatness(keyframes, candidate) for candidate in candidates]
        # Those without needles first, then by the bulk of the triangles.
        best = max(range(len(candidates)), key=lambda i: (min(fatness[i][0], NEEDLE), fatness[i][1]))
        found.append((fatness[best][0], candidates[best]))
        if fatness[best][0] >= NEEDLE:
            break
    return max(found, key=lambda item: min(item[0], NEEDLE))[1]
