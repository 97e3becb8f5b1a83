"""A step of BFGS of each sample: :func:`torch_modal.elastic.minimise.bfgs_update` in one pass."""

import warp as wp

from torch_modal.elastic.kernels.types import HALF, place, real


@wp.kernel(enable_backward=False)
def update(
    n: int, value: wp.array[real], slope: wp.array[real], slack: real, shortest: real, a: wp.array[real],
    there: wp.array[real], energy: wp.array[real], gradient: wp.array[real], norm: wp.array[real],
    inverse: wp.array[real], length: wp.array[real], goal: wp.array[real], rounding: wp.array[real],
    n_steps: wp.array[wp.int64], pushed: wp.array[real],
):  # fmt: skip
    """Take a step or not, with the inverse after it; then go to where the next one leads."""
    s = wp.tid()
    v = s * n
    square = real(0.0)
    for i in range(n):
        square += slope[place(v, i)] * slope[place(v, i)]
    size_of_slope = wp.sqrt(square)
    bound = energy[s] * slack
    if size_of_slope < norm[s]:
        bound += rounding[s] * wp.sqrt(wp.max(energy[s], real(0.0)))
    if length[s] > real(0.0) and value[s] <= bound:
        curvature = real(0.0)
        form = real(0.0)
        for i in range(n):
            pushed[place(v, i)] = real(0.0)
        for j in range(n):
            change = slope[place(v, j)] - gradient[place(v, j)]
            curvature += change * (there[place(v, j)] - a[place(v, j)])
            row = (v + j) * n
            for i in range(n):
                pushed[place(v, i)] = pushed[place(v, i)] + change * inverse[place(row, i)]
        for i in range(n):
            form += (slope[place(v, i)] - gradient[place(v, i)]) * pushed[place(v, i)]
        share = real(0.0)
        if curvature > real(0.0):
            share = real(1.0) / curvature
        half = HALF * (share * form + real(1.0))
        for i in range(n):
            gradient[place(v, i)] = slope[place(v, i)]
            slope[place(v, i)] = there[place(v, i)] - a[place(v, i)]  # from here on the move
            a[place(v, i)] = there[place(v, i)]
            pushed[place(v, i)] = pushed[place(v, i)] - half * slope[place(v, i)]
        for j in range(n):
            row = (v + j) * n
            scaled = share * slope[place(v, j)]
            other = share * pushed[place(v, j)]
            for i in range(n):
                at = place(row, i)
                inverse[at] = inverse[at] - (scaled * pushed[place(v, i)] + other * slope[place(v, i)])
        energy[s] = value[s]
        norm[s] = size_of_slope
        n_steps[s] = n_steps[s] + wp.int64(1)
        length[s] = real(1.0)
        if size_of_slope <= goal[s]:
            length[s] = real(0.0)
    elif length[s] > shortest:
        length[s] = HALF * length[s]
    else:
        length[s] = real(0.0)
    for i in range(n):
        there[place(v, i)] = a[place(v, i)]
    for j in range(n):
        pull = length[s] * gradient[place(v, j)]
        row = (v + j) * n
        for i in range(n):
            there[place(v, i)] = there[place(v, i)] - pull * inverse[place(row, i)]
