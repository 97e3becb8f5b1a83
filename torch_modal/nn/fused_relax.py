"""The local steps by kernels of NVIDIA Warp, where that is installed.

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
from torch_modal.nn.adjoint import flattened
from torch_modal.nn.launch import Backend, Shapes, has_kernels, kernels, launch, pulled_back, recorded, traced
from torch_modal.nn.relax import STEP_LENGTHS, conjugate_gradients, inverse_of_symmetric, relax


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
        return recorded(kernel, (n_samples, len(self.record) if n is None else n), shapes, *given)

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
        return (None,) * 3 + pulled_back(run, given, to_shape, ctx.needs_input_grad[3:])

    @staticmethod
    def vmap(
        info: Any, in_dims: tuple[Any, ...], fused: FusedRelax, n_steps: int, n_products: int, *given: Tensor
    ) -> tuple[tuple[Tensor, Tensor], tuple[int, int]]:
        flat = flattened(info.batch_size, in_dims[3:], given)
        x, lengths = _Relaxed.apply(fused, n_steps, n_products, *flat)
        lengths = lengths.unflatten(1, (info.batch_size, -1))
        return (x.unflatten(0, (info.batch_size, -1)), lengths), (0, 1)
