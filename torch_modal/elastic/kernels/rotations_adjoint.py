"""Adjoints of kernels of rotations and poses, which Warp generates, except for the frame of a triangle.

A kernel that uses ``wp.grad`` must not have ``enable_backward=False``: gradients of nested functions would be lost.
Warp warns of its own adjoint, which is not used.
"""

import warp as wp

from torch_modal.elastic.kernels import procrustes, rotations
from torch_modal.elastic.kernels.rotations import corners, half_rotation, quaternion, to_corners, triangle, work_of
from torch_modal.elastic.kernels.types import HALF, TINIEST, place, real, vec3

mean_pose = wp.kernel(procrustes.mean_pose.func, module=__name__)
trajectory_edges = wp.kernel(rotations.trajectory_edges.func, module=__name__)


@wp.func
def gradients(first: wp.mat33d, second: wp.mat33d, sign: real, w: wp.vec2d, stiffness: vec3, to: wp.mat33d):
    """Gradients of the corners of a triangle in two shapes, and of their weights."""
    a, here = triangle(first)
    b, there = triangle(second)
    q = sign * quaternion(wp.transpose(b) @ a)
    at = wp.matrix_from_rows(a[0], a[1], here, there)
    half = half_rotation(q)
    to_at, to_half, to_w, _stiffness, _to = wp.grad(work_of)(at, half, w, stiffness, to)
    # By hand, as ``wp.grad`` takes the arc twice more.
    axis = vec3(q[1], q[2], q[3])
    square = wp.max(wp.dot(axis, axis), TINIEST)
    scale = wp.where(square > TINIEST, wp.dot(half, axis) / square, real(1.0))
    along = wp.dot(axis, to_half)
    to_axis = scale * to_half + ((q[0] - scale) / square * along) * axis
    # The torque on the rotation, and back in the first shape.
    torque = HALF * (q[0] * to_axis + along * axis + wp.cross(axis, to_axis))
    twice = real(2.0) * wp.cross(torque, axis)
    torque_of_a = wp.cross(a[0], to_at[0]) + wp.cross(a[1], to_at[1]) - torque - q[0] * twice + wp.cross(axis, twice)
    return to_corners(a, here, torque_of_a, to_at[2]), to_corners(b, there, torque, to_at[3]), to_w


@wp.kernel
def right_hand_side(
    faces: wp.array[wp.vec3i], n_vertices: int, shapes: wp.array[vec3], weights: wp.array[wp.vec2d],
    sign: wp.array[real], stiffness: wp.array[vec3], to_right: wp.array[vec3], to_shapes: wp.array[vec3],
    to_weights: wp.array[wp.vec2d], threads: int,
):  # fmt: skip
    """Adjoint of ``rotations.right_hand_side``: adds the gradients of both shapes and the weights."""
    i = wp.tid()
    s = i // threads
    v = 2 * s * n_vertices
    to_w = wp.vec2d()
    for k in range(i - s * threads, faces.shape[0], threads):
        a = corners(faces, shapes, v, k)
        b = corners(faces, shapes, v + n_vertices, k)
        to = corners(faces, to_right, s * n_vertices, k)
        sign_here = sign[place(s * faces.shape[0], k)]
        first, second, to_weights_here = gradients(a, b, sign_here, weights[s], stiffness[place(k, 0)], to)
        to_w += to_weights_here
        for j in range(3):
            f = place(v, faces[place(k, 0)][j])
            wp.atomic_add(to_shapes, f, first[j])
            wp.atomic_add(to_shapes, f + n_vertices, second[j])
    wp.atomic_add(to_weights, s, to_w)
