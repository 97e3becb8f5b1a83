"""Edge-collapse coarsening shared by all key-frames, with cluster averages (section 3.2 of the paper)."""

from bisect import bisect_left
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from scipy import sparse

from torch_modal.arrays import FloatArray, IntArray
from torch_modal.geometry.connectivity import Connectivity, double_areas, label_pieces, neighbour_means
from torch_modal.geometry.decimation import decimate
from torch_modal.geometry.inspect import degenerate_faces, fatness, find_repeated_faces

# Altitude over longest side below which a triangle is a needle. With needles, other numbers of faces are tried.
NEEDLE = 6e-3
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
    """Coarse vertex of each fine vertex, -1 for those without a face. *Shape:* ``(V,)``."""
    faces: IntArray
    """Faces of the coarse mesh. *Shape:* ``(F_coarse, 3)``."""
    n_vertices: int
    """Number of coarse vertices."""

    @classmethod
    def of_labels(cls, labels: IntArray, faces: IntArray) -> "Coarsening":
        """Clusters of equal labels, -1 for none, without those that have no face. *Shape:* ``(V,), (F, 3)``."""
        coarse = _coarse_faces(labels, faces)
        used = np.unique(coarse)
        index = np.full(labels.max() + 2, -1)  # the last for the label -1
        index[used] = np.arange(len(used))
        return cls(index[labels], index[coarse], len(used))

    def restrict(self, x: FloatArray) -> FloatArray:
        """Cluster averages. *Shape:* ``(..., V, 3) -> (..., V_coarse, 3)``."""
        members = np.flatnonzero(self.clusters >= 0)
        clusters, n = self.clusters[members], self.n_vertices
        shares = 1.0 / np.bincount(clusters, minlength=n)
        matrix = sparse.csr_matrix((shares[clusters], (clusters, members)), shape=(n, len(self.clusters)))
        return np.stack([matrix @ shape for shape in x.reshape(-1, *x.shape[-2:])]).reshape(*x.shape[:-2], n, 3)

    def weights(self, mesh: Connectivity, rounds: int) -> sparse.csr_matrix:
        """Membership averaged over neighbours several times: a smooth partition of unity. *Shape:* ``(V, V_coarse)``.

        Rows of vertices that no cluster reaches are zero.
        """
        members = np.flatnonzero(self.clusters >= 0)
        entries = members, self.clusters[members]
        weights = sparse.csr_matrix((np.ones(len(members)), entries), shape=(len(self.clusters), self.n_vertices))
        averages = neighbour_means(mesh)
        for _ in range(rounds):
            weights = averages @ weights
        total = np.asarray(weights.sum(axis=1)).reshape(-1)
        return sparse.diags(1 / np.where(total > 0, total, 1)) @ weights


def coarsen(
    keyframes: FloatArray,
    faces: IntArray,
    n_faces: int = 1000,
    candidates: Sequence[int] | None = None,
    known: dict[int, IntArray] | None = None,
) -> Coarsening:
    """Partition the vertices of all key-frames by the edge collapses of one of them.

    The collapses of each candidate are tried; the partition with the best triangle quality over all key-frames is used,
    as thin coarse triangles exaggerate bending and collapse in between. Regular meshes with flat sides can lead to
    degenerate triangles: then somewhat more faces are tried.

    Args:
        keyframes: Vertex positions. *Shape:* ``(K, V, 3)``.
        faces: Vertex indices. *Shape:* ``(F, 3)``.
        n_faces: Faces of the coarse mesh; smaller meshes are not coarsened.
        candidates: Indices of the key-frames whose collapses are tried; by default all.
        known: Collapses of key-frames down to fewer faces, from earlier calls; this call adds its own.

    Raises:
        ValueError: If ``n_faces`` is below 4.
    """
    if n_faces < 4:
        raise ValueError(f"a coarse mesh needs at least 4 faces, got n_faces={n_faces}")
    sources, known = range(len(keyframes)) if candidates is None else candidates, {} if known is None else known
    attempts: list[tuple[float, Coarsening]] = []
    for n in (int(factor * n_faces) for factor in MORE_FACES):
        if attempts and (n >= len(faces) or attempts[-1][0] >= NEEDLE):
            break
        for i in set(sources) - set(known) if n < len(faces) else ():
            known[i] = decimate(keyframes[i], faces, n)[2]
        each = [collapse(keyframes[i], faces, n, known.get(i)) for i in sources]
        shares = [np.stack([fatness(x, one.faces) for x in one.restrict(keyframes)]) for one in each]
        # In the worst key-frame: those without needles first, then by the 1st percentile.
        ranks = [(min(float(x.min()), NEEDLE), float(np.percentile(x, 1, axis=-1).min())) for x in shares]
        best = max(range(len(each)), key=ranks.__getitem__)
        attempts.append((ranks[best][0], each[best]))
    return max(attempts, key=lambda one: one[0])[1]


