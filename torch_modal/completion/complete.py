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

from torch_modal.arrays import FloatArray
from torch_modal.autograd import outside_inference_mode
from torch_modal.completion.confidence import DOUBTFUL, compare, confidence_of
from torch_modal.completion.frames import CompletionProblem
from torch_modal.completion.gradient import LastSolve, ShapesOfPoints
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
    observations = list(observations)
    completion, axes, solves = _complete(
        whole.detach(), faces, observations, times, objective, estimate_times, progress
    )
    points = torch.cat([one.points.double().cpu() for one in observations])
    if not torch.is_grad_enabled() or not points.requires_grad:
        return completion
    knots = ShapesOfPoints.apply(list(solves.values()), axes, completion.knots, points)
    rows = [list(solves).index(t) for t in completion.times.tolist()]
    return completion._replace(knots=knots, shapes=knots[rows])


@outside_inference_mode
def _complete(
    whole: Tensor,
    faces: Tensor,
    observations: list[Observation],
    times: Times,
    objective: Objective,
    estimate_times: bool,
    progress: Progress,
) -> tuple[Completion, FloatArray, dict[float, LastSolve | None]]:
    """The motion; the turn to the axes of the minimisation; and, by time, how each knot was found, None if exact."""
    is_template = whole.dim() == 2
    like, shapes, indices = check_arrays(whole[None] if is_template else whole, faces)
    check_observations(observations, shapes.shape[1])
    exact = np.zeros(0) if is_template else check_times(times, len(shapes)).numpy()
    problem = CompletionProblem(shapes, torch.from_numpy(indices), exact, observations)
    with ProgressReport(len(problem.frames) * (4 + ROUNDS), "completing", progress) as report:
        poses = FramePoses(problem).search(report)
        if estimate_times:
            when = times_between(problem, poses)
            problem.frames = [frame._replace(time=t) for frame, t in zip(problem.frames, when, strict=True)]
        x, solves = Refinement(problem, objective).run(poses, report)
    misses, trust, seen, doubtful = compare(problem, x)
    sizes = [len(one.points) for one in observations]
    if doubtful:
        some = ", ".join(f"{t:g} ({100 * explained:.0f} %)" for t, explained in list(doubtful.items())[:8])
        warnings.warn(
            f"the shapes at {some} explain less than {100 * DOUBTFUL:.0f} % of the points seen then: they are "
            "doubtful, and their confidence is low. Do the points show this body, in its units?",
            MeshWarning,
            stacklevel=4,
        )
    moments = [frame.time for frame in problem.frames]
    whole_at = dict(zip(exact.tolist(), like, strict=False))
    shape_at = dict(zip(moments, problem.to_caller(x).to(like), strict=True)) | whole_at
    solve_at = dict(zip(moments, solves, strict=True)) | dict.fromkeys(whole_at)
    order = sorted(shape_at)
    knots = torch.stack([shape_at[t] for t in order])
    completion = Completion(
        torch.tensor(moments, dtype=torch.float64, device=like.device),
        torch.stack([shape_at[t] for t in moments]),
        confidence_of(problem, x, seen).to(like),
        list((misses / problem.scale).to(like).split(sizes)),
        list(trust.to(like).split(sizes)),
        knots,
        Path(knots, problem.faces, times=order, objective=objective) if len(order) > 1 else None,
    )
    return completion, problem.axes, {t: solve_at[t] for t in order}
