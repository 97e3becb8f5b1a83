"""The last stage: steps of all vertices of all frames, with new pairs and new neighbours in each round."""

from collections.abc import Sequence
from functools import partial

import numpy as np
import torch
from scipy.optimize import NoConvergence, anderson
from torch import Tensor

from torch_modal.completion.energy import PointEnergy
from torch_modal.completion.frames import CompletionProblem, Frame
from torch_modal.completion.gradient import LastSolve
from torch_modal.completion.markers import MarkerShape, shape_of_markers
from torch_modal.completion.pairs import OUTLIERS, SampledSurface, robust_weights
from torch_modal.contact.active import ContactSearch
from torch_modal.contact.separate import separate
from torch_modal.elastic.backend import choose
from torch_modal.elastic.energy import RestShapes
from torch_modal.elastic.steps import ExtraEnergies, FineEnergy
from torch_modal.elastic.term import Mesh
from torch_modal.elastic.volume import encloses
from torch_modal.inbetween.settings import Objective, stiffnesses
from torch_modal.progress import ProgressReport
from torch_modal.statistics.variation import Variation
from torch_modal.threads import run

OWN_OF_CLOUDS, OWN, OWN_OF_MARKERS, WHOLE = 0.4, 0.1, 0.5, 0.1
"""Weights of the shape by modes, where there are clouds and without, of the shape that markers show, and of whole
shapes, in Eq. 5; neighbours in time have the rest."""
STIFFNESS, OF_KNOWN, STIFFNESSES = 6.0, 2.0, (0.5, 15.0)
"""Of a point with a noise of 1, at a size of 100, in a cloud and at a known place; bounds within which that is adapted.
"""
ROUNDS, STEPS, PRODUCTS = 12, 2, 20
"""Rounds of new pairs, in each of which all vertices take steps, each with iterations of conjugate gradients."""
AHEAD = 0.8
"""Part of its last move by which a shape goes on before each round (momentum): twelve do as well as forty without."""
LAST = 6 * [60]
"""Steps after the last round, and their iterations."""
MOST_MARKERS = 0.5
"""Part of the vertices below which these are markers: noisy meshes also need their shapes by modes."""
STILL, MOST_ROUNDS = 1e-5, 40
"""Largest move of a vertex in a round, at a size of 100, where markers are at rest; rounds until then."""


