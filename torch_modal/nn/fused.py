"""The local steps and the local rotations by kernels of NVIDIA Warp, where that is installed.

Each kernel does in one pass over the elements what torch does in dozens. The torch code stays: it is what these are
tested against, what runs where Warp is not, and what differentiates a gradient once more.
"""

from collections.abc import Sequence
from functools import partial
from typing import Any, NamedTuple

import torch
from torch import Tensor, nn

from torch_modal.energy.energy import Energy
from torch_modal.energy.terms import MIN_RELATIVE_LENGTH, MIN_RELATIVE_VOLUME, Bend, Mesh, Stretch, Volume
from torch_modal.geometry.local_rotations import Course, LocalRotations
from torch_modal.nn.adjoint import flattened
from torch_modal.nn.launch import Backend, has_kernels, kernels, launch, traced
from torch_modal.nn.relax import STEP_LENGTHS, conjugate_gradients, inverse_of_symmetric, relax

Shapes = dict[int, tuple[int, ...]]
"""Of the arguments of a kernel that are its output, by their places."""


class _Recorded(torch.autograd.Function):
    """A kernel whose outputs start as zeros and are added to, with the adjoint that Warp derives."""

    @staticmethod
    def forward(ctx: Any, kernel: Any, dim: tuple[int, ...], shapes: Shapes, *given: Any) -> tuple[Tensor, ...]:
        like = next(value for value in given if isinstance(value, Tensor) and value.is_floating_point())
        outputs = {place: like.new_zeros(shape) for place, shape in shapes.items()}
        whole = [outputs.get(place, value) for place, value in enumerate(given)]
        launch(kernel, dim, whole)
        ctx.kernel, ctx.dim, ctx.places, ctx.whole = kernel, dim, list(shapes), whole
        return tuple(outputs.values())

    @staticmethod
    def backward(ctx: Any, *grads: Tensor) -> tuple[Any, ...]:
        received = dict(zip(ctx.places, (grad.contiguous() for grad in grads), strict=True))
        adjoints: list[Any] = []
        for place, value in enumerate(ctx.whole):
            if place in received:
                adjoints.append(received[place].clone())
            elif isinstance(value, Tensor) and value.is_floating_point():
                adjoints.append(torch.zeros_like(value))
            else:
                adjoints.append(None)
        launch(ctx.kernel, ctx.dim, ctx.whole, adjoints)
        return (None,) * 3 + tuple(None if place in received else own for place, own in enumerate(adjoints))


# ---------------------------------------------------------------------------------------------------------- local steps
class _Reference(NamedTuple):
    """Both rest shapes of each sample, as the kernels see them."""

    stretch: Tensor
    """Doubled weight and length. *Shape:* ``(B, E, 2)``."""
    bend: Tensor
    """Doubled weights and angles of both. *Shape:* ``(B, E, 4)``."""
    stiffness: Tensor
    """Of the volume, doubled. *Shape:* ``(B,)``."""
    volume: Tensor
    """*Shape:* ``(B,)``."""


