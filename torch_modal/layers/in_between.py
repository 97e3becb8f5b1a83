"""Shapes between two key-frames at any time, as a differentiable layer."""

from collections.abc import Callable, Sequence
from functools import partial
from typing import Any

import torch
from torch import Tensor, nn

from torch_modal.autograd import broadcast_shapes, full_precision, lasting, outlasting, require_numbers, transformed
from torch_modal.contact.in_between import ContactBetween
from torch_modal.energy.term import Mesh
from torch_modal.energy.volume import Volume, encloses
from torch_modal.geometry.crossings import require_contact
from torch_modal.inbetween.between import Between, Shared
from torch_modal.inbetween.samples import InBetweenResult, Samples, report
from torch_modal.inbetween.settings import Objective, Preset, Solver, settings
from torch_modal.keyframes.arrays import as_faces
from torch_modal.keyframes.check import checked_surface
from torch_modal.precompute.basis import ModalBasis
from torch_modal.solve.solver import Solution


class InBetween(nn.Module):
    r"""Shapes :math:`x(t)` that are cheapest to reach from both key-frames, in a space of vibration modes.

    The key-frames may be any shapes of this connectivity near those that the bases were made from. They are given in
    the caller's coordinates and units, and so is the result. A rigid motion between them is taken out first and then
    followed along its geodesic; a rigid motion of both moves the result along. At half a turn, where both senses are
    equally short, one is taken.

    Gradients reach the key-frames, the times, ``mu`` and the stiffnesses. The modes are constants.

    It computes in its own dtype, float64 unless ``.to(torch.float32)`` says otherwise, and never below float32: under
    ``autocast``, ``.half()`` and ``.bfloat16()`` it stays there. Results have the dtype of the key-frames.

    Args:
        bases: The bases (:func:`torch_modal.extract_bases`); one alone serves for both ends.
        faces: Vertex indices. *Shape:* ``(F, 3)``.
        preset: ``"accurate"``, ``"fast"`` or ``"paper"``: docs/layer.md says what each costs and gives.
        objective: What is minimised, in the place of the preset's.
        solver: How it is solved, in the place of the preset's.
        contact: Whether parts are kept from passing through each other, in the place of what the objective says
            (docs/contact.md; extra ``contact``). Each in-between is then pushed apart on its own: a motion is made by
            :class:`torch_modal.Path`, which does it the same way at all times.
        pairs: Which bases belong together, where there are more than two. Default: each with the next.

    Raises:
        ValueError: An argument is not usable.
        MissingPackageError: ``contact`` without that extra.
    """

    terms: Any
    bases: Any
    members: Any

    @lasting
    def __init__(
        self,
        bases: ModalBasis | Sequence[ModalBasis],
        faces: Tensor,
        preset: Preset = "accurate",
        *,
        objective: Objective | None = None,
        solver: Solver | None = None,
        contact: bool | None = None,
        pairs: Sequence[tuple[int, int]] | None = None,
    ) -> None:
        super().__init__()
        bases = [bases, bases] if isinstance(bases, ModalBasis) else list(bases)
        if len(bases) < 2:
            raise ValueError(f"an in-between needs two bases, got {len(bases)}; pass [basis_a, basis_b]")
        self.pairs = list(pairs) if pairs is not None else [(i, i + 1) for i in range(len(bases) - 1)]
        if not self.pairs or any(not 0 <= i < len(bases) for pair in self.pairs for i in pair):
            raise ValueError(f"pairs hold indices of {len(bases)} bases, got {self.pairs}")
        sizes = sorted({basis.n_vertices for basis in bases})
        if len(sizes) > 1:
            raise ValueError(f"the bases belong to meshes of {sizes} vertices; an in-between needs one connectivity")
        self.objective, self.solver = settings(preset, objective, solver, contact)
        if self.objective.contact:
            require_contact()
        self.terms = nn.ModuleList(self.objective.all_terms())
        mu = self.objective.mu
        if isinstance(mu, Tensor) and not isinstance(mu, nn.Parameter):
            self.register_buffer("mu", outlasting(mu))
        else:
            self.mu = mu
        self.bases = nn.ModuleList(_Basis(basis) for basis in bases)
        self.faces = torch.from_numpy(as_faces(faces))
        self._build()
        self.register_load_state_dict_post_hook(_rebuild)

    @lasting
    def _build(self) -> None:
        """Build everything that follows from the bases, on their device and in their dtype."""
        like = self.bases[0].reference
        shapes = [basis.reference.double().cpu() for basis in self.bases]
        connectivity = checked_surface(shapes, self.faces.cpu())[1]
        self.faces = torch.tensor(connectivity.faces)
        ends = [[part.double().cpu() for part in (basis.reference, basis.modes)] for basis in self.bases]
        #: Whether there is a volume to be kept: not in sheets, whose energy has two terms.
        self.encloses = all(encloses(x, connectivity) for x in shapes)
        mesh = Mesh(connectivity)
        shared = Shared.of(mesh, torch.stack(shapes), self.pairs, list(self.terms), self.solver)
        made = []
        for places in self.places:
            own, modes = torch.stack([ends[i][0] for i in places]), [ends[i][1] for i in places]
            if not self.shares:
                places, shared = range(len(places)), shared.alone(own)
            made.append(self.kind(own, places, modes, mesh, self.objective, self.solver, shared))
        self.members = nn.ModuleList(made)
        self.prepare()
        self.members.to(like)

    shares = False
    """Whether pairs share what makes a motion through all of them smooth; otherwise each is what it is alone."""

    @property
    def kind(self) -> type[Between]:
        """What the members are."""
        return ContactBetween if self.objective.contact else Between

    @property
    def places(self) -> Sequence[Sequence[int]]:
        """The bases of each member."""
        return self.pairs

    def prepare(self) -> None:
        """Build the tables of the minimisations."""
        for member in self.members:
            member.prepare()

    @lasting
    def _apply(self, fn: Callable[[Tensor], Tensor], recurse: bool = True) -> "InBetween":
        """Never below float32."""

        def kept(tensor: Tensor) -> Tensor:
            out = fn(tensor)
            low = out.is_floating_point() and torch.finfo(out.dtype).bits < 32
            return tensor.to(out.device, torch.float32) if low else out

        return super()._apply(kept, recurse)

    def solve(self, x_a: Tensor, x_b: Tensor, t: Tensor | float, pair: Tensor | int = 0) -> InBetweenResult:
        """The in-betweens, and how each minimisation went, without a warning. Arguments as for :meth:`forward`."""
        return self._batched(x_a, x_b, t, pair, None)

    def forward(self, x_a: Tensor, x_b: Tensor, t: Tensor | float, pair: Tensor | int = 0) -> Tensor:
        """The in-betweens.

        All leading dimensions broadcast against each other, as in ``torch.lerp``: a number gives one shape for each
        pair of key-frames, ``t`` of ``(B,)`` with ``(B, V, 3)`` each its own time, ``t`` of ``(T,)`` with ``(V, 3)`` T
        times, and with ``x_a[:, None]`` all pairs, where what does not depend on the time is computed once.

        Args:
            x_a: Key-frames at 0. *Shape:* ``(..., V, 3)``.
            x_b: Key-frames at 1. *Shape:* ``(..., V, 3)``.
            t: Times in [0, 1]. *Shape:* ``(...)``, or a number.
            pair: Which of the ``pairs`` each sample lies between. *Shape:* ``(...)``, or one number.

        Returns:
            The key-frames exactly at 0 and 1. *Shape:* ``(..., V, 3)``.

        Raises:
            ValueError: Shapes, dtypes, devices or times that do not fit.
            ConvergenceError: A sample did not converge, gradients are recorded and ``unconverged="raise"``.
        """
        return self._batched(x_a, x_b, t, pair, self.report()).shapes

    @property
    def dtype(self) -> torch.dtype:
        """The dtype of the computation."""
        return self.members[0].frame.reference.dtype

    @full_precision
    def _batched(
        self, x_a: Tensor, x_b: Tensor, t: Tensor | float, pair: Tensor | int, report: Callable[[Solution], None] | None
    ) -> InBetweenResult:
        times = self.check(x_a, x_b, t)
        rotations = self.objective.space == "joint" and self.objective.base == "rotations"
        if self.solver.gradient == "implicit" or self.solver.local_steps or rotations:
            require_numbers("InBetween", x_a)
        chosen = self._chosen(pair)
        item = x_a.shape[-2:]
        own = broadcast_shapes(x_a.shape[:-2], x_b.shape[:-2], *([] if chosen is None else [chosen.shape]))
        lead = broadcast_shapes(own, times.shape)
        flat_a, flat_b = (x.to(self.dtype).expand(*own, *item).reshape(-1, *item) for x in (x_a, x_b))
        index = None
        if own != lead:
            index = torch.arange(len(flat_a), device=times.device).reshape(own).expand(lead).reshape(-1)
        samples = Samples(
            flat_a,
            flat_b,
            index,
            times.expand(lead).reshape(-1),
            self.mu_of(times, lead),
            self.stiffness_of(times, lead),
        )
        if chosen is None:
            result = self.members[0 if isinstance(pair, Tensor) else pair](samples, report)
        else:
            result = self._of_several(samples, chosen.expand(own).reshape(-1), report)
        shapes, solution = unflattened(result, lead)
        return InBetweenResult(with_exact_ends(shapes, x_a, x_b, t), solution)

    def _of_several(
        self, samples: Samples, chosen: Tensor, report: Callable[[Solution], None] | None
    ) -> InBetweenResult:
        """Samples that lie between different pairs of bases."""
        index = torch.arange(len(chosen), device=chosen.device) if samples.which is None else samples.which
        order, parts = [], []
        for i, member in enumerate(self.members):
            pairs = chosen == i
            mine = torch.nonzero(pairs[index]).flatten()
            if not len(mine):
                continue
            places = pairs.cumsum(0)[index[mine]] - 1
            picked = Samples(
                samples.x_a[pairs],
                samples.x_b[pairs],
                None if samples.which is None else places,
                samples.t[mine],
                samples.mu[mine],
                [values[mine] for values in samples.stiffness],
            )
            order.append(mine)
            parts.append(member(picked, report))
        if not parts:
            return self.members[0](samples, report)  # of nothing, nothing
        return joined(parts, order)

    def report(self) -> Callable[[Solution], None]:
        """The function that ``forward`` passes solutions to, for warnings."""
        forbid = self.solver.unconverged == "raise" and torch.is_grad_enabled()
        return partial(report, max_steps=self.solver.max_steps, forbid=forbid)

    # ------------------------------------------------------------------------------------------------------ the border
    def _chosen(self, pair: Tensor | int) -> Tensor | None:
        """Which pair each sample lies between; None where all lie between the same."""
        last = len(self.members) - 1
        if not isinstance(pair, Tensor):
            if not isinstance(pair, int) or not 0 <= pair <= last:
                raise ValueError(f"pair is one of 0 to {last}, or a tensor of them; got {pair!r}")
            return None
        if pair.is_floating_point() or bool(((pair < 0) | (pair > last)).any()):
            raise ValueError(f"pair holds whole numbers from 0 to {last}; got {pair.dtype} up to {pair.max()}")
        return pair if last else None

    def check(self, x_a: Tensor, x_b: Tensor, t: Tensor | float) -> Tensor:
        """Check the arguments, and convert times to a tensor."""
        reference = self.members[0].frame.reference
        for name, x in (("x_a", x_a), ("x_b", x_b)):
            if not isinstance(x, Tensor):
                raise ValueError(f"{name} is a {type(x).__name__}; pass a tensor, for instance torch.as_tensor({name})")
            if x.shape[-2:] != reference.shape or not x.is_floating_point():
                raise ValueError(
                    f"{name} must be floating-point of shape (..., {len(reference)}, 3) as the bases are; got "
                    f"{tuple(x.shape)} of {x.dtype}"
                )
            if x.device != reference.device:
                raise ValueError(f"{name} is on {x.device}, the layer on {reference.device}; move one with .to()")
        times = torch.as_tensor(t, dtype=reference.dtype, device=reference.device)
        try:
            broadcast_shapes(x_a.shape[:-2], x_b.shape[:-2], times.shape)
        except RuntimeError:
            raise ValueError(
                f"t of shape {tuple(times.shape)} does not broadcast against key-frames of {tuple(x_a.shape[:-2])} and "
                f"{tuple(x_b.shape[:-2])}; for all times of all pairs pass x_a[:, None] and x_b[:, None]"
            ) from None
        return times

    def mu_of(self, times: Tensor, lead: torch.Size) -> Tensor:
        """``mu`` of a flat batch of these leading dimensions. *Shape:* ``(B,)``."""
        mu = torch.as_tensor(self.mu, dtype=times.dtype, device=times.device)
        try:
            return mu.expand(lead).reshape(-1)
        except RuntimeError:
            raise ValueError(
                f"mu of shape {tuple(mu.shape)} does not broadcast against samples of {tuple(lead)}"
            ) from None

    def stiffness_of(self, times: Tensor, lead: torch.Size) -> list[Tensor]:
        """Stiffnesses of a flat batch, of each term. *Shape of each:* ``(B, M)`` or ``(B, 1)``."""
        found = []
        for term, part in zip(self.terms, self.members[0].fine.energy.parts, strict=True):
            values = torch.as_tensor(term.stiffness, dtype=times.dtype, device=times.device)
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


