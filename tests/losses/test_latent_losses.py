"""Losses on latent spaces: against dense Hessians and differences, rigid motions, decoders of all kinds."""

from collections.abc import Callable

import pytest
import torch
from conftest import Shapes
from torch import Tensor, nn

import torch_modal as tm
from torch_modal.geometry.rotations import exp

DOUBLE = torch.float64
HALF = torch.float32, torch.float16


class Bending(nn.Module):
    """A key-frame, displacements of a small network, and a rotation by the last latent."""

    def __init__(self, shapes: Shapes, generator: torch.Generator) -> None:
        super().__init__()
        self.x = shapes.keyframes[0]
        first, second = (
            torch.randn(*size, generator=generator, dtype=DOUBLE) for size in ((3, 8), (8, self.x.numel()))
        )
        self.first, self.second = nn.Parameter(first), nn.Parameter(0.05 * second)

    def forward(self, z: Tensor) -> Tensor:
        x = self.x + (torch.tanh(z[:, :3] @ self.first) @ self.second).view(-1, *self.x.shape)
        axis = torch.tensor([0.0, 0.0, 1.0], dtype=DOUBLE)
        return x @ exp(z[:, 3:] * axis).mT + z[:, None, 3:]


@pytest.fixture
def decoder(bars: Shapes, generator: torch.Generator) -> Bending:
    return Bending(bars, generator)


@pytest.fixture
def z(generator: torch.Generator) -> Tensor:
    return 0.3 * torch.randn(2, 4, generator=generator, dtype=DOUBLE)


class TestLatentElasticity:
    @pytest.mark.parametrize("step", [None, 1e-4])
    def test_against_the_dense_hessian(self, bars: Shapes, decoder: Bending, z: Tensor, step: float | None) -> None:
        options = {"alpha": 1.0, "beta": 0.01, "gamma": 0.1}
        shell = tm.losses.ShellLoss(bars.faces, **options)
        roots = tm.losses.LatentElasticity(bars.faces, step=step, **options)(decoder, z)
        for i, own in enumerate(z):
            x = decoder(own[None])[0].detach()
            hessian = torch.func.hessian(lambda y, x=x: shell(y, x))(x).reshape(x.numel(), -1)
            jacobian = torch.func.jacrev(lambda c: decoder(c[None])[0].flatten())(own)
            values = torch.linalg.eigvalsh(0.5 * jacobian.mT @ hessian @ jacobian)
            assert float(values[0]) < 1e-9 * float(values[-1]), "the latent that only moves the shape costs nothing"
            assert float(roots[i]) == pytest.approx(float(values.clamp_min(0).sqrt().mean()), rel=1e-3)

    @pytest.mark.parametrize("step", [None, 1e-2])
    def test_gradients_of_latent_elasticity(
        self, bars: Shapes, decoder: Bending, z: Tensor, step: float | None, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        loss = tm.losses.LatentElasticity(bars.faces, step=step)
        move = torch.sin(torch.arange(z.numel(), dtype=DOUBLE)).view_as(z)
        leaf = z.clone().requires_grad_()
        loss(decoder, leaf).sum().backward()
        assert leaf.grad is not None and decoder.second.grad is not None
        # The Hessian is a constant: differences are those of the Jacobian alone.
        about, gram = decoder(z).detach(), loss._gram
        monkeypatch.setattr(loss, "_gram", lambda _, along: gram(about, along))
        ends = [float(loss(decoder, z + s * move).sum().detach()) for s in (1e-5, -1e-5)]
        assert float((leaf.grad * move).sum()) == pytest.approx((ends[0] - ends[1]) / 2e-5, rel=1e-6)
        assert bool(decoder.second.grad.any())

    def test_nothing_is_gained_by_crumpling(self, bars: Shapes, decoder: Bending, z: Tensor) -> None:
        """Gradients do not reach what a decoder adds to all shapes alike."""
        offset = torch.zeros_like(bars.keyframes[0]).requires_grad_()
        found = tm.losses.LatentElasticity(bars.faces)(lambda own: decoder(own) + offset, z).sum()
        (gradient,) = torch.autograd.grad(found, offset, allow_unused=True)
        assert gradient is None or not bool(gradient.any())

    def test_random_directions_are_orthonormal(self, bars: Shapes, decoder: Bending, z: Tensor) -> None:
        """All of them span the latent: the eigenvalues stay."""
        every = tm.losses.LatentElasticity(bars.faces)
        some = tm.losses.LatentElasticity(bars.faces, directions=3)
        one, again = (some(decoder, z, torch.Generator().manual_seed(0)).detach() for _ in range(2))
        assert torch.equal(one, again) and not torch.equal(one, some(decoder, z).detach())
        q = torch.linalg.qr(torch.randn(4, 4, generator=torch.Generator().manual_seed(1), dtype=DOUBLE))[0]
        rotated = every(lambda w: decoder(w @ q), z @ q.mT)
        torch.testing.assert_close(rotated, every(decoder, z))

    def test_leading_dimensions(self, bars: Shapes, decoder: Bending, z: Tensor) -> None:
        loss = tm.losses.LatentElasticity(bars.faces)
        torch.testing.assert_close(loss(decoder, z[:, None]), loss(decoder, z)[:, None])

    def test_decoders_without_forward_mode(self, bars: Shapes, decoder: Bending, z: Tensor) -> None:
        class Backward(torch.autograd.Function):
            @staticmethod
            def forward(ctx: object, x: Tensor) -> Tensor:
                return x.clone()

            @staticmethod
            def backward(ctx: object, grad: Tensor) -> Tensor:
                return grad

        def own(z: Tensor) -> Tensor:
            return Backward.apply(decoder(z))  # type: ignore[no-any-return]

        with pytest.raises((NotImplementedError, RuntimeError)):
            tm.losses.LatentElasticity(bars.faces)(own, z)
        found = tm.losses.LatentElasticity(bars.faces, step=1e-4)(own, z)
        torch.testing.assert_close(found, tm.losses.LatentElasticity(bars.faces)(decoder, z), rtol=1e-5, atol=0)


def test_decoders_in_half_precision(bars: Shapes) -> None:
    """As under autocast: the shapes, not their energies, are rounded."""
    z, loss = torch.tensor([[0.5]]), tm.losses.LatentElasticity(bars.faces).to(torch.float32)
    whole, half = (loss(lambda z, dtype=dtype: ((1 + z[..., None]) * bars.keyframes[0]).to(dtype), z) for dtype in HALF)
    assert half.dtype == torch.float32
    torch.testing.assert_close(half, whole, rtol=0.01, atol=0)


@pytest.mark.parametrize(
    "call, words",
    [
        (lambda faces, decoder, z: tm.losses.LatentElasticity(faces, directions=0), "1 or more"),
        (lambda faces, decoder, z: tm.losses.LatentElasticity(faces, step=0.0), "above 0"),
        (
            lambda faces, decoder, z: tm.losses.LatentElasticity(faces)(lambda z: decoder(z).flatten(1), z),
            r"decoder's shapes must be floating-point of shape \(2, V, 3\)",
        ),
    ],
)
def test_arguments_that_latent_losses_refuse(
    call: Callable[..., object], words: str, bars: Shapes, decoder: Bending, z: Tensor
) -> None:
    with pytest.raises(ValueError, match=words):
        call(bars.faces, decoder, z)
