"""From key-frames to a dense sequence: recursive subdivision (section 3.3 of the paper) and linear fill."""

import logging
import warnings
from collections.abc import Iterator, Sequence
from dataclasses import replace
from itertools import pairwise
from typing import Any

import torch
from torch import Tensor

from torch_modal.backends.choice import choose
from torch_modal.contact.trajectory import push_apart
from torch_modal.errors import MeshWarning
from torch_modal.geometry.connectivity import Connectivity, vertex_areas
from torch_modal.geometry.crossings import Crossings, require_contact
from torch_modal.geometry.rigid import blend
from torch_modal.inbetween.between import Between
from torch_modal.inbetween.samples import Samples
from torch_modal.inbetween.settings import Objective, Preset, Settings, Solver, settings
from torch_modal.keyframes.check import check_keyframes
from torch_modal.keyframes.times import checked_times
from torch_modal.layers.mid_shape import MidShape
from torch_modal.motion.path import Path
from torch_modal.passengers.proxy import Proxy, proxy_size
from torch_modal.precompute.basis import ModalBasis
from torch_modal.precompute.extract import bases_of_checked
from torch_modal.progress import Progress, ProgressReport

logger = logging.getLogger(__name__)

MAX_LEVELS = 12


def subdivide(
    keyframes: Any,
    faces: Any,
    levels: int = 3,
    *,
    bases: Sequence[ModalBasis] | None = None,
    n_modes: int = 30,
    cyclic: bool = False,
    n_frames: int | None = None,
    times: Tensor | Sequence[float] | None = None,
    smooth: bool | None = None,
    preset: Preset = "accurate",
    objective: Objective | None = None,
    solver: Solver | None = None,
    contact: bool | None = None,
    proxy: int | None = None,
    progress: Progress = None,
) -> Tensor:
    """Fill a sequence of key-frames with physically plausible shapes.

    Smooth in time, the shapes are those of :class:`torch_modal.Path`. Otherwise each level inserts a mid-shape between
    all neighbours, which then serves as a key-frame of the next level (section 3.3 of the paper), with the modes of the
    key-frames around it: of both in the joint space, of the nearest in the paired space.

    Args:
        keyframes: Vertex positions, two key-frames or more, in any units. *Shape:* ``(K, V, 3)``.
        faces: Vertex indices. *Shape:* ``(F, 3)``.
        levels: How often the number of intervals doubles.
        bases: The basis of each key-frame. Default: :func:`torch_modal.extract_bases`, cached on disk.
        n_modes: Modes of each key-frame where the bases are not given.
        cyclic: Whether the last key-frame leads on to the first. The sequence then ends one frame before it would
            repeat the first key-frame.
        n_frames: Number of frames of the result, evenly in time. The key-frames keep their places in it
            (:func:`keyframe_places`): frames are even within each interval. Pairs alone are filled linearly between
            their subdivided shapes, along the geodesic of the rigid motion. Default: ``2**levels`` to each interval.
        times: When the key-frames are, as for :class:`torch_modal.Path`. Default: evenly.
        smooth: Whether neighbours in time have a say. Default: where there are three key-frames or more, in the joint
            space.
        preset: As for :class:`torch_modal.InBetween`.
        objective: What is minimised, in the place of the preset's.
        solver: How it is solved, in the place of the preset's.
        contact: Whether parts are kept from passing through each other, in the place of what the objective says
            (docs/contact.md; extra ``contact``). The shapes between two key-frames are pushed apart together, by a
            displacement that is smooth in time.
        proxy: Vertices of a coarser mesh, by the same edge collapses in all key-frames, that moves in the place of the
            mesh and carries its detail (docs/passengers.md). 0: none. Default: 20,000 for meshes of more than 100,000
            vertices whose bases are not given.
        progress: What is said while it goes on: see :data:`torch_modal.progress.Progress`.

    Returns:
        The sequence in the caller's coordinates, dtype and device, the key-frames bit for bit at their places. *Shape:*
        ``((K-1) * 2**levels + 1, V, 3)``, ``(K * 2**levels, V, 3)`` if cyclic, or ``(n_frames, V, 3)``.

    Raises:
        ValueError: Input that cannot be used; the message says what arrived and what to do.
        MissingPackageError: ``contact`` without that extra.

    Warns:
        MeshWarning: With ``contact``, which key-frames pass through themselves, and how many frames still do that no
            key-frame does.
    """
    keyframes, working_faces = check_keyframes(keyframes, faces, min_keyframes=2)
    n_keys = len(keyframes)
    places = keyframe_places(n_keys, levels, cyclic=cyclic, n_frames=n_frames, times=times)
    if bases is not None:
        if proxy:
            raise ValueError("the bases belong to the whole mesh, and a proxy has its own: leave out bases, or proxy")
        proxy = 0
    n_proxy = proxy_size(proxy, keyframes.shape[1])
    if n_proxy:
        carrier = Proxy(keyframes, working_faces, n_proxy)
        shapes = subdivide(
            carrier.keyframes,
            carrier.faces,
            levels,
            n_modes=n_modes,
            cyclic=cyclic,
            n_frames=n_frames,
            times=times,
            smooth=smooth,
            preset=preset,
            objective=objective,
            solver=solver,
            contact=contact,
            proxy=0,
            progress=progress,
        )
        return carrier.carried(shapes, places, keyframes)
    chosen = settings(preset, objective, solver, contact)
    contacts = None
    if chosen.objective.contact:
        require_contact()
        contacts = _ContactReport()
        # Not each shape on its own: what was done at one time would not fit what was done at the next.
        chosen = chosen._replace(objective=replace(chosen.objective, contact=False))
    if smooth is None:
        smooth = n_keys > 2 and chosen.objective.space == "joint"
    if smooth and chosen.objective.space == "paired":
        raise ValueError("the paired space (Eq. 4) knows pairs only: smooth=True needs space='joint'")
    if bases is None:
        bases = bases_of_checked(
            keyframes, working_faces, n_modes, progress=progress, meanwhile=choose(chosen.solver.backend).load
        )
    if len(bases) != n_keys:
        raise ValueError(f"each key-frame needs its basis: got {len(bases)} bases for {n_keys} key-frames")
    sequence = keyframes.new_empty(places[-1] + 1, *keyframes.shape[1:])
    total = len(places) - 1 if smooth else (len(places) - 1) * levels
    with ProgressReport(total, "in-between shapes", progress) as bar, torch.no_grad():
        if smooth:
            parts = _along_path(keyframes, working_faces, bases, places, times, cyclic, chosen, contacts)
        else:
            parts = _by_recursion(keyframes, working_faces, bases, places, levels, n_frames, chosen, bar, contacts)
        for i, shapes in enumerate(parts):
            sequence[places[i]], sequence[places[i] + 1 : places[i + 1]] = keyframes[i], shapes
            bar.update(smooth)
        sequence[-1] = keyframes[-1]
    if contacts is not None:
        contacts.report(keyframes, working_faces)
    return sequence[:-1] if cyclic else sequence


