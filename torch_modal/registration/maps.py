"""Maps between coarse copies of two shapes, from their spectra or from landmarks.

A map gives each vertex of the first shape a vertex of the second, ``(n_first,)``. It follows from rows of
eigenfunctions: those of near-isometric shapes agree up to the functional map (Ovsjanikov et al. 2012). Lengths are in
square roots of the area.
"""

import itertools
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from scipy import sparse
from scipy.sparse import csgraph
from scipy.sparse.linalg import eigsh
from scipy.spatial import cKDTree

from torch_modal import extras
from torch_modal.arrays import BoolArray, FloatArray, IntArray
from torch_modal.geometry import inspect
from torch_modal.geometry.closest import dot
from torch_modal.geometry.decimation import decimate
from torch_modal.progress import ProgressReport
from torch_modal.registration.surface import DUST, MeshSurface, largest_pieces, main_part, referenced

N_COARSE = 2000  # approximate number of vertices of the coarse copies
N_FUNCTIONS = 60  # number of eigenfunctions, including the constant one
COARSE_FUNCTIONS = 20
FINE_FUNCTIONS = 50
N_SIGNS, MORE_SIGNS = 4, 6
"""Number of eigenfunctions with both signs in the initial maps, and in those of a second attempt."""
N_REFINED, N_DIFFERENT = 4, 2  # number of fully refined maps: the best ones, and others that differ from them
SAME = 0.1  # largest difference of equal maps, for a surface of unit area
N_SAMPLES = 40  # number of samples between which distances are compared
_STEP = 3
_NEAR = 0.12  # largest geodesic distance of closest points from the image of a map, for a surface of unit area

# Weight of the round-trip error relative to the oriented area.
_ROUND_TRIP = 3.0
# Relative and absolute stretch above which a triangle counts as torn.
_TORN = (2.5, 0.03)
# Smallest fraction of the area that is the denominator of the score, if many triangles collapse.
_LEAST_COUNTED = 0.3
# Largest error of a consistent distance, and minimum number of consistent samples for a repair.
_CONSISTENT, _FEWEST = 0.12, 8
# Tips: their smallest distance, the radius in which no vertex is more distant, and the numbers that are matched.
_TIPS_APART, _TIP_RADIUS, _FEWEST_TIPS, _MOST_TIPS = 0.35, 0.25, 4, 6
_N_MATCHINGS = 4  # number of matchings of tips that give maps
# Weight of differences of limb lengths relative to those of the tree between the limbs.
_LIMB_LENGTH = 0.2
_SHORTEST_LIMB = 0.1
# Weight of orientation relative to distance in coordinates of landmarks, and its number of eigenfunctions.
_ORIENTATION, _ORIENTATION_FUNCTIONS = 0.1, 30
# Number of eigenfunctions of the curvature that is compared.
_CURVATURE_FUNCTIONS = 40


