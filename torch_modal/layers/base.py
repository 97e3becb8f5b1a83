"""The common part of all layers of in-betweens: bases, settings, the solver, and the border."""

from collections.abc import Callable, Sequence
from typing import Any

import torch
from torch import Tensor, nn

from torch_modal.autograd import full_precision, lasting, outlasting, require_numbers
from torch_modal.contact.in_between import ContactSolver
from torch_modal.energy.term import Mesh
from torch_modal.energy.volume import Volume, encloses
from torch_modal.geometry.canonical import own_order
from torch_modal.inbetween.results import InBetweenResult, Samples
from torch_modal.inbetween.settings import Settings
from torch_modal.inbetween.solver import InBetweenSolver
from torch_modal.keyframes.arrays import as_faces
from torch_modal.keyframes.check import checked_surface
from torch_modal.modes.basis import ModalBasis


class BasisBuffers(nn.Module):
    """The buffers that a layer keeps of a basis; all else follows from them.

    Args:
        reference: *Shape:* ``(V, 3)``.
        modes: *Shape:* ``(k, V, 3)``.
    """

    reference: Tensor
    modes: Tensor

    def __init__(self, reference: Tensor, modes: Tensor) -> None:
        super().__init__()
        # Copies: what is loaded into a layer must not reach the basis that it was made from.
        self.register_buffer("reference", reference.detach().to(torch.float64, copy=True))
        self.register_buffer("modes", modes.detach().to(torch.float64, copy=True))


Bases = ModalBasis | Sequence[ModalBasis | BasisBuffers] | Tensor
"""Bases of one connectivity, or key-frames without modes, *shape* ``(K, V, 3)``."""


def basis_buffers(bases: Bases) -> list[BasisBuffers]:
    """The buffers of each basis, or of key-frames, whose modes are none.

    Raises:
        ValueError: There is nothing, or the bases belong to different meshes.
    """
    if isinstance(bases, Tensor):
        if bases.dim() != 3 or bases.shape[-1] != 3 or not bases.is_floating_point():
            raise ValueError(
                "in the place of bases, key-frames are floating-point of shape (K, V, 3); got "
                f"{tuple(bases.shape)} of {bases.dtype}"
            )
        return [BasisBuffers(x, x.new_zeros(0, *x.shape)) for x in bases]
    several = [bases] if isinstance(bases, ModalBasis) else list(bases)
    sizes = sorted({len(basis.reference) for basis in several})
    if len(sizes) > 1:
        raise ValueError(f"the bases belong to meshes of {sizes} vertices; an in-between needs one connectivity")
    return [
        basis if isinstance(basis, BasisBuffers) else BasisBuffers(basis.reference, basis.modes) for basis in several
    ]


class PreciseModule(nn.Module):
    """A module that stays in float32 or float64, whatever it is cast to, and outlives inference mode."""

    @lasting
    def _apply(self, fn: Callable[[Tensor], Tensor], recurse: bool = True) -> "PreciseModule":
        """Never below float32."""

        def kept(tensor: Tensor) -> Tensor:
            out = fn(tensor)
            low = out.is_floating_point() and torch.finfo(out.dtype).bits < 32
            return tensor.to(out.device, torch.float32) if low else out

        return super()._apply(kept, recurse)


