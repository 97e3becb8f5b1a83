"""Rotations and stretches of triangles, and the resulting sides.

Components come first, ``(3, B, F)``, as in :mod:`~torch_modal.geometry.vectors`. ``B`` stands for any dimensions.
"""

from typing import NamedTuple

import torch
from torch import Tensor

from torch_modal.geometry.rotations import arc, product, rotate_by, turn_of_change
from torch_modal.geometry.vectors import cross, inverse, norm, pick, tiny

# Smallest area relative to the squared sides; below, the normal is rounding, and divisions amplify noise.
FLAT = 1e-6

# Height of an equilateral triangle with a side of 1.
HEIGHT = 0.75**0.5


Sides = tuple[Tensor, Tensor]
"""Two sides of each triangle, from its first corner to the others. *Shape of each:* ``(3, B, F)``."""


class Frames(NamedTuple):
    """A frame on each triangle, and its stretch in the plane of the frame.

    An equilateral triangle with a side of 1, stretched by a symmetric positive definite 2 x 2 matrix, then rotated, is
    the triangle (polar decomposition). Another first corner turns frame and stretch by a third of a turn about the
    normal, in all shapes alike: nothing that is computed from them depends on it.
    """

    e1: Tensor
    """Unit vector in the plane: the rotated first side. *Shape:* ``(3, B, F)``."""
    e2: Tensor
    """Unit vector in the plane, orthogonal to it. *Shape:* ``(3, B, F)``."""
    normal: Tensor
    """Unit normal. *Shape:* ``(3, B, F)``."""
    xx: Tensor
    """Entries of the stretch. *Shape:* ``(B, F)``."""
    xy: Tensor
    yy: Tensor

    def world(self, x: Tensor, y: Tensor) -> Tensor:
        """The vector with coordinates in the plane. *Shape:* ``(B, F), (B, F) -> (3, B, F)``."""
        return x * self.e1 + y * self.e2

    def coordinates(self, v: Tensor) -> Tensor:
        """Coordinates of vectors in the frames. *Shape:* ``(3, B, F) -> (3, B, F)``."""
        return torch.stack([_dot(v, axis) for axis in self[:3]])

    @property
    def size(self) -> Tensor:
        """Mean stretch: the side of an equilateral triangle. *Shape:* ``(B, F)``."""
        return 0.5 * (self.xx + self.yy)

    @property
    def twice_areas(self) -> Tensor:
        """*Shape:* ``(B, F)``."""
        return twice_areas(self.xx, self.xy, self.yy)

    @property
    def slenderness(self) -> Tensor:
        """Altitude over longest side. *Shape:* ``(B, F)``."""
        (a, b), (c, d) = transform(self.xx, self.xy, self.xy, self.yy)
        return self.twice_areas / torch.stack([x * x + y * y for x, y in ((a, b), (c, d), (c - a, d - b))]).amax(0)


def sides(x: Tensor, faces: Tensor) -> Sides:
    """Sides of all triangles. *Shape:* ``(3, B, V), (F, 3)``."""
    origin, first, second = (pick(x, corner) for corner in faces.unbind(1))
    return first - origin, second - origin


def side_frames(x: Tensor, faces: Tensor) -> Tensor:
    """Two sides and the unit normal of each triangle, as columns; the normal is zero where there is no area.

    The product with the inverse of the columns at rest is the deformation gradient, of constant thickness.

    *Shape:* ``(3, B, V), (F, 3) -> (3, 3, B, F)``.
    """
    first, second = sides(x, faces)
    normal = cross(first, second)
    length = norm(normal)
    return torch.stack([first, second, normal * inverse(length, (normal * normal).sum(0) <= 0)], 1)


