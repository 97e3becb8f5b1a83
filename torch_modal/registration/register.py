"""Registration of one mesh to another."""

import os
from typing import Any, NamedTuple

import numpy as np
import torch
from scipy import sparse
from threadpoolctl import threadpool_limits

from torch_modal.arrays import FloatArray, IntArray
from torch_modal.errors import MeshError
from torch_modal.geometry.rigid import best_fit
from torch_modal.io.cache import Cache
from torch_modal.keyframes.check import check_keyframes
from torch_modal.keyframes.seams import weld_seams
from torch_modal.progress import Progress, ProgressReport
from torch_modal.registration.fit import COARSE_STAGES, FINE_STAGES, TemplateFit, sliding_freedom
from torch_modal.registration.landmarks import landmark_table
from torch_modal.registration.maps import (
    COARSE_FUNCTIONS,
    FINE_FUNCTIONS,
    MORE_SIGNS,
    N_SIGNS,
    SAME,
    CoarsePair,
    Map,
    SpectralShape,
)
from torch_modal.registration.report import LEAD, SLIDING, TRUSTED, Quality, Registration, judge, measure, ramp
from torch_modal.registration.surface import MeshSurface, main_part, outward, referenced

VERSION = 8  # part of the cache key: raise it when the algorithm changes
MIN_VERTICES = MORE_SIGNS + 3  # minimum number of vertices of a surface: two more than eigenfunctions
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
_STRETCHED = 0.3  # stretch above which a fit between two subjects is repeated
_CONVERGED = 0.3  # mean displacement of the vertices at convergence, in percent of the diagonal
_WORSE = 0.05  # accepted increase of a candidate's cost
_MOST = 0.8  # part of a vertex's distances that are right where the vertex is, though parts are missing
_MISPLACED = 0.20, 0.10  # largest error of these, for a surface of unit area: no confidence, full confidence
_RESCALED = 0.02  # logarithm of the global scale above which the fit is repeated


class _Candidate(NamedTuple):
    found: Map
    scale: float
    x: FloatArray
    fit: TemplateFit
    quality: Quality
    likeness: float

    @property
    def cost(self) -> float:
        """Cost of a candidate: fit and distortion minus the score of the map and the likeness of curvatures."""
        return self.quality.cost + self.found.distortion - _SCORE_SHARE * (self.found.score + self.likeness)


