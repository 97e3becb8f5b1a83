"""Exponential and logarithm of rotations against matrix functions, SciPy and kornia, and where zero divides zero."""

import math
from collections.abc import Callable

import numpy as np
import pytest
import torch
from conftest import random_rotation
from kornia.geometry.liegroup import So3
from scipy.spatial.transform import Rotation
from torch import Tensor
from torch.autograd import gradcheck, gradgradcheck

from torch_modal.geometry.rotations import HALF_TURN_SIDE, SMALL, exp, log, mean, quaternion, rotate, rotate_by

F64 = torch.float64
BORDER = 2 * math.sqrt(SMALL)  # the angle at which series and closed forms meet
ANGLES = [0.0, 1e-160, 1e-9, 1e-3, 0.999 * BORDER, 1.001 * BORDER, 0.5, 3.0, math.pi - 1e-6]


def turns(angle: float, n: int = 20) -> Tensor:
    """About random axes. *Shape:* ``(n, 3)``."""
    axes = torch.randn(n, 3, dtype=F64, generator=torch.Generator().manual_seed(0))
    return angle * axes / axes.norm(dim=1, keepdim=True)


def skew(w: Tensor) -> Tensor:
    x, y, z = w.unbind(-1)
    zero = torch.zeros_like(x)
    return torch.stack([zero, -z, y, z, zero, -x, -y, x, zero], -1).unflatten(-1, (3, 3))


def part_of(q: Tensor, t: Tensor) -> Tensor:
    """Rotations by a part of the angle, as a mean with none. *Shape:* ``(4, ...), (...) -> (4, ...)``."""
    none = torch.cat([torch.ones_like(q[:1]), torch.zeros_like(q[1:])])
    return mean(torch.stack([none, q], -1)[..., None], torch.stack([1 - t, t], -1)[..., None]).squeeze(-1)


def through_quaternions(w: Tensor) -> Tensor:
    """All functions one after the other: half of a turn, twice."""
    half = part_of(quaternion(exp(w).movedim((-2, -1), (0, 1))), w.new_full(w.shape[:-1], 0.5))
    rows = w.movedim(-1, 0)
    return rotate_by(rows, rotate(half, rotate(half, torch.ones_like(rows)))).movedim(0, -1)


# ----------------------------------------------------------------------------------------------------------- values
@pytest.mark.parametrize("angle", [*ANGLES, math.pi, 6.0, 20.0])
def test_exp_is_the_matrix_exponential(angle: float) -> None:
    w = turns(angle)
    torch.testing.assert_close(exp(w), torch.linalg.matrix_exp(skew(w)), rtol=0, atol=1e-13)
    np.testing.assert_allclose(exp(w), Rotation.from_rotvec(w.numpy()).as_matrix(), atol=1e-13)
    torch.testing.assert_close(exp(w), So3.exp(w).matrix().detach(), rtol=0, atol=1e-5)  # kornia 0.8: 1e-6


@pytest.mark.parametrize("angle", ANGLES)
def test_log_is_its_inverse(angle: float) -> None:
    w = turns(angle)
    torch.testing.assert_close(log(exp(w)), w, rtol=1e-13, atol=0)


@pytest.mark.parametrize("angle", [3.3, 6.0, 20.0, 2 * math.pi])
def test_log_takes_the_shortest_way(angle: float) -> None:
    rotation = exp(turns(angle))
    np.testing.assert_allclose(log(rotation), Rotation.from_matrix(rotation.numpy()).as_rotvec(), atol=1e-12)
    assert float(log(rotation).norm(dim=1).max()) <= math.pi + 1e-12


@pytest.mark.parametrize("axis", [[1, 0, 0], [0, 1, 0], [0, 0, 1], [1, -1, 0], [0, -1, 1], [1, -2, 0.5], [-1, -1, -1]])
@pytest.mark.parametrize("off", [0.0, 1e-16, -1e-15])
def test_half_a_turn_has_one_sense(axis: list[float], off: float) -> None:
    """Whatever its rounding, and whichever sense it was made of."""
    side = sum(a * b for a, b in zip(axis, HALF_TURN_SIDE, strict=True))
    w = torch.tensor(axis, dtype=F64) * math.copysign(math.pi, side) / math.hypot(*axis)
    for sense in (1, -1):
        found = log(exp(sense * (1 + off) * w))
        torch.testing.assert_close(found, w, rtol=0, atol=1e-13)


def test_parts_go_the_way_that_the_sign_says(generator: torch.Generator) -> None:
    w, t = torch.tensor([0.6, -0.8, 0.0], dtype=F64), torch.linspace(0, 1, 5, dtype=F64)
    for angle in (0.0, 1e-9, 1.0, 3.2, 5.0, 6.28):
        half = 0.5 * angle
        q = torch.cat([torch.tensor([math.cos(half)], dtype=F64), math.sin(half) * w])[:, None].expand(4, 5)
        v = torch.randn(3, 1, dtype=F64, generator=generator).expand(3, 5)
        truth = (exp(angle * t[:, None] * w) @ v.T[..., None]).squeeze(-1).T
        torch.testing.assert_close(rotate(part_of(q, t), v), truth, rtol=0, atol=1e-12)
        torch.testing.assert_close(rotate_by(angle * t * w[:, None], v), truth, rtol=0, atol=1e-12)


def test_cardinality_and_dtype(generator: torch.Generator) -> None:
    w = torch.randn(2, 5, 3, generator=generator)
    assert exp(w).shape == (2, 5, 3, 3) and log(exp(w)).shape == (2, 5, 3)
    assert exp(w).dtype == log(exp(w)).dtype == torch.float32
    torch.testing.assert_close(exp(w).double(), exp(w.double()), rtol=0, atol=1e-6)
    torch.testing.assert_close(exp(w)[1, 3], exp(w[1, 3]))
    torch.testing.assert_close(log(exp(w))[1, 3], log(exp(w[1, 3])))
    assert quaternion(exp(w).movedim((-2, -1), (0, 1))).shape == (4, 2, 5)
    for angle in ANGLES[:-1]:
        single = turns(angle).float()
        torch.testing.assert_close(log(exp(single)), single, rtol=0, atol=1e-5)


def test_quaternions_of_all_rotations(generator: torch.Generator) -> None:
    rotations = torch.stack([random_rotation(generator) for _ in range(50)])
    q = quaternion(rotations.movedim((-2, -1), (0, 1)))
    theirs = torch.from_numpy(Rotation.from_matrix(rotations.numpy()).as_quat()).roll(1, -1).T
    torch.testing.assert_close(q * (q * theirs).sum(0).sign(), theirs, rtol=0, atol=1e-14)


# ------------------------------------------------------------------------------------------------------ derivatives
@pytest.mark.parametrize("angle", [*ANGLES[:-1], math.pi - 1e-3, math.pi, math.pi + 1e-3])
@pytest.mark.parametrize("function", [exp, lambda w: log(exp(w)), through_quaternions], ids=["exp", "log", "all"])
def test_exp_and_log_have_both_derivatives(function: Callable[[Tensor], Tensor], angle: float) -> None:
    start = turns(angle, 3)
    if angle == math.pi:  # away from the cut: on one side of it, differences do not cross it
        start = (1 - 1e-5) * start
    assert gradcheck(function, start.requires_grad_())
    assert gradgradcheck(function, start)


# ------------------------------------------------------------------------------------------------------- transforms