class SpectralShape:
    """The main part of a surface, decimated and scaled to unit area, with eigenfunctions of its Laplacian."""

    def __init__(self, surface: MeshSurface) -> None:
        clean = largest_pieces(surface, DUST)
        if len(clean.vertices) > 1.2 * N_COARSE:
            n_faces = int(N_COARSE / len(clean.vertices) * len(clean.faces))
            vertices, faces, _ = decimate(clean.vertices, clean.faces, n_faces)
            faces = faces[~inspect.degenerate_faces(faces)]
            clean, _ = referenced(vertices, faces[~inspect.repeated_faces(faces)])
        #: Coarse copy in the units of the fine surface.
        self.placed = main_part(clean)
        self.scale = np.sqrt(self.placed.area)
        #: Coarse copy of unit area.
        self.coarse = self.placed.moved(self.placed.vertices / self.scale)
        mesh, n = (self.coarse.vertices, self.coarse.faces), len(self)
        laplacian, mass = extras.require("robust_laplacian", "register", "registration").mesh_laplacian(*mesh)
        # A small shift: the constant function makes the matrix singular.
        start = np.ones(n) + np.arange(n) / n
        #: *Shape:* ``(k,)``, and ``(n, k)``, orthonormal in the mass.
        self.eigenvalues, self.functions = eigsh(
            laplacian.tocsc(), min(N_FUNCTIONS, n - 2), mass.tocsc(), sigma=-0.01, v0=start
        )
        #: Lumped mass of the Laplacian. *Shape:* ``(n,)``.
        self.mass = mass.diagonal()
        self._heat = extras.require("potpourri3d", "register", "registration").MeshHeatMethodDistanceSolver(*mesh)

    def __len__(self) -> int:
        """Number of coarse vertices."""
        return len(self.coarse.vertices)

    def geodesics_from(self, sources: IntArray) -> FloatArray:
        """Distances along the surface by the heat method. *Shape:* ``(m,) -> (n, m)``."""
        return np.stack([self._heat.compute_distance(int(source)) for source in sources], axis=1)

    @cached_property
    def samples(self) -> tuple[IntArray, FloatArray]:
        """Farthest-point samples, and the distances to them. *Shape:* ``(m,), (n, m)``."""
        return self.farthest_points(N_SAMPLES)

    @cached_property
    def tips(self) -> IntArray:
        """Ends of limbs, the most distant first: local maxima of the mean distance. *Shape:* ``(m,)``."""
        far, (i, j) = self.samples[1].mean(1), self.coarse.edges.T
        lower = np.zeros(len(self), dtype=bool)
        lower[np.where(far[i] < far[j], i, j)] = True
        chosen: list[int] = []
        for peak in sorted(np.flatnonzero(~lower), key=lambda vertex: -far[vertex]):
            distances = self.geodesics_from(np.array([peak]))[:, 0]
            highest = far[peak] >= far[distances < _TIP_RADIUS].max()
            if highest and (distances[chosen] > _TIPS_APART).all():
                chosen.append(int(peak))
        return np.array(chosen, dtype=np.int64)

    def limb_coordinates(self, tips: IntArray) -> FloatArray:
        """Coordinates along limbs, relative to the length of each, and around them.

        Distances to the tips do not tell a side of the body from its mirror image. The angle between the directions to
        two tips has a sign, which does (Ren et al. 2018). *Shape:* ``(m,) -> (n, m + m (m - 1) / 2)``.
        """
        distances = self.geodesics_from(tips)
        lengths = np.maximum(_limb_lengths(distances[tips]), _SHORTEST_LIMB)
        beyond = np.maximum(distances - lengths, 0)
        along = np.minimum(distances / lengths, 1) + beyond / lengths.mean()
        return np.hstack([along, _ORIENTATION * self._orientations(distances)])

    def _orientations(self, values: FloatArray) -> FloatArray:
        """Smoothed sines of the angles between gradients, for each pair of functions. *Shape:* ``(n, m)``."""
        mesh = self.coarse
        corners = mesh.vertices[mesh.faces]
        opposite = np.roll(corners, 1, axis=1) - np.roll(corners, -1, axis=1)
        gradients = np.einsum("fci,fcm->fmi", np.cross(mesh.face_normals[:, None], opposite), values[mesh.faces])
        gradients /= np.maximum(np.linalg.norm(gradients, axis=2, keepdims=True), 1e-12)
        first, second = np.triu_indices(values.shape[1], 1)
        sines = dot(np.cross(gradients[:, first], gradients[:, second]), mesh.face_normals[:, None])
        share = mesh.face_areas[:, None] * sines / 3
        functions = self.functions[:, :_ORIENTATION_FUNCTIONS]
        # Integrals of products with functions that are linear in each face, by their values at its corners.
        smoothed: FloatArray = functions @ (functions[mesh.faces].sum(1).T @ share)
        return smoothed

    def curvature(self, n_functions: int = N_FUNCTIONS) -> FloatArray:
        """Twice the mean curvature, of low frequencies, positive where the surface is convex. *Shape:* ``(n,)``."""
        functions, mesh = self.functions[:, :n_functions], self.coarse
        spectrum = self.eigenvalues[:n_functions, None] * (functions.T @ (self.mass[:, None] * mesh.vertices))
        return dot(functions @ spectrum, mesh.vertex_normals)

    def is_near(self, vertices: IntArray, points: FloatArray) -> BoolArray:
        """Points in space whose nearest coarse vertices are near given ones, as a mask. *Shape:* ``(n,), (n, 3)``."""
        return self._near[vertices, self._tree.query(points)[1]]  # type: ignore[no-any-return]

    @cached_property
    def _near(self) -> BoolArray:
        """Pairs of vertices that are near along edges, as a mask. *Shape:* ``(n, n)``."""
        i, j = self.coarse.edges.T
        lengths = np.linalg.norm(self.coarse.vertices[i] - self.coarse.vertices[j], axis=1)
        graph = sparse.csr_matrix((np.maximum(lengths, 1e-12), (i, j)), shape=(len(self),) * 2)
        near: BoolArray = csgraph.dijkstra(graph, directed=False, limit=_NEAR) <= _NEAR
        return near

    @cached_property
    def _tree(self) -> cKDTree:
        return cKDTree(self.placed.vertices)

    def farthest_points(self, n: int) -> tuple[IntArray, FloatArray]:
        """Farthest-point samples, ``n`` or all vertices, and the distances to them. *Shape:* ``(m,), (n, m)``."""
        chosen = [int(self.geodesics_from(np.zeros(1, dtype=np.int64)).argmax())]
        distances = self.geodesics_from(np.array(chosen))
        while len(chosen) < min(n, len(self)):
            chosen.append(int(distances.min(1).argmax()))
            distances = np.hstack([distances, self.geodesics_from(np.array(chosen[-1:]))])
        return np.array(chosen), distances


