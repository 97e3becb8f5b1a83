"""A key-frame as the pre-computation sees it."""

from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from torch_modal.errors import MeshError
from torch_modal.geometry.connectivity import vertex_areas
from torch_modal.geometry.inspect import signed_volume
from torch_modal.geometry.normals import vertex_normals

FloatArray = NDArray[np.float64]
IntArray = NDArray[np.int64]

DIAGONAL = 100.0
"""Bounding-box diagonal in which the pre-computation works: the decimation has absolute thresholds for it."""
_DIAGONAL_RANGE = (1e-90, 1e90)


@dataclass(frozen=True)
class Surface:
    """A shape with its used vertices only, centred, with a bounding-box diagonal of 100.

    Attributes:
        points: *Shape:* ``(U, 3)``.
        faces: Indices into ``points``, wound counterclockwise seen from outside. *Shape:* ``(F, 3)``.
        used: Which vertices of the shape the points are. *Shape:* ``(U,)``.
        scale: Units here per unit of the caller.
    """

    points: FloatArray
    faces: IntArray
    used: IntArray
    scale: float

    @classmethod
    def of(cls, shape: FloatArray, faces: IntArray) -> "Surface":
        """The surface of a checked shape.

        Args:
            shape: Positions in any units. *Shape:* ``(V, 3)``.
            faces: Vertex indices. *Shape:* ``(F, 3)``.

        Raises:
            MeshError: It is so large or small that eigenvalues leave the range of float64.
        """
        used, compact = np.unique(faces, return_inverse=True)
        points = shape[used]
        low, high = points.min(axis=0), points.max(axis=0)
        diagonal = float(np.linalg.norm(high - low))
        if not _DIAGONAL_RANGE[0] < diagonal < _DIAGONAL_RANGE[1]:
            raise MeshError(
                f"the bounding-box diagonal is {diagonal:.3g}, at which eigenvalues leave the range of "
                "float64; choose another unit"
            )
        points = (points - (low + high) / 2) * (DIAGONAL / diagonal)
        return cls(points, outward(points, compact.reshape(-1, 3)), used, DIAGONAL / diagonal)

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
