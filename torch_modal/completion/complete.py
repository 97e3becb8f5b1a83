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
from torch_modal.autograd import disable_compile, full_precision, outside_inference_mode
from torch_modal.completion.confidence import DOUBTFUL, HALF_AT, compare, expected_errors, size_of
from torch_modal.completion.frames import CompletionProblem
from torch_modal.completion.gradient import LastSolve
from torch_modal.completion.observation import Observation, check_observations, refuse_transforms
from torch_modal.completion.poses import FramePoses, times_between
from torch_modal.completion.refinement import ROUNDS, Refinement
from torch_modal.elastic.implicit import minimiser_of
from torch_modal.errors import MeshWarning
from torch_modal.geometry.crossings import require_contact
from torch_modal.inbetween.settings import Objective
from torch_modal.keyframes.check import check_arrays
from torch_modal.motion.path import Path
from torch_modal.progress import Progress, ProgressReport
from torch_modal.threads import alone
from torch_modal.times import Times, check_times


class Completion(NamedTuple):
    """A motion through whole shapes, which are exact, and completed ones."""

    times: Tensor
    """Of the observations, each once, ascending. *Shape:* ``(T,)``."""
    shapes: Tensor
    """The shapes then. *Shape:* ``(T, V, 3)``."""
    errors: Tensor
    """Distances from the truth within which nine of ten vertices are expected, in the caller's units, larger where the
    surface was not seen, moves far, or was found far from its shape by modes; 0 of key-frames. *Shape:* ``(T, V)``."""
    confidence: Tensor
    """The same from 0 to 1: a half at an error of 2 % of the diagonal, 1 at none. *Shape:* ``(T, V)``."""
    misses: list[Tensor]
    """Of each observation, in the order given, the distance of its points from the shape. *Shape of each:* ``(n,)``."""
    trust: list[Tensor]
    """Of each, what its points ended up counting for: 1, less for outliers, 0 where their weight is 0."""
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