def collapse(points: FloatArray, faces: IntArray, n_faces: int, known: IntArray | None = None) -> Coarsening:
    """Partition by the edge collapses of one pose, the first of known ones; pieces that would vanish have their own."""
    if len(faces) <= n_faces:
        return Coarsening.of_labels(np.arange(len(points)), faces)
    collapses = decimate(points, faces, n_faces)[2] if known is None else known
    start = max(len(collapses) - 4 * n_faces, 0)  # each takes two faces, or one at a boundary
    left = _coarse_faces(_roots(collapses[:start], len(points)), faces, repeated=True)

    def is_enough(n: int) -> bool:
        return len(_coarse_faces(_roots(collapses[start:n], len(points)), left, repeated=True)) <= n_faces

    n = start + bisect_left(range(start, len(collapses)), True, key=is_enough)
    root = _roots(collapses[:n], len(points))
    piece = label_pieces(np.concatenate([faces[:, :2], faces[:, 1:]]), len(points))
    before = np.bincount(piece[faces[:, 0]])
    if np.count_nonzero(before) > 1:
        after = np.bincount(piece[_coarse_faces(root, faces)[:, 0]], minlength=len(before))
        poor = after < np.minimum(FACES_OF_PIECE, before)
        areas = np.bincount(piece[faces[:, 0]], double_areas(points, faces))
        for i in np.argsort(-areas, kind="stable")[:MOST_PIECES]:
            if poor[i]:
                members, corners = np.unique(faces[piece[faces[:, 0]] == i], return_inverse=True)
                root[members] = members
                if before[i] > FACES_OF_PIECE:
                    collapses = decimate(points[members], corners.reshape(-1, 3), FACES_OF_PIECE)[2]
                    root[members] = members[_roots(collapses, len(members))]
    return Coarsening.of_labels(root, faces)


def join_clusters(points: FloatArray, faces: IntArray, coarsening: Coarsening, shortest: float) -> Coarsening:
    """Merge clusters of a shape whose averages coincide: at edges up to ``shortest`` mean lengths."""
    centres, edges = coarsening.restrict(points), Connectivity(coarsening.faces).edges
    lengths = np.linalg.norm(centres[edges[:, 1]] - centres[edges[:, 0]], axis=1)
    short = lengths <= shortest * lengths.mean()
    joint = label_pieces(edges[short], len(centres))
    labels = np.where(coarsening.clusters >= 0, joint[coarsening.clusters], -1)
    return Coarsening.of_labels(labels, faces) if short.any() else coarsening


def _roots(collapses: IntArray, n: int) -> IntArray:
    """Representative vertex of the cluster of each of n vertices. *Shape:* ``(m, 2) -> (n,)``."""
    root = np.arange(n)
    root[collapses[:, 1]] = collapses[:, 0]
    while not np.array_equal(root[root], root):
        root = root[root]
    return root


def _coarse_faces(labels: IntArray, faces: IntArray, repeated: bool = False) -> IntArray:
    """Faces in terms of labels, without degenerate ones, or repeated ones unless wanted. *Shape:* ``(n, 3)``."""
    left = labels[faces]
    left = left[~degenerate_faces(left)]
    return left if repeated else left[~find_repeated_faces(left)]
