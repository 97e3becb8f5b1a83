"""Motion through many key-frames: smooth in time, at any time, differentiable."""

from collections.abc import Iterable, Sequence
from dataclasses import replace
from typing import Any

import torch
from torch import Tensor, nn

from torch_modal.autograd import disable_compile, full_precision, outside_inference_mode, require_numbers
from torch_modal.contact.active import refuse_transforms
from torch_modal.contact.in_between import push_apart
from torch_modal.elastic.backend import choose
from torch_modal.elastic.distortion import Distortion
from torch_modal.elastic.energy import RestShapes
from torch_modal.elastic.shell import ALPHA, BETA
from torch_modal.elastic.term import Mesh
from torch_modal.geometry.bodies import bodies
from torch_modal.inbetween.alignment import Pose
from torch_modal.inbetween.comparison import SLACK_OF_PATHS, blend_towards_starts
from torch_modal.inbetween.results import InBetweenResult, join_bodies, report, trivial_solution, with_exact_keyframes
from torch_modal.inbetween.settings import Objective, Preset, Solver, settings
from torch_modal.keyframes.arrays import as_faces, broadcast_leading
from torch_modal.keyframes.check import check_surface
from torch_modal.layers.base import Bases, BasisBuffers, InBetweenLayer, PreciseModule, basis_buffers
from torch_modal.layers.blend import Blend
from torch_modal.layers.in_between import InBetween
from torch_modal.motion.cubics import Scheme, evaluate_by_interval
from torch_modal.motion.spline import Explanation, Knots, Spline
from torch_modal.times import Times, check_times, locate_times, wrap_times

# Even times between two key-frames at which a path looks for contacts.
N_SEARCHED = 31

# Times nearer to a key-frame than this part of the interval are the key-frame's.
SAME_TIME = 1e-12


