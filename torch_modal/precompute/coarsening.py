"""Edge-collapse coarsening shared by all key-frames, with cluster averages (section 3.2 of the paper)."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial

import numpy as np
from scipy import sparse

from torch_modal.arrays import FloatArray, IntArray
from torch_modal.geometry.connectivity import Connectivity, connected_pieces, double_areas
from torch_modal.geometry.decimation import decimate
from torch_modal.geometry.inspect import degenerate_faces, repeated_faces

# Ratio of area to squared longest edge below which a triangle is a needle; an equilateral one has 0.43. With needles,
# other numbers of faces are tried.
NEEDLE = 3e-3
MORE_FACES = (1.0, 1.1, 1.25, 1.4, 1.6)

# Closed pieces with fewer faces vanish or bend without stretching.
FACES_OF_PIECE = 20
# Maximum number of pieces that are repaired, by area.
MOST_PIECES = 100


@dataclass(frozen=True)
class Coarsening:
    """A partition of the fine vertices into clusters, each a vertex of the coarse mesh.

    The restriction of positions and of modes is the same cluster average, so ``restrict(x + phi a)`` is exactly
    ``restrict(x) + restrict(phi) a``. The positions from quadric simplification are not linear in the pose and are not
    used.
    """

    clusters: IntArray
    """Coarse vertex of each fine vertex, -1 for unreferenced ones. *Shape:* ``(V,)``."""
    faces: IntArray
    """Faces of the coarse mesh. *Shape:* ``(F_coarse, 3)``."""

    @property
    def n_vertices(self) -> int:
        """Number of coarse vertices."""
        return int(self.clusters.max()) + 1

    def joined(self, x: FloatArray, shortest: float) -> "Coarsening":
        """With clusters merged whose averages coincide.

        Args:
            x: A shape. *Shape:* ``(V, 3)``.
            shortest: Length of an edge over the mean up to which its ends coincide.
        """
        points, edges = self.restrict(x), Connectivity(self.faces, self.n_vertices).edges
        lengths = np.linalg.norm(points[edges[:, 1]] - points[edges[:, 0]], axis=1)
        short = lengths <= shortest * lengths.mean()
        if not short.any():
            return self
        joint = connected_pieces(edges[short], len(points))
        faces = _coarse_faces(joint, self.faces)
        index = _compact(faces, len(points))
        return Coarsening(np.where(self.clusters >= 0, index[joint[self.clusters]], -1), index[faces])

    def restriction(self) -> sparse.csr_matrix:
        """Matrix of the cluster average. *Shape:* ``(V_coarse, V)``."""
        members = np.flatnonzero(self.clusters >= 0)
        clusters = self.clusters[members]
        sizes = np.bincount(clusters, minlength=self.n_vertices)
        shape = (self.n_vertices, len(self.clusters))
        return sparse.csr_matrix((1.0 / sizes[clusters], (clusters, members)), shape=shape)

    def restrict(self, x: FloatArray) -> FloatArray:
        """Cluster averages. *Shape:* ``(..., V, 3) -> (..., V_coarse, 3)``."""
        matrix = self.restriction()
        coarse = np.stack([matrix @ shape for shape in x.reshape(-1, *x.shape[-2:])])
        return coarse.reshape(*x.shape[:-2], self.n_vertices, 3)


class Collapses:
    """Cached partitions by the edge collapses of single key-frames, shared by pairs of key-frames.

    Args:
        faces: Vertex indices. *Shape:* ``(F, 3)``.
    """

    def __init__(self, faces: IntArray) -> None:
        # Copies: `share_memory()`, as for spawned workers, frees what is under the view of a tensor.
        self.faces = faces.copy()
        self._poses: dict[int, FloatArray] = {}
        self._known: dict[tuple[int, int], Coarsening] = {}

    def of(self, places: Sequence[int], keyframes: FloatArray) -> Callable[[int, int], Coarsening]:
        """A function of local indices of key-frames. The first pose passed for a key-frame is kept.

        Args:
            places: Global index of each key-frame.
            keyframes: Vertex positions. *Shape:* ``(K, V, 3)``.
        """
        for place, points in zip(places, keyframes, strict=True):
            self._poses.setdefault(place, points.copy())
        return partial(self._at, tuple(places))

    def _at(self, places: tuple[int, ...], keyframe: int, n_faces: int) -> Coarsening:
        """The partition by the collapses of one key-frame to a number of faces."""
        key = places[keyframe], n_faces
        if key not in self._known:
            self._known[key] = collapsed(self._poses[key[0]], self.faces, n_faces)
        return self._known[key]


def collapsed(points: FloatArray, faces: IntArray, n_faces: int) -> Coarsening:
    """Partition by the edge collapses of one pose; pieces that would vanish are collapsed separately."""
    root = _roots(points, faces, n_faces)
    coarse_faces = _coarse_faces(root, faces)
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
        coarse_faces = _coarse_faces(root, faces)
    # Clusters without faces carry no energy and are removed.
    index = _compact(coarse_faces, len(points))
    return Coarsening(index[root], index[coarse_faces])


def _compact(faces: IntArray, n: int) -> IntArray:
    """Number of each vertex among those that faces use, -1 for the others. *Shape:* ``(n,)``."""
    used = np.unique(faces)
    index = np.full(n, -1)
    index[used] = np.arange(len(used))
    return index


def _roots(points: FloatArray, faces: IntArray, n_faces: int) -> IntArray:
    """Representative vertex of each cluster. *Shape:* ``(V,)``."""
    collapses = decimate(points, faces, n_faces)[2]
    root = np.arange(len(points))
    root[collapses[:, 1]] = collapses[:, 0]
    while not np.array_equal(root[root], root):
        root = root[root]
    return root


def _coarse_faces(root: IntArray, faces: IntArray) -> IntArray:
    """Faces of the coarse mesh in terms of the representative vertices. *Shape:* ``(F_coarse, 3)``."""
    left = root[faces]
    left = left[~degenerate_faces(left)]
    return left[~repeated_faces(left)]


def _fatness(keyframes: FloatArray, coarsening: Coarsening) -> tuple[float, float]:
    """Ratio of area to squared longest edge in the worst key-frame.

    Returns:
        Minimum and 1st percentile over the coarse triangles.
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

    The collapses of each key-frame are candidates; the partition with the best triangle quality over all key-frames is
    used, as thin coarse triangles exaggerate bending and collapse in between. Regular meshes with flat sides can lead
    to degenerate triangles: then somewhat more faces are tried.

    Args:
        keyframes: Vertex positions. *Shape:* ``(K, V, 3)``.
        faces: Vertex indices. *Shape:* ``(F, 3)``.
        n_faces: Faces of the coarse mesh; smaller meshes are not coarsened.
        collapses: Shared partitions, from key-frame and number of faces (:meth:`Collapses.of`).

    Raises:
        ValueError: If ``n_faces`` is below 4.
    """
    if n_faces < 4:
        raise ValueError(f"a coarse mesh needs at least 4 faces, got n_faces={n_faces}")
    if len(faces) <= n_faces:
        index = _compact(faces, keyframes.shape[1])
        return Coarsening(index, index[faces])
    collapses = Collapses(faces).of(range(len(keyframes)), keyframes) if collapses is None else collapses
    found: list[tuple[float, Coarsening]] = []
    for n in (int(factor * n_faces) for factor in MORE_FACES):
        if n >= len(faces):
            break
        candidates = [collapses(i, n) for i in range(len(keyframes))]
        fatness = [_fatness(keyframes, candidate) for candidate in candidates]
        # Candidates without needles first, then by the 1st percentile.
        best = max(range(len(candidates)), key=lambda i: (min(fatness[i][0], NEEDLE), fatness[i][1]))
        found.append((fatness[best][0], candidates[best]))
        if fatness[best][0] >= NEEDLE:
            break
    return max(found, key=lambda item: min(item[0], NEEDLE))[1]
