"""The common part of all layers of in-betweens: bases, settings, the solver, and the border."""

import warnings
from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import Any

import torch
from torch import Tensor, nn

from torch_modal.arrays import FloatArray
from torch_modal.autograd import full_precision, is_eager, outside_inference_mode, require_numbers
from torch_modal.contact.in_between import ContactSolver
from torch_modal.elastic.term import Mesh, Term, register_weight
from torch_modal.elastic.volume import encloses
from torch_modal.geometry.bodies import bodies
from torch_modal.geometry.canonical import own_order
from torch_modal.geometry.connectivity import Connectivity
from torch_modal.inbetween.results import InBetweenResult, Samples, join_bodies
from torch_modal.inbetween.settings import Settings, expand_to_samples, stiffnesses
from torch_modal.inbetween.solver import InBetweenSolver
from torch_modal.keyframes.arrays import as_faces, check_tensor
from torch_modal.keyframes.check import check_surface
from torch_modal.modes.basis import ModalBasis, as_bases
from torch_modal.threads import alone, by_chunks


class BasisBuffers(nn.Module):
    """The buffers that a layer keeps of a basis; all else follows from them. *Shape:* ``(V, 3), (k, V, 3)``."""

    reference: Tensor
    modes: Tensor

    def __init__(self, reference: Tensor, modes: Tensor) -> None:
        super().__init__()
        # Copies: what is loaded into a layer must not reach the basis that it was made from.
        self.register_buffer("reference", reference.detach().to(torch.float64, copy=True))
        self.register_buffer("modes", modes.detach().to(torch.float64, copy=True))


Bases = ModalBasis | Sequence[ModalBasis | BasisBuffers] | Tensor | FloatArray | Sequence[Tensor | FloatArray]
"""Bases of one connectivity, or key-frames without modes, *shape* ``(K, V, 3)``."""


def basis_buffers(bases: Bases, required: bool, kept: bool = False) -> list[BasisBuffers]:
    """The buffers of each basis, or of key-frames, which have no modes.

    Args:
        bases: Bases or key-frames.
        required: Whether modes are minimised in.
        kept: Whether modes serve for something else where there are some. Otherwise they are left out.

    Raises:
        ValueError: There is nothing, neither bases of one mesh nor key-frames, or there are no modes where required.
    """
    n = None if required or kept else 0
    buffers = [
        basis if isinstance(basis, BasisBuffers) else BasisBuffers(basis.reference, basis.modes[:n])
        for basis in as_bases(bases)
    ]
    if required and not any(len(each.modes) for each in buffers):
        raise ValueError(
            'preset="modal" and "paper" minimise in modes, and there are none: pass bases (tm.extract_bases) instead '
            'of key-frames, or take preset="accurate" or "fast"'
        )
    return buffers


class PreciseModule(nn.Module):
    """A module of bases that stays in float32 or float64, whatever it is cast to, and outlives inference mode."""

    bases: Sequence[BasisBuffers]
    faces: Tensor
    built_from: Tensor
    _known: list[int] | None = None  # identities of tensors that are the bases' own

    @outside_inference_mode
    def _apply(self, fn: Callable[[Tensor], Tensor], recurse: bool = True) -> "PreciseModule":
        """Never below float32."""

        def convert(tensor: Tensor) -> Tensor:
            out = fn(tensor)
            low = out.is_floating_point() and torch.finfo(out.dtype).bits < 32
            return tensor.to(out.device, torch.float32) if low else out

        return super()._apply(convert, recurse)

    def check_shapes(self, *sizes: int | str, **shapes: Tensor) -> None:
        """Raise a ValueError for shapes that do not fit the mesh, sizes of their leading dimensions, or the device."""
        reference = self.bases[0].reference
        for name, x in shapes.items():
            check_tensor(name, x, "...", *sizes, *reference.shape, device=reference.device)

    def _load_from_state_dict(self, state_dict: Mapping[str, Any], prefix: str, *others: Any) -> None:
        """Load a state as torch does, but refuse one that does not fit before any of its tensors is loaded."""
        present = self.state_dict(prefix=prefix)
        state = {name: state_dict.get(name, x) for name, x in present.items()}
        wrong = [f"{name} {tuple(x.shape)}" for name, x in state.items() if x.shape != present[name].shape]
        if others[1]:  # strict
            named = {name for name in state_dict if name.startswith(prefix)}
            wrong += [f"{name} {'missing' if name in present else 'unexpected'}" for name in named ^ present.keys()]
        if wrong:
            what = ", ".join(wrong[:4])
            raise RuntimeError(f"the state does not fit this {type(self).__name__}, which stays as it is: {what}")
        references = [state[f"{prefix}bases.{i}.reference"].double().cpu() for i in range(len(self.bases))]
        check_surface(references, self.faces.cpu())
        super()._load_from_state_dict(state_dict, prefix, *others)

    def _marks(self) -> Tensor:
        """Numbers that identify the bases. *Shape:* ``(K, 3)``."""
        return torch.stack([torch.cat([b.reference, *b.modes[-1:]]).square().mean(0) for b in self.bases])

    def _require_own_bases(self) -> None:
        """Raise where ``functional_call`` has replaced the bases, and not what follows from them."""
        seen = [id(x) for basis in self.bases for x in (basis.reference, basis.modes)]
        if seen == self._known or not is_eager(marks := self._marks()):
            return
        if not torch.allclose(marks.to(self.built_from), self.built_from, 1e-4, 0.0):
            raise RuntimeError(
                f"the bases of this {type(self).__name__} were replaced, and not what it computed from its own: load "
                "them by load_state_dict, or make a layer of them"
            )
        self._known = seen


