"""The poses of two shapes: :func:`torch_modal.geometry.procrustes.mean_pose`."""

import warp as wp

from torch_modal.elastic.kernels.elements import real, vec4
from torch_modal.elastic.kernels.rotations import about, first_axis, half_turn, quaternion_of, second_axis


@wp.func
def best_rotation(covariance: wp.mat33d):
    """rigid.best_rotation."""
    largest = real(0.0)
    for i in range(3):
        for j in range(3):
            largest = wp.max(largest, wp.abs(covariance[i, j]))
    if largest > real(0.0):
        covariance = covariance / largest
    u, _, v = wp.svd3(covariance)  # both of determinant one, and the singular value of least size may be negative
    return u @ wp.transpose(v)


@wp.func
def matrix_of(q: vec4):
    x = first_axis(q)
    y = second_axis(q)
    return wp.matrix_from_cols(x, y, wp.cross(x, y))


@wp.func
def half_of(rotation: wp.mat33d):
    """Axis times half the angle, which is at most a right angle."""
    q = quaternion_of(rotation)
    if q[0] < real(0.0):
        q = -q
    return half_turn(q)


@wp.kernel(enable_backward=False)
def mean_pose(
    to_reference: wp.array(dtype=wp.mat33d),
    among: wp.array(dtype=wp.mat33d),
    weights: wp.array(dtype=wp.vec2d),
    turns: wp.array(dtype=wp.mat33d),
    pose: wp.array(dtype=wp.mat33d),
):
    """procrustes.mean_pose of two shapes."""
    s = wp.tid()
    w = weights[s]
    onto = best_rotation(among[4 * s + 1])
    back = wp.transpose(onto)
    first = best_rotation(w[0] * to_reference[2 * s] + w[1] * to_reference[2 * s + 1] @ back)
    turns[2 * s] = first
    turns[2 * s + 1] = first @ onto
    pose[s] = matrix_of(about(w[1] * half_of(back))) @ wp.transpose(first)