class FusedRelax(nn.Module):
    """:func:`torch_modal.nn.relax.relax` towards two rest shapes, for the terms of Eq. 5 alone.

    It computes in float64, whatever comes in.

    Args:
        energy: Of stretch, bend and volume, in this order, on the fine mesh.
        mesh: That mesh.
    """

    record: Tensor
    hinge: Tensor
    faces: Tensor
    walls: Tensor
    used: Tensor

    def __init__(self, energy: Energy, mesh: Mesh) -> None:
        super().__init__()
        own = mesh.connectivity
        interior = torch.tensor(own.counts == 2)
        record = torch.cat([mesh.edges, torch.full_like(mesh.edges, -1)], 1)
        record[interior] = mesh.hinges
        self._energy = (energy,)
        self.n_vertices = own.n_vertices
        self.closed = len(own.boundary_chain) == 0
        self.register_buffer("record", record.int(), persistent=False)
        self.register_buffer("hinge", (interior.cumsum(0) - 1).int(), persistent=False)
        self.register_buffer("faces", mesh.faces.int(), persistent=False)
        chain = torch.tensor(own.boundary_chain)
        cones = torch.cat([chain.flip(1), torch.full_like(chain[:, :1], -1)], 1)
        self.register_buffer("walls", torch.cat([mesh.faces, cones]).int(), persistent=False)
        self.register_buffer("used", energy.used, persistent=False)

    @staticmethod
    def serves(energy: Energy, backend: Backend) -> bool:
        """Whether it can stand in for an energy."""
        return [type(part.term) for part in energy.parts] == [Stretch, Bend, Volume] and has_kernels(backend)

    @property
    def energy(self) -> Energy:
        """What the kernels compute, in torch."""
        return self._energy[0]

    def forward(
        self,
        x: Tensor,
        first: Tensor,
        second: Tensor,
        t: Tensor,
        stiffness: Sequence[Tensor],
        n_steps: int,
        n_products: int,
        chunk: int,
    ) -> Tensor:
        """Steps of all vertices.

        Args:
            x: Where to start. *Shape:* ``(B, V, 3)``.
            first: Rest shapes of the weight ``1 - t``. *Shape:* ``(B, V, 3)``.
            second: Rest shapes of the weight ``t``. *Shape:* ``(B, V, 3)``.
            t: *Shape:* ``(B,)``.
            stiffness: Of each term. *Shape of each:* ``(B, M)`` or ``(B, 1)``.
            n_steps: Newton steps.
            n_products: Iterations of conjugate gradients in each.
            chunk: Samples at a time: more do not fit into caches.

        Returns:
            *Shape:* ``(B, V, 3)``.
        """
        if not n_steps:
            return x
        if traced(x):
            return self.oracle(n_steps, n_products, x, first, second, t, *stiffness)
        given = [value.double() for value in (x, first, second, t, *stiffness)]
        parts = [
            _Relaxed.apply(self, n_steps, n_products, *(value[i : i + chunk] for value in given))[0]
            for i in range(0, len(x), chunk)
        ]
        return torch.cat(parts).to(x)

    def oracle(self, n_steps: int, n_products: int, x: Tensor, first: Tensor, second: Tensor, *rest: Tensor) -> Tensor:
        """The same by torch."""
        t, *stiffness = rest
        one, other = (self.energy.rest(self.energy.extend(x.movedim(-1, 0).contiguous())) for x in (first, second))
        return relax(self.energy, x, self.energy.between(one, other, t, stiffness), n_steps, n_products)

    # ------------------------------------------------------------------------------------------------------- the energy
    def reference(self, first: Tensor, second: Tensor, t: Tensor, *stiffness: Tensor) -> _Reference:
        """What shapes are compared with; recorded where gradients are."""
        module, (n_samples, n) = kernels(), first.shape[:2]
        alpha, beta, gamma = (value.contiguous() for value in stiffness)
        pull = torch.stack([1 - t, t], -1)
        lengths = []
        for end in (first, second):
            lengths.append(total := t.new_zeros(n_samples))
            launch(module.total_length, (n_samples, len(self.record)), [end, self.record, n, total])
        shortest = torch.stack(lengths, -1) * (MIN_RELATIVE_LENGTH / len(self.record))
        given: list[Any] = [first, second, self.record, self.hinge, pull, shortest, alpha, beta]
        given += [n, alpha.shape[-1], beta.shape[-1], None, None]
        shapes: Shapes = {11: (n_samples, len(self.record), 2), 12: (n_samples, len(self.record), 4)}
        stretch, bend = self._run(module.rest, shapes, given)
        volumes = [self.volume(end)[0] for end in (first, second)]
        pulls = [
            2 * share * gamma[:, 0] / torch.maximum(found.abs(), MIN_RELATIVE_VOLUME * self._area(end) ** 1.5) ** 2
            for share, found, end in zip(pull.unbind(-1), volumes, (first, second), strict=True)
        ]
        whole = pulls[0] + pulls[1]
        share = torch.where(whole > 0, pulls[1] / torch.where(whole > 0, whole, 1), 0)
        return _Reference(stretch, bend, whole, torch.lerp(volumes[0], volumes[1], share))

    def _area(self, x: Tensor) -> Tensor:
        """Of the surface, closed towards the centre. *Shape:* ``(B, V, 3) -> (B,)``."""
        given = [x, self.centre(x), self.walls, self.n_vertices, None]
        return self._run(kernels().area, {4: (len(x),)}, given, len(self.walls))[0]

    def centre(self, x: Tensor) -> Tensor:
        """The mean of all vertices of faces. *Shape:* ``(B, V, 3) -> (B, 3)``."""
        return x.mean(1) if len(self.used) == self.n_vertices else x[:, self.used].mean(1)

    def volume(self, x: Tensor) -> tuple[Tensor, Tensor]:
        """The volume about the centre, and its gradient. *Shape:* ``(B,), (B, V, 3)``."""
        n_samples = len(x)
        given = [x, self.centre(x), self.faces, self.n_vertices, None, None]
        total, normal = self._run(kernels().volume, {4: (n_samples,), 5: tuple(x.shape)}, given, len(self.faces))
        if not self.closed:  # the centre moves with all vertices; of a closed surface it does not matter
            share = normal.sum(1, keepdim=True) / len(self.used)
            normal = normal.index_add(1, self.used, -share.expand(-1, len(self.used), -1))
        return total, normal

    def _run(self, kernel: Any, shapes: Shapes, given: list[Any], n: int | None = None) -> tuple[Tensor, ...]:
        n_samples = next(iter(shapes.values()))[0]
        return _Recorded.apply(kernel, (n_samples, len(self.record) if n is None else n), shapes, *given)

    def linearise(self, x: Tensor, to: _Reference) -> tuple[Tensor, ...]:
        """Energy, gradient but for the volume, diagonal blocks, and records of edges and hinges."""
        b, e = len(x), len(self.record)
        shapes: Shapes = {5: (b,), 6: tuple(x.shape), 7: (*x.shape[:2], 6), 8: (b, e, 5), 9: (b, e, 10)}
        return self._run(
            kernels().linearise, shapes, [x, self.record, to.stretch, to.bend, self.n_vertices, *[None] * 5]
        )

    def value(self, x: Tensor, to: _Reference) -> Tensor:
        """The energy but for its constant. *Shape:* ``(B, V, 3) -> (B,)``."""
        energy = x.new_zeros(len(x))
        given = [x, self.record, to.stretch, to.bend, self.n_vertices, energy]
        launch(kernels().value, (len(x), len(self.record)), given)
        volume = torch.zeros_like(energy)
        launch(
            kernels().volume, (len(x), len(self.faces)), [x, self.centre(x), self.faces, self.n_vertices, volume, None]
        )
        return energy + self._of_volume(volume, to)

    @staticmethod
    def _of_volume(volume: Tensor, to: _Reference) -> Tensor:
        return 0.5 * to.stiffness * (volume - to.volume) ** 2

    # -------------------------------------------------------------------------------------------------------- the steps
    def steps(self, n_steps: int, n_products: int, x: Tensor, *rest: Tensor) -> tuple[Tensor, Tensor]:
        """The steps, and the length of each: nothing is recorded. *Shape:* ``(B, V, 3), (n_steps, B)``."""
        to = self.reference(*rest)
        lengths = x.new_zeros(n_steps, len(x))
        at = self._linearised(x, to)
        for k in range(n_steps):
            solution, reached = self._solved(x, at, to, n_products)
            # The whole step, linearised at once for the next one, is nearly always the one that is taken.
            if k < n_steps - 1:
                there = self._linearised(reached, to)
                energy = there[0]
            else:
                there, energy = None, self.value(reached, to)
            length = torch.where(energy < at[0], 1.0, 0.0).to(x)
            if not bool(length.all()):
                length = self._shortened(x, solution, at[0], length, to)
                reached = x + length[:, None, None] * solution
                there = self._linearised(reached, to) if k < n_steps - 1 else None
            x, lengths[k] = reached, length
            at = at if there is None else there
        return x, lengths

    def _linearised(self, x: Tensor, to: _Reference) -> tuple[Tensor, ...]:
        energy, gradient, diagonal, edges, hinges = self.linearise(x, to)
        volume, normal = self.volume(x)
        moment = to.stiffness * (volume - to.volume)
        return energy + self._of_volume(volume, to), gradient, diagonal, edges, hinges, normal, moment

    def _shortened(self, x: Tensor, solution: Tensor, before: Tensor, length: Tensor, to: _Reference) -> Tensor:
        for shorter in STEP_LENGTHS[1:]:
            downhill = (length == 0) & (self.value(x + shorter * solution, to) < before)
            length = torch.where(downhill, shorter, length)
            if bool(length.all()):
                break
        return length

    def _solved(self, x: Tensor, at: Sequence[Tensor], to: _Reference, n_products: int) -> tuple[Tensor, Tensor]:
        """Conjugate gradients, fused. *Shape:* ``(B, V, 3)`` each: the step, and where it leads."""
        module, (b, n) = kernels(), x.shape[:2]
        _, gradient, diagonal, edges, hinges, normal, moment = at
        residual, direction, solution, product, reached = torch.empty(5, *x.shape, dtype=x.dtype, device=x.device)
        size, swept, form = torch.zeros(3, n_products + 1, b, dtype=x.dtype, device=x.device)
        vertices, records = (b, n), (b, len(self.record))
        given = [gradient, normal, moment, diagonal, n, residual, direction, solution, product, size[0], swept[0]]
        launch(module.begin, vertices, given)
        for k in range(n_products):
            launch(module.product, records, [direction, self.record, edges, hinges, n, product, form[k]])
            if k == n_products - 1:
                given = [x, direction, to.stiffness, swept[k], size[k], form[k], n, solution, reached]
                launch(module.arrive, vertices, given)
                break
            given = [direction, product, normal, diagonal, to.stiffness, swept[k], size[k], form[k], n]
            launch(module.advance, vertices, [*given, solution, residual, size[k + 1]])
            given = [residual, diagonal, normal, size[k], size[k + 1], n, direction, product, swept[k + 1]]
            launch(module.turn, vertices, given)
        return solution, reached

    def recorded(self, n_products: int, lengths: Tensor, x: Tensor, *rest: Tensor) -> Tensor:
        """The same steps of known lengths, by kernels that autograd can go back through. *Shape:* ``(B, V, 3)``."""
        to = self.reference(*rest)
        for length in lengths:
            at = self._linearised(x, to)
            _, gradient, diagonal, _, _, normal, moment = at
            right = -(gradient + moment[:, None, None] * normal)
            product, precondition = partial(self._product, at, to), partial(_applied, _inverse(diagonal))
            solution = conjugate_gradients(product, precondition, _dot, right, n_products)
            x = x + length[:, None, None] * solution
        return x

    def _product(self, at: Sequence[Tensor], to: _Reference, field: Tensor) -> Tensor:
        """The convex Hessian times a field. *Shape:* ``(B, V, 3)``."""
        edges, hinges, normal = at[3:6]
        given = [field, self.record, edges, hinges, self.n_vertices, None, None]
        found, _ = self._run(kernels().product, {5: tuple(field.shape), 6: (len(field),)}, given)
        return found + to.stiffness[:, None, None] * _dot(normal, field) * normal


