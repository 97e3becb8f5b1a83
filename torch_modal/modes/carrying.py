"""Deformation of the tetrahedra of one key-frame to other poses, so that each set is meshed once."""

from dataclasses import replace

import numpy as np
import scipy.sparse as sp

from torch_modal.arrays import AnyArray, FloatArray, IntArray
from torch_modal.geometry.sparse import factorize
from torch_modal.geometry.surface import Surface
from torch_modal.modes.solid import Solid
from torch_modal.modes.stiffness import dirichlet_matrix, hat_gradients
from torch_modal.modes.tetrahedra import solid_volumes, tet_volumes

FIT_WEIGHT = 1e4
"""Weight of the surface term relative to the deformation energy; both are dimensionless."""
LOCAL_GLOBAL_STEPS = 5
"""Local-global steps after the first solve; the energy has then nearly converged."""
MAX_FIT_RMS = 5e-3
MAX_FIT = 0.1
"""Largest root mean square and maximum distances from the key-frame, in bounding-box diagonals."""
SINGULAR = 1e-3
"""Determinant over the cubed norm, below which a matrix counts as singular; a rotation has 0.19."""
MOST_POLAR_STEPS = 20
MAX_INVERTED = 0.04
"""Largest fraction of inverted tetrahedra. Up to 2.5 % change neither modes nor mid-shapes."""


class Carrier:
    """As-rigid-as-possible deformation of the tetrahedra of one key-frame to other poses.

    The embedded surface is pulled to its positions in the other pose. All steps and all key-frames share one system
    matrix, which is factorised here.

    Raises:
        RuntimeError: The matrix is singular, for example if no surface point is embedded in a piece.
        LinAlgError: A tetrahedron is degenerate.
    """

    def __init__(self, solid: Solid) -> None:
        tetrahedra, points = solid.tetrahedra, solid.surface.vertices
        self.solid, self.weights = solid, solid.weights()
        self.gradients, self.volumes = hat_gradients(tetrahedra), solid_volumes(tetrahedra)
        extent = float(np.linalg.norm(np.ptp(points, axis=0)))
        areas, self.area = solid.surface.vertex_areas, solid.surface.area
        # |W x - p|² is a mean over the surface, per diagonal squared; the other term a mean over the volume.
        self.pull = sp.diags(FIT_WEIGHT * self.volumes.sum() / extent**2 * areas / self.area) @ self.weights
        laplacian = dirichlet_matrix(tetrahedra, self.gradients).tocsc()
        self.factors = factorize(laplacian + self.weights.T @ self.pull)

    def carry(self, surface: Surface) -> Solid | None:
        """The solid in the pose of another key-frame.

        Returns:
            None if its tetrahedra are too bad for modes: far from the surface, or many of them inverted.

        Raises:
            LinAlgError: The result is not finite.
        """
        rest, faces = self.solid.tetrahedra, self.solid.surface.faces
        areas = surface.vertex_areas
        # The diagonal, the unit of length here, depends on the pose; the area hardly does.
        scale = np.sqrt(surface.area / self.area)
        target = surface.vertices / scale
        turns = vertex_rotations(self.solid.surface.vertices, target, faces)
        # Harmonic extension of the surface rotations to the volume.
        field = self.factors.solve(self.pull.T @ turns.reshape(-1, 9)).reshape(-1, 3, 3)
        gradients = field[rest.tets].mean(axis=1)
        corners, n = rest.tets.reshape(-1), len(rest.vertices)
        for _ in range(LOCAL_GLOBAL_STEPS + 1):
            # Minimises sum_t vol_t |∇x - R_t|² with the surface pulled to the target.
            rotations = nearest_rotations(gradients)
            forces = np.einsum("t,tij,taj->tai", self.volumes, rotations, self.gradients).reshape(-1, 3)
            summed = np.stack([np.bincount(corners, force, minlength=n) for force in forces.T], axis=1)
            vertices = self.factors.solve(summed + self.pull.T @ target)
            gradients = np.einsum("tai,taj->tij", vertices[rest.tets], self.gradients)

        distance = np.linalg.norm(self.weights @ vertices - target, axis=1) / np.linalg.norm(np.ptp(target, axis=0))
        inverted = (tet_volumes(rest._replace(vertices=vertices)) <= 0).mean()
        fits = np.sqrt(np.average(distance**2, weights=areas)) <= MAX_FIT_RMS and distance.max() <= MAX_FIT
        if not fits or inverted > MAX_INVERTED:
            return None
        return replace(
            self.solid, surface=surface, tetrahedra=rest._replace(vertices=vertices * scale), meshed=self.solid
        )


def vertex_rotations(before: FloatArray, after: FloatArray, faces: IntArray) -> FloatArray:
    """Rotation of the surface around each vertex from one pose to another.

    It is the nearest to the mean of the faces' rotations by area. *Shape:* ``(U, 3), (U, 3), (F, 3) -> (U, 3, 3)``.
    """
    frames = []
    for x in (after, before):
        one, two = (x[faces[:, corner]] - x[faces[:, 0]] for corner in (1, 2))
        normal = np.cross(one, two)
        area = np.linalg.norm(normal, axis=1)
        # Scaled like the edges, so that the gradient does not depend on the size of the face.
        frames.append(np.stack([one, two, normal / np.maximum(np.sqrt(area), 1e-300)[:, None]], axis=2))
    posed, rest = frames
    usable = area > 1e-12 * area.max()
    gradients = np.zeros((len(faces), 3, 3))
    gradients[usable] = posed[usable] @ np.linalg.inv(rest[usable])
    weighted = np.repeat(nearest_rotations(gradients) * area[:, None, None], 3, axis=0).reshape(-1, 9)
    summed = [np.bincount(faces.reshape(-1), column, minlength=len(before)) for column in weighted.T]
    return nearest_rotations(np.stack(summed, axis=1).reshape(-1, 3, 3))


def nearest_rotations(matrices: AnyArray) -> FloatArray:
    """The rotations nearest to matrices. *Shape:* ``(·, 3, 3) -> (·, 3, 3)``.

    The orthogonal factor of the polar decomposition by Newton's iteration ``X <- (s X + X^-T / s) / 2``, scaled by
    ``s = det(X)^(-1/3)`` (Higham 1986), in a third of the time of a singular value decomposition. The latter serves
    mirrored and singular matrices.
    """
    sound = np.linalg.det(matrices) > SINGULAR * np.linalg.norm(matrices, axis=(1, 2)) ** 3
    u, _, vt = np.linalg.svd(matrices[~sound])
    u[:, :, 2] *= np.sign(np.linalg.det(u @ vt))[:, None]
    x = np.ascontiguousarray(np.moveaxis(matrices[sound], 0, -1))
    for _ in range(MOST_POLAR_STEPS):
        cofactors = np.stack([np.cross(x[i - 2], x[i - 1], axis=0) for i in range(3)])  # det(X) X^-T
        determinant = (x[0] * cofactors[0]).sum(axis=0)
        scale = np.cbrt(determinant)
        previous, x = x, 0.5 * (x / scale + cofactors * (scale / determinant))
        if np.abs(x - previous).max(initial=0.0) < 1e-14:
            break
    rotations = np.empty((len(matrices), 3, 3))
    rotations[~sound], rotations[sound] = u @ vt, np.moveaxis(x, -1, 0)
    return rotations
