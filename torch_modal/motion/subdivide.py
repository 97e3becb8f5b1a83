"""From key-frames to a dense sequence, also by recursive subdivision (section 3.3 of the paper)."""

import warnings
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from itertools import pairwise

import torch
from torch import Tensor

from torch_modal.arrays import ArrayLike
from torch_modal.elastic.backend import choose
from torch_modal.errors import MeshWarning
from torch_modal.geometry.connectivity import Connectivity
from torch_modal.geometry.crossings import Crossings
from torch_modal.inbetween.results import report
from torch_modal.inbetween.settings import Objective, Preset, Settings, Solver, settings
from torch_modal.keyframes.check import Keyframes, check_keyframes
from torch_modal.layers.mid_shape import MidShape
from torch_modal.modes.basis import ModalBasis
from torch_modal.modes.extract import bases_of_checked
from torch_modal.motion.path import Path
from torch_modal.passengers.proxy import Proxy, proxy_size
from torch_modal.progress import Progress, ProgressReport
from torch_modal.times import Times, check_times

MAX_LEVELS = 12

GivenBases = Sequence[ModalBasis] | Callable[[Tensor, Tensor], Sequence[ModalBasis]] | None
"""Bases, or what makes them of key-frames and faces."""


def interpolate(
    keyframes: ArrayLike,
    faces: ArrayLike,
    levels: int = 3,
    *,
    bases: GivenBases = None,
    n_modes: int = 30,
    cyclic: bool = False,
    n_frames: int | None = None,
    times: Times = None,
    smooth: bool | None = None,
    preset: Preset = "accurate",
    objective: Objective | None = None,
    solver: Solver | None = None,
    contact: bool | None = None,
    mu: float | None = None,
    regions: int | None = None,
    proxy: int | None = None,
    progress: Progress = None,
) -> Tensor:
    """Fill a sequence of key-frames with physically plausible shapes.

    With three key-frames or more, the result follows a :class:`torch_modal.Path`, smooth in time. Two key-frames give
    the shapes of :class:`torch_modal.InBetween`. Neither needs modes unless there are contacts or terms beyond Eq. 5,
    or with ``preset="modal"`` for pairs. With ``preset="paper"`` each level inserts a mid-shape between all neighbours,
    which then serves as a key-frame of the next level with the modes of the nearest key-frame (section 3.3 of the
    paper).

    Args:
        keyframes: Vertex positions, two key-frames or more, in any units. *Shape:* ``(K, V, 3)``.
        faces: Vertex indices. *Shape:* ``(F, 3)``.
        levels: How often the number of intervals doubles.
        bases: The basis of each key-frame; or a function that makes them of key-frames and faces, where modes are
            needed. Default: :func:`torch_modal.extract_bases`, cached on disk.
        n_modes: Modes of each key-frame where modes are needed and the bases are not given.
        cyclic: True where the last key-frame leads on to the first. The sequence then ends one frame before it would
            repeat the first key-frame.
        n_frames: Number of frames of the result, evenly in time. The key-frames keep their places in it
            (:func:`~torch_modal.motion.subdivide.keyframe_places`): frames are even within each interval. Not with
            ``preset="paper"``. Default: ``2**levels`` to each interval.
        times: When the key-frames are, as for :class:`torch_modal.Path`. Default: evenly.
        smooth: False treats each pair of key-frames alone. Default: True where there are three key-frames or more.
        preset: As for :class:`torch_modal.InBetween`.
        objective: What is minimised, instead of the preset's objective.
        solver: How it is solved, instead of the preset's solver.
        contact: True to keep parts from passing through each other, instead of what the objective says
            (docs/contact.md; extra ``contact``). The shapes between two key-frames are pushed apart together, by a
            displacement that is smooth in time.
        mu: Weight of the similarity of Eq. 4, with ``preset="paper"``. Default: the objective's.
        regions: Segments that local interpolation takes, likewise: those that the modes of the two key-frames reach
            worst, in all levels. Default: the solver's.
        proxy: Vertices of a coarser mesh, by the same edge collapses in all key-frames, that moves instead of the
            mesh and carries its detail (docs/passengers.md). 0: none. Default: 20,000 for meshes of more than 100,000
            vertices whose bases are not given.
        progress: Reports progress: see :data:`torch_modal.progress.Progress`.

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
    keyframes, faces = check_keyframes(keyframes, faces, min_keyframes=2)
    places = keyframe_places(len(keyframes), levels, cyclic=cyclic, n_frames=n_frames, times=times)
    carrier = _carrier(keyframes, faces, bases, proxy)
    moving = check_keyframes(carrier.keyframes, carrier.faces) if carrier else Keyframes(keyframes, faces)
    chosen = settings(preset, objective, solver, regions, contact=contact, mu=mu)
    recursive = chosen.objective.space == "paired"
    if recursive and (smooth or n_frames is not None):
        raise ValueError("the paired space (Eq. 4) has the middle of a pair only: leave out smooth and n_frames")
    smooth = not recursive and len(keyframes) > 2 if smooth is None else smooth
    made = _make_bases(moving, bases, n_modes, smooth, chosen, progress)
    sequence = _fill(moving, made, places, levels, times, cyclic, smooth, chosen, progress)
    return carrier.carry(sequence, places, keyframes) if carrier else sequence


subdivide = interpolate
"""The paper's name of :func:`interpolate`."""