class _Basis(nn.Module):
    """The buffers that a layer keeps of a basis; all else follows from them."""

    reference: Tensor
    modes: Tensor

    def __init__(self, basis: ModalBasis) -> None:
        super().__init__()
        # Copies: what is loaded into a layer must not reach the basis that it was made from.
        self.register_buffer("reference", basis.reference.to(torch.float64, copy=True))
        self.register_buffer("modes", basis.modes.to(torch.float64, copy=True))


def _rebuild(layer: InBetween, *_: Any) -> None:
    """Rebuild everything that follows from the bases after others were loaded."""
    layer._build()


def joined(parts: Sequence[InBetweenResult], order: Sequence[Tensor]) -> InBetweenResult:
    """Flat batches as one.

    Args:
        parts: One or more. Where numbers of modes differ, zeros follow the amplitudes.
        order: Where the samples of each part stand in the whole. *Shape of each:* ``(B,)``.
    """
    places = torch.cat(list(order))
    sorted_ = torch.equal(places, torch.arange(len(places), device=places.device))
    back = slice(None) if sorted_ else torch.argsort(places)  # picking all would copy them
    widest = max(part.solution.amplitudes.shape[-1] for part in parts)
    amplitudes = torch.cat(
        [nn.functional.pad(p.solution.amplitudes, (0, widest - p.solution.amplitudes.shape[-1])) for p in parts]
    )
    each = zip(*(part.solution[1:] for part in parts), strict=True)
    others = [None if values[0] is None else torch.cat(values)[back] for values in each]
    shapes = torch.cat([part.shapes for part in parts])
    return InBetweenResult(shapes[back], Solution(amplitudes[back], *others))  # type: ignore[arg-type]


