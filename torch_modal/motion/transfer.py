r"""A motion, or a set of shapes, of one body on another one: deformation transfer (Sumner and Popović 2004).

For each triangle :math:`g` of the target, with sides :math:`s` at rest, and the deformation gradients :math:`F_f` of
the source's triangles, the result minimises :math:`\sum_g \sum_s w_s |\Delta x - (\sum_f S_{gf} F_f) s|^2` with the
cotangent weights of the target.
"""

import math
import warnings

import numpy as np
import torch
from scipy import sparse
from scipy.spatial.transform import Rotation
from torch import Tensor

from torch_modal.arrays import Array, BoolArray, FloatArray
from torch_modal.errors import MeshError, MeshWarning
from torch_modal.geometry.connectivity import double_areas
from torch_modal.geometry.poisson import WEIGHT_RANGE, Reconstruction
from torch_modal.geometry.rigid import best_fit, best_rotation
from torch_modal.geometry.sparse import SparseSolver, graph_laplacian, solve_by
from torch_modal.geometry.triangle_frames import Sides, side_frames, sides
from torch_modal.geometry.vectors import cross, norm
from torch_modal.keyframes.arrays import as_faces, as_positions
from torch_modal.keyframes.check import check_keyframes
from torch_modal.keyframes.seams import WeldedKeyframes, weld_seams
from torch_modal.motion.path import Path
from torch_modal.motion.standing import stand
from torch_modal.progress import Progress, ProgressReport
from torch_modal.registration.landmarks import Landmarks, landmark_table
from torch_modal.registration.load import ADVICE
from torch_modal.registration.register import register
from torch_modal.registration.report import TRUSTED, Registration
from torch_modal.registration.surface import MeshSurface
from torch_modal.times import Times

# Points of a target triangle, all within it, at which the source is sampled: the centroid first.
_SAMPLES = np.array([[1, 1, 1], [2.4, 0.3, 0.3], [0.3, 2.4, 0.3], [0.3, 0.3, 2.4]]) / 3
_SAMPLES = np.concatenate([_SAMPLES, [[0.45, 0.45, 0.1], [0.1, 0.45, 0.45], [0.45, 0.1, 0.45]]])
_FLAT = 1e-12  # area over the mean area below which a triangle of the source has no gradient
_OFF = 0.05  # mean distance of a map from the source at rest, in diagonals, above which it is another shape's
_AXES = np.cos(np.radians(25))  # cosine of the angle below which a rotation is one between coordinate axes
_OWN = 1e-6  # weight of its own gradient on a triangle without counterpart, over a neighbour's: none is left alone
_AT_ONCE = 2**18  # triangles times frames in memory at a time