def frames(triangle_sides: Sides) -> Frames:
    """The frame of each triangle; the normal of one without area is arbitrary and a constant, all is finite."""
    first, second = triangle_sides
    one, other = first, (second - 0.5 * first) / HEIGHT  # the images of orthonormal axes
    xx, xy, yy = _dot(one, one), _dot(one, other), _dot(other, other)
    point, total = xx + yy <= tiny(one), (xx + yy).clamp_min(tiny(one))
    up = cross(one, other) / total
    area = norm(up).clamp_min(FLAT)
    # Derivatives of what is arbitrary have no bound.
    normal = torch.where(area <= FLAT, up.detach(), up) / area
    lift = area * total
    root = (total + 2 * lift).sqrt()
    per = inverse(root, point)
    e1, e2 = per * (one + cross(other, normal)), per * (other + cross(normal, one))
    return Frames(e1, e2, normal, (xx + lift) / root, xy / root, (yy + lift) / root)


def frames_of(shapes: Tensor, faces: Tensor) -> Frames:
    """The frame of each triangle of shapes. *Shape:* ``(B, V, 3), (F, 3)``."""
    return frames(sides(shapes.movedim(-1, 0).contiguous(), faces))


def twice_areas(xx: Tensor, xy: Tensor, yy: Tensor) -> Tensor:
    """Twice the areas of equilateral triangles with a side of 1 after a stretch. *Shape of each:* ``(B, F)``."""
    return HEIGHT * (xx * yy - xy * xy)


def transform(xx: Tensor, xy: Tensor, yx: Tensor, yy: Tensor) -> tuple[tuple[Tensor, Tensor], tuple[Tensor, Tensor]]:
    """Two sides, in their plane, of equilateral triangles after a linear map. *Shape of each:* ``(B, F)``."""
    return (xx, yx), (0.5 * xx + HEIGHT * xy, 0.5 * yx + HEIGHT * yy)


def edge_means(wanted: Sides, weights: Tensor, edges: Tensor, signs: Tensor, n_edges: int) -> Tensor:
    """Edge vectors as weighted means of the sides along them.

    Args:
        wanted: Sides of all triangles.
        weights: Non-negative weights of the sides. *Shape:* ``(3F,)`` or ``(B, 3F)``.
        edges: The ``sides`` of a :class:`~torch_modal.geometry.connectivity.Connectivity`. *Shape:* ``(3F,)``.
        signs: Its ``signs``. *Shape:* ``(3F,)``.
        n_edges: Number of edges, E.

    Returns:
        *Shape:* ``(3, B, E)``.
    """
    first, second = wanted
    around = torch.cat([first, second - first, -second], -1) * (weights * signs)
    summed = around.new_zeros(*around.shape[:-1], n_edges).index_add(-1, edges, around)
    total = weights.new_zeros(*weights.shape[:-1], n_edges).index_add(-1, edges, weights)
    return summed / total.clamp_min(torch.finfo(total.dtype).tiny)


def bend(displaced: Sides, reference: Frames) -> tuple[Tensor, Tensor]:
    """Infinitesimal rotation and strain of a displacement field (Kirchhoff-Love kinematics).

    Args:
        displaced: Sides of the displacement field.
        reference: Frames of the undeformed shape; a batch of one is broadcast.

    Returns:
        Axis times angle, in the coordinates of the shape; entries ``xx, xy, yy`` of the symmetric gradient in the
        triangle's frame. *Shape of each:* ``(3, B, F)``.
    """
    axes = reference[:3]
    first, second = displaced
    one, other = first, (second - 0.5 * first) / HEIGHT
    xx, xy, yy = _inverse(reference)
    x_x, y_x, n_x = (_dot(xx * one + xy * other, axis) for axis in axes)
    x_y, y_y, n_y = (_dot(xy * one + yy * other, axis) for axis in axes)
    spin = 0.5 * (y_x - x_y)
    rotation = n_y * axes[0] - n_x * axes[1] + spin * axes[2]
    return rotation, torch.stack([x_x, 0.5 * (x_y + y_x), y_y])


def stretch(strain: Tensor, xx: Tensor, xy: Tensor, yy: Tensor) -> tuple[tuple[Tensor, Tensor], tuple[Tensor, Tensor]]:
    """Two sides, in their plane, after a stretch and the exponential of a strain. *Shape:* ``(3, B, F), (B, F)``."""
    return transform(*_product(_exponential(*strain), (xx, xy, yy)))