class Refinement:
    """Minimises the distances of points together with the energy towards rest shapes, frame by frame.

    Args:
        problem: What was seen.
        objective: Stiffnesses, terms beyond Eq. 5, and True for no contact.
    """

    def __init__(self, problem: CompletionProblem, objective: Objective) -> None:
        self.problem = problem
        self.mesh, self.backend, self.contact = Mesh(problem.mesh), choose("auto"), objective.contact
        closed = all(encloses(x, problem.mesh) for x in problem.whole)
        terms = objective.all_terms()
        self.fine: FineEnergy = self.backend.fine_energy(self.mesh, terms)
        one = problem.whole[:1, 0, 0]
        self.stiffness = [x.detach() for x in stiffnesses(terms, self.fine.energy, one, torch.Size((1,)), closed)]
        points = self.fine.energy.anchors
        #: Fixed points of the terms. *Shape:* ``(1, P, 3)``.
        self.anchors = None if points is None else torch.from_numpy(problem.to_canonical(points))[None]

    def run(
        self, poses: Sequence[Tensor], followed: Sequence[Tensor], report: ProgressReport
    ) -> tuple[Tensor, LastSolve]:
        """Shapes of the frames, from those by modes and those that follow their clouds; and how they were found.

        *Shape of each:* ``(V, 3)``; *shape:* ``(T, V, 3)``.
        """
        frames = self.problem.frames
        # With few markers, shapes are smooth functions of the points, and are minimised until nothing moves.
        few = MOST_MARKERS * len(self.problem.template)
        smooth = all(one.places is not None and len(one.points) < few for frame in frames for one in frame.seen)
        for i, pose in enumerate(poses):
            surface = SampledSurface(pose.numpy(), self.problem.mesh)
            frames[i] = frames[i]._replace(seen=[one.with_noise(surface) for one in frames[i].seen])
        x = torch.stack(list(followed))
        markers: list[MarkerShape | None] = self._markers(x) if smooth else [None] * len(frames)
        own = torch.stack([each if one is None else one.x.detach() for one, each in zip(markers, x, strict=True)])
        shares = [OWN_OF_MARKERS if one else OWN * (not smooth) for one in markers]
        (numbers, weights), of_known = self._rests(shares), OF_KNOWN

        def rests_of(x: Tensor, own: Tensor) -> list[RestShapes]:
            shapes = torch.cat([own, self.problem.whole, x])[numbers]
            rows = zip(shapes.split(1), weights.split(1), strict=True)
            return [RestShapes(*row, self.stiffness, self.anchors) for row in rows]

        def relax(x: Tensor, products: list[int], start: Tensor | None = None) -> LastSolve:
            starts = (x if start is None else start).split(1)
            rows = zip(frames, starts, rests_of(x, own), strict=True)
            every = run([partial(self._relax, frame, one, rests, products, of_known) for frame, one, rests in rows])
            x, points = torch.cat([one for one, _ in every]), [p for _, p in every]
            return LastSolve(x, own, self.fine.energy, rests_of, points, markers, smooth)

        before = x
        for _ in range(ROUNDS):
            x, before = relax(x, STEPS * [PRODUCTS], x + AHEAD * (x - before)).x, x
            report.update(len(frames))
            # Points of known places are missed by their noise, neither more nor less (Morozov's discrepancy).
            ratios = [
                frame.weight * (one.weights @ np.minimum(one.distances(shape) / one.noise, OUTLIERS) ** 2) / 3
                for frame, shape in zip(frames, x.numpy(), strict=True)
                for one in frame.seen
                if one.places is not None
            ]
            if ratios:
                of_known = float(np.clip(of_known * np.clip(np.median(ratios), 0.5, 2.0) ** 2, *STIFFNESSES))
        if smooth:
            of_known = 2.0 ** round(np.log2(of_known))  # a constant of the gradient
            options = {"alpha": 1.0, "line_search": None, "f_tol": STILL, "maxiter": MOST_ROUNDS}
            try:
                # SciPy divides infinite steps where nothing moves at the start.
                with np.errstate(invalid="ignore"):
                    moved = anderson(
                        lambda x: relax(torch.from_numpy(x), STEPS * [PRODUCTS]).x.numpy() - x, x.numpy(), **options
                    )
            except NoConvergence as error:
                moved = error.args[0]
            x = torch.from_numpy(moved)
        solve = relax(x, LAST)
        return self._separate(solve) if self.contact else solve.x, solve

    def _relax(
        self, frame: Frame, x: Tensor, rests: RestShapes, products: list[int], of_known: float
    ) -> tuple[Tensor, PointEnergy]:
        """Steps of all vertices of a frame, with pairs found where they start, and these. *Shape:* ``(1, V, 3)``."""
        surface, springs, trusts = SampledSurface(x[0].numpy(), self.problem.mesh), [], []
        for seen in frame.seen:
            pairs, factor = seen.pair(surface), STIFFNESS if seen.places is None else of_known
            trust = robust_weights(pairs.distances(surface.vertices), seen.noise)
            weights = factor / seen.noise**2 * frame.weight * len(seen.points) * pairs.weights * trust
            springs.append(pairs._replace(weights=weights))
            trusts.append(np.ones(len(trust)) if seen.places is None else trust)
        points = PointEnergy(springs, np.concatenate(trusts))
        return self.fine.relax(x, rests, products, lambda *_: [points]), points

    def _separate(self, solve: LastSolve) -> Tensor:
        """Push apart the parts of each shape that pass through each other, but for what whole shapes do.

        *Shape:* ``(T, V, 3)``.
        """
        problem, shapes = self.problem, []
        search = ContactSearch(self.backend, problem.mesh, problem.whole, problem.template, 1)
        for x, rests, points in zip(solve.x.split(1), solve.rests(solve.x, solve.own), solve.points, strict=True):

            def relax(
                x: Tensor, _: Tensor, extra: ExtraEnergies, rests: RestShapes = rests, points: PointEnergy = points
            ) -> Tensor:
                return self.fine.relax(x, rests, [PRODUCTS], lambda *chunk: [points, *extra(*chunk)])

            search.watched[:] = False  # each shape by itself
            shapes.append(separate(x, relax, search)[0])
        return torch.cat(shapes)

    def _markers(self, by_modes: Tensor) -> list[MarkerShape | None]:
        """The shape that the markers of each frame show, between the key-frames."""
        whole, frames = self.problem.whole, self.problem.frames
        if len(whole) < 2:
            return [None] * len(frames)
        order = np.roll(np.arange(len(whole)), -self.problem.largest)  # whatever the order of the caller
        variation, work = Variation(whole[order], self.problem.faces), []
        for frame, x in zip(frames, by_modes, strict=True):
            near = [np.interp(frame.time, self.problem.times, row) for row in np.eye(len(whole))[order]]
            about = torch.tensor(np.array(near))
            work.append(partial(shape_of_markers, variation, frame, about, x, self.problem.differentiable))
        return run(work)

    def _rests(self, own: list[float]) -> tuple[Tensor, Tensor]:
        """Rest shapes of each frame, and their weights: its own, whole ones, and neighbours in time.

        Numbers count the frames' own shapes, then whole ones, then frames as they are. *Shape of each:* ``(T, 5)``.
        """
        frames, exact = self.problem.frames, self.problem.times
        n, n_whole, times = len(frames), len(self.problem.whole), np.array([frame.time for frame in frames])
        whole, completed = np.arange(n, n + len(exact)), np.arange(n + n_whole, 2 * n + n_whole)
        rows, weights = [], []
        for i, frame in enumerate(frames):
            alone = OWN_OF_CLOUDS if any(one.places is None for one in frame.seen) else own[i]
            every = np.append(whole, np.delete(completed, i)), np.append(exact, np.delete(times, i))
            row, shares = [i], [alone]
            for share, numbers, when in ((WHOLE, whole, exact), (1 - alone - WHOLE, *every)):
                if not len(when):  # the template, of no time
                    numbers, when = np.array([n]), np.zeros(1)
                order = np.argsort(when, kind="stable")
                after = np.searchsorted(when[order], frame.time, side="right")
                ends = order[np.clip([after - 1, after], 0, len(when) - 1)]
                u = float(np.interp(frame.time, when[ends], (0.0, 1.0)))
                row, shares = [*row, *numbers[ends]], [*shares, share * (1 - u), share * u]
            rows.append(row)
            weights.append(shares)
        return torch.tensor(np.array(rows)), torch.tensor(weights, dtype=torch.float64)
