"""Weighted in-betweens of several key-frames, as a differentiable layer."""

from collections.abc import Callable, Sequence

import torch
from torch import Tensor, nn

from torch_modal.autograd import broadcast_shapes, full_precision, made_outside, once, require_numbers, traced
from torch_modal.inbetween.among import Among, WeightedSamples
from torch_modal.inbetween.between import Between
from torch_modal.inbetween.samples import InBetweenResult, Samples
from torch_modal.inbetween.settings import Objective, Preset, Solver, settings
from torch_modal.layers.in_between import InBetween, unflattened, with_exact
from torch_modal.precompute.basis import ModalBasis
from torch_modal.solve.solver import Solution

MOST_BELOW_ZERO = 0.25
"""What weights below zero may add up to: energies then still have a minimum."""

ROUNDING = 1e-5
"""Sums of weights may differ from one by so much, or by the rounding of their dtype."""

SECOND = "Blend has first derivatives only; those of InBetween, for two key-frames, may be differentiated again"


class _OfAll(InBetween):
    """One member, with the modes of all bases."""

    @property
    def kind(self) -> type[Between]:
        """What the member is."""
        return Among

    @property
    def places(self) -> Sequence[Sequence[int]]:
        """All bases."""
        return [range(len(self.bases))]


class Blend(nn.Module):
    r"""Shapes in between several key-frames, by weights: the minimiser of :math:`\sum_k w_k\, d(x_k, x)`.

    ``d`` is Eq. 5. The key-frames may be any shapes of this connectivity near those that the bases were made from, as
    many or as few as are wanted. Their order does not matter, nor do key-frames of weight 0. Two key-frames of a layer
    of two bases have the shapes of :class:`InBetween` at the time of the second weight. A rigid motion between
    key-frames is taken out first; the result has the weighted mean of their poses.

    Gradients reach the key-frames, the weights and the stiffnesses. Second derivatives are an error, but for two
    key-frames of a layer of two bases. The modes are constants. Precision, warnings and statuses are those of
    :class:`InBetween`.

    Args:
        bases: The bases, one or more (:func:`torch_modal.extract_bases`); the first gives the scale.
        faces: Vertex indices. *Shape:* ``(F, 3)``.
        preset: ``"accurate"`` or ``"fast"``, as for :class:`InBetween`.
        objective: What is minimised, in the place of the preset's.
        solver: How it is solved, in the place of the preset's.

    Raises:
        ValueError: An argument is not usable, or the objective has contact or the paired space, which are of pairs.
    """

    def __init__(
        self,
        bases: ModalBasis | Sequence[ModalBasis],
        faces: Tensor,
        preset: Preset = "accurate",
        *,
        objective: Objective | None = None,
        solver: Solver | None = None,
    ) -> None:
        super().__init__()
        objective, solver = settings(preset, objective, solver)
        if objective.space == "paired" or objective.contact:
            raise ValueError("contact and space='paired' are of two key-frames; a blend has space='joint' alone")
        several = [bases, bases] if isinstance(bases, ModalBasis) else list(bases)
        several = several * 2 if len(several) == 1 else several
        self.layer = _OfAll(several, faces, objective=objective, solver=solver, pairs=[(0, 1)])

    def solve(self, keyframes: Tensor, weights: Tensor) -> InBetweenResult:
        """The shapes, and how each minimisation went, without a warning. Arguments as for :meth:`forward`."""
        return self._batched(keyframes, weights, None)

    def forward(self, keyframes: Tensor, weights: Tensor) -> Tensor:
        """The weighted in-betweens.

        All leading dimensions broadcast against each other: weights of ``(T, K)`` with key-frames of ``(K, V, 3)`` give
        T shapes.

        Args:
            keyframes: *Shape:* ``(..., K, V, 3)``.
            weights: They add up to one. Some may be below zero, down to a sum of -0.25. *Shape:* ``(..., K)``.

        Returns:
            The key-frame exactly where it has all the weight. *Shape:* ``(..., V, 3)``.

        Raises:
            ValueError: Shapes, dtypes, devices or weights that do not fit.
            ConvergenceError: A sample did not converge, gradients are recorded and ``unconverged="raise"``.
        """
        return self._batched(keyframes, weights, self.layer.report()).shapes

    @full_precision
    def _batched(
        self, keyframes: Tensor, weights: Tensor, report: Callable[[Solution], None] | None
    ) -> InBetweenResult:
        layer = self.layer
        lead = self._check(keyframes, weights)
        require_numbers("Blend", keyframes)
        n, item = keyframes.shape[-3], keyframes.shape[-2:]
        flat = keyframes.to(layer.dtype).expand(*lead, n, *item).reshape(-1, n, *item)
        pulls = weights.to(layer.dtype).expand(*lead, n).reshape(-1, n)
        if torch.finfo(weights.dtype).bits < 32:  # of an autocast model: to more digits, they do not add up to one
            pulls = pulls / pulls.sum(1, keepdim=True)
        stiffness = layer.stiffness_of(pulls[:, 0], lead)
        member = layer.members[0]
        if n == 2 and len(layer.bases) == 2 and made_outside(_is_pair, pulls, flat):
            t = pulls[:, 1]
            result = member(Samples(flat[:, 0], flat[:, 1], None, t, layer.mu_of(t, lead), stiffness), report)
        else:
            # Second derivatives pass what goes in, in reverse mode, or what comes out, in forward mode.
            x, w, *others = (once(given, SECOND) for given in (flat, pulls, *stiffness))
            result = member.weighted(WeightedSamples(x, w, others), report)
            result = result._replace(shapes=once(result.shapes, SECOND))
        shapes, solution = unflattened(result, lead)
        return InBetweenResult(_with_exact_keyframes(shapes, keyframes, weights), solution)

    def _check(self, keyframes: Tensor, weights: Tensor) -> torch.Size:
        """Check the arguments; the leading dimensions of the result."""
        layer = self.layer
        layer.check(keyframes, keyframes, 0.0)
        if keyframes.dim() < 3 or not isinstance(weights, Tensor) or weights.shape[-1:] != keyframes.shape[-3:-2]:
            shape = tuple(weights.shape) if isinstance(weights, Tensor) else type(weights).__name__
            raise ValueError(
                "keyframes have the shape (..., K, V, 3), weights (..., K) with the same K; got "
                f"{tuple(keyframes.shape)} and {shape}"
            )
        if not weights.is_floating_point() or weights.device != keyframes.device:
            raise ValueError(
                f"weights are floating-point and on the device of the key-frames, {keyframes.device}; got "
                f"{weights.dtype} on {weights.device}"
            )
        try:
            lead = broadcast_shapes(keyframes.shape[:-3], weights.shape[:-1])
        except RuntimeError:
            raise ValueError(
                f"weights of shape {tuple(weights.shape)} do not broadcast against sets of key-frames of "
                f"{tuple(keyframes.shape[:-3])}"
            ) from None
        if not traced(weights):
            made_outside(_check_weights, weights)
        return lead


