"""Whole numbers at the vertices of a mesh, each less what its neighbours tell of it: small numbers, which pack well.

Vertices are taken outwards from a first one, by connectivity alone. Each is predicted by the parallelogram of known
triangles (Touma and Gotsman 1998). It is what PCA's components are packed with in `rates.py`.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

IntArray = NDArray[np.int64]


class Generation(NamedTuple):
    """Vertices that are predicted at the same time."""

    targets: IntArray
    """*Shape:* ``(m,)``."""
    place: IntArray
    """Which of them each row predicts. *Shape:* ``(r,)``."""
    tip: IntArray | None
    """Of known triangles across an edge from the target; None if there are only known neighbours, ``first``."""
    first: IntArray
    """Ends of those edges. *Shape:* ``(r,)``."""
    second: IntArray


def generations(faces: IntArray, n_vertices: int) -> list[Generation]:
    """In which order vertices are predicted, and from what."""
    sides = np.concatenate([faces[:, [0, 1, 2]], faces[:, [1, 2, 0]], faces[:, [2, 0, 1]]])  # ends, and the corner left
    ends, corner = np.sort(sides[:, :2], axis=1), sides[:, 2]
    order = np.lexsort((corner, ends[:, 1], ends[:, 0]))
    ends, corner = ends[order], corner[order]
    same = np.flatnonzero((ends[1:] == ends[:-1]).all(axis=1))
    hinges = np.concatenate(
        [
            np.column_stack([corner[same], ends[same], corner[same + 1]]),
            np.column_stack([corner[same + 1], ends[same], corner[same]]),
        ]
    )
    links = np.concatenate([ends, ends[:, ::-1]])
    known = np.zeros(n_vertices, dtype=bool)
    found: list[Generation] = []
    unknown = 0
    while True:
        hinges = hinges[~known[hinges[:, 3]]]
        ready = hinges[known[hinges[:, :3]].all(axis=1)]
        if len(ready):
            targets, place = np.unique(ready[:, 3], return_inverse=True)
            found.append(Generation(targets, place.reshape(-1), ready[:, 0], ready[:, 1], ready[:, 2]))
        else:
            links = links[~known[links[:, 1]]]
            near = links[known[links[:, 0]]]
            if len(near):
                targets, place = np.unique(near[:, 1], return_inverse=True)
                found.append(Generation(targets, place.reshape(-1), None, near[:, 0], near[:, 0]))
            else:
                rest = np.flatnonzero(~known[unknown:])
                if not len(rest):
                    return found
                unknown += int(rest[0])
                targets = np.array([unknown])
                before = np.array([max(unknown - 1, 0)])
                found.append(Generation(targets, np.zeros(1, dtype=np.int64), None, before, before))
        known[found[-1].targets] = True


def residuals(x: IntArray, plan: list[Generation]) -> IntArray:
    """What is left of whole numbers, in the order of generations. *Shape:* ``(V, 3) -> (V, 3)``."""
    parts = []
    for targets, place, tip, first, second in plan:
        rows = x[first] if tip is None else x[first] + x[second] - x[tip]
        total, count = np.zeros((len(targets), 3), dtype=np.int64), np.zeros(len(targets), dtype=np.int64)
        np.add.at(total, place, rows)
        np.add.at(count, place, 1)
        parts.append(x[targets] - (2 * total + count[:, None]) // (2 * count[:, None]))
    return np.concatenate(parts)
