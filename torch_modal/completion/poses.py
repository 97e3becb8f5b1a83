"""Modal poses of all frames: outward in time from what is known, then between neighbours; and times from them."""

import math
from collections.abc import Sequence
from functools import partial
from hashlib import sha256
from typing import NamedTuple

import numpy as np
import torch
from scipy import sparse
from scipy.optimize import minimize_scalar
from scipy.spatial.transform import Rotation
from torch import Tensor

from torch_modal.completion.bending import ModalBending, ModalPose
from torch_modal.completion.details import Details
from torch_modal.completion.follow import follow, volumes_at
from torch_modal.completion.frames import CompletionProblem, Frame
from torch_modal.completion.pairs import SampledSurface
from torch_modal.completion.search import AFTER_FIRST, FIRST, N_KEPT, N_SOFT, REST, UNTURNED, PoseSearch
from torch_modal.geometry.rigid import align, best_fit
from torch_modal.geometry.triangle_frames import frames_of, mirror_sides
from torch_modal.modes.coarsening import coarsen
from torch_modal.modes.extract import extract_bases
from torch_modal.motion.decoder import scale_modes
from torch_modal.motion.path import Path
from torch_modal.progress import ProgressReport
from torch_modal.threads import run

N_MODES = 60
"""Modes of the template in which poses are searched, at most."""
COARSE_FACES = 2500
"""Faces of the mesh on which they are searched; of fewer, it is the caller's."""
SHIFTS = (-0.17, 0.17)
"""Times at which a motion may be instead of where its neighbours say, in parts of the gap between these."""
N_TURNED, DISTINCT, CERTAIN = 3, 0.8, 0.7
"""Turns of the template that are tried; the largest cosine of the angle between two; score over that of the template as
it is below which it is turned.
"""
N_COMPARED, N_FOLLOWED, FOLLOWED = 2, 8, (6.0, 1.5)
"""Poses of a search that are compared after as-rigid-as-possible steps, these, and the largest distance of a pair in
the first and in the last; so do all vertices follow after the coarse ones.
"""
TRUSTED, SETTLED, EXPLAINED = 0.34, 1.2, 0.2
"""Part of the frames, those that explain most, that are settled; score over the least one below which others are, too;
and score of a cloud below which turns of the template are not tried.
"""
N_OUTWARD, N_BETWEEN, N_ALIKE, N_KNOWN = 2, 3, 2, 24
"""Rounds in which frames that are not settled are searched again, outward from settled ones, then between their
neighbours; starts of the former from shapes of any time; shapes that starts are made from: of a long motion the nearest
in time, and for starts from any time some in equal steps.
"""
TIME_ROUNDS, LATEST, UNCHANGED = 6, 0.5, 10.0
"""Rounds in which times are estimated; the largest change, in parts of the gap between neighbours, and its weight."""


class ModalFit(NamedTuple):
    """A frame by modes."""

    x: Tensor
    """The shape; from a template alone, it also follows its clouds."""
    base: Tensor
    pose: ModalPose
    score: float
    """How much it leaves unexplained."""


