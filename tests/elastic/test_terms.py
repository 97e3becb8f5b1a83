"""Terms of an energy: those of Eq. 5 by ``torch.func``, and terms of one's own all the way through the layers."""

import math
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import pytest
import torch
from conftest import Shapes, modal
from helpers.terms import Area, Pull, Spring
from torch import Tensor, nn

import torch_modal as tm
from torch_modal.elastic.term import Mesh, PeriodicTerm

DOUBLE = torch.float64


def test_angles_of_any_number_of_shapes_are_one_reference(generator: torch.Generator) -> None:
    """Six rows stand for K rest angles exactly, wherever they lie, and the energy has no kink at half a turn."""
    angles, weights = (torch.rand(5, 40, dtype=DOUBLE, generator=generator) for _ in range(2))
    angles = 20 * angles - 10
    term, at = PeriodicTerm(), torch.linspace(-4, 4, 40, dtype=DOUBLE)
    record, left = term.merge_rests(angles, weights)
    versine = 1 - (at - angles).cos()
    truth = (weights * (2 * versine + versine**2 / 3)).sum(0)
    torch.testing.assert_close(term.energies(at, record) + left, truth)
    energy = lambda x: term.energies(x, record).sum()  # noqa: E731
    slope, bound, beyond = term.derivatives(at, record)
    torch.testing.assert_close(slope, torch.func.grad(energy)(at))
    torch.testing.assert_close(bound + beyond, torch.func.hessian(energy)(at).diagonal())
    assert bool((beyond <= 1e-12).all())
    alone, _ = term.merge_rests(torch.zeros(1, 3, dtype=DOUBLE), torch.ones(1, 3, dtype=DOUBLE))
    half_a_turn = math.pi + torch.tensor([-1e-9, 0, 1e-9], dtype=DOUBLE)
    assert float(term.derivatives(half_a_turn, alone)[0].abs().max()) < 1e-8
    small = torch.tensor([1e-5, 0.1, math.radians(60)], dtype=DOUBLE)
    assert float((term.energies(small, alone) / small**2 - 1).abs().max()) < 0.013


def test_a_stiff_spring_holds_its_vertex(bars: Shapes, generator: torch.Generator) -> None:
    """In the caller's coordinates, wherever the key-frames are."""
    move = torch.tensor([30.0, -20.0, 10.0], dtype=DOUBLE)
    x_a, x_b = bars.keyframes[1:] + move
    plain = tm.InBetween(bars.bases[1:], bars.faces)(x_a, x_b, 0.5)
    point = plain[[7]] + 0.05
    objective = tm.Objective(terms=(Spring([7], point, 1e5),))
    held = tm.InBetween(bars.bases[1:], bars.faces, objective=objective)(x_a, x_b, 0.5)
    assert float((held[7] - point).norm()) < 0.1 * float((plain[7] - point).norm())


def test_a_term_has_a_parameter_that_learns(bars: Shapes) -> None:
    term = Area(nn.Parameter(torch.tensor(5.0, dtype=DOUBLE)))
    layer = tm.InBetween(bars.bases[1:], bars.faces, objective=tm.Objective(terms=(term,)))
    assert [name for name, _ in layer.named_parameters()] == ["terms.3.stiffness"]
    layer(*bars.keyframes[1:], 0.5).square().sum().backward()
    assert float(term.stiffness.grad) != 0


def test_paired_space_takes_terms_too(bars: Shapes) -> None:
    settings: Any = modal(space="paired", coarse_faces=200)
    plain = tm.MidShape(bars.bases[1:], bars.faces, **settings)(*bars.keyframes[1:])
    objective = replace(settings["objective"], terms=(Area(1e3), Spring([3], plain[[3]] + 0.1, 1e3)))
    other = tm.MidShape(bars.bases[1:], bars.faces, objective=objective, solver=settings["solver"])
    assert float((other(*bars.keyframes[1:]) - plain).abs().max()) > 1e-3


# ------------------------------------------------------------------------------------------------ stiffness in parts


def test_a_soft_part_takes_the_deformation(bars: Shapes) -> None:
    """By the energy with these stiffnesses, the layer that knows them does better than the one that does not."""
    x_a, x_b = bars.keyframes[1:]
    mesh = Mesh.of(bars.faces, len(x_a))
    alpha = torch.where(bars.keyframes[0][mesh.edges].mean(1)[:, 0] > 0, 5.0, 500.0).double()
    blind, knowing = (
        tm.InBetween(bars.bases[1:], bars.faces, **modal(alpha=a, gamma=0.0, anchor=0.0)) for a in (500.0, alpha)
    )
    shell, scale = tm.ShellEnergy(bars.faces, alpha=alpha, gamma=0.0), blind.core.alignment.scale
    found = [sum(shell(scale * layer(x_a, x_b, 0.5), scale * end) for end in (x_a, x_b)) for layer in (blind, knowing)]
    assert float(found[1]) < 0.9998 * float(found[0])
    # The part that is soft gives way: its edges change more than before.
    start, end = mesh.edges.unbind(1)
    lengths = [(x[end] - x[start]).norm(dim=-1) for x in (blind(x_a, x_b, 0.5), knowing(x_a, x_b, 0.5), x_a)]
    change = [(now / lengths[2] - 1).abs() for now in lengths[:2]]
    assert float(change[1][alpha < 500].mean()) > float(change[0][alpha < 500].mean())


