"""Flat sheets without a thickness, and cylinders that they bend to: in-betweens are known in closed form."""

from collections.abc import Callable

import numpy as np
from matplotlib.path import Path
from scipy.interpolate import CubicSpline
from scipy.spatial import Delaunay, cKDTree

from helpers.bodies import FloatArray, IntArray

Direction = Callable[[FloatArray], FloatArray]

# ------------------------------------------------------------------------------------------------------------- motions


def cylinder(points: FloatArray, time: float, direction: Direction, rulings: float = np.pi / 2) -> FloatArray:
    """A flat sheet in z = 0 bent to a cylinder over the planar curve whose tangent has a given direction.

    Args:
        points: Of the flat sheet. *Shape:* ``(n, 3)``.
        time: By which the directions are multiplied.
        direction: Angles of the tangent at lengths along the curve. *Shape:* ``(m,) -> (m,)``.
        rulings: Angle between the x axis and the lines that stay straight.
    """
    c, s = np.sin(rulings), np.cos(rulings)
    along, across = c * points[:, 0] - s * points[:, 1], s * points[:, 0] + c * points[:, 1]

    def tangent(place: FloatArray) -> FloatArray:
        angle = time * direction(place)
        return np.stack([np.cos(angle), np.sin(angle)], 1)

    grid = np.linspace(along.min(), along.max(), 20_001)
    x, z = CubicSpline(grid, tangent(grid)).antiderivative()(along).T
    return np.stack([c * x + s * across, c * across - s * x, z], 1)


def rolled(place: FloatArray, length: float, turns: float) -> FloatArray:
    """Directions along a circle, which goes round more than once."""
    return 2 * np.pi * turns * place / length


def folded(place: FloatArray, centre: float, width: float, angle: float) -> FloatArray:
    """Directions of two straight parts with a narrow bend between them."""
    u = np.clip((place - centre) / width + 0.5, 0, 1)
    return angle * u**2 * (3 - 2 * u)


# ------------------------------------------------------------------------------------------------------------ patterns


def pattern(outline: FloatArray, spacing: float) -> tuple[FloatArray, IntArray]:
    """An irregular triangulation of a polygon in z = 0, wound counterclockwise.

    Args:
        outline: Its corners, counterclockwise. *Shape:* ``(n, 2)``.
        spacing: About the length of the edges.
    """
    polygon = Path(outline)
    random = np.random.default_rng(0)
    sides = np.roll(outline, -1, 0) - outline
    counts = np.ceil(np.linalg.norm(sides, axis=1) / spacing).astype(int)
    border = np.concatenate(
        [a + side * np.arange(n)[:, None] / n for a, side, n in zip(outline, sides, counts, strict=True)]
    )
    low, high = outline.min(0), outline.max(0)
    x, y = np.meshgrid(np.arange(low[0], high[0], spacing), np.arange(low[1], high[1], spacing * np.sqrt(0.75)))
    x[1::2] += spacing / 2
    grid = np.stack([x.ravel(), y.ravel()], 1)
    grid = grid + random.uniform(-0.3, 0.3, grid.shape) * spacing
    grid = grid[polygon.contains_points(grid) & (cKDTree(border).query(grid)[0] > 0.6 * spacing)]
    points = np.concatenate([border, grid])
    faces = Delaunay(points).simplices.astype(np.int64)
    a, b, c = (points[corner] for corner in faces.T)
    doubled = (b - a)[:, 0] * (c - a)[:, 1] - (b - a)[:, 1] * (c - a)[:, 0]
    faces = np.where((doubled < 0)[:, None], faces[:, ::-1], faces)
    kept = polygon.contains_points((a + b + c) / 3) & (np.abs(doubled) > 1e-3 * spacing**2)
    return np.column_stack([points, np.zeros(len(points))]), faces[kept]


def rectangle(length: float, width: float, spacing: float) -> tuple[FloatArray, IntArray]:
    """A flat sheet from x = 0."""
    return pattern(np.array([[0, 0], [length, 0], [length, width], [0, width]], dtype=float), spacing)
