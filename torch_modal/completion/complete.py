r"""A motion from whole, partial and noisy samples.

The shapes :math:`x_i` at the times of the observations minimise

.. math:: \sum_i \sum_p \frac{w_p}{\sigma_p^2} \rho(x_i - q_p)^2 + \sum_i \sum_k s_{ik} d(\bar x_{ik}, x_i)

with the distances of observed points from the places that they are paired with, and the energy of Eq. 5 towards whole
shapes and neighbours in time. Poses and amplitudes of modes come first, then all vertices.
"""

import warnings
from collections.abc import Sequence
from dataclasses import replace
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor

from torch_modal.autograd import outside_inference_mode
from torch_modal.completion.confidence import DOUBTFUL, compare, confidence_of
from torch_modal.completion.frames import CompletionProblem
from torch_modal.completion.gradient import LastSolve, with_gradients
from torch_modal.completion.observation import Observation, check_observations
from torch_modal.completion.poses import FramePoses, times_between
from torch_modal.completion.refinement import ROUNDS, Refinement
from torch_modal.errors import MeshWarning
from torch_modal.geometry.crossings import require_contact
from torch_modal.inbetween.settings import Objective
from torch_modal.keyframes.check import check_arrays
from torch_modal.motion.path import Path
from torch_modal.progress import Progress, ProgressReport
from torch_modal.times import Times, check_times


class Completion(NamedTuple):
    """A motion through whole shapes, which are exact, and completed ones."""

    times: Tensor
    """Of the observations, each once, ascending. *Shape:* ``(T,)``."""
    shapes: Tensor
    """The shapes then. *Shape:* ``(T, V, 3)``."""
    confidence: Tensor
    """Near 1 where the surface was seen, then or at times nearby, and moves little between its neighbours in time; low
    where it moves far, above all unseen, or is inferred. *Shape:* ``(T, V)``."""
    misses: list[Tensor]
    """Of each observation, in the order given, the distance of its points from the shape. *Shape of each:* ``(n,)``."""
    trust: list[Tensor]
    """Weights that the points ended with: 1, or less for outliers. *Shape of each:* ``(n,)``."""
    knots: Tensor
    """Whole and completed shapes in the order of time. *Shape:* ``(K, V, 3)``."""
    path: Path | None
    """The motion through the knots; None where there is only one."""

    def __call__(self, t: Tensor | float) -> Tensor:
        """Shapes at times between the first and the last knot. *Shape:* ``(...) -> (..., V, 3)``.

        Raises:
            ValueError: A time is before or after these.
        """
        if self.path is not None:
            return self.path(self.knots, t)
        t = torch.as_tensor(t, dtype=self.times.dtype, device=self.knots.device)
        if not bool((t == self.times[0]).all()):
            raise ValueError(f"one shape alone is known, at {float(self.times[0]):g}; pass observations of more times")
        return self.knots[0].expand(*t.shape, -1, -1)


def complete(
    keyframes: Tensor,
    faces: Tensor,
    observations: Sequence[Observation],
    *,
    times: Times = None,
    estimate_times: bool = False,
    objective: Objective | None = None,
    contact: bool | None = None,
    progress: Progress = None,
) -> Completion:
    """A motion through whole key-frames and partial, noisy samples.

    Modal poses of all frames are found first, by pairs of points and places on the surface, from far to near, outward
    in time from what is known; points that nothing explains are tried on the limbs nearby. Then all vertices minimise
    the distances together with Eq. 5 towards neighbours in time and whole shapes (docs/completion.md).

    Args:
        keyframes: Whole shapes, which are exact, *shape* ``(K, V, 3)``, or one rest shape of no time, ``(V, 3)``.
        faces: Vertex indices. *Shape:* ``(F, 3)``.
        observations: What was seen, at any times, in any order; several may have the same time.
        times: Of the key-frames, ascending; 0, 1, 2 and so on by default. *Shape:* ``(K,)``.
        estimate_times: True where clocks are not exact: the time of each shape between others is the one at which the
            path through the others is nearest to it, in the same order. The first and the last keep theirs.
        objective: Stiffnesses of Eq. 5 and further terms of the energy of all vertices, and of the path; its other
            settings have no effect.
        contact: True to keep parts from passing through each other, instead of what the objective says
            (docs/contact.md; extra ``contact``). Gradients are of the shapes without contact.
        progress: A bar, :data:`torch_modal.progress.Progress`.

    Returns:
        The motion, in the dtype and on the device of the key-frames. Its shapes have first derivatives in the points of
        the observations, through the last minimisation: pairs, rest shapes and poses by modes are constants of it.

    Raises:
        ValueError: Key-frames, times or observations do not fit, the points are in other units, or the objective is
            one of two shapes (``space="paired"``).
        MissingPackageError: ``contact`` without that extra.
    """
    whole = torch.as_tensor(keyframes)
    if whole.dim() == 2 and times is not None:
        raise ValueError("a template of the shape (V, 3) has no time; pass key-frames (1, V, 3) that have one")
    objective = objective or Objective()
    objective = objective if contact is None else replace(objective, contact=contact)
    if objective.space == "paired":
        raise ValueError("the paired space (Eq. 4) has two shapes for each time, a completion one: space='joint'")
    if objective.contact:
        require_contact()
    solver = _Completer(whole.detach(), faces, observations, times, objective)
    completion, solves = solver.run(estimate_times, progress)
    points = [one.points for one in solver.observations]
    if not torch.is_grad_enabled() or not any(x.requires_grad for x in points):
        return completion
    return solver.with_gradients(completion, solves, points)


