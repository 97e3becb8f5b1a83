"""The last stage: steps of all vertices of all frames, with new pairs and new neighbours in each round."""

import numpy as np
import torch
from scipy import sparse
from torch import Tensor

from torch_modal.arrays import FloatArray
from torch_modal.completion.energy import PointEnergy
from torch_modal.completion.frames import OUTLIERS, CompletionProblem, Frame, robust
from torch_modal.completion.gradient import LastSolve
from torch_modal.completion.pairs import Cloud, Pairs, SampledSurface
from torch_modal.contact.active import ContactSearch
from torch_modal.contact.separate import separate
from torch_modal.elastic.backend import choose
from torch_modal.elastic.energy import RestShapes
from torch_modal.elastic.steps import ExtraEnergies, FineEnergy
from torch_modal.elastic.term import Mesh
from torch_modal.elastic.volume import encloses
from torch_modal.geometry.connectivity import vertex_areas
from torch_modal.inbetween.settings import Objective, stiffnesses
from torch_modal.progress import ProgressReport
from torch_modal.registration.fit import ElasticSurface

OWN_OF_CLOUDS, OWN, WHOLE = 0.4, 0.1, 0.1
"""Weights of the shape by modes, where there are clouds and without, and of whole shapes, in Eq. 5; neighbours in
time have the rest."""
STIFFNESS, OF_KNOWN, STIFFNESSES = 6.0, 2.0, (0.5, 15.0)
"""Of a point with a noise of 1, at a size of 100, in a cloud and at a known place; bounds within which that is adapted.
"""
FOLLOWS, WEIGHTS, REACH = 20, (0.02, 0.5), (15.0, 1.5)
"""Steps in which a shape follows clouds; weights of points next to a vertex's, and the largest distance of a pair, in
the first and in the last.
"""
ROUNDS, STEPS, PRODUCTS = 12, 2, 20
"""Rounds of new pairs, in each of which all vertices take steps, each with iterations of conjugate gradients."""
LAST = (6, 60)
"""Steps after the last round, and their iterations."""


ANCHOR = 1e-4
"""Weight of each vertex's place by modes, as :data:`WEIGHTS`."""


