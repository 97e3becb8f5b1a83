"""The in-between is one continuous function: no jumps in time or in the key-frames, nothing that others decide."""

from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from conftest import Shapes
from helpers.shapes import apart, diagonal
from torch import Tensor

import torch_modal as tm
from torch_modal.data.samples import load_sample

DOUBLE = torch.float64


def shapes_of(keyframes: Tensor, faces: Tensor, n_modes: int) -> Shapes:
    return Shapes(keyframes, faces, tm.extract_bases(keyframes, faces, n_modes, progress=False))


@pytest.fixture(scope="module")
def hand(data_dir: Path) -> Shapes:
    """Open and fist: the angles of many hinges differ by half a turn, and coarse triangles are near collapse."""
    keyframes, faces = tm.load_keyframes([data_dir / "mh-hand" / f"{name}.obj" for name in ("00-open", "02-fist")])
    return shapes_of(keyframes.double(), faces, 15)


def run_of_trex(data_dir: Path, frames: list[int], n_modes: int) -> Shapes:
    """Frames of a run, of a mesh with needles."""
    with np.load(data_dir / "animals" / "trex.npz") as stored:
        start = int(stored["clip_starts"][stored["clip_names"].tolist().index("TRex_Run")])
        keyframes = torch.tensor(stored["frames"][start:][frames]).double()
        return shapes_of(keyframes, torch.tensor(stored["faces"]).long(), n_modes)


@pytest.fixture(scope="module")
def trex(data_dir: Path) -> Shapes:
    """Two frames whose steps of all vertices are shortened."""
    return run_of_trex(data_dir, [0, 8], 15)


def largest_jump(layer: tm.InBetween, x_a: Tensor, x_b: Tensor, n: int) -> float:
    """The largest change between even times that is far above those beside it, after bisection."""
    times = torch.linspace(0, 1, n, dtype=DOUBLE)
    shapes = torch.cat([layer(x_a, x_b, some) for some in times.split(20)])
    steps = torch.stack([(y - x).norm(dim=-1).max() for x, y in pairwise(shapes)])
    usual = torch.stack([steps[max(0, i - 3) : i + 4].median() for i in range(len(steps))])
    found = 0.0
    for i in (steps / usual).topk(3).indices.tolist():
        low, high, x, y = times[i], times[i + 1], shapes[i], shapes[i + 1]
        for _ in range(16):
            middle = 0.5 * (low + high)
            z = layer(x_a, x_b, middle)
            left = (z - x).norm(dim=-1).max() > (y - z).norm(dim=-1).max()
            low, high, x, y = (low, middle, x, z) if left else (middle, high, z, y)
        found = max(found, apart(x, y))
    return found


every_preset = pytest.mark.parametrize("preset", ["accurate", "fast"])


@every_preset
@pytest.mark.parametrize("name", ["hand", pytest.param("trex", marks=pytest.mark.slow)])
@torch.no_grad()
def test_shapes_do_not_jump_in_time(name: str, preset: Any, request: pytest.FixtureRequest) -> None:
    """The minimiser that is not anchored jumps by 5 % of the diagonal at 0.5679 of the hand."""
    shapes = request.getfixturevalue(name)
    assert largest_jump(tm.InBetween(shapes.bases, shapes.faces, preset), *shapes.keyframes, 61) < 1e-4


@every_preset
@torch.no_grad()
def test_shapes_do_not_jump_with_the_key_frames(hand: Shapes, preset: Any, generator: torch.Generator) -> None:
    layer = tm.InBetween(hand.bases, hand.faces, preset)
    noise = 1e-10 * diagonal(hand.keyframes) * torch.randn(hand.keyframes.shape, dtype=DOUBLE, generator=generator)
    for t in (0.3333, 0.5679, 0.9115):
        assert apart(layer(*hand.keyframes, t), layer(*(hand.keyframes + noise), t)) < 1e-6


@every_preset
@torch.no_grad()
def test_key_frames_exchanged_give_the_same_shapes_backwards(preset: Any) -> None:
    sample, t = load_sample("creature"), torch.tensor([0.0, 0.37, 0.5], dtype=DOUBLE)
    x_a, x_b, _ = (creature := shapes_of(sample.keyframes[:3].double(), sample.faces, 15)).keyframes
    forth, back = (tm.InBetween(bases, creature.faces, preset) for bases in (creature.bases[:2], creature.bases[1::-1]))
    assert apart(forth(x_a, x_b, t), back(x_b, x_a, 1 - t)) < 1e-6


@torch.no_grad()
def test_shapes_do_not_jump_where_the_modal_solve_leaves_slivers(data_dir: Path) -> None:
    """Full bending stiffness there moves a vertex by 0.36 % of the diagonal within 1e-5."""
    shapes = run_of_trex(data_dir, [0, 12], 30)
    layer = tm.InBetween(shapes.bases, shapes.faces)
    near = layer(*shapes.keyframes, torch.linspace(0.1690, 0.1698, 17, dtype=DOUBLE))
    assert max(apart(x, y) for x, y in pairwise(near)) < 2e-4


def test_nothing_is_worse_where_nothing_is_strained(hand: Shapes) -> None:
    """Rigid motions: the in-betweens have distortions of rounding, and no status but CONVERGED."""
    x = hand.keyframes[0]
    turn = torch.linalg.matrix_exp(torch.tensor([[0.0, -1, 0.3], [1, 0, 0.2], [-0.3, -0.2, 0]], dtype=DOUBLE))
    layer = tm.InBetween([hand.bases[0]] * 2, hand.faces)
    found = layer.solve(x, x @ turn.mT + 3.0, torch.linspace(0, 1, 11, dtype=DOUBLE))
    assert bool(found.solution.converged.all())
