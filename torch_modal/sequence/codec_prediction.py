"""Whole numbers at the vertices of a mesh, each less what its neighbours tell of it: small numbers, which pack well.

Vertices are taken outwards from a first one, by connectivity alone. Each is predicted from triangles whose corners are
known: by the parallelogram (Touma and Gotsman 1998), or, where a shape of the same mesh is known, from how the vertex
lies against the triangle there. Sums of whole numbers are exact everywhere; the second kind rounds only what was added,
multiplied, divided or rooted one number at a time, which is the same on all machines.
"""

from typing import Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray

IntArray = NDArray[np.int64]
FloatArray = NDArray[np.float64]
Way = Literal["parallelogram", "turned", "moved"]
WAYS: tuple[Way, ...] = ("parallelogram", "turned", "moved")


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


def residuals(x: IntArray, plan: list[Generation], way: Way, guide: IntArray | None) -> IntArray:
    """What is left of whole numbers, in the order of generations. *Shape:* ``(V, 3) -> (V, 3)``."""
    done = np.zeros_like(x)
    parts = []
    for generation in plan:
        parts.append(x[generation.targets] - _predicted(done, generation, way, guide))
        done[generation.targets] = x[generation.targets]
    return np.concatenate(parts)


def restored(left: IntArray, plan: list[Generation], way: Way, guide: IntArray | None) -> IntArray:
    """The inverse of :func:`residuals`."""
    x = np.zeros_like(left)
    start = 0
    for generation in plan:
        end = start + len(generation.targets)
        x[generation.targets] = left[start:end] + _predicted(x, generation, way, guide)
        start = end
    return x


def _predicted(x: IntArray, generation: Generation, way: Way, guide: IntArray | None) -> IntArray:
    targets, place, tip, first, second = generation
    if way == "parallelogram" or guide is None:
        rows = x[first] if tip is None else x[first] + x[second] - x[tip]
        return _mean(rows, place, len(targets))
    mine = targets[place]
    if tip is None or way == "moved":
        rows = x[first] + x[second] - guide[first] - guide[second] + 2 * guide[mine]
        return _mean(rows, place, len(targets), 2)
    before, now = (_frame(y, tip, first, second) for y in (guide, x))
    apart = guide[mine] - 0.5 * (guide[first] + guide[second])
    turned = sum((_dot(apart, old))[:, None] * new for old, new in zip(before, now, strict=True))
    rows = np.floor(16 * (0.5 * (x[first] + x[second]) + turned) + 0.5).astype(np.int64)
    return _mean(rows, place, len(targets), 16)


def _frame(x: IntArray, tip: IntArray, first: IntArray, second: IntArray) -> tuple[FloatArray, FloatArray, FloatArray]:
    along = (x[second] - x[first]).astype(np.float64)
    e1 = along / np.maximum(np.sqrt(_dot(along, along)), 1e-300)[:, None]
    away = (x[tip] - x[first]).astype(np.float64)
    away = away - _dot(away, e1)[:, None] * e1
    e2 = away / np.maximum(np.sqrt(_dot(away, away)), 1e-300)[:, None]
    return e1, e2, np.cross(e1, e2)


def _dot(a: FloatArray, b: FloatArray) -> FloatArray:
    """One number at a time, so that no order of sums is left to a library."""
    return a[:, 0] * b[:, 0] + a[:, 1] * b[:, 1] + a[:, 2] * b[:, 2]


def _mean(rows: IntArray, place: IntArray, n: int, per: int = 1) -> IntArray:
    """Rounded means of rows, each of which counts ``per`` times too much. *Shape:* ``(r, 3) -> (n, 3)``."""
    total, count = np.zeros((n, 3), dtype=np.int64), np.zeros(n, dtype=np.int64)
    np.add.at(total, place, rows)
    np.add.at(count, place, per)
    return (2 * total + count[:, None]) // (2 * count[:, None])
