"""Sculpting with bones: blended cones -> clean closed triangle mesh -> skinned poses.

The shape is the smooth union of the cones in a rest pose. Surface nets give its connectivity; relaxation on
the surface and Delaunay flips make the triangles nearly equilateral. The mesh then follows its bones by dual
quaternions, and keeps its volume.

Symbols: V vertices, F faces, B bones, N points.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.sparse import csr_matrix, diags, eye
from scipy.sparse.linalg import splu
from scipy.spatial.transform import Rotation

Array = NDArray[np.float64]
IntArray = NDArray[np.int64]
Point = tuple[float, float, float]


@dataclass(frozen=True)
class Bone:
    """A joint at ``head``, from which the bone runs to ``tail``; it moves with ``parent``."""

    parent: str | None
    head: Point
    tail: Point


@dataclass(frozen=True)
class Cone:
    """Flesh around a bone: spheres of radius ``ra`` at ``a`` growing or shrinking to ``rb`` at ``b``.

    ``stretch`` scales the cone along x, y and z about ``a``; ``blend`` is the width of its fillet.
    """

    bone: str
    a: Point
    b: Point
    ra: float
    rb: float
    stretch: Point = (1.0, 1.0, 1.0)
    blend: float = 0.05

    def distance(self, points: Array) -> tuple[Array, Array]:
        """Signed distance (a bound if stretched) and radius of the nearest sphere. *Shape:* ``(N,)`` each."""
        axis = (np.array(self.b) - self.a) / self.stretch
        length = np.linalg.norm(axis)
        offset = (points - self.a) / self.stretch
        along = offset @ axis / length
        across = np.sqrt(np.maximum((offset**2).sum(1) - along**2, 0.0))
        # The nearest sphere is not the one at the foot of the perpendicular: the slope of the side shifts it.
        slope = (self.rb - self.ra) / length
        h = np.clip((along + across * slope / np.sqrt(1 - slope**2)) / length, 0.0, 1.0)
        radius = self.ra + h * (self.rb - self.ra)
        return (np.hypot(across, along - h * length) - radius) * min(self.stretch), radius


def signed_distance(cones: list[Cone], points: Array) -> Array:
    """Smooth union of all cones, negative inside. *Shape:* ``(N,)``."""
    total = cones[0].distance(points)[0]
    for cone in cones[1:]:
        d = cone.distance(points)[0]
        overlap = np.maximum(cone.blend - np.abs(total - d), 0.0) / cone.blend
        total = np.minimum(total, d) - overlap**2 * cone.blend / 4
    return total


def _gradient(cones: list[Cone], points: Array, step: float = 1e-4) -> Array:
    shifts = step * np.eye(3)
    return np.stack(
        [signed_distance(cones, points + s) - signed_distance(cones, points - s) for s in shifts], axis=1
    ) / (2 * step)


def _project(cones: list[Cone], points: Array, rounds: int = 2) -> tuple[Array, Array]:
    """Newton steps onto the surface; also the unit normals there."""
    for _ in range(rounds):
        g = _gradient(cones, points)
        points = points - g * (signed_distance(cones, points) / np.maximum((g**2).sum(1), 0.1))[:, None]
    return points, g / np.linalg.norm(g, axis=1, keepdims=True)


def surface_nets(cones: list[Cone], cell: float, shift: float = 0.0) -> tuple[Array, IntArray]:
    """One vertex in each grid cell that the surface crosses, one quad around each grid edge that it cuts.

    Args:
        cones: The shape.
        cell: Edge length of the grid.
        shift: Moves the grid along x and y, in cells.

    Returns:
        Vertices ``(V, 3)`` and quads ``(Q, 4)``, wound outwards.
    """
    reach = [np.array(end) + sign * r * np.array(c.stretch) * 1.5
             for c in cones for end, r in ((c.a, c.ra), (c.b, c.rb)) for sign in (-1, 1)]  # fmt: skip
    # The grid is placed symmetrically about z = 0, so that a mirrored shape gets a mirrored mesh.
    low, high = np.min(reach, axis=0) - 2 * cell, np.max(reach, axis=0) + 2 * cell
    low[:2] += shift * cell
    low[2] = -cell * np.ceil(max(-low[2], high[2]) / cell)
    high[2] = -low[2]
    size = np.round((high - low) / cell).astype(int) + 1
    corners = low + cell * np.stack(np.meshgrid(*map(np.arange, size), indexing="ij"), axis=-1)
    value = signed_distance(cones, corners.reshape(-1, 3)).reshape(size)
    inside = value < 0

    total, count = np.zeros((*(size - 1), 3)), np.zeros(size - 1)
    quads = []
    for axis in range(3):
        lo, hi = [slice(None)] * 3, [slice(None)] * 3
        lo[axis], hi[axis] = slice(None, -1), slice(1, None)
        i, j, k = np.nonzero(inside[tuple(lo)] != inside[tuple(hi)])
        start = np.stack([i, j, k], axis=1)
        end = start + np.eye(3, dtype=int)[axis]
        f0, f1 = value[tuple(start.T)], value[tuple(end.T)]
        crossing = low + cell * (start + (f0 / (f0 - f1))[:, None] * (end - start))
        u, v = np.eye(3, dtype=int)[[(axis + 1) % 3, (axis + 2) % 3]]
        around = np.stack([start, start - u, start - u - v, start - v], axis=1)
        around[f0 > 0] = around[f0 > 0][:, ::-1]
        for cells in around.transpose(1, 0, 2):
            np.add.at(total, tuple(cells.T), crossing)
            np.add.at(count, tuple(cells.T), 1)
        quads.append(np.ravel_multi_index(tuple(around.transpose(2, 0, 1)), tuple(size - 1)))
    used, faces = np.unique(np.concatenate(quads), return_inverse=True)
    vertices = total.reshape(-1, 3)[used] / count.reshape(-1)[used, None]
    return vertices, faces.reshape(-1, 4)


def _split_quads(vertices: Array, quads: IntArray) -> IntArray:
    """Two triangles per quad, along the shorter diagonal."""
    a, b, c, d = quads.T
    along_ac = np.linalg.norm(vertices[a] - vertices[c], axis=1) <= np.linalg.norm(vertices[b] - vertices[d], axis=1)
    first = np.where(along_ac, [a, b, c], [a, b, d]).T
    second = np.where(along_ac, [a, c, d], [b, c, d]).T
    return np.concatenate([first, second])


def corner_angles(vertices: Array, faces: IntArray) -> Array:
    """Angle at each corner in degrees. *Shape:* ``(F, 3)``."""
    p = vertices[faces]
    u, v = np.roll(p, -1, axis=1) - p, np.roll(p, 1, axis=1) - p
    return np.degrees(np.arctan2(np.linalg.norm(np.cross(u, v), axis=-1), (u * v).sum(-1)))


def _delaunay_flips(vertices: Array, faces: IntArray) -> IntArray:
    """One round of flips of edges whose opposite angles sum to more than 180 degrees, each face used once."""
    faces = faces.copy()
    directed = np.concatenate([np.roll(faces, -k, axis=1) for k in range(3)])
    owner = np.tile(np.arange(len(faces)), 3)
    angle = corner_angles(vertices, faces)[:, [2, 0, 1]].T.reshape(-1)  # opposite to each edge
    rows = {(i, j): n for n, (i, j) in enumerate(directed[:, :2].tolist())}
    twin = np.array([rows[j, i] for i, j in directed[:, :2].tolist()])
    excess = angle + angle[twin] - 180
    touched = np.zeros(len(faces), dtype=bool)
    for n in np.argsort(-excess, kind="stable"):
        if excess[n] < 1e-6:
            break
        m = twin[n]
        i, j, k, l = *directed[n], directed[m, 2]  # noqa: E741
        if touched[owner[n]] or touched[owner[m]] or (k, l) in rows or (l, k) in rows:
            continue
        faces[owner[n]], faces[owner[m]] = (k, i, l), (l, j, k)
        touched[[owner[n], owner[m]]] = True
        rows[k, l] = rows[l, k] = -1
    return faces


def _neighbour_mean(vertices: Array, faces: IntArray) -> csr_matrix:
    """Matrix that averages over the neighbours of each vertex, by their areas. *Shape:* ``(V, V)``."""
    i, j = faces.reshape(-1), faces[:, [1, 2, 0]].reshape(-1)
    links = csr_matrix((np.ones(len(i)), (i, j)), shape=(len(vertices),) * 2)
    p = vertices[faces]
    area = np.linalg.norm(np.cross(p[:, 1] - p[:, 0], p[:, 2] - p[:, 0]), axis=1)
    links = ((links + links.T) > 0).astype(float) @ diags(np.bincount(faces.reshape(-1), np.repeat(area, 3)))
    return diags(1 / np.asarray(links.sum(1)).reshape(-1)) @ links


def is_manifold(faces: IntArray) -> bool:
    """Whether every directed edge occurs once and its opposite, too."""
    edges = set(zip(faces.reshape(-1).tolist(), np.roll(faces, -1, axis=1).reshape(-1).tolist(), strict=True))
    return len(edges) == faces.size and all((j, i) in edges for i, j in edges)


def sculpt(cones: list[Cone], cell: float, rounds: int = 60) -> tuple[Array, IntArray]:
    """Closed mesh of the smooth union, triangles of about the size of a grid cell, nearly equilateral.

    Args:
        cones: The shape.
        cell: Edge length of the grid.
        rounds: Rounds of relaxation along the surface.

    Returns:
        Vertices ``(V, 3)`` and faces ``(F, 3)``.

    Raises:
        RuntimeError: If no position of the grid gives a manifold.
    """
    # Where two sheets cross one cell, the vertex that they share is not manifold. It is rare: move the grid.
    for shift in np.arange(0, 1, 0.1):
        vertices, quads = surface_nets(cones, cell, shift)
        if is_manifold(quads):
            break
    else:
        raise RuntimeError(f"No grid of cell size {cell} gives a manifold: limbs too thin or too close for it.")
    faces = _split_quads(vertices, quads)
    for _ in range(rounds):
        vertices, normals = _project(cones, vertices, rounds=1)
        move = _neighbour_mean(vertices, faces) @ vertices - vertices
        vertices = vertices + 0.6 * (move - (move * normals).sum(1, keepdims=True) * normals)
        faces = _delaunay_flips(vertices, faces)
    return _project(cones, vertices)[0], faces


def bind(
    cones: list[Cone], bones: dict[str, Bone], vertices: Array, faces: IntArray, softness: float
) -> tuple[Array, Array]:
    """Skinning weights: each vertex to the bone of its nearest cone, then heat flow along the surface.

    Heat flows over the surface, not through the air, so neighbouring limbs do not pull on each other. It
    flows further where the limb is thick: about ``softness`` radii.

    Returns:
        Weights ``(V, B)``, rows sum to one, and the radius of the limb at each vertex ``(V,)``.
    """
    names = list(bones)
    pairs = [cone.distance(vertices) for cone in cones]
    nearest = np.argmin([d for d, _ in pairs], axis=0)
    radius = np.stack([r for _, r in pairs])[nearest, np.arange(len(vertices))]
    weights = np.eye(len(names))[[names.index(cones[n].bone) for n in nearest]]
    mean = _neighbour_mean(vertices, faces)
    for _ in range(5):  # neighbouring radii must be close, or heat jumps at a bone's end
        radius = mean @ radius
    edge = np.linalg.norm(vertices[faces[:, 0]] - vertices[faces[:, 1]], axis=1).mean()
    steps = 4  # one implicit step leaves exponential tails, several come near a Gaussian
    heat = 2 * (softness * radius / edge) ** 2 / steps  # on a regular mesh, mean - self = edge^2 / 4 * Laplacian
    solver = splu((eye(len(vertices)) + diags(heat) @ (eye(len(vertices)) - mean)).tocsc())
    for _ in range(steps):
        weights = solver.solve(weights)
    return weights, radius


def place_bones(bones: dict[str, Bone], turns: dict[str, Rotation], shift: Array) -> tuple[Array, Array]:
    """Where a pose puts each bone: ``x -> R x + t`` from the rest pose.

    Args:
        bones: Parents before children.
        turns: Rotation of each bone relative to its parent, about its head; none where missing.
        shift: Translation of the root. *Shape:* ``(3,)``.

    Returns:
        Unit quaternions (x, y, z, w) ``(B, 4)``, each on its parent's side, and translations ``(B, 3)``.
    """
    rotation: dict[str, Rotation] = {}
    place: dict[str, Array] = {}
    quaternions: list[Array] = []
    for name, bone in bones.items():
        head, turn = np.array(bone.head), turns.get(name, Rotation.identity())
        if bone.parent is None:
            rotation[name], place[name], side = (
                turn,
                head + shift - turn.apply(head),
                np.array([0, 0, 0, 1.0]),
            )
        else:
            parent = bone.parent
            rotation[name] = rotation[parent] * turn
            joint = rotation[parent].apply(head) + place[parent]
            place[name], side = joint - rotation[name].apply(head), quaternions[list(bones).index(parent)]
        q = rotation[name].as_quat()
        quaternions.append(q if q @ side >= 0 else -q)
    return np.array(quaternions), np.array(list(place.values()))


def skin(vertices: Array, weights: Array, quaternions: Array, translations: Array) -> Array:
    """Dual-quaternion skinning (Kavan et al. 2007): bent and twisted joints do not collapse. ``(V, 3)``."""
    v, w, t = quaternions[:, :3], quaternions[:, 3:], translations
    dual = 0.5 * np.concatenate([w * t + np.cross(t, v), -(t * v).sum(1, keepdims=True)], axis=1)
    real, dual = weights @ quaternions, weights @ dual
    size = np.linalg.norm(real, axis=1, keepdims=True)
    real, dual = real / size, dual / size
    shift = 2 * (real[:, 3:] * dual[:, :3] - dual[:, 3:] * real[:, :3] + np.cross(real[:, :3], dual[:, :3]))
    return Rotation.from_quat(real).apply(vertices) + shift


def restore_volume(vertices: Array, faces: IntArray, volume: float, radius: Array) -> Array:
    """Flesh hardly compresses: add one share of the thickness, so that the volume is right. ``(V, 3)``."""
    for _ in range(4):  # Newton; the volume is cubic in the factor
        p = vertices[faces]
        gradient = np.zeros_like(vertices)
        for k in range(3):
            np.add.at(gradient, faces[:, k], np.cross(p[:, (k + 1) % 3], p[:, (k + 2) % 3]) / 6)
        normals = gradient / np.linalg.norm(gradient, axis=1, keepdims=True)
        missing = volume - (gradient * vertices).sum() / 3
        move = radius[:, None] * normals
        vertices = vertices + missing / (gradient * move).sum() * move
    return vertices
