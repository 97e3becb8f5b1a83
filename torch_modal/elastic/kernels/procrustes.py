"""Best rotations, and the poses of two shapes: :func:`torch_modal.geometry.procrustes.mean_pose`."""

import warp as wp

from torch_modal.elastic.kernels.rotations import about, half_rotation, quaternion
from torch_modal.elastic.kernels.types import HALF, TINIEST, real, vec3

EPSILON = wp.constant(real(64 * 2.0**-52))


@wp.func
def best_rotation(covariance: wp.mat33d):
    """rigid.best_rotation. Both factors have determinant one, and the least singular value may be negative."""
    largest = real(0.0)
    for i in range(3):
        largest = wp.max(largest, wp.max(wp.abs(covariance[i])))
    u, _, v = wp.svd3(covariance / wp.where(largest > real(0.0), largest, real(1.0)))
    return u @ wp.transpose(v)


@wp.func_grad(best_rotation)
def to_covariance(covariance: wp.mat33d, to_rotation: wp.mat33d):
    """By Newton's step from the solution, which has a floor, as there: singular values may be equal."""
    rotation = best_rotation(covariance)
    p = covariance @ wp.transpose(rotation)
    trace = wp.trace(p)
    floor = wp.where(wp.abs(trace) > TINIEST, EPSILON * wp.abs(trace), real(1.0))
    hessian = (trace + floor) * wp.identity(n=3, dtype=real) - HALF * (p + wp.transpose(p))
    m = to_rotation @ wp.transpose(rotation)
    torque = vec3(m[2, 1] - m[1, 2], m[0, 2] - m[2, 0], m[1, 0] - m[0, 1])
    wp.adjoint[covariance] += wp.skew(wp.inverse(hessian) @ torque) @ rotation


@wp.kernel(enable_backward=False)
def best_rotations(covariances: wp.array[wp.mat33d], rotations: wp.array[wp.mat33d]):
    """rigid.best_rotation of each."""
    m = wp.tid()
    rotations[m] = best_rotation(covariances[m])


@wp.kernel(enable_backward=False)
def mean_pose(
    to_reference: wp.array[wp.mat33d], among: wp.array[wp.mat33d], weights: wp.array[wp.vec2d],
    rotations: wp.array[wp.mat33d], pose: wp.array[wp.mat33d],
):  # fmt: skip
    """procrustes.mean_pose of two shapes."""
    s = wp.tid()
    w = weights[s]
    onto = best_rotation(among[4 * s + 1])
    back = wp.transpose(onto)
    first = best_rotation(w[0] * to_reference[2 * s] + w[1] * to_reference[2 * s + 1] @ back)
    rotations[2 * s] = first
    rotations[2 * s + 1] = first @ onto
    q = quaternion(back)
    half = half_rotation(wp.where(q[0] < real(0.0), -q, q))
    pose[s] = wp.quat_to_matrix(about(w[1] * half)) @ wp.transpose(first)
