"""Every layer and random transform, with a call of it: for what must hold of all of them, in worker processes too."""

from collections.abc import Callable, Iterable
from dataclasses import replace
from functools import partial
from typing import Any, Literal, NamedTuple

import pytest
import torch
from conftest import Shapes
from torch import Tensor

import torch_modal as tm
from helpers.terms import Edges
from torch_modal.data.augmentation import ShapeAugmentation
from torch_modal.inbetween.settings import PRESETS

DOUBLE = torch.float64
TIMES = torch.tensor([0.5, 1.5, 1.0, 0.0], dtype=DOUBLE)


class Case(NamedTuple):
    """A layer or transform."""

    make: Callable[[Shapes], Any]
    """From three key-frames with bases."""
    call: Callable[[Any, Tensor], Tensor]
    """From the layer and the key-frames, with leading dimensions where ``batched``. *Shape:* ``(..., 3, V, 3)``."""
    result: Literal["shapes", "a ratio", "other"] = "shapes"
    """Shapes move along with the key-frames and have their unit; a ratio depends on neither."""
    batched: bool = True


class Linear(torch.nn.Module):
    """A decoder of latents ``(B, 2)``: the first shape, and two displacements."""

    def __init__(self, shapes: Tensor) -> None:
        super().__init__()
        self.register_buffer("shapes", shapes)

    def forward(self, z: Tensor) -> Tensor:
        x = self.shapes.to(z)
        return x[0] + z[:, :1, None] * (x[1] - x[0]) + z[:, 1:, None] * (x[2] - x[0])


class Step(torch.nn.Module):
    """Three steps of :class:`torch_modal.GaussNewtonStep` from the first shape towards the second."""

    def __init__(self, shapes: Shapes) -> None:
        super().__init__()
        self.shell = tm.ShellEnergy(shapes.faces)
        self.n_modes = shapes.bases[0].n_modes
        self.step = tm.GaussNewtonStep(tm.ModalEnergy(self.shell, shapes.bases[0].modes))

    def forward(self, x: Tensor, rest: Tensor) -> Tensor:
        lead = x.shape[:-2]
        x, rest = (shape.reshape(-1, *shape.shape[-2:]) for shape in (x, rest))
        placement = self.step.energy.place(x, self.shell.reference_of(rest))
        a = x.new_zeros(len(x), self.n_modes)
        for _ in range(3):
            a = self.step(a, placement).amplitudes
        return a.view(*lead, self.n_modes)


class Random(torch.nn.Module):
    """A transform with the space that it draws from."""

    def __init__(self, kind: type[ShapeAugmentation], shapes: Shapes) -> None:
        super().__init__()
        # Draws laid on the key-frames depend on no shape that is passed.
        options = {"on_keyframes": False} if kind is tm.RandomBlend else {}
        self.own = kind(p=1.0, space=space(shapes), **options)

    def forward(self, x: Tensor) -> Tensor:
        with torch.random.fork_rng():
            torch.manual_seed(0)
            return self.own(x)


def space(shapes: Shapes) -> tm.ShapeSpace:
    """Of all key-frames, without tables."""
    return tm.ShapeSpace(shapes.bases, shapes.faces)


def in_between(shapes: Shapes, **options: Any) -> tm.InBetween:
    """Of the first two key-frames."""
    return tm.InBetween(shapes.bases[:2], shapes.faces, **options)


def with_own_term(shapes: Shapes) -> tm.InBetween:
    """With stiffnesses that are tensors of the state."""
    terms = (Edges(torch.tensor(3.0)),)
    return in_between(shapes, objective=tm.Objective(alpha=torch.tensor(400.0), mu=torch.tensor(2.0), terms=terms))


def decoder(shapes: Shapes) -> tm.ModalDecoder:
    """Of all key-frames, with the modes of the first."""
    times, basis = torch.tensor([0.0, 1.0, 3.0], dtype=DOUBLE), shapes.bases[0]
    return tm.ModalDecoder(shapes.keyframes, shapes.faces, times, basis.reference, basis.modes)