@dataclass(frozen=True, eq=False)
class Map:
    """A map, and its scores for the second shape and for its mirror image. *Shape:* ``(n_first,)``.

    A score is the oriented area of the worse direction minus three times the mean round-trip error: 0.7 or more for
    correct maps of one subject, negative for mirrored ones.
    """

    pair: "CoarsePair"
    vertices: IntArray
    score: float
    mirrored_score: float

    @cached_property
    def distortion(self) -> float:
        """Mean over the vertices of the largest distance error to a sample."""
        return float(self.pair.errors(self.vertices).max(1).mean())

    def differs(self, others: Sequence["Map"]) -> bool:
        """True if each of other maps has a different image of some part."""
        places = self.pair.second.coarse.vertices
        return all(difference(places[self.vertices], places[one.vertices]) > SAME for one in others)


class CoarsePair:
    """Maps from one coarse shape, of n_first vertices, to another."""

    def __init__(self, first: SpectralShape, second: SpectralShape) -> None:
        self.first, self.second = first, second
        self.samples, self.distances = first.samples

    # ------------------------------------------------------------------------------------------------ scores and errors
    def rated(self, vertices: IntArray, k: int = FINE_FUNCTIONS) -> Map:
        """Scores of a map with ``k`` eigenfunctions. *Shape:* ``(n_first,)``."""
        first, second = self.first, self.second
        k = min(k, first.functions.shape[1], second.functions.shape[1])
        back = nearest_rows(second.functions[:, :k] @ self._functional(vertices, k).T, first.functions[:, :k])
        areas = _oriented_area(first, second, vertices), _oriented_area(second, first, back)
        round_trip = np.linalg.norm(first.coarse.vertices[back[vertices]] - first.coarse.vertices, axis=1).mean()
        score, mirrored_score = (float(area - _ROUND_TRIP * round_trip) for area in (min(areas), -max(areas)))
        return Map(self, vertices, score, mirrored_score)

    def errors(self, vertices: IntArray) -> FloatArray:
        """Errors of the distances from vertices to samples. *Shape:* ``(n_first,) -> (n_first, m)``."""
        images = self.second.geodesics_from(vertices[self.samples])[vertices]
        found: FloatArray = np.abs(self.distances - images)
        return found

    def likeness(self, vertices: IntArray) -> float:
        """Correlation of the curvatures of corresponding vertices; front and back differ. *Shape:* ``(n_first,)``."""
        here, there = self.first.curvature(_CURVATURE_FUNCTIONS), self.second.curvature(_CURVATURE_FUNCTIONS)[vertices]
        here, there = here - here.mean(), there - there.mean()
        return float(dot(here, there) / max(np.linalg.norm(here) * np.linalg.norm(there), 1e-12))

    # ------------------------------------------------------------------------------------------------------------- maps
    def _functional(self, vertices: IntArray, k: int) -> FloatArray:
        """Pull-back of functions from the second shape to the first. *Shape:* ``(k, k)``."""
        weighted = self.first.mass[:, None] * self.second.functions[vertices, :k]
        found: FloatArray = self.first.functions[:, :k].T @ weighted
        return found

    def refined(self, vertices: IntArray, start: int, stop: int = FINE_FUNCTIONS) -> Map:
        """Refine a map with from ``start`` to ``stop`` eigenfunctions (ZoomOut, Melzi et al. 2019)."""
        most = min(stop, self.first.functions.shape[1], self.second.functions.shape[1])
        for k in [*range(min(start, most), most, _STEP), most]:
            rows = self.second.functions[:, :k] @ self._functional(vertices, k).T
            vertices = nearest_rows(self.first.functions[:, :k], rows)
        return self.rated(vertices, stop)

    def from_landmarks(self, pairs: IntArray) -> Map:
        """Refined map from geodesic distances to landmarks. *Shape:* ``(n, 2)``, coarse vertices of both."""
        signatures = []
        for shape, sources in zip((self.first, self.second), pairs.T, strict=True):
            distances = shape.geodesics_from(sources)
            signatures.append(distances / distances.max(0))  # proportions differ
        return self.refined(nearest_rows(*signatures), 8)

    def from_tips(self) -> list[Map]:
        """Maps from the best matchings of tips; none if there are few tips.

        Matchings compare the tree of distances between the tips: if limbs grow, a distance changes by the growth of
        its two limbs, and what is left is the difference of the trunks.
        """
        tips, others = self.first.tips, self.second.tips
        n = min(len(tips), len(others), _MOST_TIPS)
        if n < _FEWEST_TIPS:
            return []
        orders = np.array(list(itertools.permutations(range(min(len(others), _MOST_TIPS + 2)), n)))
        here, there = self.first.geodesics_from(tips[:n])[tips[:n]], self.second.geodesics_from(others)[others]
        changes = here - there[orders[:, :, None], orders[:, None]]
        growth = _limb_lengths(changes)
        i, j = np.triu_indices(n, 1)
        trunks = (changes - growth[:, :, None] - growth[:, None])[:, i, j]
        costs = np.sqrt((trunks**2).mean(1)) + _LIMB_LENGTH * growth.std(1)
        best = orders[np.argsort(costs, kind="stable")[:_N_MATCHINGS]]
        return [self.from_limbs(np.stack([tips[:n], others[order]], axis=1)) for order in best]

    def from_limbs(self, pairs: IntArray) -> Map:
        """Map from coordinates along limbs, for any proportions. *Shape:* ``(n, 2)``, coarse vertices of both."""
        here, there = (
            shape.limb_coordinates(ends) for shape, ends in zip((self.first, self.second), pairs.T, strict=True)
        )
        return self.rated(nearest_rows(here, there))

    def from_spectra(self, n_signs: int, progress: ProgressReport) -> list[Map]:
        """The best maps from spectra, best first; the last is the best map to the mirrored target.

        The initial maps are all ``2**n_signs`` sign patterns of the lowest eigenfunctions, and rigid alignments of
        principal axes. All are refined with few eigenfunctions, the best with all.
        """
        starts, coarse = list(self._starts(n_signs)), []
        progress.expect(len(starts))
        for vertices, k in starts:
            coarse.append(self.refined(vertices, k, COARSE_FUNCTIONS))
            progress.update()
        coarse.sort(key=lambda found: -found.score)
        best = coarse[:N_REFINED]
        for found in coarse[N_REFINED:]:  # the best ones are often the same map
            if len(best) < N_REFINED + N_DIFFERENT and found.differs(best):
                best.append(found)
        best.append(max(coarse, key=lambda found: found.mirrored_score))
        *fine, mirrored = [self.refined(found.vertices, COARSE_FUNCTIONS) for found in best]
        return [*sorted(fine, key=lambda found: -found.score), mirrored]

    def _starts(self, n_signs: int) -> Iterator[tuple[IntArray, int]]:
        """Initial maps, and the number of eigenfunctions for their refinement."""
        first, second, k = self.first, self.second, n_signs + 1
        for signs in itertools.product([1.0, -1.0], repeat=n_signs):
            yield nearest_rows(first.functions[:, :k], second.functions[:, :k] * [1.0, *signs]), k
        axes, centred_shapes = [], []
        for surface in (first.coarse, second.coarse):
            points = surface.vertices - np.average(surface.vertices, 0, surface.vertex_areas)
            frame = np.linalg.eigh(points.T @ (surface.vertex_areas[:, None] * points))[1]
            axes.append(frame * [1, 1, np.sign(np.linalg.det(frame))])
            centred_shapes.append(points)
        centred, target = centred_shapes
        flips = ([1, 1, 1], [1, -1, -1], [-1, 1, -1], [-1, -1, 1])
        goal = np.hstack([target, 0.1 * second.coarse.vertex_normals])
        for turn in (np.eye(3), *(axes[0] * signs @ axes[1].T for signs in flips)):
            yield nearest_rows(np.hstack([centred @ turn, 0.1 * first.coarse.vertex_normals @ turn]), goal), 12

    def repaired(self, found: Map) -> Map | None:
        """A map from the mutually consistent samples of one that may be wrong in parts; None if they are few."""
        images = found.vertices[self.samples]
        to_images = self.second.geodesics_from(images)
        error = np.abs(self.distances[self.samples] - to_images[images])
        error = np.maximum(error, error.T)
        kept = np.arange(len(self.samples))
        while len(kept) >= _FEWEST:
            against = (error[np.ix_(kept, kept)] > _CONSISTENT).sum(1)
            if not against.any():
                break
            kept = np.delete(kept, against.argmax())
        if len(kept) < _FEWEST or len(kept) == len(self.samples):
            return None
        return self.refined(nearest_rows(self.distances[:, kept], to_images[:, kept]), 26)