@disable_compile
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
        the observations, through the last minimisation of all frames: exact ones of markers; where there are clouds or
        noisy meshes, pairs and poses by modes are constants of it, and a warning says so.

    Raises:
        ValueError: Key-frames, times or observations do not fit, the points are in other units, or the objective is
            none, or one of two shapes (``space="paired"``).
        RuntimeError: Within a transform of ``torch.func``, or forward mode.
        MissingPackageError: ``contact`` without that extra.
    """
    whole = torch.as_tensor(keyframes)
    if objective is not None and not isinstance(objective, Objective):
        raise ValueError(f"objective is a torch_modal.Objective; got {objective!r}")
    if whole.dim() == 2 and times is not None:
        raise ValueError("a template of the shape (V, 3) has no time; pass key-frames (1, V, 3) that have one")
    objective = objective or Objective()
    objective = objective if contact is None else replace(objective, contact=contact)
    if objective.space == "paired":
        raise ValueError("the paired space (Eq. 4) has two shapes for each time, a completion one: space='joint'")
    if objective.contact:
        require_contact()
    observations = list(observations)
    refuse_transforms("complete", whole)
    if torch.is_grad_enabled() and whole.requires_grad:
        message = "completed shapes have no gradients in the key-frames, in the points alone: pass keyframes.detach()"
        warnings.warn(message, MeshWarning, stacklevel=3)
    completion, axes, solve, rows = _complete(
        whole.detach(), faces, observations, times, objective, estimate_times, progress
    )
    points = torch.cat([one.points.double().cpu() for one in observations])
    if not torch.is_grad_enabled() or not points.requires_grad:
        return completion
    if solve is not None and not solve.smooth:
        message = "gradients of clouds and noisy meshes leave out pairs and poses: even their sign may be wrong"
        warnings.warn(f"{message}; those of markers are exact", MeshWarning, stacklevel=3)

    def pull_back(grad: Tensor) -> Tensor:
        slopes, turn = grad.cpu().double()[rows], torch.from_numpy(axes)
        if solve is None or not slopes.any():
            return torch.zeros_like(points)
        return solve.pull_back(slopes @ turn.mT, len(points)) @ turn

    knots = minimiser_of(points, completion.knots, pull_back)
    when = sorted({*completion.times.tolist(), *([] if completion.path is None else completion.path.times.tolist())})
    return completion._replace(knots=knots, shapes=knots[[when.index(t) for t in completion.times.tolist()]])


@full_precision
@outside_inference_mode
@alone()
def _complete(
    whole: Tensor,
    faces: Tensor,
    observations: list[Observation],
    times: Times,
    objective: Objective,
    estimate_times: bool,
    progress: Progress,
) -> tuple[Completion, FloatArray, LastSolve | None, list[int]]:
    """The motion; the turn to the axes of the minimisation, the last one, and the knots that it found."""
    is_template = whole.dim() == 2
    like, shapes, indices = check_arrays(whole[None] if is_template else whole, faces)
    check_observations(observations, shapes.shape[1])
    exact = np.zeros(0) if is_template else check_times(times, len(shapes)).numpy()
    problem = CompletionProblem(shapes, torch.from_numpy(indices), exact, observations)
    shape_at, solve = dict(zip(exact.tolist(), problem.whole, strict=False)), None
    poses: Sequence[Tensor] = []
    if problem.frames:
        with ProgressReport(len(problem.frames) * (3 + ROUNDS), "completing", progress) as report:
            poses, followed = zip(*FramePoses(problem).search(report), strict=True)
            if estimate_times:
                when = times_between(problem, poses)
                problem.frames = [frame._replace(time=t) for frame, t in zip(problem.frames, when, strict=True)]
            found, solve = Refinement(problem, objective).run(poses, followed, report)
        shape_at |= {frame.time: one for frame, one in zip(problem.frames, found, strict=True)}
    frames = sorted([*problem.frames, *problem.exact], key=lambda frame: frame.time)
    x = torch.stack([shape_at[frame.time] for frame in frames])
    misses, trust, seen, doubtful, stray = compare(problem, frames, x)
    sizes = [len(one.points) for one in observations]
    if doubtful:
        some = ", ".join(f"{t:g} ({100 * explained:.0f} %)" for t, explained in list(doubtful.items())[:8])
        warnings.warn(
            f"the shapes at {some} explain less than {100 * DOUBTFUL:.0f} % of the points seen then: those that are no "
            "key-frames are doubtful, and their confidence is low. Do the points show this body, in its units?",
            MeshWarning,
            stacklevel=7,
        )
    if (size := size_of(problem, x)) != 1:
        warnings.warn(
            f"the shapes are {size:.3g} times as large as the whole ones: are the points in another unit, or of "
            "another body? Scale the points, or the whole shapes, before",
            MeshWarning,
            stacklevel=7,
        )
    if stray:
        some = "; ".join(stray[:8])
        message = f"no shape explains {some}: leave them out if they are not of this body, else look at the shape there"
        warnings.warn(message, MeshWarning, stacklevel=7)
    order, moments = sorted(shape_at), [frame.time for frame in frames]
    whole_at = dict(zip(exact.tolist(), like, strict=False))  # bit for bit
    knots = torch.stack([whole_at[t] if t in whole_at else problem.to_caller(shape_at[t]).to(like) for t in order])
    by_modes = dict(zip([frame.time for frame in problem.frames], poses, strict=True))
    errors = expected_errors(problem, frames, x, by_modes, seen)
    half = HALF_AT * (problem.template.amax(0) - problem.template.amin(0)).norm()
    completion = Completion(
        torch.tensor(moments, dtype=torch.float64, device=like.device),
        knots[[order.index(t) for t in moments]],
        (errors / problem.scale).to(like),
        torch.exp2(-errors / half).to(like),
        list((misses / problem.scale).to(like).split(sizes)),
        list(trust.to(like).split(sizes)),
        knots,
        Path(knots, problem.faces, times=order, objective=objective) if len(order) > 1 else None,
    )
    return completion, problem.axes, solve, [order.index(frame.time) for frame in problem.frames]