class Refinement:
    """Minimises the distances of points together with the energy towards rest shapes, frame by frame.

    Args:
        problem: What was seen.
        objective: Stiffnesses, terms beyond Eq. 5, and True for no contact.
    """

    def __init__(self, problem: CompletionProblem, objective: Objective) -> None:
        self.problem, self.frames = problem, problem.frames
        self.mesh, self.backend, self.contact = Mesh(problem.mesh), choose("auto"), objective.contact
        closed = all(encloses(x, problem.mesh) for x in problem.whole)
        terms = objective.all_terms()
        self.fine: FineEnergy = self.backend.fine_energy(self.mesh, terms)
        one = problem.whole[:1, 0, 0]
        self.stiffness = [x.detach() for x in stiffnesses(terms, self.fine.energy, one, torch.Size((1,)), closed)]
        points = self.fine.energy.anchors
        #: Fixed points of the terms. *Shape:* ``(1, P, 3)``.
        self.anchors = None if points is None else torch.from_numpy(problem.to_canonical(points))[None]
        #: Stiffness of points of known places, as :data:`OF_KNOWN`.
        self.of_known = OF_KNOWN

    def run(self, poses: list[Tensor], report: ProgressReport) -> tuple[Tensor, list[LastSolve]]:
        """Shapes of the frames from their poses by modes, and how each was found. *Shape:* ``(T, V, 3)``."""
        for frame, pose in zip(self.frames, poses, strict=True):
            surface = SampledSurface(pose.numpy(), self.problem.mesh)
            frame.samples = [one.with_noise(surface) for one in frame.samples]
        poses = [self._follow(frame, x) for frame, x in zip(self.frames, poses, strict=True)]
        (numbers, weights), solves = self._rests(), list[LastSolve]()
        x = torch.stack(poses)
        for k in range(ROUNDS + 1):
            shapes = torch.cat([torch.stack(poses), self.problem.whole, x])[numbers]
            steps = LAST if k == ROUNDS else (STEPS, PRODUCTS)
            solves = []
            for i, frame in enumerate(self.frames):
                rests = RestShapes(shapes[i : i + 1], weights[i : i + 1], self.stiffness, self.anchors)
                solves.append(self._relax(frame, x[i : i + 1], rests, steps))
                report.update(k < ROUNDS)
            x = torch.cat([solve.x for solve in solves])
            ratios = [
                ratio for frame, one in zip(self.frames, x, strict=True) for ratio in self._noise_ratios(frame, one)
            ]
            if ratios:
                # Points of known places are missed by their noise, neither more nor less (Morozov's discrepancy).
                factor = float(np.clip(np.median(ratios), 0.5, 2.0))
                self.of_known = float(np.clip(self.of_known * factor**2, *STIFFNESSES))
        if self.contact:
            x = self._separate(solves)
        return x, solves

    def _follow(self, frame: Frame, x: Tensor) -> Tensor:
        """The shape after as-rigid-as-possible steps towards the clouds of a frame. *Shape:* ``(V, 3)``."""
        if not frame.clouds:
            return x
        moved, n = x.numpy(), sum(len(cloud.points) for cloud in frame.clouds)
        surface = ElasticSurface(SampledSurface(moved, self.problem.mesh))
        unit = surface.stiffness * min(n, len(moved) / 2)
        # Every part is anchored, also one that no point is near.
        anchor = sparse.identity(len(moved), format="csr"), moved, np.full(len(moved), ANCHOR * surface.stiffness)
        for weight, reach in zip(np.geomspace(*WEIGHTS, FOLLOWS), np.geomspace(*REACH, FOLLOWS), strict=True):
            current, pulls = SampledSurface(moved, self.problem.mesh), [anchor]
            for pairs in [*(cloud.places(current) for cloud in frame.clouds), *frame.markers]:
                trust = robust(pairs.distances(moved), reach / OUTLIERS)
                pulls.append((pairs.places, pairs.points, weight * unit * pairs.weights * trust))
            moved = surface.follow(moved, pulls)
        return torch.from_numpy(moved)

    def _relax(self, frame: Frame, x: Tensor, rests: RestShapes, steps: tuple[int, int]) -> LastSolve:
        """Steps of all vertices of a frame, with pairs found where they start. *Shape:* ``(1, V, 3)``."""
        surface, numbers, springs = SampledSurface(x[0].numpy(), self.problem.mesh), [], []
        for sample in frame.samples:
            seen, n = sample.seen, len(sample.observation.points)
            pairs, factor = (seen.places(surface), STIFFNESS) if isinstance(seen, Cloud) else (seen, self.of_known)
            trust = robust(pairs.distances(surface.vertices), sample.noise)
            springs.append(pairs._replace(weights=factor / sample.noise**2 * n * pairs.weights * trust))
            numbers.append(np.full(len(pairs.points), sample.number))
        points = PointEnergy(springs)
        x = self.fine.relax(x, rests, (steps,), lambda *_: [points])
        return LastSolve(x, self.fine.energy, rests, points, np.concatenate(numbers))

    def _separate(self, solves: list[LastSolve]) -> Tensor:
        """Push apart the parts of each shape that pass through each other, but for what whole shapes do.

        *Shape:* ``(T, V, 3)``.
        """
        template = self.problem.template.numpy()
        areas = torch.from_numpy(vertex_areas(template, self.problem.mesh.faces))
        pairs = self.backend.crossings(self.problem.mesh, template)
        search, shapes = ContactSearch(self.mesh, self.problem.whole, areas, 1, pairs, template), []
        for solve in solves:

            def relax(x: Tensor, _: Tensor, extra: ExtraEnergies, solve: LastSolve = solve) -> Tensor:
                one_step = ((1, PRODUCTS),)
                return self.fine.relax(x, solve.rests, one_step, lambda *chunk: [solve.points, *extra(*chunk)])

            search.watched[:] = False  # each shape by itself
            shapes.append(separate(solve.x, relax, search)[0])
        return torch.cat(shapes)

    @staticmethod
    def _noise_ratios(frame: Frame, x: Tensor) -> list[float]:
        """Squared distances of points from their known places, over those that their noise explains."""
        misses = [one.distances(x.numpy()) for one in frame.markers]
        noises = [one.noise for one in frame.samples if isinstance(one.seen, Pairs)]
        return [
            float(np.mean(np.minimum(each / noise, OUTLIERS) ** 2)) / 3
            for each, noise in zip(misses, noises, strict=True)
        ]

    def _rests(self) -> tuple[Tensor, Tensor]:
        """Rest shapes of each frame, and their weights: its own by modes, whole ones, and neighbours in time.

        Numbers count frames by modes, then whole shapes, then frames as they are. *Shape of each:* ``(T, 5)``.
        """
        n, n_whole, exact = len(self.frames), len(self.problem.whole), self.problem.times
        times = np.array([frame.time for frame in self.frames])
        whole, frames = np.arange(n, n + n_whole), np.arange(n + n_whole, 2 * n + n_whole)
        every, numbers = np.concatenate([exact, times]), np.concatenate([whole[: len(exact)], frames])
        rows, weights = [], []
        for i, t in enumerate(times):
            others = numbers != frames[i]
            by_modes = OWN_OF_CLOUDS if self.frames[i].clouds else OWN
            row, parts = [i], [by_modes]
            for share, pool, which in (
                (WHOLE, exact, whole),
                (1 - by_modes - WHOLE, every[others], numbers[others]),
            ):
                first, last, u = _around(pool, t) if len(pool) else (0, 0, 0.0)
                which = which if len(pool) else whole  # the template, or one frame alone
                row, parts = [*row, which[first], which[last]], [*parts, share * (1 - u), share * u]
            rows.append(row)
            weights.append(parts)
        return torch.tensor(np.array(rows)), torch.tensor(weights, dtype=torch.float64)


def _around(times: FloatArray, t: float) -> tuple[int, int, float]:
    """Indices of the last time before another and of the first after, and how far between; the nearest, outside."""
    order = np.argsort(times, kind="stable")
    before = int(np.searchsorted(times[order], t, side="right")) - 1
    first, last = order[max(before, 0)], order[min(before + 1, len(times) - 1)]
    gap = times[last] - times[first]
    return int(first), int(last), float(np.clip((t - times[first]) / gap, 0, 1)) if gap > 0 else 0.0