def _dot(a: Tensor, b: Tensor) -> Tensor:
    """*Shape:* ``(B, V, 3), (B, V, 3) -> (B, 1, 1)``."""
    return (a * b).sum((1, 2))[:, None, None]


def _applied(inverse: Tensor, residual: Tensor) -> Tensor:
    """*Shape:* ``(B, V, 3, 3), (B, V, 3) -> (B, V, 3)``."""
    return (inverse @ residual[..., None]).squeeze(-1)


def _inverse(packed: Tensor) -> Tensor:
    """Inverses of symmetric matrices, as :func:`torch_modal.nn.relax.inverse_of_symmetric`. *Shape:* ``(..., 6)``."""
    xx, xy, xz, yy, yz, zz = packed.unbind(-1)
    rows = torch.stack([xx, xy, xz, xy, yy, yz, xz, yz, zz]).unflatten(0, (3, 3))
    return inverse_of_symmetric(rows).movedim((0, 1), (-2, -1))


class _Relaxed(torch.autograd.Function):
    """Fused steps. Backward takes them once more, recorded: nothing is kept in between but the input."""

    @staticmethod
    def forward(fused: FusedRelax, n_steps: int, n_products: int, *given: Tensor) -> tuple[Tensor, Tensor]:
        return fused.steps(n_steps, n_products, *(value.detach().contiguous() for value in given))

    @staticmethod
    def setup_context(ctx: Any, inputs: tuple[Any, ...], output: tuple[Tensor, Tensor]) -> None:
        ctx.fused, ctx.n_steps, ctx.n_products, *given = inputs
        ctx.mark_non_differentiable(output[1])
        ctx.save_for_backward(output[1], *given)

    @staticmethod
    def backward(ctx: Any, to_shape: Tensor, _: Tensor) -> tuple[Tensor | None, ...]:
        lengths, *given = ctx.saved_tensors
        if torch.is_grad_enabled():  # torch differentiates its own code once more
            run = partial(ctx.fused.oracle, ctx.n_steps, ctx.n_products)
        else:
            run = partial(ctx.fused.recorded, ctx.n_products, lengths)
            given = [value.detach().contiguous() for value in given]
        return (None,) * 3 + _pulled_back(run, given, to_shape, ctx.needs_input_grad[3:])

    @staticmethod
    def vmap(
        info: Any, in_dims: tuple[Any, ...], fused: FusedRelax, n_steps: int, n_products: int, *given: Tensor
    ) -> tuple[tuple[Tensor, Tensor], tuple[int, int]]:
        flat = flattened(info.batch_size, in_dims[3:], given)
        x, lengths = _Relaxed.apply(fused, n_steps, n_products, *flat)
        lengths = lengths.unflatten(1, (info.batch_size, -1))
        return (x.unflatten(0, (info.batch_size, -1)), lengths), (0, 1)


