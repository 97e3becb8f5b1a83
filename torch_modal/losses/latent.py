"""Elastic energy of small steps in the latent space of a decoder."""

from collections.abc import Callable
from typing import Any

import torch
from torch import Tensor, nn

from torch_modal.autograd import full_precision
from torch_modal.elastic.energy import EnergyAt
from torch_modal.keyframes.arrays import check_tensor
from torch_modal.losses.shell import ShellLoss

Decoder = Callable[[Tensor], Tensor]

# Added to eigenvalues below the root, as a part of their mean: the slope of a root is infinite at zero.
FLOOR = 1e-6


class LatentElasticity(nn.Module):
    r"""Shell energy of a small step of the latent: small where latents move shapes as bodies move.

    With the Jacobian ``J`` of the decoder and the Hessian ``H`` of :class:`ShellLoss` about the decoded shape, a step
    ``u`` costs :math:`u^T G u` with :math:`G = \tfrac12 J^T H J`. Its eigenvalues are zero where the latent only turns
    or shifts the shape. The loss is the mean of their square roots, as in ARAPReg (Huang et al. 2021), which takes
    the Hessian of an as-rigid-as-possible energy. ``H`` is the Gauss-Newton Hessian, and is never assembled.

    Args:
        faces: Vertex indices. *Shape:* ``(F, 3)``.
        directions: Number of random orthonormal directions of the latent at each call; all by default. Each costs about
            two passes of the decoder.
        step: Size of the steps in the latent by which the Jacobian is taken in central differences. None: by forward
            mode, exact, for decoders whose operations have it.
        stiffness: ``alpha``, ``beta`` and ``gamma`` of :class:`ShellLoss`.

    Raises:
        ValueError: An argument is out of range.
    """

    def __init__(
        self,
        faces: Tensor,
        directions: int | None = None,
        *,
        step: float | None = None,
        **stiffness: float | Tensor,
    ) -> None:
        super().__init__()
        if directions is not None and directions < 1:
            raise ValueError(f"directions is 1 or more, or None for all; got {directions}")
        if step is not None and not 0 < step < torch.inf:
            raise ValueError(f"step is above 0, or None for forward mode; got {step}")
        self.shell = ShellLoss(faces, **stiffness)
        self.directions, self.step = directions, step

    def forward(self, decoder: Decoder, z: Tensor, generator: torch.Generator | None = None) -> Tensor:
        """The loss at each latent; gradients reach the latents and the parameters of the decoder, through ``J``.

        ``H`` is a constant of the graph: otherwise a decoder would learn to crumple shapes, with long edges across the
        direction of motion.

        Args:
            decoder: Maps latents ``(B, n)`` to shapes ``(B, V, 3)``, each for itself: no normalisation over the batch.
            z: *Shape:* ``(..., n)``.
            generator: Source of random directions.

        Returns:
            *Shape:* ``(...)``.

        Raises:
            ValueError: The decoder has another shape.
            NotImplementedError: An operation of the decoder has no forward mode, and ``step`` is None; of a function of
                the user's own, a RuntimeError.
        """
        flat = z.reshape(-1, z.shape[-1])
        x, along = self._tangents(decoder, flat, generator)
        gram = self._gram(x.detach(), along)
        values = torch.linalg.eigvalsh(gram).clamp_min(0)
        floor = FLOOR * values.mean(-1, keepdim=True) + torch.finfo(values.dtype).tiny
        return (values + floor).sqrt().mean(-1).reshape(z.shape[:-1])

    def _tangents(self, decoder: Decoder, z: Tensor, generator: torch.Generator | None) -> tuple[Tensor, list[Tensor]]:
        """Decoded shapes, and their derivatives along directions of the latent. *Shape of each:* ``(B, V, 3)``."""
        n = z.shape[-1]
        directions = torch.eye(n).to(z)
        if self.directions is not None and self.directions < n:
            device = z.device if generator is None else generator.device
            drawn = torch.randn(n, self.directions, generator=generator, device=device, dtype=torch.float64)
            directions = torch.linalg.qr(drawn)[0].mT.to(z)
        steps = [row.expand_as(z) for row in directions]
        if self.step is not None:
            both = [(decoder(z + self.step * row), decoder(z - self.step * row)) for row in steps]
            x, tangents = decoder(z), [(up - down) / (2 * self.step) for up, down in both]
        else:
            pairs: list[Any] = [torch.func.jvp(decoder, (z,), (row,)) for row in steps]
            x, tangents = pairs[0][0], [tangent for _, tangent in pairs]
        check_tensor("the decoder's shapes", x, len(z), "V", 3)
        return x.to(torch.promote_types(x.dtype, torch.float32)), tangents  # of an autocast decoder

    @full_precision
    def _gram(self, x: Tensor, along: list[Tensor]) -> Tensor:
        """Products of displacements in the Hessian about shapes. *Shape:* ``(B, k, k)``."""
        energy, scale = self.shell.energy, self.shell.scale(x)
        reference = self.shell.reference_of(scale * x)
        at = EnergyAt(energy, self.shell._rows(scale * x), reference)
        fields = [self.shell._rows(scale * field) for field in along]
        gram = x.new_zeros(len(x), len(along), len(along))
        for summand, one, record in zip(energy.parts, at.terms, reference.records, strict=True):
            rates = [summand.along(one, field)[1] for field in fields]
            scaled = torch.stack(rates, 1) * record[:, :1].sqrt()  # (B, k, M)
            gram = gram + scaled @ scaled.mT
        return gram
