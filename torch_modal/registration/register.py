"""Registration of one mesh to another."""

import os
from typing import NamedTuple

import numpy as np
import torch
from threadpoolctl import threadpool_limits

from torch_modal.arrays import AnyArray, ArrayLike, BoolArray, FloatArray, IntArray
from torch_modal.errors import MeshError
from torch_modal.geometry.rigid import best_fit
from torch_modal.io.cache import Cache
from torch_modal.keyframes.check import check_keyframes
from torch_modal.keyframes.seams import weld_seams
from torch_modal.passengers.passengers import Passengers
from torch_modal.progress import Progress, ProgressReport
from torch_modal.registration.fit import COARSE_STAGES, FINE_STAGES, TemplateFit, sliding_freedom
from torch_modal.registration.landmarks import Landmarks, landmark_table
from torch_modal.registration.maps import (
    COARSE_FUNCTIONS,
    FINE_FUNCTIONS,
    MORE_SIGNS,
    N_SIGNS,
    SAME,
    Map,
)
from torch_modal.registration.pair import MeshPair
from torch_modal.registration.report import LEAD, SLIDING, TRUSTED, Quality, Registration, judge, measure, ramp
from torch_modal.registration.surface import MeshSurface, beside_holes

VERSION = 12  # part of the cache key: raise it when the algorithm changes
MIN_LANDMARKS = 5  # minimum number of landmarks between different subjects: fewer do not determine the map
_SURE_SCORE = 0.62  # score of a spectral map below which more initial maps are tried
_SCORE_SHARE = 0.5  # weight of a map's score and likeness relative to the stretch of its fit
_NEAR_LANDMARK = 0.1  # largest landmark error of a spectral map, for a surface of unit area
_RIVALS = 3  # maximum number of maps that are fitted
# Largest difference to the best map, in score minus distortion: between two subjects, and for one.
_RIVAL_SCORE = 0.2, 0.15
_WHOLE = 70  # percentile of the distances between fits that tells whether they differ as a whole
_CLOSE = 0.1  # cost above the best fit's up to which others count
_SPECTRAL_REFINEMENTS = (True, True, False, False)  # of the map of each repeated fit
_MORE_REFINEMENTS = 4  # number of further ones for a partial target, whose maps converge slowly
_FEWEST = 8  # minimum number of samples of the template that a partial target has
_STRETCHED = 0.3  # stretch above which a fit between two subjects is repeated
_CONVERGED = 0.3  # mean displacement of the vertices at convergence, in percent of the diagonal
_WORSE = 0.05  # accepted increase of a candidate's cost
_RESCALED = 0.02  # logarithm of the global scale above which the fit is repeated
_MOST = 0.8  # fraction of a vertex's distances that are right where the vertex is, though parts are missing
_MISPLACED = 0.20, 0.10  # largest error of these, for a surface of unit area: no confidence, full confidence


class _Candidate(NamedTuple):
    map: Map
    x: FloatArray
    quality: Quality
    likeness: float
    counted: BoolArray | None
    """Vertices with a counterpart on a partial target; None for a whole one. *Shape:* ``(n,)``."""

    @property
    def cost(self) -> float:
        """Cost of a candidate: fit and distortion minus the score of the map and the likeness of curvatures."""
        fit = self.quality.cost(self.map.pair.partial)
        return fit + self.map.distortion - _SCORE_SHARE * (self.map.score + self.likeness)