def _along_path(
    keyframes: Tensor,
    faces: Tensor,
    bases: Sequence[ModalBasis],
    places: Sequence[int],
    times: Tensor | Sequence[float] | None,
    cyclic: bool,
    chosen: Settings,
    contacts: "_ContactReport | None",
) -> Iterator[Tensor]:
    """Shapes between the key-frames of each interval, smooth in time."""
    path = Path(bases, faces.cpu(), times, cyclic, objective=chosen.objective, solver=chosen.solver)
    path.to(keyframes.device)
    for i, when in enumerate(_times_of_intervals(path.times, places)):
        shapes = path(keyframes, when[1:-1])
        if contacts is not None and len(shapes):
            u = (when[1:-1] - when[0]) / (when[-1] - when[0])
            samples = path.samples(keyframes[None], i, torch.zeros_like(u, dtype=torch.int64), u)
            shapes = contacts(path.layer.members[path.members[i]], samples, shapes)
        yield shapes


def _by_recursion(
    keyframes: Tensor,
    faces: Tensor,
    bases: Sequence[ModalBasis],
    places: Sequence[int],
    levels: int,
    n_frames: int | None,
    chosen: Settings,
    bar: ProgressReport,
    contacts: "_ContactReport | None",
) -> Iterator[Tensor]:
    """Shapes between the key-frames of each interval, of the pair alone."""
    weights = torch.from_numpy(vertex_areas(keyframes[0].cpu().double().numpy(), faces.cpu().numpy())).to(keyframes)
    for i, n in enumerate(b - a for a, b in pairwise(places)):
        j = (i + 1) % len(keyframes)
        segment = _Segment((bases[i], bases[j]), faces, chosen, keyframes.device)
        shapes = torch.stack([keyframes[i], keyframes[j]])
        for _ in range(levels):
            pairs = torch.stack([shapes[:-1], segment.mid_shapes(shapes)], 1)
            shapes = torch.cat([pairs.flatten(0, 1), shapes[-1:]])
            bar.update()
        shapes = shapes if n_frames is None else _resample(shapes, n, weights)
        if contacts is not None and len(shapes) > 2:
            shapes[1:-1] = contacts(*segment.samples(shapes), shapes[1:-1])
        yield shapes[1:-1]