class _Completer:
    """All stages."""

    @outside_inference_mode
    def __init__(
        self,
        whole: Tensor,
        faces: Tensor,
        observations: Sequence[Observation],
        times: Times,
        objective: Objective,
    ) -> None:
        is_template = whole.dim() == 2
        self.like, shapes, indices = check_arrays(whole[None] if is_template else whole, faces)
        self.observations = check_observations(observations, shapes.shape[1])
        exact = np.zeros(0) if is_template else check_times(times, len(shapes)).numpy()
        self.objective = objective
        self.problem = CompletionProblem(shapes, torch.from_numpy(indices), exact, self.observations)
        #: Key-frames by their times.
        self.exact = dict(zip(exact.tolist(), self.like, strict=False))

    @outside_inference_mode
    def run(self, estimate: bool, progress: Progress) -> tuple[Completion, list[LastSolve]]:
        """The motion, and how each shape was found."""
        problem = self.problem
        with ProgressReport(len(problem.frames) * (4 + ROUNDS), "completing", progress) as report:
            poses = FramePoses(problem).search(report)
            if estimate:
                for frame, t in zip(problem.frames, times_between(problem, poses), strict=True):
                    frame.time = t
            x, solves = Refinement(problem, self.objective).run(poses, report)
        misses, trust, seen, doubtful = compare(problem, x)
        if doubtful:
            some = ", ".join(f"{t:g} ({100 * explained:.0f} %)" for t, explained in list(doubtful.items())[:8])
            warnings.warn(
                f"the shapes at {some} explain less than {100 * DOUBTFUL:.0f} % of the points seen then: they are "
                "doubtful, and their confidence is low. Do the points show this body, in its units?",
                MeshWarning,
                stacklevel=5,
            )
        times, like = [frame.time for frame in problem.frames], self.like
        shapes = [self.exact.get(t, problem.to_caller(one).to(like)) for t, one in zip(times, x, strict=True)]
        knots = self.exact | dict(zip(times, shapes, strict=True))
        order = sorted(knots)
        stacked = torch.stack([knots[t] for t in order])
        path = Path(stacked, problem.faces, times=order, objective=self.objective) if len(order) > 1 else None
        completion = Completion(
            torch.tensor(times, dtype=torch.float64, device=like.device),
            torch.stack(shapes),
            confidence_of(problem, x, seen).to(like),
            [(each / problem.scale).to(like) for each in misses],
            [each.to(like) for each in trust],
            stacked,
            path,
        )
        return completion, solves

    def with_gradients(
        self, completion: Completion, solves: Sequence[LastSolve], points: Sequence[Tensor]
    ) -> Completion:
        """Add gradients in the points."""
        at, every = completion.times.tolist(), sorted(set(self.exact) | set(completion.times.tolist()))
        used = [None if t in self.exact else solve for t, solve in zip(at, solves, strict=True)]
        shapes = with_gradients(completion.shapes, points, used, self.problem.axes)
        rows = torch.tensor([every.index(t) for t in at], device=shapes.device)
        return completion._replace(shapes=shapes, knots=completion.knots.index_copy(0, rows, shapes))
