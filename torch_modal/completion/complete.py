r"""A motion from whole, partial and noisy samples.

The shapes :math:`x_i` at the times of the observations minimise

.. math:: \sum_i \sum_p \frac{w_p}{\sigma_p^2} \rho(x_i - q_p)^2 + \sum_i \sum_k s_{ik} d(\bar x_{ik}, x_i)

with the distances of observed points from the places that they are paired with, and the energy of Eq. 5 towards whole
shapes and neighbours in time. Poses and amplitudes of modes come first, then all vertices.
"""

import warnings
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import torch
from scipy.spatial import cKDTree
from torch import Tensor

from torch_modal.arrays import BoolArray, FloatArray
from torch_modal.autograd import outside_inference_mode
from torch_modal.completion.bending import ModalBending, ModalPose
from torch_modal.completion.energy import PointEnergy
from torch_modal.completion.gradient import LastSolve, with_gradients
from torch_modal.completion.observation import Observation, check_observations
from torch_modal.completion.pairs import Cloud, Pairs, SampledSurface
from torch_modal.completion.search import HALF, SOFT, PoseSearch, Seen
from torch_modal.elastic.backend import choose
from torch_modal.elastic.bend import Bend
from torch_modal.elastic.energy import RestShapes
from torch_modal.elastic.shell import ALPHA, BETA, GAMMA
from torch_modal.elastic.steps import FineEnergy
from torch_modal.elastic.stretch import Stretch
from torch_modal.elastic.term import Mesh
from torch_modal.elastic.volume import Volume, encloses
from torch_modal.errors import MeshWarning
from torch_modal.geometry.canonical import to_canonical
from torch_modal.geometry.rigid import best_fit
from torch_modal.geometry.triangle_frames import frames_of, mirrored_sides
from torch_modal.keyframes.arrays import require_units
from torch_modal.keyframes.check import check_arrays
from torch_modal.modes.coarsening import Coarsening, coarsen
from torch_modal.modes.extract import extract_bases
from torch_modal.motion.decoder import scale_modes
from torch_modal.motion.path import Path
from torch_modal.progress import Progress, ProgressReport
from torch_modal.registration.surface import places_between
from torch_modal.times import check_times

N_MODES = 60
"""Modes of the first shape in which poses are searched."""
COARSE_FACES = 2500
"""Faces of the mesh on which they are searched; of fewer, it is the caller's."""
SHIFTS = (-0.17, 0.17)
"""Times at which a motion may be instead of where its neighbours say, in parts of the gap between these."""

TRUSTED, N_ALIKE = 0.34, 2
"""Part of the frames, those that explain most, from which the others are searched again; starts from their shapes."""

OWN_OF_CLOUDS, OWN, WHOLE = 0.4, 0.1, 0.1
"""Weights of the shape by modes, where there are clouds and without, and of whole shapes, in Eq. 5; neighbours in
time have the rest."""
STIFFNESS, STIFFNESSES = 2.0, (0.5, 15.0)
"""Of a point with a noise of 1, at a size of 100; bounds within which it is adapted where places are known."""
SWAY = 2.0
"""Standard deviation of the amplitude of the first mode, at a size of 100."""
NOISE = 0.5
"""Of points before it is estimated, at a size of 100."""
NOISES_OF_HALF = 3.0
"""Noises of the distance at which half of a miss counts."""
NOISES = 0.1, 2.0
"""Least noise, and the largest that is estimated, at a size of 100."""
ROUNDS, STEPS, PRODUCTS = 12, 2, 20
"""Rounds of new pairs, in each of which all vertices take steps, each with iterations of conjugate gradients."""
LAST = (6, 60)
"""Steps after the last round, and their iterations."""
OUTLIERS = 4.0
"""Distance, in standard deviations of the noise, at which a point loses three quarters of its weight."""

