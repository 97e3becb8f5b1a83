"""A key-frame as the pre-computation sees it."""

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
"""Size in which the pre-computation works (:func:`~torch_modal.geometry.canonical.size`)."""
_DIAGONAL_RANGE = (1e-90, 1e90)


@dataclass(frozen=True)
class CanonicalSurface:
    """A shape with its used vertices only, in its principal axes, centred, with a size of 100.

    So all that follows from it is the same however the caller's axes are turned and the faces are listed.

    Attributes:
        points: *Shape:* ``(U, 3)``.
        faces: Indices into ``points``, wound counterclockwise seen from outside, sorted. *Shape:* ``(F, 3)``.
        used: Which vertices of the shape the points are. *Shape:* ``(U,)``.
        scale: Units here per unit of the caller.
        axes: Vectors here times this have the caller's axes. *Shape:* ``(3, 3)``.
    """

    points: FloatArray
    faces: IntArray
    used: IntArray
    scale: float
    axes: FloatArray

    @classmethod
    def of(cls, shape: FloatArray, faces: IntArray) -> "CanonicalSurface":
        """The surface of a checked shape.

        Args:
            shape: Positions in any units. *Shape:* ``(V, 3)``.
            faces: Vertex indices. *Shape:* ``(F, 3)``.

        Raises:
            MeshError: It is so large or small that eigenvalues leave the range of float64.
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
        """Of all faces."""
        return float(vertex_areas(self.points, self.faces).sum())

    @cached_property
    def normals(self) -> FloatArray:
        """Outward unit normals of the points, zero where the faces have no area. *Shape:* ``(U, 3)``."""
        return vertex_normals(self.points, self.faces)


def outward(vertices: FloatArray, faces: IntArray) -> IntArray:
    """The faces, all turned over if they wind clockwise seen from outside. *Shape:* ``(F, 3)``.

    fTetWild keeps what the faces wind around, which is nothing for a mesh that is inside out.
    """
    inside_out = signed_volume(vertices - vertices.mean(axis=0), faces) < 0
    return np.ascontiguousarray(faces[:, ::-1]) if inside_out else faces
