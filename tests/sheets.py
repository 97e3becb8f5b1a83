"""Sheets without a thickness, and how they move: flat patterns in closed form, so that in-betweens are known.

All but the shirt are developable: they keep all lengths on the surface, and the tangents turn by angles that grow
evenly with time. The shirt is open and two-sided; its sleeves turn about the shoulders, which stretches a few edges by
up to a sixth. Of more, an in-between that minimises Eq. 5 has other lengths than the mean.
"""

from collections.abc import Callable
from functools import cache, partial

import numpy as np
from bodies import Body, FloatArray, IntArray, bend
from scipy.interpolate import CubicHermiteSpline
from scipy.sparse import coo_matrix
from scipy.sparse.linalg import spsolve
from scipy.spatial import Delaunay, cKDTree

from torch_modal.geometry.connectivity import Connectivity, half_cotangents

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
    middle = (grid[1:] + grid[:-1]) / 2
    slopes = tangent(grid)
    steps = (grid[1] - grid[0]) * (slopes[:-1] + 4 * tangent(middle) + slopes[1:]) / 6
    x, z = CubicHermiteSpline(grid, np.concatenate([np.zeros((1, 2)), np.cumsum(steps, 0)]), slopes)(along).T
    return np.stack([c * x + s * across, c * across - s * x, z], 1)


def rolled(place: FloatArray, length: float, turns: float) -> FloatArray:
    """Directions along a circle, which goes round more than once."""
    return 2 * np.pi * turns * place / length


def folded(place: FloatArray, centre: float, width: float, angle: float) -> FloatArray:
    """Directions of two straight parts with a narrow bend between them."""
    u = np.clip((place - centre) / width + 0.5, 0, 1)
    return angle * u**2 * (3 - 2 * u)


def waving(place: FloatArray, length: float, amplitude: float, waves: float) -> FloatArray:
    """Directions along waves that grow from the start."""
    u = place / length
    return amplitude * u * np.sin(2 * np.pi * waves * u)


def curled(place: FloatArray, crease: float, width: float, curl: float) -> FloatArray:
    """Directions across a midrib at 0, on both sides of which a leaf rises and curls."""
    return crease * np.tanh(place / width) + curl * place


def raised(points: FloatArray, time: float, angle: float) -> FloatArray:
    """Both sleeves of the shirt turned upwards about the shoulders."""
    side = np.where(points[:, 0] < 0, -1.0, 1.0)
    right = np.stack([np.abs(points[:, 0]), points[:, 1] - SLEEVE, points[:, 2]], 1)
    moved = bend(right, time, angle, SHOULDER, CUFF) + np.array([0, SLEEVE, 0])
    return np.stack([side * moved[:, 0], moved[:, 1], moved[:, 2]], 1)


def put_together(points: FloatArray, time: float, angle: float) -> FloatArray:
    """Both sleeves of the flat shirt folded over its front."""
    side = np.where(points[:, 0] < 0, -1.0, 1.0)
    right = np.stack([np.abs(points[:, 0]), points[:, 1], points[:, 2]], 1)
    moved = cylinder(right, time, partial(folded, centre=SHOULDER, width=0.2, angle=angle))
    return np.stack([side * moved[:, 0], moved[:, 1], moved[:, 2]], 1)


# ------------------------------------------------------------------------------------------------------------ patterns


def pattern(outline: FloatArray, spacing: float) -> tuple[FloatArray, IntArray]:
    """An irregular triangulation of a polygon in z = 0, wound counterclockwise.

    Args:
        outline: Its corners, counterclockwise. *Shape:* ``(n, 2)``.
        spacing: About the length of the edges.
    """
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
    grid = grid[_inside(grid, outline) & (cKDTree(border).query(grid)[0] > 0.6 * spacing)]
    points = np.concatenate([border, grid])
    faces = Delaunay(points).simplices.astype(np.int64)
    a, b, c = (points[corner] for corner in faces.T)
    doubled = (b - a)[:, 0] * (c - a)[:, 1] - (b - a)[:, 1] * (c - a)[:, 0]
    faces = np.where((doubled < 0)[:, None], faces[:, ::-1], faces)
    kept = _inside((a + b + c) / 3, outline) & (np.abs(doubled) > 1e-3 * spacing**2)
    return np.column_stack([points, np.zeros(len(points))]), faces[kept]


def _inside(points: FloatArray, outline: FloatArray) -> np.ndarray:
    """Whether points lie in a polygon: rays to the right cross its sides an odd number of times. *Shape:* ``(n,)``."""
    (ax, ay), (bx, by) = outline.T[:, :, None], np.roll(outline, -1, 0).T[:, :, None]
    x, y = points.T
    with np.errstate(divide="ignore", invalid="ignore"):
        crossed = ((ay > y) != (by > y)) & (x < ax + (y - ay) * (bx - ax) / (by - ay))
    inside: np.ndarray = crossed.sum(0) % 2 == 1
    return inside