def register(
    template: ArrayLike,
    template_faces: ArrayLike,
    target: ArrayLike,
    target_faces: ArrayLike,
    *,
    landmarks: Landmarks = None,
    same_subject: bool = True,
    cache_dir: str | os.PathLike[str] | None = None,
    cache: bool = True,
    progress: Progress = None,
) -> Registration:
    """Register a template to a target of any connectivity.

    Laplacian spectra of decimated copies, or geodesic distances to landmarks, give a map. The map is refined, and an
    as-rigid-as-possible fit moves the template along it onto the target.

    Args:
        template: Vertex positions, float32 or float64, in any units. *Shape:* ``(V, 3)``.
        template_faces: Vertex indices. *Shape:* ``(F, 3)``.
        target: Vertex positions. *Shape:* ``(V_target, 3)``.
        target_faces: Vertex indices. *Shape:* ``(F_target, 3)``.
        landmarks: Vertices of the template and of the target, *shape* ``(n, 2)``; points, in the coordinates of each,
            *shape* ``(n, 2, 3)``; or a file of either.
        same_subject: True for nearly isometric poses of one body. Different bodies may need five landmarks or more.
        cache_dir: Folder of the cache; by default ``TORCH_MODAL_CACHE`` or the user's cache folder.
        cache: Keep results on disk, and find them there.
        progress: See :data:`torch_modal.progress.Progress`; steps of fits are counted.

    Returns:
        Positions of the template's vertices on the target, and a report. Doubtful results have a confidence below 0.5
        and warnings.

    Raises:
        MeshError: A mesh or the landmarks cannot work.
        MissingPackageError: The extra ``register`` is not installed.
    """
    checked = check_keyframes([template], template_faces, warn=False)
    goal = check_keyframes([target], target_faces, warn=False)
    shapes = [mesh.keyframes[0].detach().cpu().double().numpy() for mesh in (checked, goal)]
    points = landmark_table(landmarks, shapes)
    # Texture seams must not cut the surface open.
    welded, welded_goal = (
        weld_seams(x[None], mesh.faces.cpu()) for x, mesh in zip(shapes, (checked, goal), strict=True)
    )
    if not same_subject and 0 < len(points) < MIN_LANDMARKS:
        raise MeshError(
            f"two different subjects need {MIN_LANDMARKS} landmarks or more, or none, got {len(points)}: so few do not "
            "determine the map; give pairs of vertices, template first"
        )
    meshes = [(one.keyframes[0].numpy(), one.faces.numpy()) for one in (welded, welded_goal)]

    def compute() -> dict[str, AnyArray]:
        # The matrices are too small for BLAS threads.
        with ProgressReport(None, "register", progress) as report, threadpool_limits(1):
            return _RegistrationProblem(meshes[0], meshes[1], points, same_subject, report).solve().arrays()

    names = ("template", "faces", "target", "target_faces", "here", "there")
    inputs = dict(zip(names, (*meshes[0], *meshes[1], points[:, 0], points[:, 1]), strict=True))
    parameters = {"same_subject": same_subject, "version": VERSION}
    arrays = Cache.at(cache_dir, enabled=cache).get("registration", inputs, parameters, compute)
    result = Registration.from_arrays(arrays)
    corners = torch.from_numpy(np.unique(welded_goal.vertex_of.numpy(), return_index=True)[1])[result.target_corners]
    return result._replace(
        positions=welded.scatter(result.positions).to(checked.keyframes),
        vertex_confidence=result.vertex_confidence[welded.vertex_of],
        target_corners=corners[welded.vertex_of],
        barycentric=result.barycentric[welded.vertex_of],
        rivals=welded.scatter(result.rivals).to(checked.keyframes),
    )


