"""Real spherical harmonics up to degree 3, and their rotation."""

import numpy as np

from torch_modal.arrays import FloatArray

MOST_DEGREE = 3

# Directions from which the harmonics of a degree follow: more than it has, and none of another's opposite.
_DIRECTIONS = np.random.default_rng(0).standard_normal((12, 3))
_DIRECTIONS /= np.linalg.norm(_DIRECTIONS, axis=1, keepdims=True)

# Rotations that are applied at a time.
_CHUNK = 65_536


def harmonics(directions: FloatArray, degree: int) -> FloatArray:
    """The real harmonics of a degree, in the order and with the signs of 3D Gaussian splatting (Kerbl et al. 2023).

    Args:
        directions: Unit vectors. *Shape:* ``(..., 3)``.
        degree: 1, 2 or 3.

    Returns:
        *Shape:* ``(..., 2 degree + 1)``.
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


def rotated(coefficients: FloatArray, rotations: FloatArray) -> FloatArray:
    """Coefficients of functions on the sphere that turn: ``f'(d) = f(R^T d)``.

    Args:
        coefficients: Of degrees 1 up to 3, one after the other. *Shape:* ``(P, C, 3)``, ``(P, C, 8)`` or
            ``(P, C, 15)``.
        rotations: *Shape:* ``(P, 3, 3)``.
    """
    found = np.empty_like(coefficients)
    for start in range(0, len(coefficients), _CHUNK):
        part = slice(start, start + _CHUNK)
        back = _DIRECTIONS @ rotations[part]  # rows R^T d
        first = 0
        for degree in range(1, MOST_DEGREE + 1):
            own = slice(first, first + 2 * degree + 1)
            if own.stop > coefficients.shape[-1]:
                break
            seen = np.einsum("pdj,pcj->pcd", harmonics(back, degree), coefficients[part, :, own])
            found[part, :, own] = seen @ np.linalg.pinv(harmonics(_DIRECTIONS, degree)).T
            first = own.stop
    return found
