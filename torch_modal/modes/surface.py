"""Key-frames in canonical coordinates, samples of their surfaces, thickness and gaps."""

import numpy as np
from scipy.spatial import cKDTree

from torch_modal.arrays import FloatArray, IntArray
from torch_modal.errors import MeshError
from torch_modal.geometry.canonical import CANONICAL_SIZE, in_order, to_canonical
from torch_modal.geometry.inspect import FLATNESS, principal_extents, volume_of
from torch_modal.geometry.surface import Surface
from torch_modal.threads import n_threads

_DIAGONAL_RANGE = (1e-90, 1e90)
MOST_SAMPLES = 60_000
LEAF = 32
"""Leaf size of the tree of samples: twice SciPy's, which is a third faster for queries near the surface."""
LARGEST_GAP = 0.03
"""Largest gap that counts as proximity, in sizes."""
OPPOSED = -0.3
"""Largest cosine between the normals of opposing points."""
SEEN_POINTS = 2000
"""Approximate number of points tested for proximity; larger surfaces are subsampled."""
LARGEST_THICKNESS = 0.06
"""Largest measured thickness or gap, in sizes."""
LEAST_SAMPLES = 5000
"""Minimum number of samples for thickness and gap."""
SEEN_SAMPLES = 10_000
"""Approximate number of samples at which they are measured."""
MOST_SHRINKINGS = 10


class CanonicalSurface(Surface):
    """Referenced vertices of a shape in its principal axes, centred, with a size of 100.

    Results do not depend on the caller's axes or on the order of the faces, which are wound counterclockwise seen from
    outside, and sorted.

    Args:
        shape: A checked shape in any units. *Shape:* ``(V, 3)``.
        faces: *Shape:* ``(F, 3)``.

    Attributes:
        used: Vertex indices of the vertices in the shape. *Shape:* ``(U,)``.
        scale: Canonical units per unit of the caller.
        axes: ``vertices @ axes`` has the caller's axes. *Shape:* ``(3, 3)``.

    Raises:
        MeshError: The surface has no area, or is so large or small that eigenvalues leave the range of float64.
    """

    def __init__(self, shape: FloatArray, faces: IntArray) -> None:
        self.used, compact = np.unique(faces, return_inverse=True)
        points, compact = shape[self.used], compact.reshape(-1, 3)
        diagonal = float(np.linalg.norm(np.ptp(points, axis=0)))
        if not _DIAGONAL_RANGE[0] < diagonal < _DIAGONAL_RANGE[1]:
            raise MeshError(
                f"the bounding-box diagonal is {diagonal:.3g}, at which eigenvalues leave the range of "
                "float64; choose another unit"
            )
        extents = principal_extents(points)
        if extents[1] <= FLATNESS * extents[0]:
            raise MeshError(
                f"all vertices lie on a line: the extents are {extents[0]:.3g}, {extents[1]:.3g} and {extents[2]:.3g}; "
                "a surface has an area"
            )
        points, self.axes, _, self.scale = to_canonical(points, compact)
        order, sorted_faces = in_order(points, compact)
        ordered = order[sorted_faces]
        # fTetWild keeps the volume with positive winding number, which is empty for an inverted mesh.
        if volume_of(points - points.mean(axis=0), ordered) < 0:
            ordered = ordered[:, ::-1]
        super().__init__(points, ordered)

    def require_solid(self) -> None:
        """Raise a MeshError for a planar surface, which has no interior."""
        extents = principal_extents(self.vertices)
        if extents[2] <= FLATNESS * extents[0]:
            lengths = "{:.3g}, {:.3g} and {:.3g}".format(*extents / self.scale)
            raise MeshError(
                f"the surface is flat: its extents are {lengths}, so it encloses nothing that could be filled with "
                "tetrahedra; take the modes of the surface (method shell), or give it a thickness"
            )


