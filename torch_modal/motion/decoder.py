r"""Shapes of a motion from amplitudes: modal deformation of the smooth path through key-frames.

A mode is a displacement of one key-frame. To first order it turns and strains each triangle, and both are kept in the
triangle's own coordinates, which go along with it (rotation-strain coordinates; Huang et al. 2011). So the modes of one
key-frame serve all shapes of the motion: they bend the shape on the path, and large amplitudes turn, rather than
stretch.
"""

import copy
from collections.abc import Callable, Sequence

import torch
from torch import Tensor, nn

from torch_modal.autograd import disable_compile, full_precision, outside_inference_mode, require_numbers
from torch_modal.elastic.backend import TorchBackend
from torch_modal.geometry.connectivity import Connectivity
from torch_modal.geometry.rotations import exp
from torch_modal.geometry.triangle_frames import bend, bent_sides, edge_means, frames_of, sides
from torch_modal.keyframes.arrays import broadcast_leading, check_tensor
from torch_modal.keyframes.check import check_arrays
from torch_modal.motion.cubics import evaluate_by_interval
from torch_modal.motion.spline import Knots, Spline
from torch_modal.times import check_times, locate_times

UNIT = 0.01
"""An amplitude of 1 moves the vertices of the key-frame by this part of its diagonal, in the root mean square."""

SMALLEST_SIDE = 1e-4
"""A triangle with less than this part of the mean side has no turn or strain of its own."""

LARGEST_RATIO = 30.0
"""A triangle turns and strains by at most this many times the mode's mean over the area; only slivers do more."""

VERTICES_OF_CHUNK = 40_000
"""Vertices of all shapes that are decoded at a time: more would not fit into caches."""


