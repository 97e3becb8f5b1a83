"""Vertex normals by hand; the same for tensors and arrays."""

import numpy as np
import pytest
import torch
from torch import Tensor

from torch_modal.geometry.vectors import vertex_normals

F64 = torch.float64
CORNER = torch.tensor([[0.0, 0, 0], [1, 0, 0], [0, 1, 0], [0, 0, -3], [5, 5, 5]], dtype=F64)
FACES = torch.tensor([[0, 1, 2], [0, 1, 3]])


@pytest.fixture
def shape(capsule: tuple[np.ndarray, np.ndarray]) -> tuple[Tensor, Tensor]:
    return torch.tensor(capsule[0]), torch.tensor(capsule[1])


def test_are_means_by_area() -> None:
    found = vertex_normals(CORNER, FACES)
    expected = torch.tensor([0.0, 3.0, 1.0], dtype=F64) / 10**0.5
    torch.testing.assert_close(found[:2], expected.expand(2, 3))
    assert found[2:].tolist() == [[0, 0, 1], [0, 1, 0], [0, 0, 0]]  # the last belongs to no face


def test_cardinality_and_types(shape: tuple[Tensor, Tensor]) -> None:
    x, faces = shape
    batch = torch.stack([x, 2 * x, x + 1]).reshape(3, 1, -1, 3)
    found = vertex_normals(batch, faces)
    torch.testing.assert_close(found, vertex_normals(x, faces).expand(3, 1, -1, 3))
    single = vertex_normals(x.float(), faces)
    assert single.dtype == torch.float32
    torch.testing.assert_close(single.double(), found[0, 0], rtol=0, atol=1e-5)
    array, triangles = x.numpy(), faces.numpy().astype(np.int32)
    array.flags.writeable = False
    of_arrays = vertex_normals(array, triangles)
    assert isinstance(of_arrays, np.ndarray)
    np.testing.assert_array_equal(of_arrays, vertex_normals(x, faces))


@pytest.mark.parametrize(("dtype", "scales"), [(F64, (1e-60, 1e60)), (torch.float32, (1e-8, 1e8))])
def test_size_does_not_matter(shape: tuple[Tensor, Tensor], dtype: torch.dtype, scales: tuple[float, ...]) -> None:
    x, faces = shape
    truth = vertex_normals(x, faces).to(dtype)
    for scale in scales:
        found = vertex_normals((scale * (x - x.mean(0))).to(dtype), faces)
        torch.testing.assert_close(found, truth, rtol=0, atol=1e-4 if dtype == torch.float32 else 1e-12)


def test_faces_that_cancel_or_have_no_area_give_zero() -> None:
    assert vertex_normals(CORNER, torch.tensor([[0, 1, 2], [0, 2, 1]])).eq(0).all()
    assert vertex_normals(CORNER, torch.tensor([[0, 1, 1]])).eq(0).all()


def test_derivatives_and_transforms(shape: tuple[Tensor, Tensor]) -> None:
    x = CORNER.clone().requires_grad_()
    assert torch.autograd.gradcheck(lambda x: vertex_normals(x, FACES), [x])
    assert torch.autograd.gradgradcheck(lambda x: vertex_normals(x, FACES), [x])
    y, faces = shape
    batch = torch.stack([y, 2 * y + y.sin()])
    mapped = torch.func.vmap(lambda y: vertex_normals(y, faces))(batch)
    torch.testing.assert_close(mapped, vertex_normals(batch, faces))