class SurfaceSamples:
    """P samples of a surface, each face at a spacing of its own and with one or more. *Shape:* ``(F,)``."""

    def __init__(self, surface: Surface, spacing: FloatArray) -> None:
        corners = surface.vertices[surface.faces]
        sides = corners - np.roll(corners, 1, axis=1)
        longest = np.linalg.norm(sides, axis=2).max(axis=1) / spacing
        longest *= min(1.0, (MOST_SAMPLES / (longest**2).sum()) ** 0.5)
        n_cuts = np.maximum(np.ceil(longest), 1).astype(np.int64)
        points, shares, faces = [], [], []
        for n in np.unique(n_cuts):
            chosen = n_cuts == n
            # Centroids of the n² congruent parts of a triangle.
            up = np.array([(3 * i + 1, 3 * j + 1) for i in range(n) for j in range(n - i)])
            down = np.array([(3 * i + 2, 3 * j + 2) for i in range(n - 1) for j in range(n - 1 - i)]).reshape(-1, 2)
            uv = np.concatenate([up, down]) / (3 * n)
            weights = np.concatenate([1 - uv.sum(axis=1, keepdims=True), uv], axis=1)
            points.append(np.einsum("qa,fai->fqi", weights, corners[chosen]).reshape(-1, 3))
            shares.append(np.repeat(surface.area_vectors[chosen] / n**2, n**2, axis=0))
            faces.append(np.repeat(np.flatnonzero(chosen), n**2))
        normal = np.concatenate(shares)
        #: *Shape:* ``(P, 3)``, and the face of each, ``(P,)``.
        self.points, self.faces = np.concatenate(points), np.concatenate(faces)
        self.areas = np.linalg.norm(normal, axis=1)
        #: Outward unit normals, zero where there is no area. *Shape:* ``(P, 3)``.
        self.normals = normal / np.maximum(self.areas, 1e-300)[:, None]
        self.tree = cKDTree(self.points, leafsize=LEAF)


def self_proximity(surface: Surface) -> float:
    """Fraction of the area with an opposing part of the surface close in front of it.

    Tetrahedra fuse parts in contact, so such a pose is a poor rest pose.
    """
    step = max(len(surface.vertices) // SEEN_POINTS, 1)
    points, normals = surface.vertices[::step], surface.vertex_normals[::step]
    tree = cKDTree(points)
    opposed = np.zeros(len(points), dtype=bool)
    for gap in (1 / 16, 1 / 8, 1 / 4, 1 / 2):  # beyond half the gap, the opposing side is nearer than the point itself
        nearest = tree.query(points + gap * LARGEST_GAP * CANONICAL_SIZE * normals, workers=n_threads())[1]
        opposed |= np.einsum("vi,vi->v", normals, normals[nearest]) < OPPOSED
    areas = surface.vertex_areas[::step]
    return float(areas[opposed].sum() / areas.sum())


def clearances(surface: Surface) -> tuple[FloatArray, FloatArray]:
    """Thickness of the body behind each face, and gap in front of it; infinite above `LARGEST_THICKNESS`.

    *Shape:* ``(F,), (F,)``.

    They are diameters of balls tangent to the surface at samples, which shrink until they are empty (Ma, Bae and Choi
    2012) or touch a side that is not opposing, as in a corner.
    """
    samples = SurfaceSamples(surface, np.full(len(surface.faces), np.sqrt(surface.area / LEAST_SAMPLES)))
    seen = np.arange(0, len(samples.points), max(len(samples.points) // SEEN_SAMPLES, 1))
    clearance = np.full((2, len(surface.faces)), np.inf)
    for smallest, side in zip(clearance, (-1.0, 1.0), strict=True):
        left, radius = seen, np.full(len(seen), LARGEST_THICKNESS * CANONICAL_SIZE / 2)
        for _ in range(MOST_SHRINKINGS):
            point, direction = samples.points[left], side * samples.normals[left]
            nearest = samples.tree.query(point + radius[:, None] * direction, workers=n_threads())[1]
            across = samples.points[nearest] - point
            height = np.einsum("vi,vi->v", across, direction)
            smaller = np.einsum("vi,vi->v", across, across) / (2 * np.maximum(height, 1e-300))
            opposed = side * np.einsum("vi,vi->v", direction, samples.normals[nearest]) < OPPOSED
            shrinks = opposed & (height > 0) & (smaller < 0.99 * radius)
            left, radius = left[shrinks], smaller[shrinks]
            np.minimum.at(smallest, samples.faces[left], 2 * radius)
            if len(left) == 0:
                break
    return clearance[0], clearance[1]
