"""Rigid motions against known ones, against SciPy's, and against their own laws."""

import numpy as np
import pytest
import torch
import trimesh
from conftest import random_rotation
from scipy.spatial.transform import Rotation
from torch import Tensor
from torch.autograd import gradcheck, gradgradcheck

import torch_modal as tm
from torch_modal.geometry.rigid import best_fit, best_rotation, centroid, volumes_of
from torch_modal.geometry.rotations import exp

EYE = torch.eye(3, dtype=torch.float64)


@pytest.fixture
def cloud(generator: torch.Generator) -> Tensor:
    return torch.randn(40, 3, dtype=torch.float64, generator=generator) * torch.tensor([3.0, 2.0, 1.0]) + 5


@pytest.fixture
def weights(generator: torch.Generator) -> Tensor:
    return torch.rand(40, dtype=torch.float64, generator=generator) + 0.1


def about(axis: list[float], angle: float) -> Tensor:
    """Rotation matrix, by SciPy."""
    unit = np.array(axis) / np.linalg.norm(axis)
    return torch.from_numpy(Rotation.from_rotvec(angle * unit).as_matrix())


# ------------------------------------------------------------------------------------------------ the best fit


@pytest.mark.parametrize("angle", [0.0, 1e-9, 0.7, 3.1, np.pi])
def test_recovers_a_known_motion(cloud: Tensor, weights: Tensor, angle: float) -> None:
    rotation, move = about([1, -2, 0.5], angle), torch.tensor([10.0, -20.0, 30.0], dtype=torch.float64)
    moved = cloud @ rotation.mT + move
    fit = best_fit(cloud, moved, weights)
    torch.testing.assert_close(fit.rotation, rotation, atol=1e-13, rtol=0)
    torch.testing.assert_close(fit.apply(cloud), moved, atol=1e-12, rtol=0)
    torch.testing.assert_close(fit.inverse().apply(moved), cloud, atol=1e-12, rtol=0)


def test_aligned_shapes_broadcast_and_have_gradients(
    cloud: Tensor, weights: Tensor, generator: torch.Generator
) -> None:
    turns = torch.stack([random_rotation(generator) for _ in range(6)]).view(2, 3, 3, 3)
    moved = cloud @ turns.mT + torch.randn(2, 3, 1, 3, dtype=torch.float64, generator=generator)
    torch.testing.assert_close(tm.align(moved, cloud), cloud.expand_as(moved))
    torch.testing.assert_close(tm.align(cloud, moved), moved)
    spoilt = moved.clone()
    spoilt[..., :5, :] += 3
    torch.testing.assert_close(tm.align(cloud, spoilt, torch.arange(40) >= 5), moved)
    noisy = moved[0] + torch.randn(3, 40, 3, dtype=torch.float64, generator=generator)
    small = (cloud[::8].clone().requires_grad_(), noisy[:, ::8].clone().requires_grad_())
    assert gradcheck(lambda x, y: tm.align(x, y, weights[::8]), small) and gradgradcheck(tm.align, small)
    for x, y, one in (
        (cloud, cloud[1:], None),
        (cloud[:, :2], cloud[:, :2], None),
        (cloud.float(), cloud, None),
        (cloud, cloud, weights[1:]),
    ):
        with pytest.raises(ValueError, match=r"must (be|have shape) \("):
            tm.align(x, y, one)


@pytest.mark.parametrize("noise", [0.01, 1.0, 30.0])
def test_agrees_with_scipy_on_noise(cloud: Tensor, weights: Tensor, generator: torch.Generator, noise: float) -> None:
    moved = cloud @ random_rotation(generator).mT
    moved = moved + noise * torch.randn(cloud.shape, dtype=torch.float64, generator=generator)
    fit = best_fit(cloud, moved, weights)
    mean = [np.average(x.numpy(), axis=0, weights=weights.numpy()) for x in (cloud, moved)]
    truth, _ = Rotation.align_vectors(moved.numpy() - mean[1], cloud.numpy() - mean[0], weights.numpy())
    np.testing.assert_allclose(fit.rotation.numpy(), truth.as_matrix(), atol=1e-10)
    np.testing.assert_allclose(fit.target.numpy(), mean[1], rtol=1e-13)


def test_never_a_reflection(cloud: Tensor, weights: Tensor) -> None:
    mirrored = cloud * torch.tensor([1.0, 1.0, -1.0])
    flat = cloud * torch.tensor([1.0, 1.0, 0.0])
    for x, y in ((cloud, mirrored), (mirrored, cloud), (flat, flat @ about([1, 1, 0], 2.0).mT), (cloud, -cloud)):
        rotation = best_fit(x, y, weights).rotation
        assert float(torch.linalg.det(rotation)) == pytest.approx(1, abs=1e-12)
        torch.testing.assert_close(rotation @ rotation.mT, EYE, atol=1e-12, rtol=0)
    # A flat shape has both fits; the one without a reflection carries it exactly.
    turned = flat @ about([1, 1, 0], 2.0).mT
    torch.testing.assert_close(best_fit(flat, turned, weights).apply(flat), turned, atol=1e-12, rtol=0)


