r"""Shapes of a motion from amplitudes: modal deformation of the smooth path through key-frames.

A mode is a displacement of one key-frame. To first order it turns and strains each triangle, and both are kept in the
triangle's own coordinates, which go along with it (rotation-strain coordinates; Huang et al. 2011). So the modes of one
key-frame serve all shapes of the motion: they bend the shape on the path, and large amplitudes turn, rather than
stretch.
"""

from collections.abc import Callable, Sequence
from typing import NamedTuple

import torch
from torch import Tensor, nn

from torch_modal.autograd import (
    Recent,
    broadcast_shapes,
    full_precision,
    in_use,
    lasting,
    mapped,
    outlasting,
    require_numbers,
    traced,
)
from torch_modal.backends.torch.alignment import Alignment, Pair, vertex_tangent_offset
from torch_modal.backends.torch.backend import TorchBackend
from torch_modal.geometry.canonical import CANONICAL_SIZE
from torch_modal.geometry.connectivity import Connectivity
from torch_modal.geometry.hermite import Spacing, TangentOffset, around, beyond, located
from torch_modal.geometry.local_rotations import Trajectory
from torch_modal.geometry.rotations import exp
from torch_modal.geometry.triangle_frames import Frames, bend, convected, frames, sides
from torch_modal.inbetween.blend import Blends, RotationBlend
from torch_modal.inbetween.frame import mean_areas
from torch_modal.keyframes.arrays import checked_times
from torch_modal.keyframes.check import checked_arrays

UNIT = 0.01
"""An amplitude of 1 moves the vertices of the key-frame by this part of its diagonal, in the root mean square."""

LEAST = 1e-4
"""A triangle with less than this part of the mean side has no turn or strain of its own."""

MOST = 30.0
"""A triangle turns and strains by at most this many times the mode's mean over the area: more is that of a sliver."""

KEPT = 200_000
"""Vertices of all intervals, between two key-frames each, that are kept for the next time; two intervals at least."""

CHUNK = 40_000
"""Vertices of all shapes that are decoded at a time: more would not fit into caches."""


class Interval(NamedTuple):
    """Between two key-frames: all that does not depend on the time."""

    pair: Pair
    trajectory: Trajectory
    vertices: TangentOffset
    """Of the vertices, which say where loose pieces are."""