def _carrier(keyframes: Tensor, faces: Tensor, bases: GivenBases, proxy: int | None) -> Proxy | None:
    """A coarser mesh that moves instead, where it is asked for, or by default where a mesh without bases is large.

    Raises:
        ValueError: There are bases, too.
    """
    given = bases is not None and not callable(bases)
    if given and proxy:
        raise ValueError("the bases belong to the whole mesh, and a proxy has its own: leave out bases, or proxy")
    n_proxy = proxy_size(0 if given else proxy, keyframes.shape[1])
    return Proxy(keyframes, faces, n_proxy) if n_proxy else None


def _make_bases(
    moving: Keyframes, bases: GivenBases, n_modes: int, smooth: bool, chosen: Settings, progress: Progress
) -> Sequence[ModalBasis] | Tensor:
    """The given bases; otherwise bases with modes where these are needed, or the key-frames.

    Raises:
        ValueError: Their number is not the number of key-frames.
    """
    objective, n_keys = chosen.objective, len(moving.keyframes)
    made: Sequence[ModalBasis] | Tensor = moving.keyframes.detach()
    in_modes = bool(objective.terms) or (objective.modal_space is not None and not (smooth and n_keys > 2))
    if bases is not None and not callable(bases):
        made = bases
    elif n_modes and (in_modes or objective.contact):
        if bases is not None:
            made = bases(*moving)
        else:
            with ThreadPoolExecutor(1) as pool:
                loading = pool.submit(choose(chosen.solver.backend).load)  # takes a second
                made = bases_of_checked(*moving, n_modes, progress=progress, stacklevel=4)
                loading.result()
    if len(made) != n_keys:
        raise ValueError(f"each key-frame needs its basis: got {len(made)} bases for {n_keys} key-frames")
    return made


def _fill(
    moving: Keyframes,
    bases: Sequence[ModalBasis] | Tensor,
    places: Sequence[int],
    levels: int,
    times: Times,
    cyclic: bool,
    smooth: bool,
    chosen: Settings,
    progress: Progress,
) -> Tensor:
    """The sequence of checked key-frames with their bases: the key-frames at their places, shapes between them."""
    keyframes, faces = moving
    sequence = keyframes.new_empty(places[-1] + 1, *keyframes.shape[1:])
    with ProgressReport(len(places) - 1, "in-between shapes", progress) as bar, torch.no_grad():
        if chosen.objective.space == "paired":
            intervals = _subdivide_pairs(keyframes, faces, bases, levels, len(places) - 1, chosen)
        else:
            path = Path(bases, faces.cpu(), times, cyclic, smooth, objective=chosen.objective, solver=chosen.solver)
            intervals = _follow_path(path.to(keyframes.device), keyframes, faces, places)
        for i, shapes in enumerate(intervals):
            sequence[places[i]], sequence[places[i] + 1 : places[i + 1]] = keyframes[i], shapes
            bar.update()
        sequence[-1] = keyframes[-1]
    return sequence[:-1] if cyclic else sequence


def _follow_path(path: Path, keyframes: Tensor, faces: Tensor, places: Sequence[int]) -> Iterator[Tensor]:
    """Shapes between the key-frames of each interval."""
    motion = keyframes[None].to(path.dtype)
    knots, left = path.knots(motion), 0
    for i, n in enumerate(b - a for a, b in pairwise(places)):
        u = torch.arange(1, n).to(motion) / n
        result = path.evaluate_interval(knots, motion, i, torch.zeros_like(u, dtype=torch.int64), u, n_searched=n - 1)
        report(result.solution, path.solver)
        if result.solution.n_crossing is not None:
            left += int((result.solution.n_crossing > 0).sum())
        yield result.shapes
    if path.contact:
        _report_contacts(keyframes, faces, left, places[-1] - len(places) + 1)


