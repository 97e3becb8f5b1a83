"""Maps between coarse copies of two shapes, from their spectra or from landmarks.

A map gives each vertex of the first shape a vertex of the second, ``(n_first,)``. It follows from rows of
eigenfunctions, which agree between near-isometric shapes up to the functional map (Ovsjanikov et al. 2012). Lengths are
in square roots of the area.
"""

import itertools
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from scipy.sparse import csgraph
from scipy.sparse.linalg import eigsh
from scipy.spatial import cKDTree

from torch_modal import extras
from torch_modal.arrays import BoolArray, FloatArray, IntArray
from torch_modal.geometry import inspect
from torch_modal.geometry.closest import dot
from torch_modal.geometry.connectivity import edge_graph
from torch_modal.geometry.decimation import decimate
from torch_modal.registration.surface import DUST, MeshSurface, drop_unreferenced, largest_pieces, main_part

N_COARSE = 2000  # approximate number of vertices of the coarse copies
N_FUNCTIONS = 60  # number of eigenfunctions, including the constant one
COARSE_FUNCTIONS = 20
FINE_FUNCTIONS = 50
N_SIGNS, MORE_SIGNS = 4, 6
"""Number of eigenfunctions with both signs in the initial maps, and in the initial maps of a second attempt."""
N_REFINED, N_DIFFERENT = 4, 2  # number of fully refined maps: the best ones, and others that differ from them
SAME = 0.1  # largest difference of equal maps, for a surface of unit area
DISTANCE_SAMPLES = 40  # number of samples between which distances are compared
_STEP = 3
_NEAR = 0.12  # largest geodesic distance of closest points from the image of a map, for a surface of unit area