NEAR = 2.5
"""Distance from an observed point within which a vertex counts as seen, at a size of 100."""
NEIGHBOURS = 0.9
"""Confidence of what a neighbour in time saw."""
HALF_AFTER = 0.02
"""Motion between neighbours in time, in parts of the diagonal, that halves the confidence of what is half seen."""
DOUBTFUL = 0.5
"""Part of the points that a shape has to explain."""


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


class ModalFit(NamedTuple):
    """A frame by modes."""

    x: Tensor
    base: Tensor
    pose: ModalPose
    score: float
    """How much it leaves unexplained."""


class _Sample(NamedTuple):
    """An observation at a size of 100."""

    observation: Observation
    number: int
    seen: Cloud | Pairs
    noise: float
    """Its standard deviation; 0 where it is not known yet."""

    def off(self, surface: SampledSurface) -> tuple[FloatArray, BoolArray]:
        """Distances of the points from their places, and if normals agree. *Shape:* ``(n,)``."""
        if isinstance(self.seen, Cloud):
            return self.seen.closest(surface)[2:]
        off = np.linalg.norm(self.seen.places @ surface.vertices - self.seen.points, axis=1)
        return off, np.ones(len(off), bool)


class _Frame:
    """Observations of one time."""

    def __init__(self, time: float, samples: list[_Sample]) -> None:
        self.time, self.samples = time, samples
        self.clouds = [one.seen for one in samples if isinstance(one.seen, Cloud)]
        self.markers = [one.seen for one in samples if isinstance(one.seen, Pairs)]

    def seen(self, markers: list[Pairs]) -> Seen:
        """Observations that a pose is searched for; modes' amplitudes have the standard deviation :data:`SWAY`."""
        soft = min((one.noise or NOISE) ** 2 / (SWAY**2 * len(one.observation.points)) for one in self.samples)
        unit = NOISES_OF_HALF * max(one.noise for one in self.samples)
        return Seen(self.clouds, markers, max(SOFT, soft), max(HALF, unit))


