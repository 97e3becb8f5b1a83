r"""Motion through many key-frames: smooth in time, at any time, differentiable.

Between two key-frames of a path, the rotations and sizes of triangles and the rigid motion follow a cubic through four
key-frames (:mod:`torch_modal.geometry.hermite`) in the place of a straight step between two, and a Poisson system makes
a shape of it. Nothing is minimised unless there are terms beyond Eq. 5, which then compares with that shape.
"""

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any

import torch
from torch import Tensor, nn

from torch_modal import trees
from torch_modal.autograd import broadcast_shapes, full_precision, in_use, lasting, mapped, require_numbers
from torch_modal.contact.active import refuse_transforms
from torch_modal.contact.in_between import push_apart
from torch_modal.geometry.crossings import require_contact
from torch_modal.geometry.hermite import Tangents, around, located, wrapped
from torch_modal.inbetween.samples import InBetweenResult, Samples
from torch_modal.inbetween.settings import Objective, Preset, Solver, settings
from torch_modal.keyframes.times import checked_times
from torch_modal.layers.in_between import InBetween, joined, unflattened, with_exact_ends
from torch_modal.precompute.basis import ModalBasis
from torch_modal.solve.solver import Solution

# Even times between two key-frames at which a path looks for contacts.
N_SEARCHED = 31

# Times that differ by no more than rounding, relative to the larger one, are the same.
SAME_TIME = 2e-15


class _OfPath(InBetween):
    """Pairs of a path."""

    shares = True


class _Lazy(_OfPath):
    """Pairs of a smooth path, which minimises nothing: the tables of the minimisation are made on first use."""

    def prepare(self) -> None:
        """Nothing."""


