"""Rotations beyond a full turn."""

import math

import pytest
import torch
from sheets import cylinder as cylinder_of
from sheets import rectangle, rolled
from test_rotations import T, edges, ribbon, rotations_of
from torch import Tensor

from torch_modal.backends.torch.backend import TorchBackend
from torch_modal.backends.warp.rotations import WarpRotations
from torch_modal.geometry.connectivity import Connectivity
from torch_modal.geometry.local_rotations import LocalRotations
from torch_modal.geometry.rigid import best_rotation
from torch_modal.motion.spline import Spline

TURNS = 3


def strip(turns: float, time: float = 1.0) -> Tensor:
    """An irregular strip of 156 vertices, rolled up, and bent a little across, so that no axis is that of another."""
    x = cylinder_of(rectangle(6.0, 1.0, 0.25)[0], time, lambda s: rolled(s, 6.0, turns), math.radians(80))
    return torch.from_numpy(x)


def pair(first: Tensor, second: Tensor, t: Tensor) -> tuple[Tensor, Tensor]:
    """Two shapes of each sample, and their weights."""
    return torch.stack([first, second], 1), torch.stack([1 - t, t], -1)


@pytest.fixture(scope="module")
def mesh() -> Connectivity:
    return Connectivity(rectangle(6.0, 1.0, 0.25)[1])


@pytest.mark.parametrize("turns", [-2.2, 1.2, 3])
def test_plates_turn_at_constant_speed(turns: float) -> None:
    """Up to the rotation of the whole, which no shape depends on."""
    turn = 2 * math.pi * turns
    (x_a, faces), (x_b, _) = ribbon(0.0, 60), ribbon(turn, 60)
    rotations, mesh = rotations_of(x_a, x_b, faces)
    found = rotations(*pair(x_a.expand(len(T), -1, -1), x_b.expand(len(T), -1, -1), T)).movedim(0, -1)
    for t, row in zip(T, found, strict=True):
        wanted = edges(ribbon(float(t) * turn, 60)[0], mesh)
        torch.testing.assert_close(row @ best_rotation(wanted.mT @ row).mT, wanted, rtol=0, atol=1e-11)
    torch.testing.assert_close(found[-1], edges(x_b, mesh), rtol=0, atol=1e-12)


def test_below_a_turn_there_are_none(mesh: Connectivity) -> None:
    assert LocalRotations(mesh, torch.stack([strip(0), strip(1)])).clusters is None
    assert LocalRotations(mesh, torch.stack([strip(0), strip(TURNS)])).clusters is not None


def test_the_pose_of_a_key_frame_does_not_matter(mesh: Connectivity) -> None:
    """Neither for whether there are clusters nor for the shape in between."""
    turn = torch.linalg.qr(torch.randn(3, 3, dtype=torch.float64, generator=torch.Generator().manual_seed(1)))[0]
    turn = turn * torch.linalg.det(turn)
    half = T[2:3]
    lengths = []
    for second in (strip(TURNS), strip(TURNS) @ turn):
        rotations = LocalRotations(mesh, torch.stack([strip(0), second]))
        lengths.append(rotations(*pair(strip(0)[None], second[None], half)).norm(dim=0))
    torch.testing.assert_close(*lengths, rtol=1e-11, atol=0)
    assert LocalRotations(mesh, torch.stack([strip(0), strip(0.9) @ turn])).clusters is None


@pytest.mark.parametrize("kind", [LocalRotations, WarpRotations])
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_a_roll_keeps_its_lengths(mesh: Connectivity, kind: type[LocalRotations], dtype: torch.dtype) -> None:
    """At all times of a batch, as alone; below 2 % at eight edges a turn."""
    rotations = kind(mesh, torch.stack([strip(0), strip(TURNS)])).to(dtype)
    x_a, x_b, t = strip(0).to(dtype), strip(TURNS).to(dtype), T.to(dtype)
    found = rotations(*pair(x_a.expand(4, -1, -1), x_b.expand(4, -1, -1), t))
    assert found.dtype == dtype
    for k, time in enumerate(t):
        wanted = edges(strip(TURNS, float(time)), mesh).norm(dim=-1)
        assert ((found[:, k].norm(dim=0) - wanted).abs() / wanted).mean() < 0.02
        torch.testing.assert_close(rotations(*pair(x_a[None], x_b[None], t[k : k + 1]))[:, 0], found[:, k])
    mapped = torch.vmap(lambda t: rotations(*pair(x_a[None], x_b[None], t[None]))[:, 0], out_dims=1)(t)
    torch.testing.assert_close(mapped, found)


@pytest.mark.parametrize("kind", [LocalRotations, WarpRotations])
def test_gradients(mesh: Connectivity, kind: type[LocalRotations]) -> None:
    """Away from where triangles turn by whole turns exactly, and there."""
    rotations = kind(mesh, torch.stack([strip(0), strip(TURNS)]))
    noise = 0.01 * torch.randn(2, len(strip(0)), 3, dtype=torch.float64, generator=torch.Generator().manual_seed(0))
    x_a, x_b = strip(0) + noise[0], strip(TURNS) + noise[1]
    given = [value.clone().requires_grad_() for value in (x_a[None], x_b[None], T[1:2])]
    assert torch.autograd.gradcheck(lambda *given: rotations(*pair(*given)), given, fast_mode=True)


def test_intervals_of_a_motion_have_clusters_of_their_own(mesh: Connectivity) -> None:
    shapes, times = torch.stack([strip(0), strip(0.5), strip(TURNS)]), torch.arange(3).double()
    for order, wanted in (([0, 1, 2], [False, True]), ([2, 0, 1], [True, False])):
        spline = Spline(mesh, shapes[order], times, None, TorchBackend())
        assert [rotations.clusters is not None for rotations in spline.rotations] == wanted