def _pulled_back(run: Any, given: Sequence[Tensor], to_output: Tensor, needed: Sequence[bool]) -> tuple[Any, ...]:
    """Gradients of a function of tensors in those that need one."""
    if torch.is_grad_enabled():  # gradients of gradients, or a transform of torch.func
        return torch.func.vjp(run, *given)[1](to_output)
    with torch.enable_grad():
        leaves = [value.detach().requires_grad_(need) for value, need in zip(given, needed, strict=True)]
        wanted = [leaf for leaf, need in zip(leaves, needed, strict=True) if need]
        found = iter(torch.autograd.grad(run(*leaves), wanted, to_output, allow_unused=True))
    return tuple(next(found) if need else None for need in needed)


# ------------------------------------------------------------------------------------------------------ local rotations
class FusedRotations(LocalRotations):
    """:class:`~torch_modal.geometry.local_rotations.LocalRotations` whose edges come from kernels, in float64."""

    def __init__(self, *args: Any) -> None:
        super().__init__(*args)
        parent = self.ancestors[0]
        depth, above = (parent != torch.arange(len(parent))).long(), parent
        while bool((above != above[above]).any()):
            depth, above = depth + depth[above], above[above]
        of_faces = {
            "face": self.faces,
            "order": torch.argsort(depth, stable=True),
            "parent": parent,
            "piece_of": self.piece,
            "edge_of": self.sides.unflatten(0, (3, -1)).T,
        }
        for name, values in of_faces.items():
            self.register_buffer(f"_{name}", values.int().contiguous(), persistent=False)
        self.register_buffer("_signs", self.side_signs.unflatten(0, (3, -1)).T.contiguous(), persistent=False)

    def forward(self, first: Tensor, second: Tensor, t: Tensor) -> Tensor:
        """As the other's."""
        if traced(first):
            return self.oracle(first, second, t)
        given = [value.double() for value in (first, second, t)]
        return _Turned.apply(self, *given).to(first)

    def oracle(self, first: Tensor, second: Tensor, t: Tensor) -> Tensor:
        """The same by torch."""
        return super().forward(first, second, t)

    def sense(self, first: Tensor, second: Tensor) -> Tensor:
        """The sign of the quaternion of each triangle. *Shape:* ``(B, F)``."""
        module, (b, n), n_faces = kernels(), first.shape[:2], len(self.faces)
        quaternions, areas = first.new_empty(b, n_faces, 4), first.new_empty(b, n_faces)
        launch(module.turns, (b, n_faces), [first, second, self._face, n, quaternions, areas])
        if first.device.type != "cpu":  # the walk down the tree is one thread's
            return self._senses(quaternions.movedim(-1, 0), areas)
        n_pieces = int(self.piece.max()) + 1
        sign, vote = torch.empty_like(areas), first.new_zeros(b, n_pieces)
        given = [quaternions, areas, self._order, self._parent, self._piece_of, n_pieces, sign, vote]
        launch(module.senses, (b,), given)
        return sign

    def edges(self, sense: Tensor, first: Tensor, second: Tensor, t: Tensor) -> Tensor:
        """Edge vectors where the senses are known. *Shape:* ``(3, B, E)``."""
        b, n, n_edges = len(first), first.shape[1], len(self.per_length)
        given = [first, second, t, self._face, self._edge_of, self._signs.double(), sense, n, n_edges, None]
        return _means(*_Recorded.apply(kernels().turned_edges, (b, len(self.faces)), {9: (b, n_edges, 4)}, *given))

    def along(self, course: Course, which: Tensor, t: Tensor) -> Tensor:
        """As the other's."""
        if traced(t):
            return super().along(course, which, t)
        packed = torch.cat([part if part.dim() > 2 else part[None] for part in course])
        edges = _OnCourse.apply(self, packed.movedim(0, -1).double(), which, t.double())
        return edges.to(course.unit)

    def course_oracle(self, packed: Tensor, which: Tensor, t: Tensor) -> Tensor:
        """Edges on a packed course, by torch. *Shape:* ``(P, F, 31)``."""
        parts = packed.movedim(-1, 0).split([3, 3, 3, 3, 6, 6, 6, 1])
        return super().along(Course._make([*parts[:-1], parts[-1][0]]), which, t)

    def course_edges(self, which: Tensor, packed: Tensor, t: Tensor) -> Tensor:
        """The same by kernels. *Shape:* ``(3, B, E)``."""
        b, n_edges = len(t), len(self.per_length)
        given = [packed, which.int(), t, self._edge_of, self._signs.double(), n_edges, None]
        return _means(*_Recorded.apply(kernels().course_edges, (b, len(self.faces)), {6: (b, n_edges, 4)}, *given))