def complete(
    keyframes: Tensor,
    faces: Tensor,
    observations: Sequence[Observation],
    *,
    times: Tensor | Sequence[float] | None = None,
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
        progress: A bar, :data:`torch_modal.progress.Progress`.

    Returns:
        The motion, in the dtype and on the device of the key-frames. Its shapes have first derivatives in the points of
        the observations, through the last minimisation: pairs, rest shapes and poses by modes are constants of it.

    Raises:
        ValueError: Key-frames, times or observations do not fit, or the points are in other units.
    """
    whole = torch.as_tensor(keyframes)
    is_template = whole.dim() == 2
    if is_template and times is not None:
        raise ValueError("a template of the shape (V, 3) has no time; pass key-frames (1, V, 3) that have one")
    completion, solver, points = _complete(whole.detach(), faces, observations, times, progress)
    if not torch.is_grad_enabled() or not any(x.requires_grad for x in points):
        return completion
    return _differentiable(completion, solver, points)


@outside_inference_mode
def _complete(
    whole: Tensor,
    faces: Tensor,
    observations: Sequence[Observation],
    times: Tensor | Sequence[float] | None,
    progress: Progress,
) -> tuple[Completion, "_Completer", list[Tensor]]:
    is_template = whole.dim() == 2
    like, shapes, indices = check_arrays(whole[None] if is_template else whole, faces)
    given = check_observations(observations, shapes.shape[1])
    at = np.zeros(0) if is_template else check_times(times, len(shapes)).numpy()
    solver = _Completer(shapes, torch.from_numpy(indices), at, given)
    with ProgressReport(len(solver.frames) * (4 + ROUNDS), "completing", progress) as report:
        solver.search(report)
        solver.refine(report)
    return solver.result(like), solver, [one.points for one in given]


def _differentiable(completion: Completion, solver: "_Completer", points: Sequence[Tensor]) -> Completion:
    """Add gradients in the points to a completion."""
    exact, at = set(solver.times.tolist()), completion.times.tolist()
    solves = [None if t in exact else own for t, own in zip(at, solver.solves, strict=True)]
    shapes = with_gradients(completion.shapes, points, solves, solver.axes)
    rows = torch.tensor([i for i, t in enumerate(sorted(exact | set(at))) if t in at], device=shapes.device)
    return completion._replace(shapes=shapes, knots=completion.knots.index_copy(0, rows, shapes))


class _Completer:
    """The solver, at a size of 100 in the axes of the first shape."""

    def __init__(self, shapes: FloatArray, faces: Tensor, times: FloatArray, given: list[Observation]) -> None:
        self.faces, self.times, self.n = faces, times, len(given)
        _, self.axes, self.centre, self.scale = to_canonical(shapes[0], faces.numpy())
        self.whole = torch.from_numpy((shapes - self.centre) @ self.axes.T * self.scale)
        self.template = self.whole[0]
        samples = [self._sample(one, i) for i, one in enumerate(given)]
        every = sorted({one.time for one in given})
        self.frames = [_Frame(t, [one for one in samples if one.observation.time == t]) for t in every]
        mesh = Mesh.of(faces, shapes.shape[1])
        self.mesh = mesh.connectivity
        closed = all(encloses(x, self.mesh) for x in self.whole)
        self.stiffness = ALPHA, BETA, GAMMA if closed else 0.0
        self.fine: FineEnergy = choose("auto").fine_energy(mesh, [Stretch(ALPHA), Bend(BETA), Volume(GAMMA)])
        basis = extract_bases(self.template[None], faces, N_MODES)[0]
        modes = scale_modes(basis.modes, 100.0)
        self.bending = ModalBending(self.template, faces, modes)
        self.coarse: Coarsening | None = None
        coarse_bending = self.bending
        if len(faces) > COARSE_FACES:
            self.coarse = coarsen(self.whole.numpy(), faces.numpy(), COARSE_FACES, range(len(self.whole)), {})
            restricted = [torch.from_numpy(self.coarse.restrict(x.numpy())) for x in (self.template, modes)]
            coarse_bending = ModalBending(restricted[0], torch.from_numpy(self.coarse.faces), restricted[1])
        self.poses = PoseSearch(coarse_bending, basis.eigenvalues)
        self.x: list[Tensor] = []
        #: Stiffness of points of known places, as :data:`STIFFNESS`.
        self.of_known = STIFFNESS
        self.solves: list[LastSolve] = []

    # ------------------------------------------------------------------------------------------------------- the input
    def _to_canonical(self, x: Tensor, direction: bool = False) -> FloatArray:
        points = x.detach().cpu().double().numpy()
        return points @ self.axes.T if direction else (points - self.centre) @ self.axes.T * self.scale

    def _sample(self, one: Observation, number: int) -> _Sample:
        """An observation at a size of 100; raises where it is in other units."""
        points, known = self._to_canonical(one.points), self.template[self.faces.unique()]
        weights = np.ones(len(points)) if one.weights is None else one.weights.cpu().double().numpy()
        seen: Cloud | Pairs
        if one.is_cloud:
            normals, view = (None if x is None else self._to_canonical(x, True) for x in (one.normals, one.view))
            seen = Cloud(points, normals, weights, view)
        else:
            corners, barycentric = one.places()
            places = places_between(corners.cpu().numpy(), barycentric.cpu().double().numpy(), len(self.template))
            seen = Pairs(places, points, None, weights / weights.sum(), np.arange(len(points)))
            known = torch.from_numpy(places @ self.template.numpy())
        require_units(f"{one}: the points", torch.from_numpy(points), "the first shape", known[None], 1 / self.scale)
        return _Sample(one, number, seen, 0.0 if one.noise is None else max(one.noise * self.scale, NOISES[0]))

    # ------------------------------------------------------------------------------------------------- poses of frames
    def search(self, report: ProgressReport) -> None:
        """Modal poses of all frames, outward in time from what is known, and then from those that explain most."""
        n, whole = len(self.frames), list(zip(self.times, self.whole, strict=False))
        fits = dict[int, ModalFit]()
        if not whole:
            rigid = [self._place_rigidly(i, self.template) for i in range(n)]
            first = int(np.argmin([score for _, score in rigid]))
            fits[first] = self._search(first, [(self.template, rigid[first][0])])
            report.update()
        self._outward(fits, {}, whole, report)
        bound = float(np.quantile([one.score for one in fits.values()], TRUSTED))
        trusted = {i: one for i, one in fits.items() if one.score <= bound}
        report.update(len(trusted))
        self._outward(trusted, fits, whole, report)
        for i in sorted(range(n), key=lambda i: -trusted[i].score):
            others = {j: one for j, one in trusted.items() if j != i}
            if others or whole:
                again = self._search(i, self._starts(self.frames[i].time, self._known(others, whole)))
                trusted[i] = min(trusted[i], again, key=lambda one: one.score)
            report.update()
        fits = trusted
        for i in range(n):
            one = fits[i]
            pose = self.poses.stiffen(self._coarsen(one.base), one.pose, self._seen(i))
            self.x.append(self.bending.shape(one.base, pose))
            report.update()

    def _outward(
        self,
        fits: dict[int, ModalFit],
        before: dict[int, ModalFit],
        whole: list[tuple[float, Tensor]],
        report: ProgressReport,
    ) -> None:
        """Add all other frames, those near in time to what is known first; none is worse than it was before."""
        left = [i for i in range(len(self.frames)) if i not in fits]
        while left:
            known = self._known(fits, whole)
            gaps = [min(abs(self.frames[i].time - t) for t, _ in known) for i in left]
            i = left.pop(int(np.argmin(gaps)))
            starts = self._starts(self.frames[i].time, known)
            if before:
                starts += self._alike(i, [x for _, x in known])
            fits[i] = self._search(i, starts)
            if i in before:
                fits[i] = min(fits[i], before[i], key=lambda one: one.score)
            report.update()

    def _known(self, fits: dict[int, ModalFit], whole: list[tuple[float, Tensor]]) -> list[tuple[float, Tensor]]:
        """Times and shapes of frames, and of whole ones, in the order of time."""
        return sorted([*whole, *((self.frames[i].time, one.x) for i, one in fits.items())], key=lambda one: one[0])

    def _alike(self, i: int, shapes: Sequence[Tensor]) -> list[tuple[Tensor, ModalPose]]:
        """The shapes that explain most of a frame after a rigid motion: motions repeat."""
        placed = [(x, *self._place_rigidly(i, x)) for x in shapes]
        return [(x, pose) for x, pose, _ in sorted(placed, key=lambda one: one[2])[:N_ALIKE]]

    def _starts(self, t: float, known: list[tuple[float, Tensor]]) -> list[tuple[Tensor, ModalPose]]:
        """Shapes from which a search at a time starts."""
        times, shapes = np.array([own for own, _ in known]), torch.stack([x for _, x in known])
        if t in times:
            return [(shapes[int(np.argmin(np.abs(times - t)))], self.bending.still())]
        if len(known) > 1 and times[0] < t < times[-1]:
            path = Path(shapes, self.faces, times=times.tolist())
            after = int(np.searchsorted(times, t))
            gap = times[after] - times[after - 1]
            base = path(shapes, t)
            bases = [base]
            for shift in SHIFTS:
                other = path(shapes, float(np.clip(t + shift * gap, times[0], times[-1])))
                bases.append(best_fit(other, base).apply(other))
        else:
            nearest = np.argsort(np.abs(times - t))
            bases = [shapes[nearest[0]]]
            if len(known) > 1:
                bases.append(self._beyond(shapes[nearest[1]], shapes[nearest[0]]))
        return [(x, self.bending.still()) for x in bases]

    def _beyond(self, before: Tensor, last: Tensor) -> Tensor:
        """The shape as far after the last one as that is after the one before."""
        motion = best_fit(before, last)
        sides = mirrored_sides(frames_of(last[None], self.faces), frames_of(motion.apply(before)[None], self.faces))
        x = self.bending.reconstruction(sides, last.T[:, None].contiguous())[:, 0].T
        x = best_fit(x, last).apply(x)
        middle = last.mean(0)
        return (x - middle) @ motion.rotation.mT + 2 * middle - before.mean(0)

    def _place_rigidly(self, i: int, x: Tensor) -> tuple[ModalPose, float]:
        """The pose of a shape in a frame, and how much it leaves unexplained."""
        seen, base = self._seen(i), self._coarsen(x)
        pose = self.poses.rigid(base, seen)
        return pose, self.poses.score(base, pose, seen)

    def _search(self, i: int, starts: Sequence[tuple[Tensor, ModalPose]]) -> ModalFit:
        """A frame by modes."""
        own = [(self._coarsen(x), pose) for x, pose in starts]
        k, pose, score = self.poses.fit(own, self._seen(i))
        base = starts[k][0]
        return ModalFit(self.bending.shape(base, pose), base, pose, score)

    def _seen(self, i: int) -> Seen:
        """Observations of a frame, on the coarse mesh."""
        return self.frames[i].seen([self._restrict(pairs) for pairs in self.frames[i].markers])

    def _coarsen(self, x: Tensor) -> Tensor:
        return x if self.coarse is None else torch.from_numpy(self.coarse.restrict(x.numpy()))

    def _restrict(self, pairs: Pairs) -> Pairs:
        """Known places on the coarse mesh."""
        if self.coarse is None:
            return pairs
        rows = pairs.places.tocoo()
        cluster = np.maximum(self.coarse.clusters[rows.col], 0)
        shape = len(pairs.points), self.coarse.n_vertices
        return pairs._replace(places=type(rows)((rows.data, (rows.row, cluster)), shape=shape).tocsr())

    # ---------------------------------------------------------------------------------------------------- all vertices
    def refine(self, report: ProgressReport) -> None:
        """Steps of all vertices of all frames, with new pairs and new neighbours in each round."""
        x = torch.stack(self.x)
        for frame, own in zip(self.frames, self.x, strict=True):
            surface = SampledSurface(own.numpy(), self.mesh)
            frame.samples = [self._with_noise(one, surface) for one in frame.samples]
        stiffness = [x.new_full((1, 1), value) for value in self.stiffness]
        numbers, weights = self._rests()
        for k in range(ROUNDS + 1):
            shapes = torch.cat([torch.stack(self.x), self.whole, x])[numbers]
            steps = LAST if k == ROUNDS else (STEPS, PRODUCTS)
            self.solves = []
            for i, frame in enumerate(self.frames):
                rests = RestShapes(shapes[i : i + 1], weights[i : i + 1], stiffness)
                self.solves.append(self._relax(frame, x[i : i + 1], rests, steps))
                report.update(k < ROUNDS)
            x = torch.cat([solve.x for solve in self.solves])
            ratios = [
                ratio for frame, own in zip(self.frames, x, strict=True) for ratio in self._noise_ratios(frame, own)
            ]
            if ratios:
                # Points of known places are missed by their noise, neither more nor less (Morozov's discrepancy).
                factor = float(np.clip(np.median(ratios), 0.5, 2.0))
                self.of_known = float(np.clip(self.of_known * factor**2, *STIFFNESSES))
        self.x = list(x)

    def _relax(self, frame: _Frame, x: Tensor, rests: RestShapes, steps: tuple[int, int]) -> LastSolve:
        """Steps of all vertices of a frame, with pairs found where they start. *Shape:* ``(1, V, 3)``."""
        surface, numbers, springs = SampledSurface(x[0].numpy(), self.mesh), [], []
        for sample in frame.samples:
            seen = sample.seen
            pairs, own = (seen.pairs(surface), STIFFNESS) if isinstance(seen, Cloud) else ([seen], self.of_known)
            stiffness = own / sample.noise**2 * len(sample.observation.points)
            for one in pairs:
                counts = robust(np.linalg.norm(one.places @ surface.vertices - one.points, axis=1), sample.noise)
                springs.append(one._replace(weights=stiffness * one.weights * counts))
                numbers.append(np.full(len(one.points), sample.number))
        points = PointEnergy(springs)
        x = self.fine.relax(x, rests, (steps,), lambda *_: [points])
        return LastSolve(x, self.fine.energy, rests, points, np.concatenate(numbers))

    @staticmethod
    def _noise_ratios(frame: _Frame, x: Tensor) -> list[float]:
        """Squared distances of points from their known places, over those that their noise explains."""
        off = [np.linalg.norm(own.places @ x.numpy() - own.points, axis=1) for own in frame.markers]
        noises = [one.noise for one in frame.samples if isinstance(one.seen, Pairs)]
        return [
            float(np.mean(np.minimum(own / noise, OUTLIERS) ** 2)) / 3 for own, noise in zip(off, noises, strict=True)
        ]

    @staticmethod
    def _with_noise(one: _Sample, surface: SampledSurface) -> _Sample:
        """A sample with its noise, estimated where it is not known: from the median of distances with such an error."""
        if one.noise:
            return one
        median = float(np.median(one.off(surface)[0])) / (0.6745 if isinstance(one.seen, Cloud) else 1.538)
        return one._replace(noise=float(np.clip(median, *NOISES)))

    def _rests(self) -> tuple[Tensor, Tensor]:
        """Rest shapes of each frame, and their weights: its own by modes, whole ones, and neighbours in time.

        Numbers count frames by modes, then whole shapes, then frames as they are. *Shape of each:* ``(T, 5)``.
        """
        n, times = len(self.frames), np.array([frame.time for frame in self.frames])
        whole = np.arange(n, n + len(self.whole))
        frames = np.arange(n + len(self.whole), 2 * n + len(self.whole))
        every, numbers = np.concatenate([self.times, times]), np.concatenate([whole[: len(self.times)], frames])
        rows, weights = [], []
        for i, t in enumerate(times):
            others = numbers != frames[i]
            by_modes = OWN_OF_CLOUDS if self.frames[i].clouds else OWN
            row, parts = [i], [by_modes]
            for share, pool, own in (
                (WHOLE, self.times, whole),
                (1 - by_modes - WHOLE, every[others], numbers[others]),
            ):
                first, last, u = _around(pool, t) if len(pool) else (0, 0, 0.0)
                own = own if len(pool) else whole  # the template, or one frame alone
                row, parts = [*row, own[first], own[last]], [*parts, share * (1 - u), share * u]
            rows.append(row)
            weights.append(parts)
        return torch.tensor(np.array(rows)), torch.tensor(weights, dtype=torch.float64)

    # ---------------------------------------------------------------------------------------------------------- result
    def result(self, like: Tensor) -> Completion:
        """The motion in the caller's coordinates."""
        x = torch.stack(self.x)
        misses: list[Tensor] = [like.new_zeros(0)] * self.n
        trust, seen, poor = list(misses), x.new_zeros(x.shape[:2]), []
        for i, frame in enumerate(self.frames):
            surface = SampledSurface(x[i].numpy(), self.mesh)
            for one in frame.samples:
                off, agree = one.off(surface)
                counts = agree * robust(off, one.noise)
                misses[one.number] = torch.from_numpy(off / self.scale).to(like)
                trust[one.number] = torch.from_numpy(counts).to(like)
                points = self._to_canonical(one.observation.points)
                gaps, nearest = cKDTree(points).query(surface.vertices, 3)
                close = (counts[nearest] * np.exp(-0.5 * (gaps / NEAR) ** 2)).max(1)
                part = float(counts.mean())
                if part < DOUBTFUL:
                    poor.append(f"{frame.time:g} ({100 * part:.0f} %)")
                seen[i] = torch.maximum(seen[i], min(1.0, part / DOUBTFUL) * torch.from_numpy(close))
        if poor:
            warnings.warn(
                f"the shapes at {', '.join(poor[:8])} explain less than {100 * DOUBTFUL:.0f} % of the points seen "
                "then: they are doubtful, and their confidence is low. Do the points show this body, in its units?",
                MeshWarning,
                stacklevel=4,
            )
        confidence = self._confidence(x, seen)
        at = [frame.time for frame in self.frames]
        exact = dict(zip(self.times.tolist(), like, strict=False))
        done = [exact.get(t, self._restore(own).to(like)) for t, own in zip(at, x, strict=True)]
        knots = exact | dict(zip(at, done, strict=True))
        times = sorted(knots)
        stacked = torch.stack([knots[t] for t in times])
        path = Path(stacked, self.faces, times=times) if len(times) > 1 else None
        moments = torch.tensor(at, dtype=torch.float64, device=like.device)
        return Completion(moments, torch.stack(done), confidence.to(like), misses, trust, stacked, path)

    def _confidence(self, x: Tensor, seen: Tensor) -> Tensor:
        """Confidence from what was seen at each time, there and nearby, and from the motion. *Shape:* ``(T, V)``.

        What moves far between its neighbours in time is less certain.
        """
        whole = [(float(t), own, torch.ones_like(own[:, 0])) for t, own in zip(self.times, self.whole, strict=False)]
        times = {frame.time for frame in self.frames}
        frames = [(frame.time, *one) for frame, *one in zip(self.frames, x, seen, strict=True)]
        every = sorted([*frames, *(one for one in whole if one[0] not in times)], key=lambda one: one[0])
        shapes, near = torch.stack([one[1] for one in every]), torch.stack([one[2] for one in every])
        for order in (range(1, len(near)), range(len(near) - 2, -1, -1)):
            for i in order:
                near[i] = torch.maximum(near[i], NEIGHBOURS * near[i - order.step])
        half = HALF_AFTER * float((self.template.amax(0) - self.template.amin(0)).norm())
        confidence = torch.zeros_like(seen)
        for row, i in enumerate(i for i, one in enumerate(every) if one[0] in times):
            neighbours = [j for j in (i - 1, i + 1) if 0 <= j < len(shapes)]
            others = shapes[neighbours] if neighbours else self.whole[:1]
            moved = (best_fit(others, shapes[i].expand_as(others)).apply(others) - shapes[i]).norm(dim=-1).mean(0)
            confidence[row] = near[i] * torch.exp2(-(1.5 - seen[row]) * moved / half)
        return confidence

    def _restore(self, x: Tensor) -> Tensor:
        return (x / self.scale) @ torch.from_numpy(self.axes) + torch.from_numpy(self.centre)


def _around(times: FloatArray, t: float) -> tuple[int, int, float]:
    """Indices of the last time before another and of the first after, and how far between; the nearest, outside."""
    order = np.argsort(times, kind="stable")
    before = int(np.searchsorted(times[order], t, side="right")) - 1
    first, last = order[max(before, 0)], order[min(before + 1, len(times) - 1)]
    gap = times[last] - times[first]
    return int(first), int(last), float(np.clip((t - times[first]) / gap, 0, 1)) if gap > 0 else 0.0


def robust(off: FloatArray, noise: float) -> FloatArray:
    """Weights of points at distances (Geman and McClure)."""
    counts: FloatArray = 1 / (1 + (off / (OUTLIERS * noise)) ** 2) ** 2
    return counts