def decoded(layer: tm.ModalDecoder, x: Tensor) -> Tensor:
    """At two times, of amplitudes and of key-frames."""
    amplitudes = torch.linspace(-1, 1, 2 * layer.n_modes).view(2, -1).to(x)
    return layer(amplitudes, torch.tensor([0.5, 2.5]).to(x), keyframes=x)


def passengers(shapes: Shapes) -> tm.Passengers:
    """Points about the first key-frame."""
    x = shapes.keyframes[0]
    return tm.Passengers(x, shapes.faces, x[::3] + 0.01 * (x[::3] - x.mean(0)))


def two_bodies(x: Tensor) -> Tensor:
    """The shapes, and beside them, far away, the same in another order. *Shape:* ``(..., 3, V, 3)``."""
    length = x[..., :1, -1:, :] - x[..., :1, :1, :]
    return torch.cat([x, x.flip(-3) + 5 * length], -2)


def of_two_bodies(shapes: Shapes) -> tm.InBetween:
    """Of the first two key-frames, with the modes of each body."""
    x, bases = two_bodies(shapes.keyframes)[:2], []
    for shape, one, other in zip(x, shapes.bases[:2], shapes.bases[:0:-1], strict=True):
        parts = torch.cat([one.modes, 0 * one.modes], 1), torch.cat([0 * other.modes, other.modes], 1)
        values = torch.cat([one.eigenvalues, other.eigenvalues])
        bases.append(tm.ModalBasis(shape, values, torch.cat(parts), one.rigid_eigenvalues))
    layer = tm.InBetween(bases, torch.cat([shapes.faces, shapes.faces + shapes.keyframes.shape[1]]), "modal")
    assert len(layer.cores) == 2
    return layer


def latent(layer: Any, x: Tensor) -> Tensor:
    """Of a straight path of codes."""
    return layer(Linear(x), torch.tensor([[0.0, 0.0], [0.5, 0.1], [1.0, 0.0]]).to(x))


def pair(layer: Any, x: Tensor) -> Tensor:
    """Of the first two shapes."""
    return layer(x[..., 0, :, :], x[..., 1, :, :])


def pair_in_time(layer: Any, x: Tensor) -> Tensor:
    """Of the first two shapes, at two times."""
    return layer(x[..., 0, :, :], x[..., 1, :, :], torch.tensor([0.3, 0.6]).to(x))


def set_in_time(layer: Any, x: Tensor) -> Tensor:
    """Of all shapes, at two times."""
    return layer(x, torch.tensor([0.5, 1.5]).to(x))


def blended(layer: Any, x: Tensor) -> Tensor:
    """By two sets of weights."""
    return layer(x, torch.tensor([[0.2, 0.3, 0.5], [0.334, 0.333, 0.333]]).to(x))


COARSE = replace(PRESETS["modal"].objective, coarse_faces=30)

