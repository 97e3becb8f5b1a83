"""PLY files of points: scans, markers, and splats of 3D Gaussian splatting."""

from pathlib import Path

import numpy as np
from scipy.spatial.transform import Rotation

from torch_modal.arrays import FloatArray
from torch_modal.io.ply import PlyFile

_QUATERNION = [f"rot_{i}" for i in range(4)]
_SCALES = [f"scale_{i}" for i in range(3)]
_NORMALS = ["nx", "ny", "nz"]

MOST_DEGREE = 3  # of spherical harmonics

# Directions whose values determine the harmonics of a degree: more than it has, and no two opposite.
_DIRECTIONS = np.random.default_rng(0).standard_normal((12, 3))
_DIRECTIONS /= np.linalg.norm(_DIRECTIONS, axis=1, keepdims=True)

_ROTATIONS_AT_ONCE = 65_536  # rotations that are applied at a time


class PointFile:
    """A PLY file, with or without faces, whose vertices at ``positions`` ``(P, 3)`` can be moved; the rest stays.

    Vertices may be splats, with a rotation and logarithms of scales.
    """

    def __init__(self, path: Path) -> None:
        if not path.is_file():
            raise FileNotFoundError(f"{path}: no such file")
        try:
            self._file = PlyFile(path)
            self.positions = self._file.columns("x", "y", "z")
        except (ValueError, KeyError, IndexError) as error:
            raise ValueError(f"{path} is no PLY file of points with x, y and z: {error}") from error
        self._names = self._file.properties.keys()
        self.n_faces = self._file.elements.get("face", (0,))[0]
        #: *Shape:* ``(P, 3)``, or ``(P, 0)`` without normals.
        self.normals = self._file.columns(*_NORMALS) if {*_NORMALS} <= self._names else self.positions[:, :0]
        self.is_splats = {*_QUATERNION, *_SCALES} <= self._names
        #: Properties of the harmonics above degree 0, one channel after the other.
        rest = [name for name in self._names if name.startswith("f_rest_")]
        self._harmonics = sorted(rest, key=lambda name: int(name.removeprefix("f_rest_")))
        if self.is_splats and len(self._harmonics) not in [3 * (n * n - 1) for n in range(1, MOST_DEGREE + 2)]:
            raise ValueError(
                f"{path} has {len(self._harmonics)} f_rest properties; splats of degree 0 to {MOST_DEGREE} have 0, 9, "
                "24 or 45"
            )

    def move(self, positions: FloatArray, rotations: FloatArray, gradients: FloatArray) -> bytes:
        """The file with points at other positions; normals, and axes and harmonics of splats, are rotated.

        Scales of splats change as lengths along their axes do under the deformation gradients. *Shape:*
        ``(P, 3), (P, 3, 3), (P, 3, 3)``.
        """
        new = dict(zip("xyz", positions.T, strict=True))
        if self.normals.size:
            rotated = np.einsum("pij,pj->pi", rotations, self.normals)
            new |= dict(zip(_NORMALS, rotated.T, strict=True))
        if self.is_splats:
            # SciPy's quaternions have the scalar last, and a length.
            quaternions = np.roll(self._file.columns(*_QUATERNION), -1, axis=1)
            quaternions[~quaternions.any(1), 3] = 1
            before = Rotation.from_quat(quaternions)
            rotated = (Rotation.from_matrix(rotations) * before).as_quat()
            new |= dict(zip(_QUATERNION, np.roll(rotated, 1, axis=1).T, strict=True))
            stretch = np.linalg.norm(gradients @ before.as_matrix(), axis=1)
            scales = self._file.columns(*_SCALES) + np.log(np.maximum(stretch, np.finfo(np.float32).tiny))
            new |= dict(zip(_SCALES, scales.T, strict=True))
            if self._harmonics:
                coefficients = self._file.columns(*self._harmonics).reshape(len(positions), 3, -1)
                rotated = rotate_harmonics(coefficients, rotations).reshape(len(positions), -1)
                new |= dict(zip(self._harmonics, rotated.T, strict=True))
        return self._file.with_columns(new)


def evaluate_harmonics(directions: FloatArray, degree: int) -> FloatArray:
    """The real harmonics of a degree, in the order and with the signs of 3D Gaussian splatting (Kerbl et al. 2023).

    *Shape:* ``(..., 3) -> (..., 2 degree + 1)``, of unit vectors; degrees 1, 2 and 3.
    """
    x, y, z = np.moveaxis(directions, -1, 0)
    if degree == 1:
        return np.sqrt(3 / (4 * np.pi)) * np.stack([-y, z, -x], -1)
    if degree == 2:
        rows = [2 * x * y, -2 * y * z, (2 * z * z - x * x - y * y) / np.sqrt(3), -2 * x * z, x * x - y * y]
        return np.sqrt(15 / (16 * np.pi)) * np.stack(rows, -1)
    rows = [
        -np.sqrt(10) * y * (3 * x * x - y * y),
        2 * np.sqrt(60) * x * y * z,
        -np.sqrt(6) * y * (4 * z * z - x * x - y * y),
        2 * z * (2 * z * z - 3 * x * x - 3 * y * y),
        -np.sqrt(6) * x * (4 * z * z - x * x - y * y),
        np.sqrt(60) * z * (x * x - y * y),
        -np.sqrt(10) * x * (x * x - 3 * y * y),
    ]
    return np.sqrt(7 / (64 * np.pi)) * np.stack(rows, -1)


def rotate_harmonics(coefficients: FloatArray, rotations: FloatArray) -> FloatArray:
    """Coefficients of rotated functions on the sphere: ``f'(d) = f(R^T d)``.

    Degrees 1 up to 3 follow one another. *Shape:* ``(P, C, 3)``, ``(P, C, 8)`` or ``(P, C, 15)``.
    """
    rotated = np.empty_like(coefficients)
    for start in range(0, len(coefficients), _ROTATIONS_AT_ONCE):
        rows = slice(start, start + _ROTATIONS_AT_ONCE)
        back = _DIRECTIONS @ rotations[rows]  # rows R^T d
        first = 0
        for degree in range(1, MOST_DEGREE + 1):
            columns = slice(first, first + 2 * degree + 1)
            if columns.stop > coefficients.shape[-1]:
                break
            seen = np.einsum("pdj,pcj->pcd", evaluate_harmonics(back, degree), coefficients[rows, :, columns])
            rotated[rows, :, columns] = seen @ np.linalg.pinv(evaluate_harmonics(_DIRECTIONS, degree)).T
            first = columns.stop
    return rotated
