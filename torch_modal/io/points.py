"""PLY files of points: scans, markers, and splats of 3D Gaussian splatting."""

from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from torch_modal.arrays import FloatArray
from torch_modal.geometry.harmonics import MOST_DEGREE, rotated
from torch_modal.io.ply import PlyFile

_QUATERNION = [f"rot_{i}" for i in range(4)]
_SCALES = [f"scale_{i}" for i in range(3)]
_NORMALS = ["nx", "ny", "nz"]


class PointFile:
    """A PLY file whose vertices move, with or without faces; all else stays as it is.

    Attributes:
        positions: *Shape:* ``(P, 3)``.
        is_splats: Whether the points are splats: with a rotation and logarithms of scales.

    Args:
        path: The file.

    Raises:
        FileNotFoundError: There is none.
        ValueError: It is no PLY file of points.
    """

    def __init__(self, path: Path) -> None:
        if not path.is_file():
            raise FileNotFoundError(f"{path}: no such file")
        try:
            self._file = PlyFile(path)
            self.positions = self._file.columns("x", "y", "z")
        except (ValueError, KeyError, IndexError) as error:
            raise ValueError(f"{path} is no PLY file of points with x, y and z: {error}") from error
        self._names = self._file.vertex.properties.keys()
        self.is_splats = {*_QUATERNION, *_SCALES} <= self._names
        #: Properties of the harmonics above degree 0, one channel after the other.
        self._harmonics = sorted(
            (name for name in self._names if name.startswith("f_rest_")),
            key=lambda name: int(name.removeprefix("f_rest_")),
        )
        if self.is_splats and len(self._harmonics) not in [3 * (n * n - 1) for n in range(1, MOST_DEGREE + 2)]:
            raise ValueError(
                f"{path} has {len(self._harmonics)} f_rest properties; splats of degree 0 to {MOST_DEGREE} have 0, 9, "
                "24 or 45"
            )

    def moved(self, positions: FloatArray, rotations: FloatArray, gradients: FloatArray) -> bytes:
        """The file with points that moved, and what turns with them: normals; of splats axes, scales and harmonics.

        Axes of splats turn, and scales change as lengths along the axes do.

        Args:
            positions: *Shape:* ``(P, 3)``.
            rotations: *Shape:* ``(P, 3, 3)``.
            gradients: Deformation gradients. *Shape:* ``(P, 3, 3)``.
        """
        new = dict(zip("xyz", positions.T, strict=True))
        if {*_NORMALS} <= self._names:
            turned = np.einsum("pij,pj->pi", rotations, self._file.columns(*_NORMALS))
            new |= dict(zip(_NORMALS, turned.T, strict=True))
        if self.is_splats:
            # SciPy's quaternions have the scalar last, and a length.
            quaternions = np.roll(self._file.columns(*_QUATERNION), -1, axis=1)
            quaternions[~quaternions.any(1), 3] = 1
            given = Rotation.from_quat(quaternions)
            turned = (Rotation.from_matrix(rotations) * given).as_quat()
            new |= dict(zip(_QUATERNION, np.roll(turned, 1, axis=1).T, strict=True))
            stretch = np.linalg.norm(gradients @ given.as_matrix(), axis=1)
            scales = self._file.columns(*_SCALES) + np.log(np.maximum(stretch, np.finfo(np.float32).tiny))
            new |= dict(zip(_SCALES, scales.T, strict=True))
            if self._harmonics:
                own = self._file.columns(*self._harmonics).reshape(len(positions), 3, -1)
                new |= dict(zip(self._harmonics, rotated(own, rotations).reshape(len(positions), -1).T, strict=True))
        return self._file.with_columns(new)