def test_cardinality_and_weights(cloud: Tensor, weights: Tensor, generator: torch.Generator) -> None:
    many = torch.randn(2, 3, 40, 3, dtype=torch.float64, generator=generator)
    fit = best_fit(many, cloud, weights)
    assert fit.rotation.shape == (2, 3, 3, 3)
    one = best_fit(many[1, 2], cloud, weights)
    torch.testing.assert_close(fit.rotation[1, 2], one.rotation, atol=1e-13, rtol=0)
    torch.testing.assert_close(fit.apply(many)[1, 2], one.apply(many[1, 2]), atol=1e-12, rtol=0)
    # A vertex of no weight has no say.
    weights[0] = 0
    before = best_fit(cloud, many[0, 0], weights)
    cloud[0] += 100
    torch.testing.assert_close(best_fit(cloud, many[0, 0], weights).rotation, before.rotation)
    torch.testing.assert_close(centroid(cloud, weights), (weights[1:, None] * cloud[1:]).sum(0) / weights[1:].sum())


# ------------------------------------------------------------------------------------------------- derivatives


def covariances() -> dict[str, Tensor]:
    turn = about([0.3, 1.0, -0.4], 1.1)
    diagonal = {
        "generic": [3.0, 2.0, 0.5],
        "two equal": [2.0, 2.0, 0.7],
        "sphere": [1.5, 1.5, 1.5],
        "flat": [2.0, 1.0, 0.0],
        "mirrored": [3.0, 2.0, -0.5],
    }
    matrices = {name: turn @ torch.diag(torch.tensor(d, dtype=torch.float64)) for name, d in diagonal.items()}
    return {"unturned sphere": 2.0 * EYE, **matrices}


@pytest.mark.parametrize("name", covariances())
def test_gradcheck_best_rotation(name: str) -> None:
    covariance = covariances()[name].clone().requires_grad_()
    assert gradcheck(best_rotation, (covariance,), atol=1e-7)
    assert gradgradcheck(best_rotation, (covariance,), atol=1e-6)


DEGENERATE = {
    "plane": [2, 1, 0],
    "nearly a plane": [2, 1, 1e-9],
    "line": [2, 0, 0],
    "nearly a line": [2, 1e-7, 1e-9],
    "point": [0, 0, 0],
    "mirrored": [3, 2, -0.5],
    "mirrored, two alike": [3, 2, -2],
    "mirrored, two nearly alike": [3, 2, -1.999999],
    "turned inside out": [1, 1, -1],
    "tiny": [3e-150, 2e-150, 1e-150],
    "huge": [3e150, 2e150, 1e150],
}


@pytest.mark.parametrize("name", DEGENERATE)
@pytest.mark.parametrize("tracked", [False, True])
def test_best_rotation_of_degenerate_shapes(name: str, tracked: bool, generator: torch.Generator) -> None:
    """One of the best, where there are many; a rotation always, with finite gradients."""
    values = torch.tensor(DEGENERATE[name], dtype=torch.float64)
    before, after = (exp(2 * torch.randn(100, 3, dtype=torch.float64, generator=generator)) for _ in range(2))
    covariance = (before * values @ after.mT).requires_grad_(tracked)
    with torch.set_grad_enabled(tracked):
        rotation = best_rotation(covariance)
    torch.testing.assert_close(rotation @ rotation.mT, EYE.expand(100, 3, 3), atol=1e-13, rtol=0)
    torch.testing.assert_close(torch.linalg.det(rotation), torch.ones(100, dtype=torch.float64))
    size = float(values.abs().max()) or 1.0
    reached = (rotation * (covariance / size)).sum((-2, -1))
    torch.testing.assert_close(reached, (values.sum() / size).expand(100), atol=1e-13, rtol=0)
    if tracked:
        (gradient,) = torch.autograd.grad((rotation * before).sum(), covariance)
        assert gradient.isfinite().all()


def test_derivative_at_a_sphere_by_hand() -> None:
    # R^T A stays symmetric: at A = c I, R = I + W with 2 c W = dA - dA^T.
    change = torch.tensor([[0.3, -1.0, 2.0], [0.5, 0.1, -0.7], [0.0, 4.0, 1.0]], dtype=torch.float64)
    _, derivative = torch.autograd.functional.jvp(best_rotation, 2.5 * EYE, change)
    torch.testing.assert_close(derivative, (change - change.mT) / 5, atol=1e-12, rtol=0)


def test_gradcheck_best_fit_of_symmetric_shape() -> None:
    cube = torch.cartesian_prod(*[torch.tensor([-1.0, 1.0], dtype=torch.float64)] * 3).requires_grad_()
    turned = (cube.detach() @ about([1, 2, 3], 0.8).mT + 2).requires_grad_()
    weights = torch.ones(8, dtype=torch.float64)
    assert gradcheck(lambda x, y: best_fit(x, y, weights).apply(x), (cube, turned), atol=1e-7)


def test_signed_volumes_of_ellipsoids_and_their_mirror_images() -> None:
    mesh = trimesh.creation.icosphere(2)
    x, faces = torch.from_numpy(mesh.vertices).double(), torch.from_numpy(mesh.faces)
    scales = torch.tensor([[1.0, 2, 3], [1, -2, 3], [2, 2, 0]], dtype=torch.float64)
    shapes = (x * scales[:, None]) @ about([1, 2, 3], 0.7).mT + torch.tensor([1.0, 2, 3])
    expected = mesh.volume * scales.prod(1)
    torch.testing.assert_close(volumes_of(shapes[None], faces), expected[None], rtol=1e-12, atol=1e-12)