LAYERS: dict[str, Case] = {
    "InBetween": Case(in_between, pair_in_time),
    "InBetween, torch": Case(partial(in_between, solver=tm.Solver(backend="torch")), pair_in_time),
    "InBetween, fast": Case(partial(in_between, preset="fast"), pair_in_time),
    "InBetween, modal": Case(partial(in_between, objective=COARSE), pair_in_time),
    "InBetween, modal, torch": Case(
        partial(in_between, objective=COARSE, solver=tm.Solver(backend="torch")), pair_in_time
    ),
    "InBetween, own term": Case(with_own_term, pair_in_time),
    "InBetween, contact": Case(partial(in_between, contact=True), pair_in_time),
    "InBetween, bodies": Case(of_two_bodies, lambda layer, x: pair_in_time(layer, two_bodies(x))),
    "MidShape, paper": Case(lambda s: tm.MidShape(s.bases[:2], s.faces, preset="paper", regions=3), pair),
    "Blend": Case(lambda s: tm.Blend(s.bases, s.faces), blended),
    "Path": Case(lambda s: tm.Path(s.bases, s.faces), set_in_time),
    "Path, pairs": Case(lambda s: tm.Path(s.bases, s.faces, smooth=False), set_in_time),
    "Path, contact": Case(lambda s: tm.Path(s.bases, s.faces, contact=True), set_in_time),
    "ModalDecoder": Case(decoder, decoded, "other", batched=False),
    "Passengers": Case(passengers, lambda layer, x: layer(x)),
    "Passengers, rotations": Case(passengers, lambda layer, x: layer.rotations(x), "other"),
    "Passengers, gradients": Case(passengers, lambda layer, x: layer.gradients(x), "other"),
    "GaussNewtonStep": Case(Step, pair, "other"),
    "ShellEnergy": Case(lambda s: tm.ShellEnergy(s.faces), pair, "other"),
    "ShellLoss": Case(lambda s: tm.losses.ShellLoss(s.faces), pair, "a ratio"),
    "LatentElasticity": Case(lambda s: tm.losses.LatentElasticity(s.faces), latent, "a ratio", batched=False),
}

TRANSFORMS: dict[str, Case] = {
    kind.__name__: Case(partial(Random, kind), lambda layer, x: layer(x), batched=False)
    for kind in (
        tm.RandomBlend,
        tm.RandomInBetween,
        tm.RandomModalDeformation,
        tm.RandomRigidMotion,
    )
}

CASES = {**LAYERS, **TRANSFORMS}

FUNCTIONS: dict[str, Case] = {
    "subdivide": Case(
        lambda s: s, lambda s, x: tm.subdivide(x, s.faces, 1, bases=s.bases, preset="fast", progress=False)
    ),
    "fit": Case(space, lambda space, x: space.fit(x[1, ::5], torch.arange(0, x.shape[1], 5)).shape),
    "components": Case(space, lambda space, x: space.components().coordinates(x)),
    "self_contacts": Case(lambda s: s, lambda s, x: tm.self_contacts(x, s.faces).number),
}

CONTACT = {"InBetween, contact", "Path, contact"}

ALIKE = {
    *("InBetween, torch", "InBetween, modal, torch", "InBetween, own term", "InBetween, bodies", "Path, pairs"),
    *("Passengers, rotations", "Passengers, gradients", "ShellEnergy"),
}
"""Not in the default run: another layer of the table takes most of their ways through the code."""


def each(names: Iterable[str]) -> pytest.MarkDecorator:
    """A test of each of these layers."""
    params = [pytest.param(name, marks=[pytest.mark.slow] * (name in ALIKE)) for name in names]
    return pytest.mark.parametrize("name", params)


every_layer = each(CASES)


class Made:
    """A layer, made once for all checks that leave it as it is."""

    def __init__(self, name: str, shapes: Shapes) -> None:
        self.case, self.shapes, self.x = {**CASES, **FUNCTIONS}[name], shapes, shapes.keyframes
        self.layer = self.case.make(shapes)
        self.truth = self.call(self.x)

    def call(self, x: Tensor, layer: Any = None) -> Tensor:
        return self.case.call(self.layer if layer is None else layer, x)


def assert_near(found: Tensor, truth: Tensor, part: float = 1e-12) -> None:
    """Within a part of the largest number."""
    assert found.shape == truth.shape and bool(truth.any())
    torch.testing.assert_close(found, truth, rtol=0, atol=part * float(truth.detach().abs().max()), check_dtype=False)


def loss(x: Tensor) -> Tensor:
    """Squares with weights: of unit quaternions, those without add up to a constant."""
    return (torch.linspace(1, 2, x.numel()).to(x).view_as(x) * x.square()).sum()


def gradient(call: Callable[[Tensor], Tensor], x: Tensor) -> Tensor:
    """Gradient of that loss of a call."""
    leaf = x.clone().requires_grad_()
    (found,) = torch.autograd.grad(loss(call(leaf)), leaf)
    return found