class FramePoses:
    """Finds modal poses of all frames of a problem."""

    def __init__(self, problem: CompletionProblem) -> None:
        self.problem = problem
        n_modes = min(N_MODES, 3 * len(problem.mesh.used) - 6)
        basis = extract_bases(problem.template[None], problem.faces, n_modes)[0]
        self.coarse = coarse = coarsen(problem.whole.numpy(), problem.faces.numpy(), COARSE_FACES)
        self.faces = torch.from_numpy(coarse.faces)
        whole, fields = (coarse.restrict(x.numpy()) for x in (problem.whole, scale_modes(basis.modes, 100.0)))
        #: The template, on the coarse mesh as all that follows.
        self.template = torch.from_numpy(whole[problem.largest])
        self.bending = ModalBending(self.template, self.faces, torch.from_numpy(fields))
        self.poses = PoseSearch(self.bending, basis.eigenvalues)
        #: Times and whole shapes.
        self.whole = list(zip(problem.times.tolist(), torch.from_numpy(whole), strict=False))
        select = sparse.identity(coarse.n_vertices, format="csr")[np.maximum(coarse.clusters, 0)]
        #: With known places on the coarse mesh.
        self.frames = [one._replace(seen=[each.restrict(select) for each in one.seen]) for one in problem.frames]
        #: Frames, and the shapes from which they were searched.
        self.searched = set[tuple[int, bytes]]()

    def search(self, report: ProgressReport) -> list[tuple[Tensor, Tensor]]:
        """Shapes by modes of all frames, and those that follow their clouds from there. *Shape of each:* ``(V, 3)``."""
        fits, alone = dict[int, ModalFit](), not self.whole
        if alone:
            report.expect((N_OUTWARD + N_BETWEEN - 1) * len(self.frames))
            fits = self._first(self.template)
            report.update()
        self._outward(fits, {}, report)
        for _ in range(N_OUTWARD if alone else 0):
            before, fits = fits, self._settled(fits)
            report.update(len(fits))
            self._outward(fits, before, report)
        for _ in range(N_BETWEEN if alone else 1):
            settled = self._settled(fits) if alone else {}
            for i in sorted(fits, key=lambda i: -fits[i].score):
                known = self._knots({j: one for j, one in fits.items() if j != i})
                if known and i not in settled:
                    fits[i] = self._again(i, self._starts(self.frames[i].time, known), fits[i])
                report.update()
        problem, details = self.problem, Details(self.problem, self.coarse)
        coarse = torch.stack([shape for _, shape in self.whole] or [self.template])
        when, each = [frame.time for frame in self.frames], ((coarse, self.poses.mesh), (problem.whole, problem.mesh))
        volumes = zip(*(volumes_at(when, problem.times, *one) for one in each), strict=True)
        return run([partial(self._finish, i, fits[i], details, two, report) for i, two in enumerate(volumes)])

    def _finish(
        self, i: int, fit: ModalFit, details: Details, volumes: tuple[float | None, ...], report: ProgressReport
    ) -> tuple[Tensor, Tensor]:
        """The shape of the stiffest modes that explain as much, and the one that follows; of all vertices.

        Volumes are of the coarse mesh and of the caller's.
        """
        frame, problem, (of_coarse, of_all) = self.frames[i], self.problem, volumes
        x = self.bending.shape(fit.base, self.poses.stiffen(fit.base, fit.pose, frame))
        by_modes, followed = details.add(frame.time, x, follow(frame, x, self.poses.mesh, volume=of_coarse))
        if len(self.faces) < len(problem.faces):
            followed = follow(problem.frames[i], followed, problem.mesh, N_FOLLOWED, FOLLOWED, of_all)
        report.update()
        return by_modes, followed

    def _settled(self, fits: dict[int, ModalFit]) -> dict[int, ModalFit]:
        """The fits that explain about as much as the best one, or the best third of all."""
        scores = {i: one.score / len(self.frames[i].seen) for i, one in fits.items()}
        bound = max(float(np.quantile(list(scores.values()), TRUSTED)), SETTLED * min(scores.values()))
        return {i: one for i, one in fits.items() if scores[i] <= bound}

    def _first(self, template: Tensor) -> dict[int, ModalFit]:
        """The frame that the template fits best after a rigid motion.

        It may be turned: then a quarter turn about its principal axes is a better start, by far, as symmetric bodies
        fit as well after some turns. With each turn another frame may fit best.
        """
        body, turns = self._surface(template), torch.from_numpy(Rotation.create_group("O").as_matrix())
        _, first, pose = self._place(body)
        fit = self._search(first, [(template, pose)])
        if fit.score < EXPLAINED * len(self.frames[first].seen):
            return {first: fit}
        turned = run([partial(self.poses.place, body, self.frames[first], turn) for turn in turns])
        distinct = [pose]
        for pose, _ in sorted(turned, key=lambda one: one[1]):
            # The trace of a rotation by an angle is 1 + 2 cos.
            if all(float((pose.rotation * other.rotation).sum()) < 1 + 2 * DISTINCT for other in distinct):
                distinct.append(pose)
        if len(distinct) == 1:  # markers come from anywhere to the same pose
            return {first: fit}
        placed = [self._place(body, one.rotation) for one in (fit.pose, *distinct[1 : 1 + N_TURNED])]
        _, best, pose = min(placed, key=lambda one: one[0])
        other = self._search(best, [(template, pose)])
        return {best: other} if other.score < CERTAIN * fit.score else {first: fit}

    def _place(self, body: SampledSurface, turn: Tensor = UNTURNED) -> tuple[float, int, ModalPose]:
        """The frame that a turned body fits best, with its score and rigid pose."""
        placed = run([partial(self.poses.place, body, frame, turn) for frame in self.frames])
        first = min(range(len(placed)), key=lambda i: placed[i][1])
        return placed[first][1], first, placed[first][0]

    def _outward(self, fits: dict[int, ModalFit], before: dict[int, ModalFit], report: ProgressReport) -> None:
        """Add all other frames, those near in time to what is known first; none is worse than it was before."""
        while left := [i for i in range(len(self.frames)) if i not in fits]:
            known = self._knots(fits)
            i = min(left, key=lambda i: min(abs(self.frames[i].time - t) for t, _ in known))
            starts = self._starts(self.frames[i].time, known)
            if before:
                starts += self._alike(i, [x for _, x in known])
            fits[i] = self._again(i, starts, before.get(i))
            report.update()

    def _again(self, i: int, starts: Sequence[tuple[Tensor, ModalPose]], before: ModalFit | None) -> ModalFit:
        """The fit before, or a better one from the starts that no search of the frame had."""
        keys = [(i, sha256(base.numpy().tobytes()).digest()) for base, _ in starts]
        new = [start for key, start in zip(keys, starts, strict=True) if key not in self.searched]
        self.searched.update(keys)
        found = [self._search(i, new)] if new else []
        return min([*([before] if before else []), *found], key=lambda one: one.score)

    def _knots(self, fits: dict[int, ModalFit]) -> list[tuple[float, Tensor]]:
        """Times and shapes of frames, and of whole ones, in the order of time."""
        shapes = [*self.whole, *((self.frames[i].time, one.x) for i, one in fits.items())]
        return sorted(shapes, key=lambda one: one[0])

    def _alike(self, i: int, shapes: Sequence[Tensor]) -> list[tuple[Tensor, ModalPose]]:
        """The shapes that explain most of a frame after a rigid motion: motions repeat."""
        shapes = shapes[:: math.ceil(len(shapes) / N_KNOWN)]
        placed = run([partial(self.poses.place, self._surface(x), self.frames[i]) for x in shapes])
        ranked = sorted(zip(shapes, placed, strict=True), key=lambda one: one[1][1])
        return [(x, pose) for x, (pose, _) in ranked[:N_ALIKE]]

    def _starts(self, t: float, known: list[tuple[float, Tensor]]) -> list[tuple[Tensor, ModalPose]]:
        """Shapes from which a search at a time starts."""
        known = sorted(sorted(known, key=lambda one: abs(one[0] - t))[:N_KNOWN], key=lambda one: one[0])
        times, shapes = np.array([time for time, _ in known]), torch.stack([x for _, x in known])
        nearest = np.argsort(np.abs(times - t))
        bases = [shapes[nearest[0]]]
        if times[0] < t < times[-1]:
            path = Path(shapes, self.faces, times=times.tolist())
            gap = np.diff(times)[np.searchsorted(times, t) - 1]
            bases = [path(shapes, t)]
            for shift in SHIFTS:
                other = path(shapes, float(np.clip(t + shift * gap, times[0], times[-1])))
                bases.append(best_fit(other, bases[0]).apply(other))
        elif len(known) > 1:
            bases.append(self._beyond(shapes[nearest[1], None], shapes[nearest[0], None])[0])
        return [(x, self.bending.still()) for x in bases]

    def _beyond(self, before: Tensor, last: Tensor) -> Tensor:
        """The shape as far after the last one as that is after the one before. *Shape:* ``(1, V, 3)``."""
        motion = best_fit(before, last)
        sides = mirror_sides(frames_of(last, self.faces), frames_of(motion.apply(before), self.faces))
        x = align(self.bending.reconstruction(sides, last), last)
        return motion._replace(source=motion.target, target=2 * motion.target - motion.source).apply(x)

    def _search(self, i: int, starts: Sequence[tuple[Tensor, ModalPose]]) -> ModalFit:
        """The best pose of a frame from several starts, or one of these.

        Surface that a camera should see and that has no points guides limbs between key-frames. With a template alone,
        it may also hold them back: each start descends with and without it, and the score with it decides.
        """
        frame, poses, alone = self.frames[i], self.poses, not self.whole
        both = alone and any(one.camera is not None for one in frame.seen)
        ways, n_modes = [frame, frame.without_cameras()][: 1 + both], N_SOFT if alone else None

        def begin(base: Tensor, pose: ModalPose, way: Frame) -> tuple[Tensor, ModalPose, Frame, float]:
            pose = poses.descend(base, pose, way, part=FIRST, n_modes=n_modes)
            return base, pose, way, poses.score(base, pose, frame._replace(unit=AFTER_FIRST))

        def finish(base: Tensor, pose: ModalPose, way: Frame | None) -> tuple[Tensor, ModalPose, float]:
            pose = pose if way is None else poses.descend(base, pose, way, part=REST)
            return base, pose, poses.score(base, pose, frame)

        begun = run([partial(begin, *start, way) for start in starts for way in ways])
        kept = [one[:-1] for one in sorted(begun, key=lambda one: one[-1])[:N_KEPT]]
        fits = run([partial(finish, *one) for one in (*((*start, None) for start in starts), *kept)])
        fits.sort(key=lambda one: one[2])
        base, pose, score = fits[0]
        fits[0] = base, *poses.move_limbs(base, pose, frame, score)
        if alone:
            followed = run([partial(self._follow, i, *one) for one in fits[:N_COMPARED]])
            return min(followed, key=lambda one: one.score)
        base, pose, score = fits[0]
        return ModalFit(self.bending.shape(base, pose), base, pose, score)

    def _follow(self, i: int, base: Tensor, pose: ModalPose, score: float) -> ModalFit:
        """A fit whose shape follows the clouds: what modes cannot express would add up from frame to frame."""
        frame, x = self.frames[i], self.bending.shape(base, pose)
        followed = follow(frame, x, self.poses.mesh, N_FOLLOWED, FOLLOWED)
        score += frame.score(self._surface(followed)) - frame.score(self._surface(x))
        return ModalFit(followed, base, pose, score)

    def _surface(self, x: Tensor) -> SampledSurface:
        return SampledSurface(x.numpy(), self.poses.mesh)