def _subdivide_pairs(
    keyframes: Tensor, faces: Tensor, bases: Sequence[ModalBasis] | Tensor, levels: int, n: int, chosen: Settings
) -> Iterator[Tensor]:
    """Shapes between the key-frames of each of n intervals, by recursive subdivision in the paired space."""
    mesh = Connectivity(faces.cpu().numpy(), keyframes.shape[1])
    edges = torch.tensor(mesh.edges, device=keyframes.device)
    for ends in ([i, (i + 1) % len(keyframes)] for i in range(n)):
        layers: dict[tuple[int, int], MidShape] = {}
        for pair in [(0, 1), (0, 0), (1, 1)]:
            both = [ends[k] for k in pair]
            chosen_bases = bases[both] if isinstance(bases, Tensor) else [bases[k] for k in both]
            solver = chosen.solver if pair == (0, 1) else replace(chosen.solver, regions=0)
            layers[pair] = MidShape(chosen_bases, faces.cpu(), objective=chosen.objective, solver=solver)
            layers[pair].to(keyframes.device).in_between.core.local = layers[0, 1].in_between.core.local
        shapes = keyframes[ends]
        for _ in range(levels):
            nearest = _nearest_ends(shapes, edges)
            each = zip(pairwise(nearest), shapes[:-1], shapes[1:], strict=True)
            mids = torch.stack([layers[pair](x, y) for pair, x, y in each])
            shapes = torch.cat([torch.stack([shapes[:-1], mids], 1).flatten(0, 1), shapes[-1:]])
        yield shapes[1:-1]


def _nearest_ends(shapes: Tensor, edges: Tensor) -> list[int]:
    """Index, 0 or 1, of the end whose edge lengths are nearer to the lengths of each shape."""
    lengths = torch.linalg.norm(shapes[:, edges[:, 0]] - shapes[:, edges[:, 1]], dim=-1)
    to_first, to_last = ((lengths - lengths[end]).norm(dim=-1) for end in (0, -1))
    return (to_last < to_first).long().tolist()


def keyframe_places(
    n_keyframes: int, levels: int = 3, *, cyclic: bool = False, n_frames: int | None = None, times: Times = None
) -> list[int]:
    """Places of the key-frames in the result of :func:`torch_modal.interpolate`.

    Returns:
        The frame number of each key-frame; if cyclic, a further one where the first key-frame would come again.

    Raises:
        ValueError: ``levels`` or ``n_frames`` is out of range, or ``times`` do not fit.
    """
    if not isinstance(levels, int) or not 0 <= levels <= MAX_LEVELS:
        raise ValueError(f"levels is a whole number from 0 to {MAX_LEVELS} (each doubles the frames), got {levels!r}")
    when = check_times(times, n_keyframes, cyclic)
    intervals = len(when) - 1
    if n_frames is None:
        return [i * 2**levels for i in range(len(when))]
    if n_frames < n_keyframes:
        raise ValueError(f"{n_frames} frames leave no room for {n_keyframes} key-frames; ask for {n_keyframes} or more")
    total = n_frames if cyclic else n_frames - 1
    share = (when - when[0]) / (when[-1] - when[0])
    places = torch.floor(share * total + 0.5).long()
    # No two key-frames share a frame, however near in time.
    order = torch.arange(intervals + 1)
    places = (places - order).cummax(0).values.clamp_max(total - intervals) + order
    return places.tolist()


def _report_contacts(keyframes: Tensor, faces: Tensor, left: int, total: int) -> None:
    """Warn about key-frames that pass through themselves, and about in-betweens that still do."""
    mesh, messages = Connectivity(faces.cpu().numpy(), keyframes.shape[1]), []
    for i, shape in enumerate(keyframes.detach().double().cpu().numpy()):
        pairs = Crossings(mesh, shape[None]).pairs(shape)
        if len(pairs):
            where = ", ".join(f"{c:.4g}" for c in shape[mesh.faces[pairs[0]]].mean((0, 1)))
            messages.append(
                f"key-frame {i} passes through itself: {len(pairs)} pairs of triangles, the first "
                f"{pairs[0].tolist()} near ({where}); in-betweens next to it may do so too"
            )
    if left:
        messages.append(
            f"in {left} of {total} in-betweens, parts still go through each other: a key-frame between those around "
            "them may help"
        )
    for message in messages:
        warnings.warn(message, MeshWarning, stacklevel=5)