def keyframe_places(
    n_keyframes: int,
    levels: int = 3,
    *,
    cyclic: bool = False,
    n_frames: int | None = None,
    times: Tensor | Sequence[float] | None = None,
) -> list[int]:
    """Where :func:`subdivide` puts the key-frames.

    Returns:
        The frame number of each key-frame; if cyclic, a further one where the first key-frame would come again.

    Raises:
        ValueError: ``levels`` or ``n_frames`` is out of range, or ``times`` do not fit.
    """
    if not isinstance(levels, int) or not 0 <= levels <= MAX_LEVELS:
        raise ValueError(f"levels is a whole number from 0 to {MAX_LEVELS} (each doubles the frames), got {levels!r}")
    intervals = n_keyframes if cyclic else n_keyframes - 1
    when = checked_times(times, n_keyframes, cyclic)
    if n_frames is None:
        return [i * 2**levels for i in range(intervals + 1)]
    if n_frames < n_keyframes:
        raise ValueError(
            f"n_frames={n_frames} leaves no room for {n_keyframes} key-frames; ask for {n_keyframes} or more"
        )
    total = n_frames if cyclic else n_frames - 1
    share = (when - when[0]) / (when[-1] - when[0])
    places = torch.floor(share * total + 0.5).long().tolist()
    # No two key-frames share a frame, however near in time.
    for i in range(1, intervals + 1):
        places[i] = max(places[i], places[i - 1] + 1)
    for i in range(intervals, 0, -1):
        places[i] = min(places[i], total - (intervals - i))
    return places


def frame_times(
    n_keyframes: int,
    levels: int = 3,
    *,
    cyclic: bool = False,
    n_frames: int | None = None,
    times: Tensor | Sequence[float] | None = None,
) -> Tensor:
    """When the frames of :func:`subdivide` are: even within each interval of key-frames. Arguments as there.

    Returns:
        *Shape:* ``(T,)``, float64.
    """
    when = checked_times(times, n_keyframes, cyclic)
    places = keyframe_places(n_keyframes, levels, cyclic=cyclic, n_frames=n_frames, times=times)
    parts = [times[:-1] for times in _times_of_intervals(when, places)]
    return torch.cat(parts if cyclic else [*parts, when[-1:]])


def _times_of_intervals(when: Tensor, places: Sequence[int]) -> Iterator[Tensor]:
    """Even times of each interval, both ends among them. *Shape:* ``(K,) -> (n + 1,)``."""
    for (start, end), (a, b) in zip(pairwise(when.tolist()), pairwise(places), strict=True):
        yield torch.linspace(start, end, b - a + 1, dtype=torch.float64, device=when.device)


def linear_sequence(keyframes: Tensor, places: Sequence[int]) -> Tensor:
    """Linear interpolation of all vertices, to compare :func:`subdivide` with.

    Args:
        keyframes: *Shape:* ``(K, V, 3)``.
        places: From :func:`keyframe_places`; one more than key-frames closes the cycle.
    """
    cyclic = len(places) > len(keyframes)
    parts = []
    for i, n in enumerate(b - a for a, b in pairwise(places)):
        t = torch.arange(n, dtype=keyframes.dtype, device=keyframes.device) / n
        parts.append(torch.lerp(keyframes[i], keyframes[(i + 1) % len(keyframes)], t[:, None, None]))
    return torch.cat(parts if cyclic else [*parts, keyframes[-1:]])