class InBetweenLayer(PreciseModule):
    """A layer that solves in-betweens of shapes near the references of its bases (:func:`basis_buffers`)."""

    terms: Sequence[Term]
    cores: Sequence[InBetweenSolver]
    mu: float | Tensor
    separate = True
    """False to solve all bodies as one problem, for example with contact."""

    def __init__(self, bases: Sequence[BasisBuffers], faces: Tensor, chosen: Settings) -> None:
        super().__init__()
        self.objective, self.solver = chosen
        self.terms = nn.ModuleList(self.objective.all_terms())  # type: ignore[assignment]
        if self.objective.modal_space is None:
            _warn_of_stiffness(self.terms)
        register_weight(self, "mu", self.objective.mu)
        self.bases = nn.ModuleList(bases)  # type: ignore[assignment]
        self.faces = torch.from_numpy(as_faces(faces))
        self._build()
        self.register_load_state_dict_post_hook(InBetweenLayer._build)

    @outside_inference_mode
    @alone()
    def _build(self, _: object = None) -> None:
        """Build everything that follows from the bases, in float64 on the CPU, then of their dtype and device."""
        like = self.bases[0].reference
        references, modes = (
            [getattr(basis, name).double().cpu() for basis in self.bases] for name in ("reference", "modes")
        )
        connectivity = check_surface(references, self.faces.cpu())[1]
        self.faces = torch.tensor(connectivity.faces)
        chosen = self.objective
        several: list[tuple[Tensor | slice, Connectivity]] = [(slice(None), connectivity)]
        numbers = all(torch.as_tensor(term.stiffness).shape[-1:] in ((), (1,)) for term in self.terms)
        if self.separate and chosen.space != "paired" and numbers and not (chosen.contact or chosen.terms):
            several = bodies(torch.stack(references).numpy(), connectivity)
        #: Vertices of each body, and its solver.
        self.vertices, cores = [vertices for vertices, _ in several], []
        #: True where there is a volume to be kept: not in sheets, whose energy has two terms.
        self.encloses = []
        kind = ContactSolver if chosen.contact else InBetweenSolver
        for vertices, mesh in several:
            shapes, moves = torch.stack(references)[:, vertices], [each[:, vertices] for each in modes]
            if chosen.space != "paired":  # nothing depends on the caller's order
                order = own_order([x.numpy() for x in shapes], mesh.faces)
                shapes, moves = shapes[order], [moves[i] for i in order]
            if len(several) > 1:  # without the modes of other bodies
                moves = [each[each.flatten(1).any(1)] for each in moves]
            cores.append(kind(shapes, moves, Mesh(mesh), list(self.terms), chosen, self.solver).to(like))
            self.encloses.append(all(encloses(x, mesh) for x in shapes))
        self.cores = nn.ModuleList(cores)  # type: ignore[assignment]
        self.register_buffer("built_from", self._marks(), persistent=False)

    @property
    def core(self) -> InBetweenSolver:
        """The solver of the first body, as a rule the only one."""
        return self.cores[0]  # type: ignore[no-any-return]

    @property
    def dtype(self) -> torch.dtype:
        """The dtype of the computation."""
        return self.cores[0].alignment.scale.dtype

    @full_precision
    def solve_samples(self, keyframes: Tensor, weights: Tensor, lead: torch.Size) -> InBetweenResult:
        """The in-betweens of key-frames and weights that were checked, in the layer's dtype.

        *Shape:* ``(*lead, K, V, 3), (*lead, K)``, or ones that expand to these.
        """
        require_numbers(type(self).__name__, keyframes)
        self._require_own_bases()
        n, item = weights.shape[-1], keyframes.shape[-2:]
        flat = keyframes.to(self.dtype).expand(*lead, n, *item).reshape(-1, n, *item)
        flat_weights = weights.to(self.dtype).expand(*lead, n).reshape(-1, n)
        mu = expand_to_samples("mu[..., None]", torch.as_tensor(self.mu)[..., None], 1, flat_weights, lead)[:, 0]
        results = []
        for vertices, core, closed in zip(self.vertices, self.cores, self.encloses, strict=True):
            stiffness = stiffnesses(self.terms, core.fine.energy, flat_weights, lead, closed)
            samples = Samples(flat[:, :, vertices], flat_weights, mu, stiffness)
            # Further terms may have parameters of their own.
            results.append(by_chunks(core, samples, samples.keyframes.shape[2], closed=not self.objective.terms))
        result = results[0] if len(results) == 1 else join_bodies(results, self.vertices)
        return result.unflatten(lead)

    def stiffness_of(self, like: Tensor, lead: torch.Size, body: int = 0) -> list[Tensor]:
        """Stiffnesses of a body in a flat batch, of each term. *Shape of each:* ``(B, M)`` or ``(B, 1)``."""
        return stiffnesses(self.terms, self.cores[body].fine.energy, like, lead, self.encloses[body])


def _warn_of_stiffness(terms: Iterable[Term]) -> None:
    """Warn of stiffnesses of single elements, or to be learned, where only the local steps depend on them."""
    values = [torch.as_tensor(term.stiffness) for term in terms]
    if any(value.requires_grad or value.shape[-1:] not in ((), (1,)) for value in values):
        warnings.warn(
            'stiffnesses act on the local steps alone, which reach a few edges far: preset="modal" minimises with them',
            UserWarning,
            stacklevel=4,
        )