def bend_sides(rotation: Tensor, strain: Tensor, reference: Frames) -> Sides:
    """Sides after a bend: stretched in their plane, then turned by the finite rotation of the same axis and angle.

    The stretch is the exponential of the strain: shear keeps the area, and no triangle inverts.

    Args:
        rotation: Axis times angle, in the coordinates of the shape. *Shape:* ``(3, B, F)``.
        strain: Its entries ``xx, xy, yy`` in the frames. *Shape:* ``(3, B, F)``.
        reference: Frames of the undeformed shape.
    """
    first, second = stretch(strain, *reference[3:])
    return rotate_by(rotation, reference.world(*first)), rotate_by(rotation, reference.world(*second))


def bend_slopes(rotation: Tensor, strain: Tensor, reference: Frames, axes: Tensor) -> Sides:
    """Derivatives of :func:`bend_sides` in the rotation, along three axes, and in the three entries of the strain.

    *Shape:* ``(3, B, F), (3, B, F)`` and, of the axes by column, ``(3, 3, B, F)``; ``(3, 6, B, F)`` of each side.
    """
    with torch.enable_grad():
        # A copy for each of four coordinates: one backward of few numbers.
        copies = strain.detach()[:, None].repeat(1, 4, 1, 1).requires_grad_()
        first, second = stretch(copies, *reference[3:])
        ends = torch.stack([*first, *second])
        slopes = torch.autograd.grad(ends.diagonal().sum(), copies)[0]  # (3, 4, B, F)
    turns = turn_of_change(rotation[:, None], axes)
    e1, e2 = (rotate_by(rotation, axis)[:, None] for axis in reference[:2])
    ends = ends.detach().diagonal().movedim(-1, 0)

    def side(x: Tensor, y: Tensor, to_x: Tensor, to_y: Tensor) -> Tensor:
        return torch.cat([cross(turns, x * e1 + y * e2), e1 * to_x + e2 * to_y], 1)

    return side(ends[0], ends[1], slopes[:, 0], slopes[:, 1]), side(ends[2], ends[3], slopes[:, 2], slopes[:, 3])


def bent_sides(turn: Tensor, strain: Tensor, shape: Frames) -> Sides:
    """Displacements of the sides by infinitesimal turns and strains in the frames, of which :func:`bend` finds them.

    *Shape:* ``(3, B, F), (3, B, F)``.
    """

    def displace(x: Tensor, y: Tensor) -> Tensor:
        plane = shape.world(strain[0] * x + (strain[1] - turn[2]) * y, (strain[1] + turn[2]) * x + strain[2] * y)
        return plane + (turn[0] * y - turn[1] * x) * shape.normal

    first, second = transform(shape.xx, shape.xy, shape.xy, shape.yy)
    return displace(*first), displace(*second)


def bending_between(reference: Frames, other: Frames, quaternions: Tensor) -> tuple[Tensor, Tensor]:
    """Rotation and strain from one shape to another: :func:`bend_sides` of it are the sides of the other.

    Args:
        reference: Frames of the shape that bends.
        other: Frames of the other.
        quaternions: Rotations from the first frames to the others; signs tell the way round. *Shape:* ``(4, B, F)``.
    """
    cos, sin, *entries = _polar(reference, other)
    half = 0.5 * torch.atan2(sin, cos)
    rotation = 2 * arc(product(quaternions, torch.cat([half.cos()[None], half.sin() * reference.normal])))
    return rotation, torch.stack(_logarithm(*entries))