class Path(nn.Module):
    """Shapes at any time of a motion through key-frames.

    Velocities are continuous at the key-frames, which are reproduced exactly. They are limited to three times the
    slower one of both sides, triangle by triangle, so that what stops does stop. The ends have no acceleration.

    Args:
        bases: The basis of each key-frame, two or more (:func:`torch_modal.extract_bases`).
        faces: Vertex indices. *Shape:* ``(F, 3)``.
        times: When the key-frames are, ascending; if cyclic, one more, when the first comes again. Default: 0, 1, 2,
            and so on. *Shape:* ``(K,)``, or ``(K + 1,)`` if cyclic.
        cyclic: Whether the last key-frame leads on to the first. Times are then taken modulo the period.
        smooth: Whether neighbours in time have a say; False treats each pair alone. A function is another path scheme:
            :data:`torch_modal.geometry.hermite.Tangents` (docs/extending.md).
        preset: As for :class:`torch_modal.InBetween`; not ``"paper"``, which knows the middle of a pair only.
        objective: What is minimised, in the place of the preset's.
        solver: How it is solved, in the place of the preset's.
        contact: Whether parts are kept from passing through each other, in the place of what the objective says
            (docs/contact.md; extra ``contact``). Shapes are searched at 31 times between any two key-frames, and
            pushed apart by one displacement that is smooth in time. It is a constant of the graph: gradients are those
            of the shapes without contact, and not exact where something touches. Those of ``InBetween`` are.

    Raises:
        ValueError: An argument is not usable.
        MissingPackageError: ``contact`` without that extra.
    """

    times: Tensor

    @lasting
    def __init__(
        self,
        bases: Sequence[ModalBasis],
        faces: Tensor,
        times: Tensor | Sequence[float] | None = None,
        cyclic: bool = False,
        smooth: bool | Tangents = True,
        preset: Preset = "accurate",
        *,
        objective: Objective | None = None,
        solver: Solver | None = None,
        contact: bool | None = None,
    ) -> None:
        super().__init__()
        n = len(bases)
        if n < 2:
            raise ValueError(f"a path needs two key-frames or more, got {n} bases")
        objective, solver = settings(preset, objective, solver, contact)
        if objective.space == "paired":
            raise ValueError("the paired space (Eq. 4) knows the middle of a pair only; a path needs space='joint'")
        self.register_buffer("times", checked_times(times, n, cyclic))
        #: Whether shapes are pushed apart. The layer does not: what it did at each time alone would jump.
        self.contact = objective.contact
        if self.contact:
            require_contact()
        objective = replace(objective, contact=False)
        pairs = [(i, (i + 1) % n) for i in range(n if cyclic else n - 1)]
        kind = _Lazy if smooth and n > 2 and not objective.terms else _OfPath
        self.layer = kind(list(bases), faces, objective=objective, solver=solver, pairs=pairs)
        self.cyclic = cyclic
        self.smooth = bool(smooth)
        #: The path scheme; None for the default.
        self.tangents = smooth if callable(smooth) else None
        #: Which pair of bases each interval has the modes of.
        self.members = list(range(len(pairs)))

    @property
    def n_keyframes(self) -> int:
        """Number of key-frames, K."""
        return len(self.members) + (not self.cyclic)

    @lasting
    def insert(self, t: float) -> "Path":
        """The same motion with one more key-frame, which borrows the modes of those around it, as in the paper.

        Args:
            t: When it is, between the others; modulo the period, if cyclic.

        Returns:
            A path of one more key-frame, with the same layer.

        Raises:
            ValueError: The time is outside, not finite, or that of a key-frame.
        """
        at = self.times.new_tensor([t])
        i = int(located(at, self.times, self.cyclic)[0])
        if self.cyclic:
            at = wrapped(at, self.times)
        # Modulo the period, a key-frame's time comes out with rounding.
        scale = torch.maximum(self.times.abs().amax(), self.times.new_tensor(abs(t)))
        if bool(((self.times - at).abs() <= SAME_TIME * scale).any()):
            raise ValueError(f"there is a key-frame at {t:g} already; replace it in the keyframes that are passed")
        other = Path.__new__(Path)
        nn.Module.__init__(other)
        other.layer, other.cyclic, other.contact = self.layer, self.cyclic, self.contact
        other.smooth, other.tangents = self.smooth, self.tangents
        other.members = [*self.members[: i + 1], *self.members[i:]]
        other.register_buffer("times", torch.cat([self.times[: i + 1], at, self.times[i + 1 :]]))
        return other

    def solve(self, keyframes: Tensor, t: Tensor | float) -> InBetweenResult:
        """The shapes, and how each minimisation went, without a warning. Arguments as for :meth:`forward`."""
        return self._batched(keyframes, t, None)

    def forward(self, keyframes: Tensor, t: Tensor | float) -> Tensor:
        """The shapes at given times.

        Args:
            keyframes: Near those that the bases were made from. *Shape:* ``(..., K, V, 3)``.
            t: Times, broadcast against the leading dimensions of the key-frames. *Shape:* ``(...)``, or a number.

        Returns:
            The key-frames exactly at theirs. *Shape:* ``(..., V, 3)``.

        Raises:
            ValueError: Shapes that do not fit, or a time before the first or after the last key-frame.
            ConvergenceError: As for :class:`torch_modal.InBetween`.
        """
        return self._batched(keyframes, t, self.layer.report()).shapes

    @full_precision
    def _batched(
        self, keyframes: Tensor, t: Tensor | float, report: Callable[[Solution], None] | None
    ) -> InBetweenResult:
        layer = self.layer
        require_numbers("Path", keyframes)
        if keyframes.dim() < 3 or keyframes.shape[-3] != self.n_keyframes:
            raise ValueError(
                f"keyframes of this path have the shape (..., {self.n_keyframes}, V, 3); got {tuple(keyframes.shape)}"
            )
        layer.check(keyframes[..., 0, :, :], keyframes[..., -1, :, :], 0.0)
        rounding = torch.finfo(t.dtype).eps if isinstance(t, Tensor) and t.is_floating_point() else 0.0
        t = torch.as_tensor(t, dtype=self.times.dtype, device=keyframes.device)
        own = keyframes.shape[:-3]
        try:
            lead = broadcast_shapes(own, t.shape)
        except RuntimeError:
            raise ValueError(
                f"t of shape {tuple(t.shape)} does not broadcast against motions of {tuple(own)}; for all times of all "
                "motions pass keyframes[:, None]"
            ) from None
        flat = keyframes.reshape(-1, *keyframes.shape[-3:])
        which = torch.arange(len(flat), device=t.device).reshape(own).expand(lead).reshape(-1)
        segment, u = located(t.expand(lead).reshape(-1), self.times, self.cyclic, rounding)
        order, parts = [], []
        intervals = in_use(segment, len(self.members)) or [0]  # of nothing, nothing
        if mapped(segment):
            # Of each interval all shapes, of which some are taken.
            every = torch.arange(len(which), device=which.device)
            order = [place * len(which) + every for place in range(len(intervals))]
            whole = joined([self._between(flat, i, which, u, report) for i in intervals], order)
            place = sum((segment == i) * place for place, i in enumerate(intervals))
            return unflattened(trees.rows(whole, place * len(which) + every), lead)
        for i in intervals:
            mine = torch.nonzero(segment == i).flatten()
            order.append(mine)
            parts.append(self._between(flat, i, which[mine], u[mine], report))
        return unflattened(joined(parts, order), lead)

    def _between(
        self,
        keyframes: Tensor,
        i: int,
        which: Tensor,
        u: Tensor,
        report: Callable[[Solution], None] | None,
    ) -> InBetweenResult:
        """Shapes of one interval. *Shape:* ``(L, K, V, 3), (B,), (B,) -> (B, V, 3)``."""
        member = self.layer.members[self.members[i]]
        samples = self.samples(keyframes, i, which, u)
        result = member(samples, report)
        if self.contact:
            result = self._in_contact(keyframes, i, samples, result)
        ends = keyframes[which, i], keyframes[which, (i + 1) % self.n_keyframes]
        return InBetweenResult(with_exact_ends(result.shapes, *ends, samples.t), result.solution)

    def samples(self, keyframes: Tensor, i: int, which: Tensor, u: Tensor) -> Samples:
        """Times of one interval as a batch. *Shape:* ``(L, K, V, 3), (B,), (B,)``."""
        layer, n = self.layer, self.n_keyframes
        x = keyframes.to(layer.dtype)
        neighbours: dict[str, Any] = {}
        if self.smooth and n > 2:
            before, after, spacing = around(i, self.times, self.cyclic)
            neighbours["before"], neighbours["after"] = (None if j is None else x[:, j] for j in (before, after))
            neighbours["spacing"] = spacing.mapped(lambda h: h.to(x).expand(len(x)))._replace(tangents=self.tangents)
        u = u.to(x)
        stiffness = layer.stiffness_of(u, u.shape)
        return Samples(x[:, i], x[:, (i + 1) % n], which, u, layer.mu_of(u, u.shape), stiffness, **neighbours)

    def _in_contact(self, keyframes: Tensor, i: int, samples: Samples, result: InBetweenResult) -> InBetweenResult:
        """Shapes of one interval pushed apart, by a displacement found at even times of each motion."""
        refuse_transforms(result.shapes)
        member = self.layer.members[self.members[i]]
        even = torch.arange(1, N_SEARCHED + 1).to(samples.t) / (N_SEARCHED + 1)
        shapes, left = result.shapes.clone(), torch.zeros_like(result.solution.status)
        which = samples.which
        assert which is not None
        for motion in which.unique().tolist():
            own = keyframes[motion : motion + 1]
            grid = self.samples(own, i, torch.zeros(len(even), dtype=torch.int64, device=which.device), even)
            with torch.no_grad():
                found = push_apart(member, grid, member(grid, None).shapes)
            mine = torch.nonzero(which == motion).flatten()
            at = self.samples(own, i, torch.zeros_like(mine), samples.t[mine])
            pushed, left[mine] = found.apply(member, at, result.shapes[mine])
            shapes = shapes.index_copy(0, mine, pushed)
        return InBetweenResult(shapes, result.solution._replace(n_crossing=left))