def times_between(problem: CompletionProblem, shapes: Sequence[Tensor]) -> list[float]:
    """Times at which the path through all other shapes is nearest to each; the first and the last stay.

    Args:
        problem: Has the frames with the times that are known.
        shapes: Of the frames. *Shape of each:* ``(V, 3)``.
    """
    first = [frame.time for frame in problem.frames]
    times, exact = list(first), problem.times.tolist()
    for i in TIME_ROUNDS * list(range(len(shapes))):
        known = [*zip(exact, problem.whole, strict=False), *zip(times, shapes, strict=True)]
        del known[len(exact) + i]
        known.sort(key=lambda one: one[0])
        axis = np.array([t for t, _ in known])
        after = int(np.searchsorted(axis, times[i]))
        if not 0 < after < len(axis):
            continue
        gap = LATEST * (axis[after] - axis[after - 1])
        around = slice(max(0, after - 2), after + 2)
        near = torch.stack([other for _, other in known[around]])
        path = Path(near, problem.faces, times=axis[around].tolist())
        bounds = max(axis[after - 1], first[i] - gap), min(axis[after], first[i] + gap)
        others = path, near, shapes[i], first[i], gap
        times[i] = float(minimize_scalar(_cost_of_time, args=others, bounds=bounds, method="bounded").x)
    return times


def _cost_of_time(t: float, path: Path, knots: Tensor, x: Tensor, t0: float, gap: float) -> float:
    """Log-likelihood of a shape at a time, where the path errs by as much as it does at best, and of the change."""
    return math.log(float((path(knots, t) - x).square().sum())) + UNCHANGED * ((t - t0) / gap) ** 2