class ModalDecoder(nn.Module):
    """Amplitudes in the modes of one key-frame, and times, to shapes: differentiable in both and in the key-frames.

    Amplitudes of zero give the path through the key-frames (:class:`torch_modal.Path`; with two key-frames, their blend
    by local rotations). An amplitude of 1 moves the vertices by 1 % of the diagonal in the root mean square.

    The state holds all but the faces: a decoder of the same faces that loads it gives the same shapes. Key-frames,
    times and the reference may also be edited in place.

    Args:
        keyframes: Two or more of one connectivity, with faces that can be used. *Shape:* ``(K, V, 3)``.
        faces: Vertex indices. *Shape:* ``(F, 3)``.
        times: When the key-frames are, ascending; if cyclic, one more, when the first comes again. *Shape:* ``(K,)`` or
            ``(K + 1,)``.
        reference: The shape that the modes belong to, one of the key-frames. *Shape:* ``(V, 3)``.
        modes: Displacements of it, of any size. *Shape:* ``(k, V, 3)``.

    Raises:
        ValueError: Shapes that do not fit, numbers that are not finite, indices of vertices that do not exist, or times
            that do not ascend.
    """

    keyframes: Tensor
    times: Tensor
    reference: Tensor
    columns: Tensor
    moves: Tensor
    faces: Tensor
    size: Tensor

    @lasting
    def __init__(
        self, keyframes: Tensor, faces: Tensor, times: Tensor | Sequence[float], reference: Tensor, modes: Tensor
    ) -> None:
        super().__init__()
        keyframes, _, indices = checked_arrays(keyframes, faces, 2)
        reference, modes = (_finite(*one, keyframes) for one in (("reference", reference, 2), ("modes", modes, 3)))
        times = checked_times(times, len(keyframes), len(times) > len(keyframes))
        keyframes, reference, modes = (outlasting(x.detach().double().cpu()) for x in (keyframes, reference, modes))
        faces, mesh = torch.from_numpy(indices), Connectivity(indices, len(reference))
        self._mesh = mesh
        self.register_buffer("faces", faces, persistent=False)
        self._start(keyframes, times, reference)
        rms = modes.square().sum(-1).mean(1).sqrt().clamp_min(torch.finfo(torch.float64).tiny)
        displaced = (modes * (UNIT * CANONICAL_SIZE / rms)[:, None, None]).movedim(-1, 0).contiguous()
        placed = reference * (CANONICAL_SIZE / self.size)
        own = frames(sides(placed.T[:, None].contiguous(), faces))
        #: What an amplitude of 1 does to each triangle. *Shape:* ``(k, 6, F)``.
        self.register_buffer("columns", _bounded(convected(bend(sides(displaced, faces), own), own), own))
        n_pieces = int(mesh.vertex_pieces.max()) + 1
        #: What it does to the centres of loose pieces, if there are several. *Shape:* ``(k, 3V)``, or none.
        centres = self.blend(0).poisson.centres(displaced) if n_pieces > 1 else displaced[..., :0]
        self.register_buffer("moves", centres.permute(1, 2, 0).flatten(1).contiguous())

    def _start(self, keyframes: Tensor, times: Tensor, reference: Tensor) -> None:
        self.register_buffer("keyframes", keyframes.clone())
        self.register_buffer("times", times.clone())
        self.register_buffer("reference", reference.clone())
        self._align()

    @lasting
    def _align(self) -> None:
        """Build everything that follows from the key-frames, their times and the reference."""
        keyframes, reference = self.keyframes.detach(), self.reference.detach()
        self.cyclic = len(self.times) > len(keyframes)
        used = reference[self.faces.unique()]
        #: Diagonal of the reference's bounding box.
        self.register_buffer("size", torch.linalg.norm(used.amax(0) - used.amin(0)), persistent=False)
        placed = reference * (CANONICAL_SIZE / self.size)
        weights = mean_areas(keyframes.double().cpu(), self.faces.cpu()).to(keyframes)
        centre = (weights[:, None] * placed).sum(0) / weights.sum()
        self.alignment = Alignment(placed - centre, CANONICAL_SIZE / self.size, weights)
        self._forget()

    def _current(self) -> None:
        """Align again where the buffers hold other numbers: they were loaded, edited in place, or replaced."""
        own = self.keyframes, self.times, self.reference
        if not torch.compiler.is_exporting() and not all(
            _same(now, then) for now, then in zip(own, self._made_of, strict=True)
        ):
            self._align()

    def _forget(self) -> None:
        self._made_of = [x.detach().clone() for x in (self.keyframes, self.times, self.reference)]
        self._shared = Blends(self._mesh, self._made_of[0].double().cpu(), (0, 1), TorchBackend())
        n_kept = max(2, KEPT // self.keyframes.shape[1])
        self._blends, self._known = Recent(n_kept), Recent(n_kept)

    @lasting
    def through(self, keyframes: Tensor, times: Tensor) -> "ModalDecoder":
        """The same modes beside a path through other key-frames, of the same connectivity."""
        other = ModalDecoder.__new__(ModalDecoder)
        nn.Module.__init__(other)
        other._mesh = self._mesh
        for name in ("faces", "columns", "moves"):
            other.register_buffer(name, getattr(self, name), persistent=name != "faces")
        other._start(keyframes.detach().to(self.keyframes), times.detach().to(self.times), self.reference)
        return other

    def blend(self, i: int) -> RotationBlend:
        """Of an interval; made at the first use, and again if many others were made since."""
        found: RotationBlend = self._blends.get(
            i, lambda: self._shared.of(i, (i + 1) % len(self.keyframes)).to(self.keyframes)
        )
        return found

    @property
    def n_intervals(self) -> int:
        """Between key-frames."""
        return len(self.times) - 1

    @property
    def n_modes(self) -> int:
        """Number of amplitudes, k."""
        return len(self.columns)

    @lasting
    def _apply(self, fn: Callable[[Tensor], Tensor], recurse: bool = True) -> "ModalDecoder":
        require_numbers("ModalDecoder", fn(self.keyframes))
        moved = super()._apply(fn, recurse)
        self._forget()
        return moved

    @full_precision
    def forward(
        self, amplitudes: Tensor, t: Tensor | float, motions: Tensor | None = None, keyframes: Tensor | None = None
    ) -> Tensor:
        """The shapes of amplitudes at times.

        Args:
            amplitudes: *Shape:* ``(..., k)``.
            t: Times within those of the key-frames; if cyclic, any. *Shape:* broadcasts against ``(...)``.
            motions: A turn, axis times angle about the shape's centre, and a move in units of the diagonal, after all
                else. Default: none. *Shape:* ``(..., 6)``.
            keyframes: Others in the place of those that the decoder was made with, near them. *Shape:* ``(K, V, 3)``.

        Returns:
            *Shape:* ``(..., V, 3)``.

        Raises:
            ValueError: Shapes that do not fit, or times outside.
        """
        if amplitudes.shape[-1:] != (self.n_modes,):
            raise ValueError(f"amplitudes have the shape (..., {self.n_modes}); got {tuple(amplitudes.shape)}")
        if keyframes is not None and keyframes.shape != self.keyframes.shape:
            raise ValueError(f"keyframes have the shape {tuple(self.keyframes.shape)}; got {tuple(keyframes.shape)}")
        if motions is not None and motions.shape[-1:] != (6,):
            raise ValueError(f"motions have the shape (..., 6); got {tuple(motions.shape)}")
        self._current()
        t = torch.as_tensor(t, dtype=self.times.dtype, device=amplitudes.device)
        lead = broadcast_shapes(amplitudes.shape[:-1], t.shape)
        a = amplitudes.expand(*lead, -1).reshape(-1, self.n_modes)
        segment, u = self.located(t.expand(lead).reshape(-1))
        order: list[Tensor] = []
        parts: list[Tensor] = []
        everywhere = traced(segment) or mapped(segment)
        for i in in_use(segment, self.n_intervals):
            interval = self._interval(i, keyframes)
            if everywhere:  # of each interval all shapes, of which some are taken
                x = self.alignment.restore(self.bent(i, interval, a, u), interval.pair, u)
                parts = [x if not parts else torch.where((segment == i)[:, None, None], x, parts[0])]
                continue
            for rows in torch.nonzero(segment == i).flatten().split(max(1, CHUNK // self.keyframes.shape[1])):
                order.append(rows)
                parts.append(self.alignment.restore(self.bent(i, interval, a[rows], u[rows]), interval.pair, u[rows]))
        if not parts:
            return amplitudes.new_zeros(*lead, *self.keyframes.shape[1:])
        x = parts[0] if everywhere else torch.cat(parts)[torch.argsort(torch.cat(order))]
        if motions is not None:
            x = moved(x, motions.expand(*lead, 6).reshape(-1, 6), self.size)
        return x.reshape(*lead, *x.shape[1:])

    def bent(self, i: int, interval: Interval, a: Tensor, u: Tensor) -> Tensor:
        """Shapes of one interval, in the frame that the key-frames are aligned in. *Shape:* ``(B, k), (B,)``."""
        pair, trajectory, vertices = interval
        wide = u[:, None, None]
        straight = torch.lerp(pair.first, pair.second, wide) + beyond(vertices, wide)
        if self.moves.shape[1]:
            straight = straight + (a @ self.moves).unflatten(1, (-1, 3))
        bending = (a @ self.columns.flatten(1)).unflatten(1, (6, -1)).movedim(1, 0)
        return self.blend(i).bent_along(trajectory, straight, u, bending)

    def located(self, t: Tensor) -> tuple[Tensor, Tensor]:
        """The interval of each time, and how far along it is. *Shape:* ``(B,)``."""
        return located(t, self.times, self.cyclic)

    def interval(self, i: int) -> Interval:
        """Data of an interval that does not depend on the time; cached."""
        self._current()
        return self._interval(i, None)

    def _interval(self, i: int, keyframes: Tensor | None) -> Interval:
        if torch.compiler.is_exporting() and i not in self._known:
            keyframes = self.keyframes if keyframes is None else keyframes  # the program computes them at each call
        if keyframes is None:
            own: Interval = self._known.get(i, lambda: self._interval(i, self._made_of[0]))
            return own
        pair = self._pair(i, keyframes)
        rotations = self.blend(i).rotations
        if pair.around is None:
            still = Spacing(*(torch.ones_like(pair.first[:, 0, 0]),) * 3)
            trajectory = rotations.trajectory(None, pair.first, pair.second, None, still)
        else:
            before, after, spacing = pair.around[:3]
            trajectory = rotations.trajectory(before, pair.first, pair.second, after, spacing)
        return Interval(pair, trajectory, vertex_tangent_offset(pair))

    def _pair(self, i: int, keyframes: Tensor) -> Pair:
        n = len(keyframes)
        x = keyframes[:, None]
        pair = self.alignment.place(x[i], x[(i + 1) % n])
        if n < 3:
            return pair
        before, after, spacing = around(i, self.times, self.cyclic)
        earlier, later = (None if j is None else x[j] for j in (before, after))
        return self.alignment.surround(pair, earlier, later, spacing.mapped(lambda h: h.to(x)[None]))


def _same(x: Tensor, y: Tensor) -> bool:
    """Whether two tensors hold the same numbers, in the same place."""
    return (x.dtype, x.device) == (y.dtype, y.device) and torch.equal(x, y)


def _finite(name: str, x: Tensor, n_dimensions: int, keyframes: Tensor) -> Tensor:
    """Displacements or positions of the vertices of the key-frames.

    Raises:
        ValueError: They are not.
    """
    item = tuple(keyframes.shape[1:])
    if not isinstance(x, Tensor) or x.dim() != n_dimensions or x.shape[-2:] != item or not x.is_floating_point():
        shape = f"({'k, ' * (n_dimensions - 2)}{item[0]}, 3)"
        got = f"{tuple(x.shape)} of {x.dtype}" if isinstance(x, Tensor) else f"a {type(x).__name__}"
        raise ValueError(f"{name} must be floating-point of shape {shape} as the key-frames are; got {got}")
    if not bool(x.isfinite().all()):
        raise ValueError(f"{name} has entries that are not finite")
    return x


def _bounded(columns: Tensor, own: Frames) -> Tensor:
    """Turns and strains; less where they are those of slivers, none without a size. *Shape:* ``(6, k, F)``."""
    areas = own.doubled_areas
    columns = torch.where(areas / own.size > LEAST * own.size.mean(), columns, 0)
    squared = columns.square().sum(0) + columns[4].square()  # the entry beside the diagonal counts twice
    limit = MOST * ((areas * squared).sum(1, keepdim=True) / areas.sum()).sqrt()
    bound = (limit / squared.sqrt().clamp_min(torch.finfo(squared.dtype).tiny)).clamp_max(1)
    return (bound * columns).movedim(0, 1).contiguous()


def moved(x: Tensor, motions: Tensor, size: Tensor) -> Tensor:
    """Shapes turned about their centres, and moved. *Shape:* ``(B, V, 3), (B, 6) -> (B, V, 3)``."""
    centre = x.mean(1, keepdim=True)
    return (x - centre) @ exp(motions[:, :3]).mT + centre + size * motions[:, None, 3:]
