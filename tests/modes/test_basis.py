"""ModalBasis: a constant, checked, saved and loaded."""

from pathlib import Path

import pytest
import torch
from safetensors.torch import save_file

from torch_modal.io.tensors import write_tensors
from torch_modal.modes.basis import FORMAT, VERSION, ModalBasis

V, K = 20, 5


@pytest.fixture
def basis() -> ModalBasis:
    generator = torch.Generator().manual_seed(0)
    return ModalBasis(
        reference=torch.randn(V, 3, dtype=torch.float64, generator=generator) * 30 + 200,
        eigenvalues=torch.arange(1.0, K + 1, dtype=torch.float64),
        modes=torch.randn(K, V, 3, dtype=torch.float64, generator=generator),
        rigid_eigenvalues=torch.full((6,), 1e-14, dtype=torch.float64),
    )


def test_is_a_constant_of_the_graph(basis: ModalBasis) -> None:
    tracked = ModalBasis(
        basis.reference.clone().requires_grad_(),
        basis.eigenvalues,
        basis.modes.clone().requires_grad_() * 2,
        basis.rigid_eigenvalues,
    )
    for tensor in (tracked.reference, tracked.eigenvalues, tracked.modes, tracked.rigid_modes):
        assert tensor.requires_grad is False
        assert tensor.grad_fn is None


def test_rigid_modes_are_the_rigid_motions(basis: ModalBasis) -> None:
    rigid = basis.rigid_modes.reshape(6, -1)
    torch.testing.assert_close(rigid @ rigid.T, torch.eye(6, dtype=torch.float64), atol=1e-13, rtol=0)
    axis = torch.tensor([0.3, -1.0, 0.7], dtype=torch.float64)
    motion = (torch.linalg.cross(axis.expand(V, 3), basis.reference) + axis).reshape(-1)
    torch.testing.assert_close(rigid.T @ (rigid @ motion), motion, rtol=1e-12, atol=1e-9)
    # the first three are translations along the axes
    expected = torch.eye(3, dtype=torch.float64)[:, None].expand(3, V, 3) / V**0.5
    torch.testing.assert_close(basis.rigid_modes[:3], expected)


def test_a_basis_is_printed_in_one_line(basis: ModalBasis) -> None:
    assert repr(basis) == "<ModalBasis of 5 modes, 20 vertices>"
    assert (
        repr([basis.truncate(2), basis])
        == "[<ModalBasis of 2 modes, 20 vertices>, <ModalBasis of 5 modes, 20 vertices>]"
    )


def test_a_truncated_basis_has_the_first_modes(basis: ModalBasis) -> None:
    first = basis.truncate(2)
    assert torch.equal(first.modes, basis.modes[:2])
    assert torch.equal(first.eigenvalues, basis.eigenvalues[:2])
    assert first.reference is basis.reference or torch.equal(first.reference, basis.reference)
    with pytest.raises(ValueError, match="6 modes requested from a basis of 5"):
        basis.truncate(6)


def test_a_basis_is_cast_and_moved(basis: ModalBasis) -> None:
    single = basis.to(torch.float32)
    assert {t.dtype for t in (single.reference, single.modes, single.rigid_modes)} == {torch.float32}
    assert basis.modes.dtype == torch.float64
    assert basis.to("meta").modes.device.type == "meta"


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_save_and_load(basis: ModalBasis, tmp_path: Path, dtype: torch.dtype) -> None:
    basis = basis.to(dtype)
    # A truncated basis is a view of the longer one, and must be saved as what it shows.
    basis.truncate(3).save(tmp_path / "b.safetensors")
    loaded = ModalBasis.load(tmp_path / "b.safetensors")
    for name in ("reference", "eigenvalues", "modes", "rigid_eigenvalues"):
        assert torch.equal(getattr(loaded, name), getattr(basis.truncate(3), name))
    assert [p.name for p in tmp_path.iterdir()] == ["b.safetensors"]


def test_load_refuses_what_is_no_basis(basis: ModalBasis, tmp_path: Path) -> None:
    path = tmp_path / "b.safetensors"
    with pytest.raises(FileNotFoundError):
        ModalBasis.load(path)

    basis.save(path)
    path.write_bytes(path.read_bytes()[:-10])
    with pytest.raises(ValueError, match="damaged"):
        ModalBasis.load(path)
    path.write_text("v 0 0 0\nf 1 1 1\n")
    with pytest.raises(ValueError, match="no safetensors file"):
        ModalBasis.load(path)

    tensors = {name: getattr(basis, name) for name in ("reference", "eigenvalues", "modes", "rigid_eigenvalues")}
    save_file(tensors, path, {"format": "pt"})
    with pytest.raises(ValueError, match=r"holds no torch_modal\.basis"):
        ModalBasis.load(path)
    write_tensors(path, FORMAT, "99", tensors)
    with pytest.raises(ValueError, match=rf"of version '{VERSION}', but .*'99'"):
        ModalBasis.load(path)
    write_tensors(path, FORMAT, VERSION, {name: t for name, t in tensors.items() if name != "modes"})
    with pytest.raises(ValueError, match="lacks the tensors modes"):
        ModalBasis.load(path)
    write_tensors(path, FORMAT, VERSION, {**tensors, "modes": tensors["modes"][:, :4]})
    with pytest.raises(ValueError, match="modes \\(k, V, 3\\)"):
        ModalBasis.load(path)


def test_tensors_must_fit(basis: ModalBasis) -> None:
    with pytest.raises(ValueError, match="share one floating-point dtype"):
        ModalBasis(basis.reference.float(), basis.eigenvalues, basis.modes, basis.rigid_eigenvalues)
    with pytest.raises(ValueError, match="got"):
        ModalBasis(basis.reference, basis.eigenvalues[:2], basis.modes, basis.rigid_eigenvalues)