@pytest.mark.parametrize("shape", [(4,), (3, 2)])
def test_exception_stiffness(shape: tuple[int, ...], bars: Shapes) -> None:
    layer = tm.InBetween(bars.bases[1:], bars.faces, objective=tm.Objective(alpha=torch.ones(shape, dtype=DOUBLE)))
    with pytest.raises(ValueError, match=r"one for each sample is values\[:, None\]"):
        layer(*bars.keyframes[1:], 0.5)


@pytest.mark.parametrize(
    ("made", "message"),
    [
        (lambda x: x[:, 0], r"got \(324,\)"),
        (lambda x: x - 1, "from -1 to"),
        (lambda x: x + 2, "from 2 to"),
    ],
    ids=["no rows", "below zero", "beyond the centre"],
)
def test_exception_elements(made: Callable[[Tensor], Tensor], message: str, bars: Shapes) -> None:
    class Wrong(Area):
        def elements(self, mesh: Mesh) -> Tensor:
            return made(mesh.faces)

    with pytest.raises(ValueError, match=f"Wrong.elements .*{message}"):
        tm.InBetween(bars.bases[1:], bars.faces, objective=tm.Objective(terms=(Wrong(),)))
    with pytest.raises(ValueError, match="terms holds a type"):
        tm.Objective(terms=(Area,))  # type: ignore[arg-type]


class TestAnchors:
    """Points of the caller's coordinates, wherever the energy is evaluated."""

    def test_shell_energy_by_hand(self, bars: Shapes) -> None:
        points = torch.tensor([[30.0, 0.0, 0.0], [0.0, 20.0, 0.0]], dtype=DOUBLE)
        terms = Spring([3], points[:1], 2.0), Spring([5, 3], points.flip(0), 0.5)
        shell, plain = tm.ShellEnergy(bars.faces, terms=terms), tm.ShellEnergy(bars.faces)
        x, rest = bars.keyframes[1:], bars.keyframes[:1]
        first, other = ((x[:, i] - point).square().sum(-1) for i, point in ((3, points[0]), (5, points[1])))
        by_hand = 2.0 * first + 0.5 * (other + first)
        torch.testing.assert_close(shell(x, rest) - plain(x, rest), by_hand)
        torch.testing.assert_close(shell(x[0], rest[0]), shell(x, rest)[0])
        torch.testing.assert_close(shell.residuals(x, rest).square().sum(-1), shell(x, rest))
        assert shell(x.float(), rest.float()).dtype == torch.float32

    def test_modal_energy_is_that_of_the_shell(self, bars: Shapes) -> None:
        shell = tm.ShellEnergy(bars.faces, terms=(Spring([3], torch.full((1, 3), 30.0, dtype=DOUBLE)),))
        rest, modes = bars.keyframes[:1], bars.bases[0].modes
        energy, a = tm.ModalEnergy(shell, modes), torch.full((1, 8), 0.1, dtype=DOUBLE)
        placement = energy.place(rest, shell.reference_of(rest))
        moved = rest + torch.tensordot(a, modes, 1)
        truth = tm.ShellEnergy(bars.faces)(moved, rest) + (moved[:, 3] - 30).square().sum(-1)
        torch.testing.assert_close(energy.value(a, placement), truth)

    @pytest.mark.parametrize("beside", [False, True])
    def test_of_terms_on_the_coarse_mesh(self, bars: Shapes, beside: bool) -> None:
        """They come beside those of sampled terms, and move the shape towards themselves, not to the origin."""
        ends = bars.keyframes[:2]
        plain = tm.InBetween(bars.bases[:2], bars.faces, **modal())(*ends, 0.5)
        spring, pulled = Spring([3], plain[3:4], 1e-3), []
        for height in (40.0, -40.0):
            point = torch.tensor([0.0, 0.0, height], dtype=DOUBLE)
            terms = (spring, Pull(point)) if beside else (Pull(point),)
            pulled.append(tm.InBetween(bars.bases[:2], bars.faces, **modal(terms=terms))(*ends, 0.5))
            before, after = ((x - point).square().sum(-1).mean() for x in (plain, pulled[-1]))
            assert float(before - after) > 1e-3
        assert float((pulled[0] - pulled[1]).abs().max()) > 1e-3