class ModalDecoder(nn.Module):
    """Amplitudes in the modes of one key-frame, and times, to shapes: differentiable in both and in the key-frames.

    Amplitudes of zero give the path through the key-frames (:class:`torch_modal.Path`; with two key-frames, their blend
    by local rotations). An amplitude of 1 moves the vertices by 1 % of the diagonal in the root mean square.

    The state holds all but the faces: a decoder of the same faces that loads it gives the same shapes.

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
    spline: Spline
    knots: Knots

    @outside_inference_mode
    def __init__(
        self, keyframes: Tensor, faces: Tensor, times: Tensor | Sequence[float], reference: Tensor, modes: Tensor
    ) -> None:
        super().__init__()
        keyframes, _, indices = check_arrays(keyframes, faces, 2)
        check_tensor("reference", reference, *keyframes.shape[1:], finite=True)
        check_tensor("modes", modes, "k", *keyframes.shape[1:], finite=True)
        times = check_times(times, len(keyframes), None)
        self._mesh = Connectivity(indices, len(reference))
        self.register_buffer("faces", torch.from_numpy(indices), persistent=False)
        for name, x in (("keyframes", keyframes), ("times", times), ("reference", reference)):
            self.register_buffer(name, x.detach().double().cpu().clone())
        self._build()
        modes = modes.detach().double().cpu()
        displaced = scale_modes(modes, self.size)
        #: Turn and strain of each triangle by an amplitude of 1. *Shape:* ``(k, 6, F)``.
        self.register_buffer("columns", bending_columns(self.reference, self.faces, displaced))
        #: Displacement of the centres of loose pieces by it, if there are several. *Shape:* ``(k, 3V)``, or none.
        several = int(self._mesh.vertex_pieces.max()) > 0
        centres = self.spline.poisson.centres(displaced) * self.spline.alignment.scale
        self.register_buffer("moves", centres.flatten(1)[:, : centres[0].numel() if several else 0].contiguous())
        self.register_load_state_dict_post_hook(ModalDecoder._build)

    @outside_inference_mode
    def _build(self, _: object = None) -> None:
        """Build everything that follows from the key-frames, their times and the reference."""
        keyframes = self.keyframes
        used = self.reference[self.faces.unique()]
        #: Diagonal of the reference's bounding box.
        self.register_buffer("size", torch.linalg.norm(used.amax(0) - used.amin(0)), persistent=False)
        spline = Spline(self._mesh, keyframes.double().cpu(), self.times.double().cpu(), None, TorchBackend())
        self.spline = spline.to(keyframes)
        self.knots = self.spline.knots(keyframes[None])

    @outside_inference_mode
    def _apply(self, fn: Callable[[Tensor], Tensor], recurse: bool = True) -> "ModalDecoder":
        require_numbers("ModalDecoder", fn(self.keyframes))
        moved = super()._apply(fn, recurse)
        self.knots = self.spline.knots(self.keyframes[None])
        return moved

    @outside_inference_mode
    def with_keyframes(self, keyframes: Tensor, times: Tensor) -> "ModalDecoder":
        """Decoder with these modes along a path through other key-frames of the same connectivity."""
        other = copy.copy(self)
        other._buffers, other._modules = dict(self._buffers), dict(self._modules)
        other.keyframes = keyframes.detach().to(self.keyframes).clone()
        other.times = times.detach().to(self.times).clone()
        other._build()
        return other

    @property
    def n_modes(self) -> int:
        """Number of amplitudes, k."""
        return len(self.columns)

    @disable_compile
    @full_precision
    def forward(
        self, amplitudes: Tensor, t: Tensor | float, motions: Tensor | None = None, keyframes: Tensor | None = None
    ) -> Tensor:
        """Shapes of amplitudes at times.

        Args:
            amplitudes: *Shape:* ``(..., k)``.
            t: Times from the first to the last key-frame; if cyclic, any. *Shape:* broadcasts against ``(...)``.
            motions: A turn, axis times angle about the shape's centre, and a move in units of the diagonal, after all
                else. Default: none. *Shape:* ``(..., 6)``.
            keyframes: Key-frames instead of the decoder's own, near them. *Shape:* ``(K, V, 3)``.

        Returns:
            *Shape:* ``(..., V, 3)``.

        Raises:
            ValueError: Shapes that do not fit, or times outside.
        """
        check_tensor("amplitudes", amplitudes, "...", self.n_modes)
        if keyframes is not None:
            check_tensor("keyframes", keyframes, *self.keyframes.shape)
        if motions is not None:
            check_tensor("motions", motions, "...", 6)
        knots = self.knots if keyframes is None else self.spline.knots(keyframes[None])
        t = torch.as_tensor(t, dtype=self.times.dtype, device=amplitudes.device)
        lead = broadcast_leading(amplitudes=amplitudes.shape[:-1], t=t.shape)
        a = amplitudes.expand(*lead, -1).reshape(-1, self.n_modes)
        segment, u = self.locate(t.expand(lead).reshape(-1))
        size = max(1, VERTICES_OF_CHUNK // self.keyframes.shape[1])

        def shapes(i: int, rows: Tensor | slice) -> Tensor:
            chunks = [rows] if isinstance(rows, slice) else rows.split(size)
            return torch.cat([self._shapes(knots, i, a[chunk], u[chunk]) for chunk in chunks])

        x = evaluate_by_interval(segment, len(self.times) - 1, shapes)
        if motions is not None:
            turns, moves = motions.expand(*lead, 6).reshape(-1, 1, 6).split(3, -1)
            centre = x.mean(1, keepdim=True)
            x = (x - centre) @ exp(turns[:, 0]).mT + centre + self.size * moves
        return x.reshape(*lead, *x.shape[1:])

    def _shapes(self, knots: Knots, i: int, a: Tensor, u: Tensor) -> Tensor:
        """Shapes of one interval. *Shape:* ``(B, k), (B,)``."""
        which = torch.zeros_like(u, dtype=torch.int64)
        straight = self.spline.straight(knots, i, which, u)
        if self.moves.shape[1]:
            straight = straight + (a @ self.moves).unflatten(1, (-1, 3))
        bending = (a @ self.columns.flatten(1)).unflatten(1, (6, -1)).movedim(1, 0)
        x = self.spline(knots, i, which, u, straight, bending)
        return self.spline.alignment.to_caller(x, self.spline.pose(knots, i, which, u))

    @torch.no_grad()
    def tangents(self, amplitudes: Tensor, t: Tensor) -> Tensor:
        """Derivatives of one shape with respect to the amplitudes, about; a fit takes them for its steps.

        Turns and strains of a mode act on the triangles of the shape, as if those of the others came before.
        *Shape:* ``(k,), () -> (k, V, 3)``.
        """
        segment, u = self.locate(t.reshape(1))
        i, which = int(segment), torch.zeros_like(segment)
        shape = self._shapes(self.knots, i, amplitudes[None], u)
        pose = self.spline.pose(self.knots, i, which, u)
        rotations, frames = self.spline.rotations[i], frames_of(shape, self.faces)
        areas, out = frames.twice_areas.repeat(1, 3), shape.new_empty(self.n_modes, *shape.shape[1:])
        for chunk in torch.arange(self.n_modes).split(max(1, VERTICES_OF_CHUNK // shape.shape[1])):
            columns = self.columns[chunk].movedim(1, 0)
            moved = bent_sides(columns[:3], columns[3:], frames)
            edges = edge_means(moved, areas, rotations.sides, rotations.side_signs, rotations.n_edges)
            centres = torch.zeros_like(out[chunk])
            if self.moves.shape[1]:
                centres = (self.moves[chunk] / self.spline.alignment.scale).unflatten(1, (-1, 3)) @ pose.rotation.mT
            out[chunk] = self.spline.poisson.forward_or_near(self.spline.poisson.right_hand_side(edges), centres)
        return out

    def locate(self, t: Tensor) -> tuple[Tensor, Tensor]:
        """Interval of each time, and its fraction of the interval. *Shape:* ``(B,)``."""
        return locate_times(t, self.times, self.spline.cyclic)


def scale_modes(modes: Tensor, size: Tensor | float) -> Tensor:
    """Modes that move the vertices by :data:`UNIT` of a size in the root mean square. *Shape:* ``(k, V, 3)``."""
    rms = modes.square().sum(-1).mean(1).sqrt().clamp_min(torch.finfo(torch.float64).tiny)
    return modes * (UNIT * size / rms)[:, None, None]


def bending_columns(reference: Tensor, faces: Tensor, displaced: Tensor) -> Tensor:
    """Turns and strains of the triangles by displacements, bounded in slivers; none of triangles without a size.

    *Shape:* ``(V, 3), (F, 3), (k, V, 3) -> (k, 6, F)``.
    """
    rest = frames_of(reference[None], faces)
    turn, strain = bend(sides(displaced.movedim(-1, 0).contiguous(), faces), rest)
    columns, areas = torch.cat([rest.coordinates(turn), strain]), rest.twice_areas
    columns = torch.where(areas / rest.size > SMALLEST_SIDE * rest.size.mean(), columns, 0)
    squared = columns.square().sum(0) + columns[4].square()  # the off-diagonal entry counts twice
    limit = LARGEST_RATIO * ((areas * squared).sum(1, keepdim=True) / areas.sum()).sqrt()
    bound = (limit / squared.sqrt().clamp_min(torch.finfo(squared.dtype).tiny)).clamp_max(1)
    return (bound * columns).movedim(0, 1).contiguous()