def register(
    template: Any,
    template_faces: Any,
    target: Any,
    target_faces: Any,
    *,
    landmarks: Any = None,
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
        progress: See :data:`torch_modal.progress.Progress`; the total grows during the work.

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
    own, other = ((one.keyframes[0].numpy(), one.faces.numpy()) for one in (welded, welded_goal))

    def compute() -> dict[str, Any]:
        # The matrices are too small for BLAS threads.
        with ProgressReport(0, "register", progress) as report, threadpool_limits(1):
            return _RegistrationProblem(own, other, points, same_subject, report).solve().arrays()

    inputs = {"template": own[0], "faces": own[1], "target": other[0], "target_faces": other[1]}
    marks = {"here": points[:, 0], "there": points[:, 1]}
    parameters = {"same_subject": same_subject, "version": VERSION}
    kept = Cache.at(cache_dir, enabled=cache).get("registration", {**inputs, **marks}, parameters, compute)
    found = Registration.from_arrays(kept)
    corners = torch.from_numpy(np.unique(welded_goal.vertex_of.numpy(), return_index=True)[1])[found.target_corners]
    return found._replace(
        positions=welded.scatter(found.positions).to(checked.keyframes),
        vertex_confidence=found.vertex_confidence[welded.vertex_of],
        target_faces=found.target_faces[welded.vertex_of],
        barycentric=found.barycentric[welded.vertex_of],
        target_corners=corners[welded.vertex_of],
        rivals=welded.scatter(found.rivals).to(checked.keyframes),
    )


class _RegistrationProblem:
    """Both meshes in percent of the target's diagonal, the target centred, the template with equal area."""

    def __init__(
        self,
        template: tuple[FloatArray, IntArray],
        target: tuple[FloatArray, IntArray],
        points: FloatArray,
        same_subject: bool,
        progress: ProgressReport,
    ) -> None:
        self.same_subject, self.progress = same_subject, progress
        rest = template[0]
        goal, self.target_vertices = referenced(target[0], outward(*target))
        # Sizes are those of the main body, without stray pieces.
        own, self.used = referenced(rest, outward(*template))
        main, body = main_part(own), main_part(goal)
        for name, part in (("template", main), ("target", body)):
            if len(part.vertices) < MIN_VERTICES or part.area == 0:
                raise MeshError(
                    f"the {name}'s largest piece has {len(part.vertices)} vertices and an area of {part.area:.3g}; "
                    f"registration needs {MIN_VERTICES} vertices or more, and an area: give a finer mesh"
                )
        self.unit, self.origin = body.diagonal / 100, body.vertices.mean(0)
        self.target = goal.moved((goal.vertices - self.origin) / self.unit)
        self.size = np.sqrt(body.area / main.area) / self.unit
        self.rest = rest * self.size
        self.template = own.moved(own.vertices * self.size)
        self.first, self.second = SpectralShape(self.template), SpectralShape(self.target)
        self.pair = CoarsePair(self.first, self.second)
        self.marks = points[:, 0] * self.size
        self.mark_places = (points[:, 1] - self.origin) / self.unit
        both = ((self.first, self.template, self.marks), (self.second, self.target, self.mark_places))
        found = [
            shape.placed.nearest_alike(at, surface.face_normals[surface.closest(at).faces])
            for shape, surface, at in both
        ]
        #: Landmarks as coarse vertices. *Shape:* ``(n, 2)``.
        self.mark_vertices = np.stack(found, axis=1)
        #: Score minus distortion of the best map onto the mirrored target.
        self.mirrored = -np.inf

    def solve(self) -> Registration:
        candidates = sorted((self._coarse(found) for found in self._rivals(self._maps())), key=lambda one: one.cost)
        close = [self._refined(one) for one in candidates if one.cost < candidates[0].cost + _CLOSE]
        best, *others = sorted(close, key=lambda one: one.cost)
        # Advantage of the best fit over another one; most fits along other maps end at the best one.
        apart = [(one.cost - best.cost, np.linalg.norm(one.x - best.x, axis=1) / self.second.scale) for one in others]
        # Differences of small parts lower the confidence of their vertices only.
        leads = [lead if np.percentile(distances, _WHOLE) > SAME else np.inf for lead, distances in apart]
        alike = [one for one, lead in zip(others, leads, strict=True) if ramp(lead, *LEAD) < TRUSTED]
        rivals = [self._fine(one)[1] for one in alike]
        #: Confidence in the place of each coarse vertex beside other fits. *Shape:* ``(n,)``.
        self.unique = np.ones(len(self.first))
        for lead, distances in apart:
            self.unique[distances > SAME] = np.minimum(self.unique[distances > SAME], ramp(lead, *LEAD))
        best = self._rescaled(best)
        return self._report(*self._fine(best), best, min(leads, default=np.inf), rivals)

    # ------------------------------------------------------------------------------------------------------------- maps
    def _maps(self) -> list[Map]:
        if len(self.marks):
            maps = [self.pair.from_landmarks(self.mark_vertices)]
            if not self.same_subject:
                return [*maps, self.pair.from_limbs(self.mark_vertices)]
            return maps + [one for one in self._spectral(N_SIGNS) if self._agrees(one)]
        maps = self._spectral(N_SIGNS)
        sure = maps[0].score >= _SURE_SCORE
        if sure and self.same_subject:
            return maps
        tips = self.pair.from_tips()
        maps += [self.pair.refined(found.vertices, COARSE_FUNCTIONS) for found in tips]
        if not (self.same_subject or sure):  # proportions may differ so much that spectra do not match
            maps += tips
        return maps if sure or tips else maps + self._spectral(MORE_SIGNS)

    def _spectral(self, n_signs: int) -> list[Map]:
        *maps, other = self.pair.from_spectra(n_signs, self.progress)
        self.mirrored = max(self.mirrored, other.mirrored_score - other.distortion)
        return maps

    def _agrees(self, found: Map) -> bool:
        """Test whether a map agrees with all landmarks."""
        places, (here, target) = self.second.coarse.vertices, self.mark_vertices.T
        errors = np.linalg.norm(places[found.vertices[here]] - places[target], axis=1)
        return bool((errors < _NEAR_LANDMARK).all())

    def _rivals(self, maps: list[Map]) -> list[Map]:
        """Different maps that will be fitted, found and repaired ones."""
        repaired = [self.pair.repaired(found) for found in maps] if self.same_subject else []
        everything = [*maps, *(found for found in repaired if found is not None and self._agrees(found))]
        best, *others = sorted(everything, key=lambda one: one.distortion - one.score)
        kept = [best]
        for found in others:
            lead = (found.score - found.distortion) - (best.score - best.distortion)
            if len(kept) < _RIVALS and lead > -_RIVAL_SCORE[self.same_subject] and found.differs(kept):
                kept.append(found)
        return kept

    # ------------------------------------------------------------------------------------------------------------- fits
    def _coarse(self, found: Map, scale: float = 1.0, x: FloatArray | None = None) -> _Candidate:
        template = self.first.placed.moved(scale * self.first.placed.vertices)
        back = self.second.placed
        fit = self._fit(template, back, found.vertices, scale)
        places = back.vertices[found.vertices]
        if x is None:
            rest, goal, areas = map(torch.from_numpy, (template.vertices, places, template.vertex_areas))
            with torch.no_grad():
                placed = best_fit(rest, goal, areas).apply(rest).numpy()
            x = fit.follow_map(placed, places)
        x = fit.run(x, COARSE_STAGES, releases=2)
        return _Candidate(found, scale, x, fit, measure(template, x, back)[0], self.pair.likeness(self._images(fit, x)))

    def _images(self, fit: TemplateFit, x: FloatArray) -> IntArray:
        """Coarse vertices of the target nearest to those of a fitted template. *Shape:* ``(n, 3) -> (n,)``."""
        return self.second.placed.nearest_alike(x, fit.template.moved(x).vertex_normals)

    def _fit(self, template: MeshSurface, back: MeshSurface, images: IntArray, scale: float) -> TemplateFit:
        marks = self.marks * scale, self.mark_places
        return TemplateFit(
            template, self.target, back, self.second, images, marks, self.progress, stretchable=not self.same_subject
        )

    def _refined(self, candidate: _Candidate) -> _Candidate:
        """Repeat the fit from the start with the map of its result, which accumulates no sliding, until convergence."""
        if not self.same_subject and candidate.quality.stretch < _STRETCHED:
            return candidate
        most = candidate.cost + _WORSE
        for spectral in _SPECTRAL_REFINEMENTS if self.same_subject else (False,):
            vertices = self._images(candidate.fit, candidate.x)
            found = self.pair.refined(vertices, FINE_FUNCTIONS) if spectral else self.pair.rated(vertices)
            again = self._coarse(found)
            if again.cost > most:
                break
            if np.linalg.norm(again.x - candidate.x, axis=1).mean() < _CONVERGED:
                return min(candidate, again, key=lambda one: one.cost)
            candidate = again
        return candidate

    def _rescaled(self, candidate: _Candidate) -> _Candidate:
        """Repeat the fit with its scale on the target: the ratio of areas is wrong if parts are missing."""
        template = candidate.fit.template
        i, j = template.edges.T
        now, rest = (np.linalg.norm(p[i] - p[j], axis=1) for p in (candidate.x, template.vertices))
        change = float(np.median(np.log(np.maximum(now, 1e-12) / np.maximum(rest, 1e-12))))
        if not self.same_subject or abs(change) < _RESCALED:
            return candidate
        again = self._coarse(candidate.found, float(np.exp(change)), candidate.x)
        return again if again.quality.cost <= candidate.quality.cost else candidate

    def _fine(self, candidate: _Candidate) -> tuple[FloatArray, FloatArray]:
        """Positions after the last stages of the referenced vertices, and of all vertices."""
        coarse, x = candidate.fit.template, candidate.x
        template = self.template.moved(self.template.vertices * candidate.scale)
        frames = candidate.fit.elastic.local_frames(x)
        start = _carried(template.vertices, coarse, x, frames)
        images = self.second.placed.nearest_alike(start, template.moved(start).vertex_normals)
        fit = self._fit(template, self.target, images, candidate.scale)
        found = fit.run(start, FINE_STAGES, releases=1)
        everything = _carried(self.rest * candidate.scale, coarse, x, frames)
        everything[self.used] = found
        return found, everything

    # ----------------------------------------------------------------------------------------------------------- report
    def _report(
        self, x: FloatArray, everything: FloatArray, best: _Candidate, lead: float, rivals: list[FloatArray]
    ) -> Registration:
        quality, supported = measure(self.template, x, self.target)
        images = self._images(best.fit, best.x)
        rated = self.pair.rated(images)
        # Where sheets touch, the image of a sample may lie on the wrong one; the map has no such errors.
        score, distortion = rated.score, min(best.found.distortion, rated.distortion)
        rows = self.template.rows(self.template.closest(self.marks))
        errors = np.linalg.norm(rows @ x - self.mark_places, axis=1)
        mirrored = float(self.mirrored - (score - distortion))
        near = self.first.placed.nearest_alike(self.template.vertices, self.template.vertex_normals)
        if self.same_subject:
            # Of a vertex in a wrong place, many distances are wrong; of the others, the few to such vertices.
            misplaced = np.quantile(self.pair.errors(images), _MOST, axis=1)
            supported = np.minimum(supported, ramp(misplaced, *_MISPLACED)[near])
        lost = float(self.template.vertex_areas[supported < TRUSTED].sum() / self.template.area)
        quality = quality._replace(unsupported_area=max(quality.unsupported_area, lost))
        freedom = sliding_freedom(self.first, self.mark_vertices[:, 0])
        confidence, said = judge(quality, score, best.likeness, errors, mirrored, lead, freedom, self.same_subject)
        unique = np.minimum(self.unique[near], ramp(freedom, *SLIDING))
        of_vertices = np.full(len(everything), confidence)
        of_vertices[self.used] = np.minimum(supported, unique)
        closest = self.target.closest(everything)
        corners = self.target_vertices[self.target.faces[closest.faces]]
        return Registration(
            positions=torch.from_numpy(everything * self.unit + self.origin),
            confidence=confidence,
            vertex_confidence=torch.from_numpy(of_vertices),
            map_score=score,
            distortion=distortion,
            **quality._asdict(),
            mirrored_lead=mirrored,
            likeness=best.likeness,
            landmark_errors=torch.from_numpy(errors),
            target_faces=torch.from_numpy(closest.faces),
            barycentric=torch.from_numpy(closest.barycentric),
            target_corners=torch.from_numpy(corners),
            rivals=torch.from_numpy(np.array(rivals).reshape(-1, *everything.shape) * self.unit + self.origin),
            warnings=said,
        )


def _carried(points: FloatArray, coarse: MeshSurface, x: FloatArray, frames: FloatArray) -> FloatArray:
    """Deformation of points near a coarse surface at rest. *Shape:* ``(n, 3)``."""
    rows: sparse.csr_matrix = coarse.rows(coarse.closest(points))
    # Barycentric mean of the affine maps of the corners.
    offsets = np.einsum("vij,vj->vi", frames, coarse.vertices)
    turn = (rows @ frames.reshape(len(frames), 9)).reshape(-1, 3, 3)
    return rows @ (x - offsets) + np.einsum("nij,nj->ni", turn, points)