def _means(total: Tensor) -> Tensor:
    """Weighted sums over their weights. *Shape:* ``(B, E, 4) -> (3, B, E)``."""
    return (total[..., :3] / total[..., 3:].clamp_min(torch.finfo(total.dtype).tiny)).movedim(-1, 0)


class _OnCourse(torch.autograd.Function):
    @staticmethod
    def forward(fused: FusedRotations, packed: Tensor, which: Tensor, t: Tensor) -> Tensor:
        return fused.course_edges(which, packed.detach().contiguous(), t.detach().contiguous())

    @staticmethod
    def setup_context(ctx: Any, inputs: tuple[Any, ...], output: Tensor) -> None:
        ctx.fused, *given = inputs
        ctx.save_for_backward(*given)

    @staticmethod
    def backward(ctx: Any, to_edges: Tensor) -> tuple[Tensor | None, ...]:
        packed, which, t = ctx.saved_tensors
        if torch.is_grad_enabled():
            given, run = [packed, t], lambda packed, t: ctx.fused.course_oracle(packed, which, t)
        else:
            given, run = [packed.contiguous(), t.contiguous()], partial(ctx.fused.course_edges, which)
        to_packed, to_t = _pulled_back(run, given, to_edges, [ctx.needs_input_grad[1], ctx.needs_input_grad[3]])
        return None, to_packed, None, to_t

    @staticmethod
    def vmap(
        info: Any, in_dims: tuple[Any, ...], fused: FusedRotations, packed: Tensor, which: Tensor, t: Tensor
    ) -> tuple[Tensor, int]:
        n = info.batch_size
        packed, which, t = (
            x.expand(n, *x.shape) if dim is None else x.movedim(dim, 0)
            for x, dim in zip((packed, which, t), in_dims[1:], strict=True)
        )
        which = which + packed.shape[1] * torch.arange(n, device=which.device)[:, None]
        out = _OnCourse.apply(fused, packed.flatten(0, 1), which.flatten(), t.flatten())
        return out.unflatten(1, (n, -1)), 1


class _Turned(torch.autograd.Function):
    @staticmethod
    def forward(fused: FusedRotations, *given: Tensor) -> Tensor:
        first, second, t = (value.detach().contiguous() for value in given)
        return fused.edges(fused.sense(first, second), first, second, t)

    @staticmethod
    def setup_context(ctx: Any, inputs: tuple[Any, ...], output: Tensor) -> None:
        ctx.fused, *given = inputs
        ctx.save_for_backward(*given)

    @staticmethod
    def backward(ctx: Any, to_edges: Tensor) -> tuple[Tensor | None, ...]:
        given = ctx.saved_tensors
        if torch.is_grad_enabled():
            run = ctx.fused.oracle
        else:
            given = [value.detach().contiguous() for value in given]
            run = partial(ctx.fused.edges, ctx.fused.sense(*given[:2]))
        return (None, *_pulled_back(run, given, to_edges, ctx.needs_input_grad[1:]))

    @staticmethod
    def vmap(info: Any, in_dims: tuple[Any, ...], fused: FusedRotations, *given: Tensor) -> tuple[Tensor, int]:
        flat = flattened(info.batch_size, in_dims[1:], given)
        return _Turned.apply(fused, *flat).unflatten(1, (info.batch_size, -1)), 1
