"""Volumes, areas, and the gradients of volumes."""

import warp as wp

from torch_modal.elastic import formulas
from torch_modal.elastic.bind import for_kernels
from torch_modal.elastic.kernels.types import place, real, vec3

SIXTH = wp.constant(real(formulas.SIXTH))
triangle_area = for_kernels(formulas.triangle_area)


@wp.kernel(enable_backward=False)
def sizes(
    faces: wp.array[wp.vec3i], n_vertices: int, x: wp.array[vec3], result: wp.array[vec3],
    normal: wp.array[vec3], n_areas: int, threads: int,
):  # fmt: skip
    """The volume, and the area of the first faces, of each shape in the second of two; and the volume's gradient.

    Volumes lie between the faces and a vertex, the centre of an extended shape. The faces around a vertex close, so
    that each gives a sixth of its normal to its corners.
    """
    i = wp.tid()
    s = i // threads
    v = s * n_vertices
    middle = x[place(v, faces[faces.shape[0] - 1][2])]
    inside = real(0.0)
    surface = real(0.0)
    for k in range(i - s * threads, faces.shape[0], threads):
        face = faces[place(k, 0)]
        p = x[place(v, face[0])]
        q = x[place(v, face[1])] - p
        r = x[place(v, face[2])] - p
        to_corner = SIXTH * wp.cross(q, r)
        inside += wp.dot(p - middle, to_corner)
        if normal:
            for j in range(3):
                wp.atomic_add(normal, place(v, face[j]), to_corner)
        if k < n_areas:
            surface += triangle_area(q, r)
    wp.atomic_add(result, 2 * s + 1, vec3(inside, surface, real(0.0)))
