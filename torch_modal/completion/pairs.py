"""Pairs of observed points and places on a surface, by position and normal, and their robust weights."""

from functools import cached_property
from typing import Any, NamedTuple

import numpy as np
from scipy import sparse
from scipy.spatial import cKDTree

from torch_modal.arrays import BoolArray, FloatArray, IntArray
from torch_modal.completion.clouds import Camera
from torch_modal.geometry.closest import closest_on_triangles, dot
from torch_modal.geometry.connectivity import Connectivity, label_pieces
from torch_modal.registration.surface import MeshSurface, places_between

# Places of each triangle that are candidates: its middle, and one near each corner; of many, the middle alone.
_PLACES, MANY_FACES = np.array([[2, 2, 2], [4, 1, 1], [1, 4, 1], [1, 1, 4]]) / 6, 10_000

# Part of the stiffness of a pair with a normal that is left along the surface.
SLIDE = 0.3
# Weight of normals: at a size of 100, a distance of 3 counts as much as 60 degrees.
CLOUD_NORMAL_WEIGHT = 3.0
# Smallest cosine between the normals of a pair.
LEAST_COSINE = 0.3
# Cells of the picture in which surfaces hide others, the depth below which they do not, cosine of grazing sight.
CELL, DEPTH, GRAZING = 2.0, 3.0, 0.15
# Neighbours of a point of a cloud, and how many of their usual distances are a gap.
N_NEIGHBOURS, GAP = 8, 3.0
# Points, about, from which the usual distance is found; cells of a gap, to which points are rounded.
N_SPACING, CELLS_OF_GAP = 1000, 6
# Distance, in standard deviations of the noise, at which a point loses three quarters of its weight.
OUTLIERS = 4.0
# Least noise, and the largest that is estimated, at a size of 100.
NOISES = 0.1, 2.0
# Trees that are asked once: made in half the time.
QUICK = {"balanced_tree": False, "compact_nodes": False}
# Distance from an observed point within which a vertex counts as seen.
SEEN_WITHIN = 2.5
# Steps in a factor of two, to which an estimated noise is rounded.
NOISE_STEPS = 4