def nearest_rows(queries: FloatArray, rows: FloatArray) -> IntArray:
    """Index of the nearest row. Dense: trees are no faster in fifty dimensions. *Shape:* ``(n, k), (m, k) -> (n,)``."""
    queries, rows = queries.astype(np.float32), rows.astype(np.float32)
    half = 0.5 * (rows * rows).sum(1)
    return np.concatenate(
        [(part @ rows.T - half).argmax(1) for part in np.array_split(queries, len(queries) // 2048 + 1)]
    )


def _limb_lengths(distances: FloatArray) -> FloatArray:
    """Lengths whose sums in pairs fit distances between tips by least squares. *Shape:* ``(..., n, n) -> (..., n)``."""
    n, sums = distances.shape[-1], distances.sum(-1)
    lengths: FloatArray = (sums - sums.sum(-1, keepdims=True) / (2 * n - 2)) / (n - 2)
    return lengths


def difference(points: FloatArray, others: FloatArray) -> float:
    """98th percentile of the distances of corresponding points. *Shape:* ``(n, 3), (n, 3)``."""
    return float(np.percentile(np.linalg.norm(points - others, axis=1), 98))


def _oriented_area(first: SpectralShape, second: SpectralShape, vertices: IntArray) -> float:
    """Fraction of the first shape's area with an untorn, outward image minus that with an inward image."""
    faces = first.coarse.faces
    image, own = second.coarse.vertices[vertices][faces], first.coarse.vertices[faces]
    area_vectors = np.cross(image[:, 1] - image[:, 0], image[:, 2] - image[:, 0])
    sign = np.sign(dot(area_vectors, second.coarse.vertex_normals[vertices][faces].mean(1)))
    before, after = (np.linalg.norm(x - np.roll(x, 1, axis=1), axis=2).max(1) for x in (own, image))
    whole = after < _TORN[0] * before + _TORN[1]
    # Faces that collapse, because the other mesh is coarser, do not count.
    counted = first.coarse.face_areas[sign != 0].sum()
    total = max(counted, _LEAST_COUNTED * first.coarse.area)
    return float((first.coarse.face_areas * whole * sign).sum() / total)