class InBetweenLayer(PreciseModule):
    """A layer that solves in-betweens of the modal spaces of all its bases.

    Args:
        bases: Of :func:`basis_buffers`.
        faces: Vertex indices. *Shape:* ``(F, 3)``.
        chosen: The settings.
    """

    terms: Any
    bases: Any
    core: InBetweenSolver

    def __init__(self, bases: Sequence[BasisBuffers], faces: Tensor, chosen: Settings) -> None:
        super().__init__()
        self.objective, self.solver = chosen
        self.terms = nn.ModuleList(self.objective.all_terms())
        mu = self.objective.mu
        if isinstance(mu, Tensor) and not isinstance(mu, nn.Parameter):
            self.register_buffer("mu", outlasting(mu))
        else:
            self.mu = mu
        self.bases = nn.ModuleList(bases)
        self.faces = torch.from_numpy(as_faces(faces))
        self._build()
        self.register_load_state_dict_post_hook(InBetweenLayer._build)

    @lasting
    def _build(self, _: Any = None) -> None:
        """Build everything that follows from the bases, in float64 on the CPU, then of their dtype and device."""
        like = self.bases[0].reference
        references, modes = (
            [getattr(basis, name).double().cpu() for basis in self.bases] for name in ("reference", "modes")
        )
        connectivity = checked_surface(references, self.faces.cpu())[1]
        if self.objective.space == "joint":  # nothing depends on the caller's order
            order = own_order([x.numpy() for x in references], connectivity.faces)
            references, modes = ([own[i] for i in order] for own in (references, modes))
        mesh = Mesh(connectivity)
        self.faces = mesh.faces
        #: True where there is a volume to be kept: not in sheets, whose energy has two terms.
        self.encloses = all(encloses(x, connectivity) for x in references)
        given = torch.stack(references), modes, mesh, list(self.terms), self.objective, self.solver
        kind = ContactSolver if self.objective.contact else InBetweenSolver
        self.core = kind(*given).to(like)

    @property
    def dtype(self) -> torch.dtype:
        """The dtype of the computation."""
        return self.core.alignment.scale.dtype

    @full_precision
    def solved(self, keyframes: Tensor, weights: Tensor, lead: torch.Size) -> InBetweenResult:
        """The in-betweens of key-frames and weights that were checked, in the layer's dtype.

        Args:
            keyframes: *Shape:* ``(*lead, K, V, 3)``, or one that expands to that.
            weights: *Shape:* ``(*lead, K)``, likewise.
            lead: The leading dimensions.
        """
        if self.solver.gradient == "implicit" or self.solver.local_steps or self.solver.regions:
            require_numbers(type(self).__name__, keyframes)
        n, item = weights.shape[-1], keyframes.shape[-2:]
        flat = keyframes.to(self.dtype).expand(*lead, n, *item).reshape(-1, n, *item)
        pulls = weights.to(self.dtype).expand(*lead, n).reshape(-1, n)
        samples = Samples(flat, pulls, self.mu_of(pulls, lead), self.stiffness_of(pulls, lead))
        return self.core(samples).unflattened(lead)

    # ------------------------------------------------------------------------------------------------------ the border
    def check_shapes(self, **given: Tensor) -> None:
        """Raise where shapes do not fit the layer.

        Raises:
            ValueError: One is no tensor, no shape of the mesh, or on another device.
        """
        reference = self.core.alignment.reference
        for name, x in given.items():
            if not isinstance(x, Tensor):
                raise ValueError(f"{name} is a {type(x).__name__}; pass a tensor, for instance torch.as_tensor({name})")
            if x.shape[-2:] != reference.shape or not x.is_floating_point():
                raise ValueError(
                    f"{name} must be floating-point of shape (..., {len(reference)}, 3) as the bases are; got "
                    f"{tuple(x.shape)} of {x.dtype}"
                )
            if x.device != reference.device:
                raise ValueError(f"{name} is on {x.device}, the layer on {reference.device}; move one with .to()")

    def mu_of(self, like: Tensor, lead: torch.Size) -> Tensor:
        """``mu`` of a flat batch of these leading dimensions. *Shape:* ``(B,)``."""
        mu = torch.as_tensor(self.mu, dtype=like.dtype, device=like.device)
        try:
            return mu.expand(lead).reshape(-1)
        except RuntimeError:
            raise ValueError(
                f"mu of shape {tuple(mu.shape)} does not broadcast against samples of {tuple(lead)}"
            ) from None

    def stiffness_of(self, like: Tensor, lead: torch.Size) -> list[Tensor]:
        """Stiffnesses of a flat batch, of each term. *Shape of each:* ``(B, M)`` or ``(B, 1)``."""
        found = []
        for term, part in zip(self.terms, self.core.fine.energy.parts, strict=True):
            values = torch.as_tensor(term.stiffness, dtype=like.dtype, device=like.device)
            values = values[None] if values.dim() == 0 else values
            values = values if self.encloses or not isinstance(term, Volume) else 0 * values
            n = 1 if term.total else part.corners.shape[1]
            try:
                if values.shape[-1] not in (1, n):
                    raise RuntimeError
                found.append(values.expand(*lead, values.shape[-1]).reshape(-1, values.shape[-1]))
            except RuntimeError:
                raise ValueError(
                    f"a stiffness of {type(term).__name__} has shape {tuple(values.shape)}; its last dimension counts "
                    f"the {n} elements or is 1, its others broadcast against samples of {tuple(lead)}: one for each "
                    "sample is values[:, None]"
                ) from None
        return found