def mirror_sides(centre: Frames, other: Frames) -> Sides:
    r"""Sides of the shape that lies as far beyond ``centre`` as ``other`` lies before it.

    From ``centre`` to ``other`` a triangle turns by ``R`` and stretches by ``U``. The mirror image turns by ``R^T``
    and stretches by :math:`4 (1 + U)^{-2}`, which agrees with :math:`U^{-1}` to first order and stays between 0 and 4.
    """
    cos, sin, u_xx, u_xy, u_yy = _polar(centre, other)
    determinant = (1 + u_xx) * (1 + u_yy) - u_xy**2
    i_xx, i_xy, i_yy = (2 * v / determinant for v in (1 + u_yy, -u_xy, 1 + u_xx))
    g_xx, g_xy, g_yy = i_xx**2 + i_xy**2, i_xy * (i_xx + i_yy), i_xy**2 + i_yy**2

    def turn_back(x: Tensor, y: Tensor) -> Tensor:
        p, q, r = other.coordinates(centre.world(x, y))
        return centre.world(cos * p + sin * q, cos * q - sin * p) + r * centre.normal

    first, second = transform(*_product((g_xx, g_xy, g_yy), centre[3:]))
    return turn_back(*first), turn_back(*second)


def principal_stretches(reference: Frames, other: Frames) -> tuple[Tensor, Tensor]:
    """Least and largest ratio of lengths in each triangle: the singular values of the map of its plane to another's.

    A batch of one reference is broadcast. *Shape of each:* ``(B, F)``.
    """
    xx, xy, yx, yy = _product(other[3:], _inverse(reference))
    total, difference = torch.hypot(xx + yy, yx - xy), torch.hypot(xx - yy, xy + yx)
    return 0.5 * (total - difference), 0.5 * (total + difference)


def _dot(a: Tensor, b: Tensor) -> Tensor:
    """*Shape:* ``(3, B, F), (3, B, F) -> (B, F)``."""
    return (a * b).sum(0)


def _polar(reference: Frames, other: Frames) -> tuple[Tensor, ...]:
    """The map of a triangle's plane to another's: cosine and sine of a rotation after a stretch, by entries."""
    xx, xy, yx, yy = _product(other[3:], _inverse(reference))
    trace = torch.hypot(xx + yy, yx - xy)  # of the stretch; never 0, as both determinants are above 0
    cos, sin = (xx + yy) / trace, (yx - xy) / trace
    return cos, sin, cos * xx + sin * yx, cos * xy + sin * yy, cos * yy - sin * xy


def _inverse(frame: Frames) -> tuple[Tensor, Tensor, Tensor]:
    """The inverse of the stretch, by entries. *Shape of each:* ``(B, F)``."""
    determinant = frame.xx * frame.yy - frame.xy * frame.xy
    return frame.yy / determinant, -frame.xy / determinant, frame.xx / determinant


def _product(a: tuple[Tensor, ...], b: tuple[Tensor, ...]) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """The product of symmetric 2 x 2 matrices, by entries ``xx, xy, yx, yy``. *Shape of each:* ``(B, F)``."""
    (a_xx, a_xy, a_yy), (b_xx, b_xy, b_yy) = a, b
    return a_xx * b_xx + a_xy * b_xy, a_xx * b_xy + a_xy * b_yy, a_xy * b_xx + a_yy * b_xy, a_xy * b_xy + a_yy * b_yy


def _logarithm(xx: Tensor, xy: Tensor, yy: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Matrix logarithm of symmetric positive definite 2 x 2 matrices, by entries."""
    mean, half = 0.5 * (xx + yy), 0.5 * (xx - yy)
    radius = (half**2 + xy**2).clamp_min(tiny(xx)).sqrt()
    even, odd = 0.5 * (mean**2 - radius**2).log(), torch.atanh(radius / mean) / radius
    return even + odd * half, odd * xy, even - odd * half


def _exponential(xx: Tensor, xy: Tensor, yy: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Matrix exponential of symmetric 2 x 2 matrices, by entries."""
    mean, half = 0.5 * (xx + yy), 0.5 * (xx - yy)
    radius = (half**2 + xy**2).clamp_min(tiny(xx)).sqrt()
    scale = mean.exp()
    even, odd = scale * radius.cosh(), scale * radius.sinh() / radius
    return even + odd * half, odd * xy, even - odd * half
