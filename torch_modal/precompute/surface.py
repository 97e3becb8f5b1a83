"""Key-frames in canonical coordinates, as the pre-computation uses them."""

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from torch_modal.arrays import FloatArray, IntArray
from torch_modal.errors import MeshError
from torch_modal.geometry.canonical import SIZE, ordered_faces, placed
from torch_modal.geometry.connectivity import vertex_areas
from torch_modal.geometry.inspect import signed_volume
from torch_modal.geometry.normals import vertex_normals

DIAGONAL = SIZE
"""Size of canonical surfaces (:func:`~torch_modal.geometry.canonical.size`)."""
_DIAGONAL_RANGE = (1e-90, 1e90)


@dataclass(frozen=True)
class CanonicalSurface:
    """Referenced vertices of a shape in its principal axes, centred, with a size of 100.

    Results do not depend on the caller's axes or on the order of the faces.

    Attributes:
        points: *Shape:* ``(U, 3)``.
        faces: Indices into ``points``, wound counterclockwise seen from outside, sorted. *Shape:* ``(F, 3)``.
        used: Vertex indices of the points in the shape. *Shape:* ``(U,)``.
        scale: Canonical units per unit of the caller.
        axes: ``points @ axes`` has the caller's axes. *Shape:* ``(3, 3)``.
    """

    points: FloatArray
    faces: IntArray
    used: IntArray
    scale: float
    axes: FloatArray

    @classmethod
    def of(cls, shape: FloatArray, faces: IntArray) -> "CanonicalSurface":
        """Canonical surface of a checked shape.

        Args:
            shape: Positions in any units. *Shape:* ``(V, 3)``.
            faces: Vertex indices. *Shape:* ``(F, 3)``.

        Raises:
            MeshError: The size is so large or small that eigenvalues leave the range of float64.
        """
        used, compact = np.unique(faces, return_inverse=True)
        points = shape[used]
        diagonal = float(np.linalg.norm(np.ptp(points, axis=0)))
        if not _DIAGONAL_RANGE[0] < diagonal < _DIAGONAL_RANGE[1]:
            raise MeshError(
                f"the bounding-box diagonal is {diagonal:.3g}, at which eigenvalues leave the range of "
                "float64; choose another unit"
            )
        own = placed(points, compact.reshape(-1, 3))
        ordered = ordered_faces(own.points, compact.reshape(-1, 3))
        return cls(own.points, outward(own.points, ordered), used, own.scale, own.axes)

    @cached_property
    def area(self) -> float:
        """Surface area."""
        return float(vertex_areas(self.points, self.faces).sum())

    @cached_property
    def normals(self) -> FloatArray:
        """Outward unit normals of the points, zero where the faces have no area. *Shape:* ``(U, 3)``."""
        return vertex_normals(self.points, self.faces)


def outward(vertices: FloatArray, faces: IntArray) -> IntArray:
    """Faces with counterclockwise winding seen from outside. *Shape:* ``(F, 3)``.

    fTetWild keeps the volume with positive winding number, which is empty for an inverted mesh.
    """
    inside_out = signed_volume(vertices - vertices.mean(axis=0), faces) < 0
    return np.ascontiguousarray(faces[:, ::-1]) if inside_out else faces