def rectangle(length: float, width: float, spacing: float) -> tuple[FloatArray, IntArray]:
    """A flat sheet from x = 0."""
    return pattern(np.array([[0, 0], [length, 0], [length, width], [0, width]], dtype=float), spacing)


def _leaf() -> tuple[FloatArray, IntArray]:
    """A blade of two halves along x, and a narrow stem."""
    x = np.linspace(0, 1, 60)[1:-1]
    upper = np.stack([2 * x, 0.03 + 0.55 * np.sin(np.pi * x**0.8) * (1 - 0.3 * x)], 1)
    half = np.concatenate([[[-0.9, 0.03], [0, 0.03]], upper])
    outline = np.concatenate([half * [1, -1], [[2.02, 0]], half[::-1]])
    return pattern(outline, 0.033)


def _shirt(thickness: float) -> tuple[FloatArray, IntArray]:
    """A front and a back, sewn together but for the neck, the hem and the cuffs, and blown up a little."""
    right = [(0.16, 1.3), (SHOULDER, 1.22), (CUFF, 1.22), (CUFF, 0.86), (SHOULDER, 0.86), (SHOULDER, 0)]
    outline = np.array(right + [(-x, y) for x, y in right[::-1]], dtype=float)[::-1]
    flat, faces = pattern(outline, 0.046)
    mesh = Connectivity(faces, len(flat))
    x, y = np.abs(flat[:, 0]), flat[:, 1]
    cuffs, hem, neck = (x == CUFF) & (y < 1.22) & (y > 0.86), (y == 0) & (x < SHOULDER), (y == 1.3) & (x < 0.16)
    seam = np.zeros(len(flat), dtype=bool)
    seam[np.unique(mesh.boundary_edges)] = True
    seam &= ~(cuffs | hem | neck)
    # As high as the root of what solves Laplace u = -1: round across, and shut along the seams.
    weights = half_cotangents(flat, mesh)
    i, j = mesh.start, mesh.end
    stiffness = coo_matrix((np.tile(-weights, 2), (np.append(i, j), np.append(j, i))), shape=[len(flat)] * 2).tocsr()
    stiffness.setdiag(-np.asarray(stiffness.sum(1)).ravel())
    free = np.flatnonzero(~seam)
    height = np.zeros(len(flat))
    height[free] = spsolve(stiffness[free][:, free].tocsc(), np.full(len(free), 1.0))
    height = thickness / 2 * np.sqrt(height / height.max())
    index = np.arange(len(flat))
    index[free] = len(flat) + np.arange(len(free))
    front, back = flat + height[:, None] * [0, 0, 1], (flat - height[:, None] * [0, 0, 1])[free]
    return np.concatenate([front, back]), np.concatenate([faces, index[faces][:, ::-1]])


STRIP, PAGE, FLAG = (6.0, 1.0), (1.4, 1.0), (1.5, 1.0)
SHOULDER, CUFF, SLEEVE = 0.5, 1.3, 1.04

_strip = partial(rectangle, *STRIP, 0.055)

SHEETS: dict[str, tuple[Callable[[], tuple[FloatArray, IntArray]], Callable[[FloatArray, float], FloatArray]]] = {
    "strip rolled once": (_strip, partial(cylinder, direction=partial(rolled, length=STRIP[0], turns=1))),
    "strip rolled 3 times": (_strip, partial(cylinder, direction=partial(rolled, length=STRIP[0], turns=3))),
    "page folded 170": (
        partial(rectangle, *PAGE, 0.024),
        partial(cylinder, direction=partial(folded, centre=0.7, width=0.14, angle=np.radians(170))),
    ),
    "flag": (
        partial(rectangle, *FLAG, 0.028),
        partial(cylinder, direction=partial(waving, length=1.5, amplitude=1.3, waves=2.5), rulings=np.radians(75)),
    ),
    "leaf": (_leaf, partial(cylinder, direction=partial(curled, crease=0.4, width=0.05, curl=3.0), rulings=0.0)),
    "shirt": (partial(_shirt, 0.4), partial(raised, angle=np.radians(40))),
    "flat shirt folded": (partial(_shirt, 0.0), partial(put_together, angle=np.radians(120))),
}
"""Their flat shapes, and how they move."""


@cache
def sheet(name: str) -> Body:
    """One of ``SHEETS``, of 1,000 to 5,000 vertices; flat at rest, but for the shirt."""
    make, motion = SHEETS[name]
    rest, faces = make()
    for array in (rest, faces):
        array.setflags(write=False)
    return Body(rest, faces, motion)