def _is_pair(weights: Tensor, keyframes: Tensor) -> bool:
    """Whether :class:`InBetween` knows what to do: not of a key-frame that is not finite and has no weight."""
    return bool(((weights >= 0) & (weights <= 1)).all() & keyframes.isfinite().all())


def _check_weights(weights: Tensor) -> None:
    known, rounding = weights.double(), max(ROUNDING, torch.finfo(weights.dtype).eps)
    off, below = (known.sum(-1) - 1).abs(), -known.clamp_max(0).sum(-1)
    wrong = ~((off <= rounding) & (below <= MOST_BELOW_ZERO + rounding))
    if bool(wrong.any()):
        raise ValueError(
            f"weights add up to 1, those below zero to -{MOST_BELOW_ZERO} at most; got {known[wrong][0].tolist()}"
        )


def _with_exact_keyframes(shapes: Tensor, keyframes: Tensor, weights: Tensor) -> Tensor:
    """In-betweens, and key-frames to the last bit where they have all the weight; gradients stay as they are.

    Args:
        shapes: *Shape:* ``(..., V, 3)``.
        keyframes: The result has their dtype. *Shape:* ``(..., K, V, 3)``.
        weights: *Shape:* ``(..., K)``.
    """
    shapes = shapes.to(keyframes.dtype)
    alone = (weights != 0).sum(-1, keepdim=True) == 1
    for x, there in zip(keyframes.unbind(-3), ((weights == 1) & alone).unbind(-1), strict=True):
        shapes = with_exact(shapes, there, x)
    return shapes