def transfer(
    frames: "Array | Path",
    faces: Array,
    target: Array,
    target_faces: Array,
    *,
    rest: "Array | None" = None,
    registration: Registration | Tensor | None = None,
    landmarks: Landmarks = None,
    times: Times = None,
    anchors: bool = True,
    keep_doubtful: bool = False,
    progress: Progress = None,
) -> Tensor:
    """A motion, or a set of shapes, of one body on another one, of other connectivity and proportions.

    Triangles of the target rotate and stretch as the source's surface around them does, relative to rest, and one
    Poisson system gives the shapes (deformation transfer, Sumner and Popović 2004). Proportions and details of the
    target stay. Parts without a counterpart, by ``vertex_confidence`` of the registration, follow their neighbours
    rigidly.

    Args:
        frames: The source's shapes, in the order of their times, or its motion. *Shape:* ``(..., V, 3)``.
        faces: Vertex indices. *Shape:* ``(F, 3)``.
        target: The other body, in any units and axes, in the pose of ``rest``. *Shape:* ``(W, 3)``.
        target_faces: Vertex indices. With the source's faces, vertices correspond by number. *Shape:* ``(G, 3)``.
        rest: The source in the pose of ``target``. Default: the first shape. *Shape:* ``(V, 3)``.
        registration: ``tm.register(target, target_faces, rest, faces, same_subject=False)``, or the places of the
            target's vertices on the source at rest, *shape* ``(W, 3)``. Default: registered here.
        landmarks: For the registration: vertices of the source and of the target, *shape* ``(n, 2)``, points, *shape*
            ``(n, 2, 3)``, or a file of either.
        times: When a :class:`torch_modal.Path` is evaluated. Default: at its key-frames. *Shape:* ``(T,)``.
        anchors: Vertices stand still where the source's do, so that feet do not slide, and the path over the ground
            follows from the target's legs. False for shapes without an order: the body's centroid then moves as the
            source's, scaled.
        keep_doubtful: Use a registration of low confidence, with a warning.
        progress: Of the registration and the frames; see :data:`torch_modal.progress.Progress`.

    Returns:
        The target's shapes, in its coordinates and the dtype and device of the frames; the target itself for ``rest``.
        Gradients reach frames, rest and target; the map and the vertices that stand are constants.
        *Shape:* ``(..., W, 3)``.

    Raises:
        MeshError: A mesh, the map or the landmarks cannot work, or the registration is doubtful.
        MissingPackageError: The extra ``register`` is not installed, and a map is needed.

    Warns:
        MeshWarning: The registration is doubtful, with ``keep_doubtful``.
    """
    if isinstance(frames, Path):
        knots = torch.stack([basis.reference for basis in frames.bases]).to(frames.dtype)
        frames = frames(knots, frames.times[: frames.n_keyframes] if times is None else torch.as_tensor(times))
    given = as_positions(frames)  # type: ignore[arg-type]  # a path has become shapes
    if given.ndim < 3:
        raise MeshError(f"frames have shape {tuple(given.shape)}; (T, V, 3) is needed, one shape alone is frames[None]")
    start = given.reshape(-1, *given.shape[-2:])[:1] if rest is None else as_positions(rest)[None].to(given)
    if start.shape[1:] != given.shape[-2:]:
        raise MeshError(f"rest has shape {tuple(start.shape[1:])}, each frame {tuple(given.shape[-2:])}: one body only")
    source = _checked("the frames", torch.cat([start, given.reshape(-1, *given.shape[-2:])]), faces)
    body = _checked("the target", as_positions(target)[None].to(given), target_faces)
    if registration is None:
        registration = correspond(start[0], faces, target, target_faces, landmarks, progress=progress)
    places, sure = _places(registration, len(body.vertex_of), keep_doubtful)
    first = np.unique(body.vertex_of.cpu().numpy(), return_index=True)[1]
    rests = source.keyframes[0].double(), source.faces, body.keyframes[0].double(), body.faces
    motion = _Motion(*rests, places[first], sure[first])
    shapes, n = [], math.prod(given.shape[:-3])
    x = source.keyframes[1:].double().unflatten(0, (n, -1))
    size = max(1, _AT_ONCE // (len(body.faces) + len(source.faces)))
    with ProgressReport(x.shape[1] * n, "transfer", progress, "frame") as report:
        for sequence in x:
            parts = []
            for some in sequence.split(size):
                parts.append(motion.shapes(some))
                report.update(len(some))
            shapes.append(motion.place(torch.cat(parts), sequence, anchors))
    return body.scatter(torch.cat(shapes)).to(given).reshape(*given.shape[:-2], -1, 3)


def correspond(
    rest: Tensor,
    faces: Array,
    target: Array,
    target_faces: Array,
    landmarks: Landmarks = None,
    cache: bool = True,
    progress: Progress = None,
) -> Registration | Tensor:
    """Registration of the target onto the source; the source's vertices if both have the same faces.

    Arguments as for :func:`transfer`, and ``cache`` as for :func:`torch_modal.register`.
    """
    body = as_positions(target)
    if body.shape == rest.shape and np.array_equal(as_faces(faces), as_faces(target_faces)):
        return rest
    marks = landmark_table(landmarks, [x.detach().cpu().double().numpy() for x in (rest, body)])[:, ::-1]
    meshes = body, target_faces, rest, faces
    return register(*meshes, landmarks=marks, same_subject=False, cache=cache, progress=progress)


def _checked(name: str, shapes: Tensor, faces: Array) -> WeldedKeyframes:
    """Key-frames without seams, whose errors name the mesh."""
    try:
        return weld_seams(*check_keyframes(shapes, faces, warn=False))
    except MeshError as error:
        raise MeshError(f"{name}: {error}") from None


def _places(registration: Registration | Tensor, n: int, keep_doubtful: bool) -> tuple[FloatArray, BoolArray]:
    """Places of the target's vertices on the source at rest, and whether each has one. *Shape:* ``(W, 3), (W,)``."""
    positions = registration.positions if isinstance(registration, Registration) else registration
    if positions.shape != (n, 3):
        raise MeshError(
            f"the registration has positions of shape {tuple(positions.shape)}, the target {n} vertices; the target is "
            "the template: register(target, target_faces, rest, faces, same_subject=False)"
        )
    places = positions.detach().cpu().double().numpy()
    if not isinstance(registration, Registration):
        return places, np.ones(n, dtype=bool)
    if registration.doubtful:
        why = f"the map between the bodies is doubtful: {registration.summary()}; {'; '.join(registration.warnings)}"
        if not keep_doubtful:
            raise MeshError(f"{why}. To help it, {ADVICE}; keep_doubtful (--keep-doubtful) uses it all the same")
        warnings.warn(why, MeshWarning, stacklevel=3)
    confidence = registration.vertex_confidence.cpu().numpy()
    return places, confidence >= TRUSTED * confidence.max()


def _axes(places: Tensor, target: Tensor, weights: Tensor) -> Tensor:
    """Rotation from the source's axes to the target's; between coordinate axes if nearly so. *Shape:* ``(3, 3)``."""
    turn = best_fit(places, target, weights).rotation
    between = torch.from_numpy(Rotation.create_group("O").as_matrix().round()).to(turn)
    traces = (between * turn).sum((1, 2))
    return between[traces.argmax()] if float(traces.max()) > 1 + 2 * _AXES else turn


def _influences(target: MeshSurface, source: MeshSurface) -> sparse.csr_matrix:
    """Weights of the source's triangles for each triangle of the target, with sum one. *Shape:* ``(G, F)``.

    They are the triangles at points within it. Where the target is finer than the source, gradients are interpolated
    between the source's vertices instead, which have means by area, so that its edges do not show.
    """
    n, samples = len(target.faces), np.einsum("sc,gci->sgi", _SAMPLES, target.vertices[target.faces])
    at = [source.closest(points) for points in samples]
    rows = np.tile(np.arange(n), len(at))
    nearest = np.concatenate([closest.faces for closest in at])
    shape = n, len(source.faces)
    within = sparse.csr_matrix((np.full(len(rows), 1 / len(at)), (rows, nearest)), shape)
    corners = source.faces.ravel(), np.repeat(np.arange(len(source.faces)), 3)
    around = sparse.csr_matrix((np.repeat(source.face_areas / 3, 3), corners), (len(source.vertices), shape[1]))
    around = sparse.diags(1 / np.maximum(source.vertex_areas, np.finfo(np.float64).tiny)) @ around
    finer = sparse.diags(np.clip(1 - target.face_areas / (within @ source.face_areas), 0, 1))
    return (within + finer @ (source.rows(at[0]) @ around - within)).tocsr()


def _tensor(matrix: sparse.spmatrix, like: Tensor) -> Tensor:
    """A sparse tensor on a device."""
    entries = matrix.tocoo()
    index = torch.from_numpy(np.stack([entries.row, entries.col]).astype(np.int64))
    return (
        torch.sparse_coo_tensor(index, torch.from_numpy(entries.data), matrix.shape, check_invariants=False)
        .coalesce()
        .to(like.device)
    )


class _Motion:
    """The target's shapes from the source's, in float64 and the source's axes.

    Args:
        rest: *Shape:* ``(V, 3)``.
        faces: *Shape:* ``(F, 3)``.
        target: *Shape:* ``(W, 3)``.
        target_faces: *Shape:* ``(G, 3)``.
        places: Of the target's vertices on the source at rest. *Shape:* ``(W, 3)``.
        sure: True where they have a counterpart. *Shape:* ``(W,)``.
    """

    def __init__(
        self, rest: Tensor, faces: Tensor, target: Tensor, target_faces: Tensor, places: FloatArray, sure: BoolArray
    ) -> None:
        a, corners, triangles = rest.detach().cpu().numpy(), faces.cpu().numpy(), target_faces.cpu().numpy()
        areas = double_areas(a, corners)
        kept = areas > _FLAT * areas.mean()
        source, mapped = MeshSurface(a, corners[kept]), MeshSurface(places, triangles)
        closest = source.closest(places)
        off = float(closest.distances.mean() / source.diagonal)
        if not off < _OFF:
            raise MeshError(
                f"registered positions are {100 * off:.0f} % of the diagonal off the source at rest, in the mean; "
                "register the target onto the shape that is passed as rest: register(target, target_faces, rest, faces)"
            )
        self.rest, self.target_faces, self.faces = rest, target_faces, faces[torch.from_numpy(kept).to(faces.device)]
        self.inverses = torch.linalg.inv(side_frames(rest.mT, self.faces).permute(2, 0, 1))[:, None]
        self.carrier, self.influence = _tensor(source.rows(closest), rest), _tensor(_influences(mapped, source), rest)

        self.known = sure[triangles].all(1)
        if not self.known.any():
            raise MeshError("no triangle of the target has a counterpart on the source")
        pairs = mapped.connectivity.face_neighbours
        between = graph_laplacian(pairs, np.ones(len(pairs)), len(triangles))
        between = between + _OWN * sparse.eye(len(triangles))
        self.extension = SparseSolver(between, np.flatnonzero(~self.known))
        self.to_known = _tensor(between @ sparse.diags(self.known.astype(float)), rest)

        before = torch.from_numpy(2 * mapped.face_areas * self.known).to(rest)
        weights = before.new_zeros(len(target)).index_add(0, target_faces.T.flatten(), before.repeat(3))
        self.turn = _axes(torch.from_numpy(places).to(rest), target.detach(), weights)
        self.target = target @ self.turn
        self.sides = sides(self.target.mT, target_faces)
        own = norm(cross(*self.sides)) * torch.from_numpy(self.known).to(rest)
        self.scale = (own.sum() / before.sum()).sqrt()
        shares = own.new_zeros(len(target)).index_add(0, target_faces.T.flatten(), own.repeat(3))
        self.shares = shares / shares.sum()
        self.reconstruction = Reconstruction(self.target, target_faces).to(rest)

    def gradients(self, x: Tensor) -> Tensor:
        """Deformation gradients of the target's triangles. *Shape:* ``(T, V, 3) -> (G, T, 3, 3)``."""
        each = side_frames(x.movedim(-1, 0).contiguous(), self.faces).permute(3, 2, 0, 1) @ self.inverses
        found = self.influence @ each.flatten(1)
        if not self.known.all():
            # Harmonic between the triangles that have a counterpart, then the nearest rotation.
            extended = solve_by(self.extension, _OWN * found - self.to_known @ found)
            free = torch.from_numpy(np.flatnonzero(~self.known)).to(x.device)
            rigid = best_rotation(extended[free].unflatten(1, (-1, 3, 3)))
            found = found.index_copy(0, free, rigid.flatten(1))
        return found.unflatten(1, (-1, 3, 3))

    def shapes(self, x: Tensor) -> Tensor:
        """Shapes with the target's centroid. *Shape:* ``(T, V, 3) -> (T, W, 3)``."""
        gradients, near = self.gradients(x), self.target.expand(len(x), -1, -1)
        first, second = (torch.einsum("gtij,jg->itg", gradients, side) for side in self.sides)
        fitted = self.reconstruction.fit((first, second), near)
        if self.target.requires_grad:
            fitted = fitted + self._by_weights((first, second), fitted.detach())
        return self.reconstruction.place_loose(fitted, near)

    def _by_weights(self, wanted: Sides, fitted: Tensor) -> Tensor:
        """Zero, with the derivatives of :meth:`shapes` in the weights: ``A dx = sum dw (wanted side - side)``."""
        corners = self.target_faces.unbind(1)
        ends = [torch.cat([corners[(i + k) % 3] for i in range(3)]) for k in range(3)]
        start, end, tip = (self.target.index_select(0, end) for end in ends)
        u, v = start - tip, end - tip
        halves = 0.5 * (u * v).sum(1) / torch.linalg.cross(u, v).norm(dim=1).clamp_min(torch.finfo(u.dtype).tiny)
        weights = halves.clamp(*WEIGHT_RANGE)
        first, second = (side.detach() for side in wanted)
        misfit = torch.cat([first, second - first, -second], -1).movedim(0, -1) - (
            fitted[:, ends[1]] - fitted[:, ends[0]]
        )
        pull = (weights - weights.detach())[:, None] * misfit
        right = torch.zeros_like(fitted).index_add(1, ends[1], pull).index_add(1, ends[0], -pull)
        return self.reconstruction.poisson(right, torch.zeros_like(fitted))

    def place(self, shapes: Tensor, x: Tensor, anchors: bool) -> Tensor:
        """Shapes on their path, in the target's axes. *Shape:* ``(T, W, 3), (T, V, 3) -> (T, W, 3)``."""
        carried = (self.carrier @ x.movedim(0, 1).flatten(1)).unflatten(1, (-1, 3)).movedim(1, 0)
        path, centres = self.shares @ carried, self.shares @ shapes
        shift = self.scale * (path - self.shares @ (self.carrier @ self.rest)) + self.shares @ self.target - centres
        if anchors and len(x) > 1:
            shapes = stand(shapes + shift[0], carried, self.shares, self.scale, self.reconstruction)
            return shapes @ self.turn.mT
        return (shapes + shift[:, None]) @ self.turn.mT