class Path(PreciseModule):
    """Shapes at any time of a motion through key-frames.

    With three key-frames or more, the rotations and sizes of triangles and the rigid motion follow splines
    (:mod:`torch_modal.motion.spline`): nothing is minimised unless there are contacts or terms beyond Eq. 5. Velocities
    are continuous at the key-frames, which are reproduced exactly. They are limited to three times the slower one of
    both sides, triangle by triangle, so that what stops does stop. The ends have no acceleration. Two key-frames alone
    give the shapes of :class:`torch_modal.InBetween`.

    Args:
        bases: The key-frames, *shape* ``(K, V, 3)``, or, where modes are needed or wanted, the basis of each
            (:func:`torch_modal.extract_bases`).
        faces: Vertex indices. *Shape:* ``(F, 3)``.
        times: When the key-frames are, ascending; if cyclic, one more, when the first comes again. Default: 0, 1, 2,
            and so on. *Shape:* ``(K,)``, or ``(K + 1,)`` if cyclic.
        cyclic: True where the last key-frame leads on to the first. Times are then taken modulo the period.
        smooth: False treats each pair of key-frames alone. A function is another path scheme:
            :data:`torch_modal.motion.cubics.Scheme` (docs/extending.md).
        preset: As for :class:`torch_modal.InBetween`; not ``"paper"``, which has the middle of a pair only.
        objective: What is minimised, instead of the preset's objective. With further terms, the shapes on the spline
            are minimised with these, each compared with itself.
        solver: How it is solved, instead of the preset's solver.
        contact: True to keep parts from passing through each other, instead of what the objective says
            (docs/contact.md; extra ``contact``). Shapes are searched at 31 times between any two key-frames, and
            pushed apart by one displacement that is smooth in time. It is a constant of the graph: gradients are of
            the shapes without contact, and not exact where something touches. Gradients of ``InBetween`` are exact.

    Raises:
        ValueError: An argument is not usable.
        MissingPackageError: ``contact`` without that extra.
    """

    times: Tensor
    splines: Sequence[Spline]
    distortions: Sequence[Distortion]

    @outside_inference_mode
    def __init__(
        self,
        bases: Bases,
        faces: Tensor,
        times: Times = None,
        cyclic: bool = False,
        smooth: bool | Scheme = True,
        preset: Preset = "accurate",
        *,
        objective: Objective | None = None,
        solver: Solver | None = None,
        contact: bool | None = None,
    ) -> None:
        super().__init__()
        objective, self.solver = settings(preset, objective, solver, contact=contact)
        if objective.space == "paired":
            raise ValueError("the paired space (Eq. 4) has the middle of a pair only; a path needs another preset")
        several = list(bases) if isinstance(bases, Iterable) else [bases]
        n = len(several)
        if n < 2:
            raise ValueError(f"a path needs two key-frames or more, got {n}")
        self.cyclic, self.smooth = cyclic, bool(smooth) and (n > 2 or cyclic)
        in_modes = objective.space is not None and not self.smooth
        buffers = basis_buffers(several, in_modes, bool(objective.terms) or objective.contact)
        #: True where shapes are pushed apart: per interval, not per time as in a layer, to stay continuous.
        self.contact = objective.contact
        self.objective = replace(objective, contact=False)
        self.register_buffer("times", check_times(times, n, cyclic).to(buffers[0].reference.device))
        self.bases = nn.ModuleList(buffers)  # type: ignore[assignment]
        #: Number of key-frames, K.
        self.n_keyframes = n
        #: The key-frames of each interval.
        self.pairs = [(i, (i + 1) % n) for i in range(len(self.times) - 1)]
        self.faces = torch.from_numpy(as_faces(faces))
        #: The path scheme; None for the default.
        self.scheme = smooth if callable(smooth) else None
        options: dict[str, Any] = {"objective": self.objective, "solver": self.solver}
        layers: list[InBetweenLayer] = []
        if not self.smooth:
            layers.extend(InBetween([buffers[i], buffers[j]], self.faces, **options) for i, j in self.pairs)
        elif self.objective.terms or self.contact:
            layers.append(Blend(buffers, self.faces, **options))
        #: In-betweens of each interval; a smooth path has none, or, with contact or further terms, one of all bases.
        self.layers: Sequence[InBetweenLayer] = nn.ModuleList(layers)  # type: ignore[assignment]
        for layer in layers if self.contact else ():
            layer.separate = False
            if len(layer.cores) > 1:
                layer._build()
        self._build()
        self.register_load_state_dict_post_hook(Path._build)

    @outside_inference_mode
    def _build(self, _: object = None) -> None:
        """Build the splines of the bases' references, on their device and in their dtype."""
        like = self.bases[0].reference
        references = torch.stack([basis.reference.double().cpu() for basis in self.bases])
        connectivity = check_surface(list(references), self.faces)[1]
        self.faces = torch.tensor(connectivity.faces)
        backend, alone = choose(self.solver.backend), self.contact or self.objective.terms
        pieces = [(slice(None), connectivity)] if alone else bodies(references.numpy(), connectivity)
        #: Vertices of each body, and its spline.
        self.vertices = [vertices for vertices, _ in pieces]
        times = self.times.cpu()
        splines = [Spline(mesh, references[:, rows], times, self.scheme, backend) for rows, mesh in pieces]
        distortions = [backend.distortion(Mesh(mesh), None) for _, mesh in pieces]
        self.splines = nn.ModuleList(splines).to(like)  # type: ignore[assignment]
        self.distortions = nn.ModuleList(distortions).to(like)  # type: ignore[assignment]
        self.register_buffer("built_from", self._marks(), persistent=False)

    @property
    def dtype(self) -> torch.dtype:
        """The dtype of the computation."""
        return self.splines[0].alignment.scale.dtype  # type: ignore[no-any-return]

    @outside_inference_mode
    def insert(self, t: float) -> "Path":
        """Motion with one more key-frame, which borrows the modes of the nearer of those around it.

        Args:
            t: When it is, between the others; modulo the period, if cyclic.

        Returns:
            A path of one more key-frame.

        Raises:
            ValueError: The time is outside, not finite, or equal to the time of a key-frame.
        """
        at = self.times.new_tensor([t])
        segment, u = locate_times(at, self.times, self.cyclic)
        i, fraction = int(segment), float(u)
        if min(fraction, 1 - fraction) <= SAME_TIME:
            raise ValueError(f"there is a key-frame at {t:g} already; replace it in the keyframes that are passed")
        buffers = [BasisBuffers(basis.reference, basis.modes) for basis in self.bases]
        nearest = buffers[self.pairs[i][round(fraction)]]
        passed = self(torch.stack([basis.reference for basis in buffers]).to(self.dtype), t)
        buffers.insert(i + 1, BasisBuffers(passed, nearest.modes))
        at = wrap_times(at, self.times) if self.cyclic else at
        times = torch.cat([self.times[: i + 1], at, self.times[i + 1 :]])
        options: dict[str, Any] = {"objective": self.objective, "solver": self.solver, "contact": self.contact}
        other = Path(buffers, self.faces, times, self.cyclic, self.scheme or self.smooth, **options)
        return other.to(self.bases[0].reference)

    @disable_compile
    def forward(self, keyframes: Tensor, t: Tensor | float) -> Tensor:
        """The shapes at given times.

        Args:
            keyframes: Near those that the path was made from. *Shape:* ``(..., K, V, 3)``.
            t: Times, broadcast against the leading dimensions of the key-frames. *Shape:* ``(...)``, or a number.

        Returns:
            The key-frames exactly at their times. *Shape:* ``(..., V, 3)``.

        Raises:
            ValueError: Shapes that do not fit, or a time before the first or after the last key-frame.
            ConvergenceError: As for :class:`torch_modal.InBetween`.
        """
        result = self.solve(keyframes, t)
        report(result.solution, self.solver)
        return result.shapes

    @disable_compile
    def solve(self, keyframes: Tensor, t: Tensor | float) -> InBetweenResult:
        """The shapes, and how each minimisation went, without a warning. Arguments as for :meth:`forward`."""
        flat, which, segment, u, lead = self._flatten(keyframes, t)
        knots = self.knots(flat)
        result = evaluate_by_interval(
            segment, len(self.pairs), lambda i, rows: self.evaluate_interval(knots, flat, i, which[rows], u[rows])
        )
        ends = flat[which[:, None], torch.tensor(self.pairs, device=segment.device)[segment]].to(keyframes.dtype)
        exact = with_exact_keyframes(result.shapes, ends, torch.stack([1 - u, u], -1))
        return result._replace(shapes=exact).unflatten(lead)

    @torch.no_grad()
    @full_precision
    def explain(self, keyframes: Tensor, t: Tensor | float) -> Explanation:
        """Causes of sudden changes in the motion, at given times. Arguments as for :meth:`forward`."""
        flat, which, segment, u, lead = self._flatten(keyframes, t)
        splines, n = self.splines, len(self.pairs)
        knots = [spline.knots(flat[:, :, body]) for spline, body in zip(splines, self.vertices, strict=True)]
        limited, turns = zip(*map(Spline.explain, splines, knots), strict=True)
        share, turn = self.smooth * torch.cat(limited, -1).to(u).mean(-1), torch.stack(turns).amax(0)
        even = [not self.smooth or any(s.rotations[i].beyond_a_turn for s in splines) for i in range(n)]
        result = self.solve(keyframes, t)
        alone = evaluate_by_interval(
            segment, n, lambda i, rows: self._spline_shapes(knots, flat, i, which[rows], u[rows])
        )
        moved = (result.shapes.reshape_as(alone.shapes) - alone.shapes).norm(dim=-1).amax(-1)
        of_intervals = share[segment, :, which], torch.tensor(even, device=u.device)[segment], turn[segment, :, which]
        fields = (x.reshape(lead + x.shape[1:]) for x in (segment, u, *of_intervals, moved))
        return Explanation._make([*fields, result.solution])

    def knots(self, motions: Tensor) -> list[Knots]:
        """The knots of each body; none if the path is not smooth. *Shape:* ``(L, K, V, 3)``."""
        parts = zip(self.splines, self.vertices, strict=True)
        return [spline.knots(motions[:, :, vertices]) for spline, vertices in parts] if self.smooth else []

    @full_precision
    def evaluate_interval(
        self, knots: list[Knots], flat: Tensor, i: int, which: Tensor, u: Tensor, n_searched: int = N_SEARCHED
    ) -> InBetweenResult:
        """Shapes of one interval.

        Args:
            knots: From :meth:`knots`.
            flat: The motions, in the dtype of the computation. *Shape:* ``(L, K, V, 3)``.
            i: The interval.
            which: Index of each shape's motion. *Shape:* ``(B,)``.
            u: Times, 0 to 1. *Shape:* ``(B,)``.
            n_searched: Number of even times at which contacts are searched.
        """
        result = self._spline_shapes(knots, flat, i, which, u)
        if self.contact:
            result = self._separate_contacts(knots, flat, i, which, u, result, n_searched)
        if self.smooth and self.objective.terms:
            x = result.shapes[:, None]  # each is compared with itself
            result = self.layers[0].solve_samples(x, torch.ones_like(x[..., 0, 0]), u.shape)
        return result

    def _spline_shapes(self, knots: list[Knots], flat: Tensor, i: int, which: Tensor, u: Tensor) -> InBetweenResult:
        """Shapes without contact and further terms. Arguments as for :meth:`evaluate_interval`."""
        weights = torch.stack([1 - u, u], -1)
        if not self.smooth:
            result = self.layers[i].solve_samples(flat[which][:, list(self.pairs[i])], weights, u.shape)
            # Amplitudes of other intervals are of other modes.
            solution = result.solution._replace(amplitudes=u.new_zeros(len(u), 0))
            return result._replace(solution=solution)  # type: ignore[no-any-return]
        results, stiffness = [], [u.new_full((len(u), 1), value) for value in (ALPHA, BETA)]
        for spline, distortion, body in zip(self.splines, self.distortions, knots, strict=True):
            straight = spline.straight(body, i, which, u)
            x, usable = spline(body, i, which, u, straight=straight), body.usable[which]
            rests = RestShapes(body.shapes[i : i + 2, which].movedim(0, 1), weights, stiffness, None)
            x, solution = blend_towards_starts(
                x, [straight], trivial_solution(x, usable), distortion, rests, SLACK_OF_PATHS
            )
            shapes = spline.alignment.to_caller(x, spline.pose(body, i, which, u))
            results.append(InBetweenResult(torch.where(usable[:, None, None], shapes, torch.nan), solution))
        return results[0] if len(results) == 1 else join_bodies(results, self.vertices)

    def _separate_contacts(
        self, knots: list[Knots], flat: Tensor, i: int, which: Tensor, u: Tensor, result: InBetweenResult, n: int
    ) -> InBetweenResult:
        """Shapes pushed apart by a displacement found at ``n`` even times of each motion."""
        refuse_transforms(result.shapes)
        layer, pair = self.layers[0 if self.smooth else i], list(self.pairs[i])
        core, even = layer.core, torch.arange(1, n + 1).to(u) / (n + 1)
        shapes, left = result.shapes, torch.zeros_like(result.solution.status)

        def pose_at(rows: Tensor, at: Tensor) -> tuple[Pose, Tensor]:
            """Poses, and key-frames in the frame of the solver."""
            if self.smooth:
                return self.splines[0].pose(knots[0], i, rows, at), knots[0].shapes[i : i + 2, rows].movedim(0, 1)
            ends, pose, _ = core.alignment(flat[rows][:, pair], torch.stack([1 - at, at], -1))
            return pose, ends

        for motion in which.unique().tolist():
            with torch.no_grad():
                rows = torch.full_like(even, motion, dtype=torch.int64)
                pose, ends = pose_at(rows, even)
                x = core.alignment.to_frame(self._spline_shapes(knots, flat, i, rows, even).shapes, pose)
                rests = RestShapes(ends, torch.stack([1 - even, even], -1), layer.stiffness_of(even, even.shape))
                if self.smooth:  # shapes on the spline are compared with themselves
                    rests = rests._replace(shapes=x[:, None], weights=torch.ones_like(even)[:, None])
                last = len(self.pairs) - 1
                goes_on = self.smooth and (self.cyclic or i > 0), self.smooth and (self.cyclic or i < last)
                both = torch.stack([ends[0], flat[motion, pair]])
                displacement = push_apart(core, x, even, rests, pose, both, goes_on)
            chosen = torch.nonzero(which == motion).flatten()
            pose = pose_at(which[chosen], u[chosen])[0]
            pushed, left[chosen] = displacement.apply(core.alignment.to_frame(result.shapes[chosen], pose), u[chosen])
            shapes = shapes.index_copy(0, chosen, core.alignment.to_caller(pushed, pose))
        return InBetweenResult(shapes, result.solution._replace(n_crossing=left))

    def _flatten(self, keyframes: Tensor, t: Tensor | float) -> tuple[Tensor, Tensor, Tensor, Tensor, torch.Size]:
        """Checked motions ``(L, K, V, 3)``; the motion, interval and fraction of each shape; leading dimensions."""
        self.check_shapes(self.n_keyframes, keyframes=keyframes)
        require_numbers("Path", keyframes)
        self._require_own_bases()
        rounding = torch.finfo(t.dtype).eps if isinstance(t, Tensor) and t.is_floating_point() else 0.0
        t = torch.as_tensor(t, dtype=self.times.dtype, device=keyframes.device)
        leading = keyframes.shape[:-3]
        hint = "for all times of all motions pass keyframes[:, None]"
        lead = broadcast_leading(hint, keyframes=leading, t=t.shape)
        flat = keyframes.to(self.dtype).reshape(-1, *keyframes.shape[-3:])
        which = torch.arange(len(flat), device=t.device).reshape(leading).expand(lead).reshape(-1)
        segment, u = locate_times(t.expand(lead).reshape(-1), self.times, self.cyclic, rounding)
        return flat, which, segment, u.to(flat), lead