class _ContactReport:
    """Pushes the shapes of each interval apart, and counts the crossings that are left."""

    def __init__(self) -> None:
        self.n_before = self.n_left = self.n_searched = 0

    def __call__(self, member: Between, samples: Samples, shapes: Tensor) -> Tensor:
        """The shapes between two key-frames, of their times. *Shape:* ``(T, V, 3)``."""
        given = shapes.to(samples.x_a)
        found = push_apart(member, samples, given)
        self.n_searched += len(found.n_crossing)
        self.n_before += int((found.n_before > 0).sum())
        self.n_left += int((found.n_crossing > 0).sum())
        return found.apply(member, samples, given)[0].to(shapes)

    def report(self, keyframes: Tensor, faces: Tensor) -> None:
        """Warn about key-frames that pass through themselves, and crossings that are left."""
        mesh = Connectivity(faces.cpu().numpy(), keyframes.shape[1])
        for i, shape in enumerate(keyframes.detach().double().cpu().numpy()):
            pairs = Crossings(mesh, shape[None]).pairs(shape)
            if len(pairs):
                where = ", ".join(f"{c:.4g}" for c in shape[mesh.faces[pairs[0]]].mean((0, 1)))
                warnings.warn(
                    f"key-frame {i} passes through itself: {len(pairs)} pairs of triangles, the first "
                    f"{pairs[0].tolist()} near ({where}); beside it that is tolerated",
                    MeshWarning,
                    stacklevel=3,
                )
        counts = (self.n_before, self.n_searched, self.n_left)
        logger.info("parts went through each other in %d of %d in-betweens looked at, and do in %d still", *counts)
        if self.n_left:
            warnings.warn(
                f"in {self.n_left} of {self.n_searched} in-betweens looked at, parts still go through each other "
                f"(without contact in {self.n_before}): a key-frame between those around them may help",
                MeshWarning,
                stacklevel=3,
            )


class _Segment:
    """Mid-shapes between neighbours of one interval of key-frames."""

    def __init__(
        self,
        bases: tuple[ModalBasis, ModalBasis],
        faces: Tensor,
        chosen: Settings,
        device: torch.device,
    ) -> None:
        self.bases, self.faces, self.chosen, self.device = bases, faces.cpu(), chosen, device
        self.layers: dict[tuple[int, int], MidShape] = {}
        self.edges = torch.tensor(Connectivity(self.faces.numpy()).edges, device=device)

    def mid_shapes(self, shapes: Tensor) -> Tensor:
        """Between each shape and the next. *Shape:* ``(n + 1, V, 3) -> (n, V, 3)``."""
        if self.chosen.objective.space == "joint":
            return self._layer(0, 1)(shapes[:-1], shapes[1:])
        nearest = self._nearest(shapes)
        mids = [
            self._layer(a, b)(x, y)
            for a, b, x, y in zip(nearest[:-1], nearest[1:], shapes[:-1], shapes[1:], strict=True)
        ]
        return torch.stack(mids)

    def samples(self, shapes: Tensor) -> tuple[Between, Samples]:
        """The in-betweens of the joint space, and the times of even shapes, without the first and the last."""
        layer = self._layer(0, 1).in_between
        t = torch.linspace(0, 1, len(shapes), dtype=layer.dtype, device=shapes.device)[1:-1]
        which = torch.zeros(len(t), dtype=torch.int64, device=t.device)
        ends = shapes[:1].to(layer.dtype), shapes[-1:].to(layer.dtype)
        stiffness = layer.stiffness_of(t, t.shape)
        return layer.members[0], Samples(*ends, which, t, layer.mu_of(t, t.shape), stiffness)

    def _layer(self, a: int, b: int) -> MidShape:
        if (a, b) not in self.layers:
            objective, solver = self.chosen
            layer = MidShape((self.bases[a], self.bases[b]), self.faces, objective=objective, solver=solver)
            self.layers[a, b] = layer.to(self.device)
        return self.layers[a, b]

    def _nearest(self, shapes: Tensor) -> list[int]:
        """Which key-frame, 0 or 1, each shape is nearer to in its edge lengths, which no rigid motion changes."""
        lengths = torch.linalg.norm(shapes[:, self.edges[:, 0]] - shapes[:, self.edges[:, 1]], dim=-1)
        to_first, to_last = ((lengths - lengths[end]).norm(dim=-1) for end in (0, -1))
        return (to_last < to_first).long().tolist()


def _resample(shapes: Tensor, intervals: int, weights: Tensor) -> Tensor:
    """Even times over one interval of key-frames. *Shape:* ``(n + 1, V, 3) -> (intervals + 1, V, 3)``."""
    position = torch.linspace(0, len(shapes) - 1, intervals + 1, dtype=shapes.dtype, device=shapes.device)
    left = position.floor().long().clamp_max(len(shapes) - 2)
    return blend(shapes[left], shapes[left + 1], position - left, weights)