def unflattened(result: InBetweenResult, lead: torch.Size) -> InBetweenResult:
    """A flat batch with these leading dimensions."""
    values = (None if value is None else value.reshape(lead + value.shape[1:]) for value in result.solution)
    solution = Solution(*values)  # type: ignore[arg-type]
    return InBetweenResult(result.shapes.reshape(*lead, *result.shapes.shape[1:]), solution)


def with_exact_ends(shapes: Tensor, x_a: Tensor, x_b: Tensor, t: Tensor | float) -> Tensor:
    """In-betweens, at 0 and 1 the key-frames to the last bit; gradients stay those of the in-between there.

    Args:
        shapes: *Shape:* ``(..., V, 3)``.
        x_a: Key-frames at 0, whose dtype the result has. *Shape:* ``(..., V, 3)``.
        x_b: Key-frames at 1, likewise. *Shape:* ``(..., V, 3)``.
        t: *Shape:* ``(...)``, or a number.
    """
    shapes = shapes.to(torch.promote_types(x_a.dtype, x_b.dtype))
    for end, x in ((0, x_a), (1, x_b)):
        if not isinstance(t, Tensor) and t != end:
            continue
        shapes = with_exact(shapes, torch.as_tensor(t == end, device=shapes.device), x)
    return shapes


def with_exact(shapes: Tensor, there: Tensor, x: Tensor) -> Tensor:
    """In-betweens, of which some are a key-frame to the last bit; gradients stay those of the in-between there.

    Args:
        shapes: *Shape:* ``(..., V, 3)``.
        there: Which of them. *Shape:* ``(...)``, bool.
        x: The key-frame. *Shape:* ``(..., V, 3)``.
    """
    exactly = x.to(shapes).detach()
    if torch.is_grad_enabled() or transformed(shapes):
        # No number comes of an in-between where that is not finite, and no gradient.
        known = shapes.detach()
        exactly = exactly + torch.where(known.isfinite(), shapes - known, 0)
    return torch.where(there[..., None, None], exactly, shapes)
