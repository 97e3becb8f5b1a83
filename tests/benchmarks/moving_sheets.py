"""Sheets that roll, fold, wave and curl: motions in closed form, so that in-betweens are known.

All but the shirt are developable: they keep all lengths on the surface, and the tangents turn by angles that grow
evenly with time. The shirt is open and two-sided; its sleeves turn about the shoulders, which stretches a few edges by
up to a sixth. Of more, an in-between that minimises Eq. 5 has other lengths than the mean.
"""

from collections.abc import Callable
from functools import cache, partial

import numpy as np
from helpers.bodies import Body, FloatArray, IntArray, bend
from helpers.sheets import cylinder, folded, pattern, rectangle, rolled
from scipy.sparse import coo_matrix
from scipy.sparse.linalg import spsolve

from torch_modal.geometry.connectivity import Connectivity, half_cotangents

# ------------------------------------------------------------------------------------------------------------- motions


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