# Weight of the round-trip error relative to the oriented area.
_ROUND_TRIP = 3.0
# Relative and absolute stretch above which a triangle counts as torn.
_TORN = (2.5, 0.03)
_OPEN = 0.1  # length of a boundary that only the second shape has, above which parts of the first may be missing
# Smallest fraction of the area that is the denominator of the score, if many triangles collapse.
_LEAST_COUNTED = 0.3
# Largest error of a consistent distance, and minimum number of consistent samples for a repair.
_CONSISTENT, _FEWEST = 0.12, 8
# Tips: their smallest distance, the radius in which no vertex is more distant, and the numbers that are matched.
_TIPS_APART, _TIP_RADIUS, _FEWEST_TIPS, _MOST_TIPS = 0.35, 0.25, 4, 6
_N_MATCHINGS = 4, 8  # number of matchings of tips that give maps, of a whole and of a partial target
# Weight of differences of limb lengths relative to differences of the tree between the limbs.
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
            clean, _ = drop_unreferenced(vertices, faces[~inspect.find_repeated_faces(faces)])
        #: Coarse copy in the units of the fine surface.
        self.placed = main_part(clean)
        self.scale = np.sqrt(self.placed.area)
        #: Coarse copy of unit area.
        self.coarse = self.placed.with_vertices(self.placed.vertices / self.scale)
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
        self._graph = edge_graph(self.coarse.vertices, self.coarse.edges)
        self._heat = extras.require("potpourri3d", "register", "registration").MeshHeatMethodDistanceSolver(*mesh)

    def __len__(self) -> int:
        """Number of coarse vertices."""
        return len(self.coarse.vertices)

    @property
    def boundary_length(self) -> float:
        """Length of the boundary, in square roots of the area."""
        start, end = self.coarse.vertices[self.coarse.connectivity.boundary_edges].transpose(1, 0, 2)
        return float(np.linalg.norm(end - start, axis=1).sum())

    def geodesics_from(self, sources: IntArray) -> FloatArray:
        """Distances along the surface by the heat method. *Shape:* ``(m,) -> (n, m)``."""
        return np.stack([self._heat.compute_distance(int(source)) for source in sources], axis=1)

    @cached_property
    def samples(self) -> tuple[IntArray, FloatArray]:
        """Samples far from each other, and the distances to them. *Shape:* ``(m,), (n, m)``."""
        chosen = [int(self.geodesics_from(np.zeros(1, dtype=np.int64)).argmax())]
        distances = self.geodesics_from(np.array(chosen))
        while len(chosen) < min(DISTANCE_SAMPLES, len(self)):
            chosen.append(int(distances.min(1).argmax()))
            distances = np.hstack([distances, self.geodesics_from(np.array(chosen[-1:]))])
        return np.array(chosen), distances

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
        two tips has a sign, which does (Ren et al. 2018): the smoothed sines of the angles between the gradients of the
        distances are coordinates, too. *Shape:* ``(m,) -> (n, m + m (m - 1) / 2)``.
        """
        distances, mesh = self.geodesics_from(tips), self.coarse
        lengths = np.maximum(_limb_lengths(distances[tips]), _SHORTEST_LIMB)
        along = np.minimum(distances / lengths, 1) + np.maximum(distances - lengths, 0) / lengths.mean()
        gradients = mesh.gradients(distances)
        gradients /= np.maximum(np.linalg.norm(gradients, axis=2, keepdims=True), 1e-12)
        first, second = np.triu_indices(len(tips), 1)
        sines = dot(np.cross(gradients[:, first], gradients[:, second]), mesh.face_normals[:, None])
        functions = self.functions[:, :_ORIENTATION_FUNCTIONS]
        # Integrals of products with functions that are linear in each face, by their values at its corners.
        integrals = functions[mesh.faces].sum(1).T @ (mesh.face_areas[:, None] * sines / 3)
        return np.hstack([along, _ORIENTATION * functions @ integrals])

    def principal_axes(self) -> tuple[FloatArray, FloatArray]:
        """Centred vertices with normals of small weight, and the axes as columns. *Shape:* ``(n, 6), (3, 3)``."""
        mesh = self.coarse
        points = mesh.vertices - np.average(mesh.vertices, 0, mesh.vertex_areas)
        axes = np.linalg.eigh(points.T @ (mesh.vertex_areas[:, None] * points))[1]
        return np.hstack([points, 0.1 * mesh.vertex_normals]), axes * [1, 1, np.sign(np.linalg.det(axes))]

    def curvature(self, n_functions: int = N_FUNCTIONS) -> FloatArray:
        """Twice the mean curvature, of low frequencies, positive where the surface is convex. *Shape:* ``(n,)``."""
        functions, mesh = self.functions[:, :n_functions], self.coarse
        spectrum = self.eigenvalues[:n_functions, None] * (functions.T @ (self.mass[:, None] * mesh.vertices))
        return dot(functions @ spectrum, mesh.vertex_normals)

    def is_near(self, vertices: IntArray, points: FloatArray) -> BoolArray:
        """Points in space whose nearest coarse vertices are near others along edges, as a mask.

        *Shape:* ``(n,), (n, 3)``.
        """
        return self._near[vertices, cKDTree(self.placed.vertices).query(points)[1]]  # type: ignore[no-any-return]

    @cached_property
    def _near(self) -> BoolArray:
        near: BoolArray = csgraph.dijkstra(self._graph, limit=_NEAR) <= _NEAR
        return near


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
    counted: BoolArray | None = None
    """Vertices with a counterpart on a partial target, if known. *Shape:* ``(n_first,)``."""

    @cached_property
    def distortion(self) -> float:
        """Mean over the vertices of the largest distance error to a sample."""
        errors = self.pair.errors(self.vertices, self.counted)
        return float((errors if self.counted is None else errors[self.counted]).max(1, initial=0).mean())

    def differs(self, others: Sequence["Map"]) -> bool:
        """True if each of other maps has a different image of some part."""
        places = self.pair.second.coarse.vertices
        offsets = [np.linalg.norm(places[self.vertices] - places[one.vertices], axis=1) for one in others]
        return all(np.percentile(distances, 98) > SAME for distances in offsets)


class CoarsePair:
    """Maps from one coarse shape, of n_first vertices, to another."""

    def __init__(self, first: SpectralShape, second: SpectralShape) -> None:
        self.first, self.second = first, second
        #: True if the second shape has holes that the first one has not.
        self.partial = second.boundary_length > first.boundary_length + _OPEN
        #: Length on the second shape over the same length on the first, both in square roots of the areas.
        self.growth = 1.0

    # ------------------------------------------------------------------------------------------------ scores and errors
    def rate(self, vertices: IntArray, k: int = FINE_FUNCTIONS, counted: BoolArray | None = None) -> Map:
        """Scores of a map with ``k`` eigenfunctions. *Shape:* ``(n_first,)``."""
        first, second = self.first, self.second
        k = min(k, first.functions.shape[1], second.functions.shape[1])
        back = nearest_rows(second.functions[:, :k] @ self._functional(vertices, k).T, first.functions[:, :k])
        areas = _area_balance(first, second, vertices), _area_balance(second, first, back)
        round_trip = np.linalg.norm(first.coarse.vertices[back[vertices]] - first.coarse.vertices, axis=1).mean()
        score, mirrored_score = (float(area - _ROUND_TRIP * round_trip) for area in (min(areas), -max(areas)))
        return Map(self, vertices, score, mirrored_score, counted)

    def errors(self, vertices: IntArray, counted: BoolArray | None = None) -> FloatArray:
        """Errors of the distances from vertices to samples that count. *Shape:* ``(n_first,) -> (n_first, m)``."""
        samples, distances = self.first.samples
        used = np.ones(len(samples), dtype=bool) if counted is None else counted[samples]
        errors = self.growth * distances[:, used] - self.second.geodesics_from(vertices[samples[used]])[vertices]
        # The way around a hole is longer.
        return np.maximum(errors, 0) if self.partial else np.abs(errors)

    def likeness(self, vertices: IntArray, counted: BoolArray | None = None) -> float:
        """Correlation of the curvatures of corresponding vertices; front and back differ. *Shape:* ``(n_first,)``."""
        here, there = self.first.curvature(_CURVATURE_FUNCTIONS), self.second.curvature(_CURVATURE_FUNCTIONS)[vertices]
        if counted is not None:
            here, there = here[counted], there[counted]
        here, there = here - here.mean(), there - there.mean()
        return float(dot(here, there) / max(np.linalg.norm(here) * np.linalg.norm(there), 1e-12))

    # ------------------------------------------------------------------------------------------------------------- maps
    def _functional(self, vertices: IntArray, k: int, counted: BoolArray | None = None) -> FloatArray:
        """Pull-back of functions from the second shape to the part of the first that counts. *Shape:* ``(k, k)``."""
        mass = self.first.mass if counted is None else self.first.mass * counted
        weighted = mass[:, None] * self.second.functions[vertices, :k]
        return np.asarray(self.first.functions[:, :k].T @ weighted)

    def refine(
        self, vertices: IntArray, start: int, stop: int = FINE_FUNCTIONS, counted: BoolArray | None = None
    ) -> Map:
        """Refine a map with from ``start`` to ``stop`` eigenfunctions (ZoomOut, Melzi et al. 2019)."""
        most = min(stop, self.first.functions.shape[1], self.second.functions.shape[1])
        for k in [*range(min(start, most), most, _STEP), most]:
            rows = self.second.functions[:, :k] @ self._functional(vertices, k, counted).T
            vertices = nearest_rows(self.first.functions[:, :k], rows)
        return self.rate(vertices, stop, counted)

    def from_landmarks(self, pairs: IntArray) -> Map:
        """Refined map from geodesic distances to landmarks. *Shape:* ``(n, 2)``, coarse vertices of both."""
        signatures = []
        for shape, sources in zip((self.first, self.second), pairs.T, strict=True):
            distances = shape.geodesics_from(sources)
            signatures.append(distances / distances.max(0))  # proportions differ
        return self.refine(nearest_rows(*signatures), 8)

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
        best = orders[np.argsort(costs, kind="stable")[: _N_MATCHINGS[self.partial]]]
        return [self.from_limbs(np.stack([tips[:n], others[order]], axis=1)) for order in best]

    def from_limbs(self, pairs: IntArray) -> Map:
        """Map from coordinates along limbs, for any proportions. *Shape:* ``(n, 2)``, coarse vertices of both."""
        shapes = zip((self.first, self.second), pairs.T, strict=True)
        return self.rate(nearest_rows(*(shape.limb_coordinates(ends) for shape, ends in shapes)))

    def from_spectra(self, n_signs: int) -> list[Map]:
        """The best maps from spectra, best first; the last is the best map to the mirrored target.

        The initial maps are all ``2**n_signs`` sign patterns of the lowest eigenfunctions, and rigid alignments of
        principal axes. All are refined with few eigenfunctions, the best with all.
        """
        k = n_signs + 1
        lowest, others = self.first.functions[:, :k], self.second.functions[:, :k]
        starts = [(lowest, others * [1.0, *signs], k) for signs in itertools.product([1.0, -1.0], repeat=n_signs)]
        (here, axes), (there, other_axes) = self.first.principal_axes(), self.second.principal_axes()
        flips = [1, 1, 1], [1, -1, -1], [-1, 1, -1], [-1, -1, 1]
        for turn in (np.eye(3), *(axes * signs @ other_axes.T for signs in flips)):
            starts.append(((here.reshape(-1, 2, 3) @ turn).reshape(-1, 6), there, 12))
        coarse = [self.refine(nearest_rows(rows, goal), n, COARSE_FUNCTIONS) for rows, goal, n in starts]
        coarse.sort(key=lambda one: -one.score)
        best = coarse[:N_REFINED]
        for one in coarse[N_REFINED:]:  # the best ones are often the same map
            if len(best) < N_REFINED + N_DIFFERENT and one.differs(best):
                best.append(one)
        best.append(max(coarse, key=lambda one: one.mirrored_score))
        *fine, mirrored = [self.refine(one.vertices, COARSE_FUNCTIONS) for one in best]
        return [*sorted(fine, key=lambda one: -one.score), mirrored]

    def repair(self, vertices: IntArray) -> Map | None:
        """A map from the mutually consistent samples of one that may be wrong in parts; None if they are few."""
        samples, distances = self.first.samples
        images = vertices[samples]
        to_images = self.second.geodesics_from(images)
        errors = np.abs(distances[samples] - to_images[images])
        wrong, kept = np.maximum(errors, errors.T) > _CONSISTENT, np.arange(len(samples))
        while len(kept) >= _FEWEST and (conflicts := wrong[np.ix_(kept, kept)].sum(1)).any():
            kept = np.delete(kept, conflicts.argmax())
        if len(kept) < _FEWEST or len(kept) == len(samples):
            return None
        return self.refine(nearest_rows(distances[:, kept], to_images[:, kept]), 26)


def nearest_rows(queries: FloatArray, rows: FloatArray) -> IntArray:
    """Index of the nearest row. Dense: trees are no faster in fifty dimensions. *Shape:* ``(n, k), (m, k) -> (n,)``."""
    queries, rows = queries.astype(np.float32), rows.astype(np.float32)
    return (queries @ rows.T - 0.5 * (rows * rows).sum(1)).argmax(1)


def _limb_lengths(distances: FloatArray) -> FloatArray:
    """Lengths whose sums in pairs fit distances between tips by least squares. *Shape:* ``(..., n, n) -> (..., n)``."""
    n, sums = distances.shape[-1], distances.sum(-1)
    lengths: FloatArray = (sums - sums.sum(-1, keepdims=True) / (2 * n - 2)) / (n - 2)
    return lengths


def _area_balance(first: SpectralShape, second: SpectralShape, vertices: IntArray) -> float:
    """Fraction of the first shape's area with an untorn, outward image minus that with an inward image."""
    faces = first.coarse.faces
    image, rest = second.coarse.vertices[vertices][faces], first.coarse.vertices[faces]
    area_vectors = np.cross(image[:, 1] - image[:, 0], image[:, 2] - image[:, 0])
    sign = np.sign(dot(area_vectors, second.coarse.vertex_normals[vertices][faces].mean(1)))
    before, after = (np.linalg.norm(x - np.roll(x, 1, axis=1), axis=2).max(1) for x in (rest, image))
    whole = after < _TORN[0] * before + _TORN[1]
    # Faces that collapse, because the other mesh is coarser, do not count.
    counted = first.coarse.face_areas[sign != 0].sum()
    total = max(counted, _LEAST_COUNTED * first.coarse.area)
    return float((first.coarse.face_areas * whole * sign).sum() / total)