class _RegistrationProblem(MeshPair):
    #: Score minus distortion of the best map onto the mirrored target.
    mirrored = -np.inf

    def solve(self) -> Registration:
        candidates = sorted(map(self._fit_coarse, self._rivals(self._maps())), key=lambda one: one.cost)
        close = [self._refine(one) for one in candidates if one.cost < candidates[0].cost + _CLOSE]
        best, *others = sorted(close, key=lambda one: one.cost)
        # Advantage of the best fit over another one; most fits along other maps end at the best one.
        apart = [(one.cost - best.cost, np.linalg.norm(one.x - best.x, axis=1) / self.second.scale) for one in others]
        # Differences of small parts lower the confidence of their vertices only.
        leads = [lead if np.percentile(distances, _WHOLE) > SAME else np.inf for lead, distances in apart]
        alike = [one for one, lead in zip(others, leads, strict=True) if ramp(lead, *LEAD) < TRUSTED]
        #: Confidence in the place of each coarse vertex compared with other fits. *Shape:* ``(n,)``.
        self.unique = np.ones(len(self.first))
        for lead, distances in apart:
            self.unique[distances > SAME] = np.minimum(self.unique[distances > SAME], ramp(lead, *LEAD))
        rivals = [self._fit_fine(one) for one in alike]
        if self._rescale(best):
            best = self._fit_coarse(best.map, best.x)
        return self._report(best, min(leads, default=np.inf), rivals)

    # ------------------------------------------------------------------------------------------------------------- maps
    def _maps(self) -> list[Map]:
        if len(self.mark_vertices):
            maps = [self.from_landmarks(self.mark_vertices)]
            if not self.same_subject:
                return [*maps, self.from_limbs(self.mark_vertices)]
            return maps + [one for one in self._spectral_maps(N_SIGNS) if self._agrees(one)]
        maps = self._spectral_maps(N_SIGNS)
        sure = maps[0].score >= _SURE_SCORE and not self.partial
        if sure and self.same_subject:
            return maps
        tips = self.from_tips()
        maps += [self.refine(one.vertices, COARSE_FUNCTIONS) for one in tips]
        if not (self.same_subject or sure):  # proportions may differ so much that spectra do not match
            maps += tips
        return maps if sure or tips else maps + self._spectral_maps(MORE_SIGNS)

    def _spectral_maps(self, n_signs: int) -> list[Map]:
        *maps, other = self.from_spectra(n_signs)
        self.mirrored = max(self.mirrored, other.mirrored_score - other.distortion)
        return maps

    def _agrees(self, one: Map) -> bool:
        """Test whether a map agrees with all landmarks."""
        places, (here, there) = self.second.coarse.vertices, self.mark_vertices.T
        errors = np.linalg.norm(places[one.vertices[here]] - places[there], axis=1)
        return bool((errors < _NEAR_LANDMARK).all())

    def _rivals(self, maps: list[Map]) -> list[Map]:
        """Different maps that will be fitted."""
        repaired = [self.repair(one.vertices) for one in maps] if self.same_subject else []
        everything = [*maps, *(one for one in repaired if one is not None and self._agrees(one))]
        best, *others = sorted(everything, key=lambda one: one.distortion - one.score)
        rivals = [best]
        for one in others:
            lead = (one.score - one.distortion) - (best.score - best.distortion)
            if len(rivals) < _RIVALS and lead > -_RIVAL_SCORE[self.same_subject] and one.differs(rivals):
                rivals.append(one)
        return rivals

    # ------------------------------------------------------------------------------------------------------------- fits
    def _fit_coarse(self, one: Map, x: FloatArray | None = None) -> _Candidate:
        """Fit of the coarse template along a map where it counts, or from positions near the target."""
        template, back = self.first.placed, self.second.placed
        fit, places = TemplateFit(self, template, back, one.vertices, one.counted), back.vertices[one.vertices]
        if x is None:
            weights = template.vertex_areas * (1 if one.counted is None else one.counted)
            rest, goal, areas = map(torch.from_numpy, (template.vertices, places, weights))
            with torch.no_grad():
                placed = best_fit(rest, goal, areas).apply(rest).numpy()
            x = fit.run(placed, COARSE_STAGES, 2, places)
        else:
            x = fit.run(x, COARSE_STAGES, 2)
        images = self._images(template.with_vertices(x))
        quality, supported = measure(template, x, back)
        counted = self._enough(supported >= TRUSTED)
        if counted is not None:
            counted = self._enough(counted & (self._well_placed(images, counted) >= TRUSTED))
        return _Candidate(one, x, quality, self.likeness(images, counted), counted)

    def _enough(self, counted: BoolArray) -> BoolArray | None:
        """The mask if the target is partial and samples are left. *Shape:* ``(n,)``."""
        return counted if self.partial and counted[self.first.samples[0]].sum() >= _FEWEST else None

    def _well_placed(self, images: IntArray, counted: BoolArray | None) -> FloatArray:
        """Confidence in each coarse vertex by its distances to those that count. *Shape:* ``(n,)``.

        Of a vertex in a wrong place, many distances are wrong; of the others, the few to such vertices.
        """
        errors = self.errors(images, counted)
        placed: FloatArray = ramp(np.quantile(errors, _MOST, axis=1), *_MISPLACED)
        if counted is not None:  # a missing limb may lie on top of its twin: the one with larger errors is wrong
            samples, mean = self.first.samples[0], errors.mean(1)
            collides = (errors > np.mean(_MISPLACED)) & (mean[:, None] > mean[samples[counted[samples]]])
            placed[collides.any(1)] = 0
        return placed

    def _images(self, shape: MeshSurface) -> IntArray:
        """Coarse vertices of the target nearest to the vertices of a fitted template. *Shape:* ``(n,)``."""
        return self.second.placed.nearest_alike(shape.vertices, shape.vertex_normals)

    def _refine(self, candidate: _Candidate) -> _Candidate:
        """Repeat the fit from the start with the map of its result, which accumulates no sliding, until convergence."""
        if not self.same_subject and candidate.quality.stretch < _STRETCHED:
            return candidate
        most = candidate.cost + _WORSE
        rounds = _SPECTRAL_REFINEMENTS + (False,) * _MORE_REFINEMENTS * self.partial
        for spectral in rounds if self.same_subject else (False,):
            if self.partial:
                self._rescale(candidate)
            vertices, known = self._images(self.first.placed.with_vertices(candidate.x)), candidate.counted
            again = self._fit_coarse(
                self.refine(vertices, FINE_FUNCTIONS, counted=known) if spectral else self.rate(vertices, counted=known)
            )
            if again.cost > most:
                break
            if np.linalg.norm(again.x - candidate.x, axis=1).mean() < _CONVERGED:
                return min(candidate, again, key=lambda one: one.cost)
            candidate = again
        return candidate

    def _rescale(self, candidate: _Candidate) -> bool:
        """Give the template its scale on the target: the ratio of areas is wrong if parts are missing."""
        coarse = self.first.placed
        i, j = coarse.edges.T
        now, rest = (np.maximum(np.linalg.norm(x[i] - x[j], axis=1), 1e-12) for x in (candidate.x, coarse.vertices))
        known = np.ones(len(i), dtype=bool) if candidate.counted is None else candidate.counted[coarse.edges].all(1)
        change = float(np.median((now / rest)[known])) if known.any() else 1.0
        if not self.same_subject or abs(np.log(change)) < _RESCALED:
            return False
        self.growth *= change if self.partial else 1
        self.rest, self.marks = change * self.rest, (change * self.marks[0], self.marks[1])
        self.template = self.template.with_vertices(change * self.template.vertices)
        self.first.placed = coarse.with_vertices(change * coarse.vertices)
        return True

    def _fit_fine(self, candidate: _Candidate) -> FloatArray:
        """Positions of all vertices after the last stages."""
        coarse = self.first.placed
        carrier, faces, rest, x = map(torch.tensor, (coarse.vertices, coarse.faces, self.rest, candidate.x))
        everything: FloatArray = Passengers(carrier, faces, rest)(x).numpy()
        images = self._images(self.template.with_vertices(everything[self.used]))
        near = coarse.nearest_alike(self.template.vertices, self.template.vertex_normals)
        counted = None if candidate.counted is None else candidate.counted[near]
        fit = TemplateFit(self, self.template, self.target, images, counted)
        everything[self.used] = fit.run(everything[self.used], FINE_STAGES, 1)
        return everything

    # ----------------------------------------------------------------------------------------------------------- report
    def _report(self, best: _Candidate, lead: float, rivals: list[FloatArray]) -> Registration:
        everything = self._fit_fine(best)
        x = everything[self.used]
        quality, supported = measure(self.template, x, self.target)
        images = self._images(self.first.placed.with_vertices(best.x))
        rated = self.rate(images)
        # Where sheets touch, the image of a sample may lie on the wrong one; the map has no such errors.
        score, distortion = rated.score, min(best.map.distortion, rated.distortion)
        rows = self.template.rows(self.template.closest(self.marks[0]))
        errors = np.linalg.norm(rows @ x - self.marks[1], axis=1)
        near = self.first.placed.nearest_alike(self.template.vertices, self.template.vertex_normals)
        if self.same_subject:
            supported = np.minimum(supported, self._well_placed(images, best.counted)[near])
        lost = float(self.template.vertex_areas[supported < TRUSTED].sum() / self.template.area)
        quality = quality._replace(unsupported_area=max(quality.unsupported_area, lost))
        freedom = sliding_freedom(self.first, self.mark_vertices[:, 0])
        mirrored = float(self.mirrored - (score - distortion))
        given = quality, score, best.likeness, errors, mirrored, lead, freedom, self.same_subject
        confidence, right, warnings = judge(*given)
        vertex_confidence = np.full(len(everything), confidence)
        unique = np.minimum(self.unique[near], ramp(freedom, *SLIDING))
        sure = ~beside_holes(self.template.with_vertices(x), self.target)
        vertex_confidence[self.used] = np.minimum(np.minimum(supported * sure, unique), right)
        closest = self.target.closest(everything)
        corners = self.target_vertices[self.target.faces[closest.faces]]
        return Registration(
            positions=torch.from_numpy(everything * self.unit + self.origin),
            confidence=confidence,
            vertex_confidence=torch.from_numpy(vertex_confidence),
            map_score=score,
            distortion=distortion,
            **quality._asdict(),
            likeness=best.likeness,
            landmark_errors=torch.from_numpy(errors),
            target_corners=torch.from_numpy(corners),
            barycentric=torch.from_numpy(closest.barycentric),
            rivals=torch.from_numpy(np.array(rivals).reshape(-1, *everything.shape) * self.unit + self.origin),
            warnings=warnings,
        )