class ObservedPoints(NamedTuple):
    """Observed points at a size of 100: a cloud, or points whose places on the surface are known."""

    points: FloatArray
    """*Shape:* ``(n, 3)``."""
    normals: FloatArray | None
    """Places may slide across these. *Shape:* ``(n, 3)``."""
    weights: FloatArray
    """*Shape:* ``(n,)``."""
    numbers: IntArray
    """Indices of the points among all observed ones. *Shape:* ``(n,)``."""
    noise: float
    """Standard deviation; 0 where it is not known yet."""
    places: Any = None
    """Interpolation matrix from vertices to the places of the points; None for a cloud. *Shape:* ``(n, V)``."""
    camera: Camera | None = None
    """Of a cloud."""

    def restrict(self, select: sparse.csr_matrix) -> "ObservedPoints":
        """With places on a coarse mesh, by the coarse vertex of each vertex. *Shape:* ``(V, V_coarse)``."""
        return self if self.places is None else self._replace(places=self.places @ select)

    def select(self, chosen: IntArray | BoolArray) -> "ObservedPoints":
        """Some of the points."""
        normals, places = (None if rows is None else rows[chosen] for rows in (self.normals, self.places))
        points, weights, numbers = self.points[chosen], self.weights[chosen], self.numbers[chosen]
        return self._replace(points=points, normals=normals, weights=weights, numbers=numbers, places=places)

    def seen_from(self, rotation: FloatArray, move: FloatArray) -> "ObservedPoints":
        """In the coordinates of a body ``x`` that is at ``x rotation^T + move``. *Shape:* ``(3, 3), (3,)``."""
        camera, normals = self.camera, None if self.normals is None else self.normals @ rotation
        camera = None if camera is None else camera.seen_from(rotation, move)
        return self._replace(points=(self.points - move) @ rotation, normals=normals, camera=camera)

    def main_part(self, gap: float) -> "ObservedPoints":
        """The points of a cloud without clusters that are a gap away from the one of the largest extent."""
        if self.places is not None:
            return self
        labels = label_clusters(self.points, gap)
        extents = [np.ptp(self.points[labels == k], axis=0).max() for k in range(labels.max() + 1)]
        return self.select(labels == np.argmax(extents))

    def thin(self, n: int) -> "ObservedPoints":
        """At most n points of a cloud, chosen at random, always the same, of the same sum of weights."""
        if self.places is not None or len(self.points) <= n:
            return self
        some = self.select(np.random.default_rng(0).permutation(len(self.points))[:n])
        return some._replace(weights=some.weights * (self.weights.sum() / some.weights.sum()))

    def with_noise(self, surface: "SampledSurface") -> "ObservedPoints":
        """The noise, where it is not known, from the median of distances from a surface, or from points.

        It is rounded, and so a constant of gradients: the median follows a single point.
        """
        median = float(np.median(self.misses(surface)[0])) / (0.6745 if self.places is None else 1.538)
        rounded = 2.0 ** (round(NOISE_STEPS * np.log2(np.clip(median, *NOISES))) / NOISE_STEPS)
        return self._replace(noise=self.noise or float(rounded))

    def distances(self, x: FloatArray) -> FloatArray:
        """Distances of the points from their places on a shape. *Shape:* ``(V, 3) -> (n,)``."""
        return np.linalg.norm(self.places @ x - self.points, axis=1)

    def misses(self, surface: "SampledSurface") -> tuple[FloatArray, BoolArray]:
        """Distances of the points from their places, or from the most alike ones whose normals may agree or not.

        *Shape:* ``(n,)`` each.
        """
        if self.places is not None:
            return self.distances(surface.vertices), np.ones(len(self.points), bool)
        return surface.most_alike(self.points, self.normals)[2:]

    def pair(self, surface: "SampledSurface", released: BoolArray | None = None) -> "ObservedPoints":
        """The points with their places; of a cloud, released vertices and normals that do not agree weigh nothing."""
        if self.places is not None:
            return self
        face, barycentric, _, agree = surface.most_alike(self.points, self.normals)
        if released is not None:
            agree = agree & ~released[surface.faces[face]].any(1)
        places = places_between(surface.faces[face], barycentric, len(surface.vertices))
        return self._replace(weights=self.weights * agree, places=places)

    def pairs(self, surface: "SampledSurface", released: BoolArray | None = None) -> "list[ObservedPoints]":
        """The points with their places, and, where the view is known, the visible places with points."""
        pairs = [self.pair(surface, released)]
        if self.camera is None or self.normals is None:
            return pairs
        seen = surface.visible(self.camera)
        seen = seen[:: max(1, len(seen) // len(self.points))]
        faces = surface.sample_faces[seen]
        tree = cKDTree(join_features(self.points, self.normals))
        nearest = tree.query(join_features(surface.samples[seen], surface.face_normals[faces]))[1]
        agree = dot(surface.face_normals[faces], self.normals[nearest]) > LEAST_COSINE
        if released is not None:
            agree &= ~released[surface.faces[faces]].any(1)
        seen, faces, nearest = seen[agree], faces[agree], nearest[agree]
        if len(seen):
            within = surface.places[seen % len(surface.places)]
            places = places_between(surface.faces[faces], within, len(surface.vertices))
            points, normals = self.points[nearest], self.normals[nearest]
            weights = np.full(len(seen), self.weights.sum() / len(seen))
            pairs.append(ObservedPoints(points, normals, weights, self.numbers[nearest], self.noise, places))
        return pairs

    def score(self, surface: "SampledSurface", unit: float) -> float:
        """Fraction of the points that the surface leaves out, and of the visible surface that a cloud leaves out."""
        distances, agree = self.misses(surface)
        total = float(self.weights @ np.where(agree, 1 - 1 / (1 + (distances / unit) ** 2), 1))
        if self.camera is not None:
            seen = surface.samples[surface.visible(self.camera)]
            gap = (cKDTree(self.points).query(seen)[0] / (3 * unit)) ** 2
            total += float(self.weights.sum() * ((gap / (1 + gap)).mean() if len(seen) else 1.0))
        return total

    def find_unexplained(
        self, surface: "SampledSurface", reach: float, least: int, near: float = np.inf
    ) -> list[IntArray]:
        """Connected groups of points that are far from the surface, but near other points, the largest first."""
        distances, agree = self.misses(surface)
        far = ~agree | (distances > reach)
        off = np.flatnonzero(far)
        if len(off) < least:
            return []
        some = self.points[:: max(1, len(self.points) // N_SPACING)]
        neighbours = cKDTree(self.points).query(some, min(N_NEIGHBOURS, len(self.points)))[0]
        pieces = label_clusters(self.points[off], max(NOISES[0], GAP / 2 * float(np.median(neighbours[:, -1]))))
        away = cKDTree(self.points[~far]).query(self.points[off])[0] if len(off) < len(far) else np.zeros(len(off))
        sizes, gaps = np.bincount(pieces), np.full(pieces.max() + 1, np.inf)
        np.minimum.at(gaps, pieces, away)
        return [off[pieces == k] for k in np.argsort(-sizes, kind="stable") if sizes[k] >= least and gaps[k] <= near]


def label_clusters(points: FloatArray, gap: float) -> IntArray:
    """Connected component of each point, where points nearer than about a gap are connected. *Shape:* ``(n,)``.

    Points are rounded to a fraction of the gap: pairs of all that lie in one place would not fit into memory.
    """
    cells, cell = np.unique(np.round(points * (CELLS_OF_GAP / gap)), axis=0, return_inverse=True)
    return label_pieces(cKDTree(cells).query_pairs(CELLS_OF_GAP, output_type="ndarray"), len(cells))[cell.ravel()]


def robust_weights(distances: FloatArray, noise: float) -> FloatArray:
    """Weights of points at distances (Geman and McClure)."""
    weights: FloatArray = 1 / (1 + (distances / (OUTLIERS * noise)) ** 2) ** 2
    return weights


def seen_at(distances: FloatArray) -> FloatArray:
    """Weights, from 0 to 1, with which vertices at distances from observed points count as seen."""
    seen: FloatArray = np.exp(-0.5 * (distances / SEEN_WITHIN) ** 2)
    return seen


def join_features(points: FloatArray, normals: FloatArray | None) -> FloatArray:
    """Points with their normals, as places of which near ones are alike. *Shape:* ``(n, 3), (n, 3) -> (n, 6)``."""
    return points if normals is None else np.hstack([points, CLOUD_NORMAL_WEIGHT * normals])


class SampledSurface(MeshSurface):
    """A shape at a size of 100, with places on its faces that may be paired."""

    def __init__(self, vertices: FloatArray, faces: IntArray | Connectivity) -> None:
        super().__init__(vertices, faces)
        self.places = _PLACES if len(self.faces) <= MANY_FACES else _PLACES[:1]
        self.samples = (self.places @ self.vertices[self.faces]).reshape(-1, 3)
        self.sample_faces = np.arange(len(self.faces)).repeat(len(self.places))

    def most_alike(
        self, points: FloatArray, normals: FloatArray | None
    ) -> tuple[IntArray, FloatArray, FloatArray, BoolArray]:
        """Face and coordinates of the place that looks most like each point, the distance, and if normals agree."""
        tree = self._tree_of_places if normals is None else self._tree_with_normals
        face = self.sample_faces[tree.query(join_features(points, normals))[1]]
        barycentric, distances = closest_on_triangles(points, self.vertices[self.faces[face]])
        agree = np.ones(len(points), bool) if normals is None else dot(self.face_normals[face], normals) > LEAST_COSINE
        return face, barycentric, distances, agree

    @cached_property
    def _tree_of_places(self) -> cKDTree:
        return cKDTree(self.samples, **QUICK)

    @cached_property
    def _tree_with_normals(self) -> cKDTree:
        return cKDTree(join_features(self.samples, self.face_normals[self.sample_faces]), **QUICK)

    def visible(self, camera: Camera) -> IntArray:
        """The samples that a camera sees. *Shape:* ``(m,)``."""
        picture, depth = camera.picture(self.samples)
        cells = np.floor(picture / CELL).astype(np.int64)
        cells -= cells.min(0)
        _, cell = np.unique(cells @ [1, cells[:, 0].max() + 1], return_inverse=True)
        nearest = np.full(cell.max() + 1, -np.inf)
        np.maximum.at(nearest, cell.ravel(), depth)
        towards = camera.towards(self.samples)
        front = (self.face_normals[self.sample_faces] * towards).sum(1) > GRAZING
        return np.flatnonzero(front & (nearest[cell.ravel()] - depth < DEPTH))
