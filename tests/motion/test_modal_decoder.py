"""The decoder of amplitudes: a function of its state, whatever it was used for before."""

import os
import subprocess
import sys
from pathlib import Path

import pytest
import torch
from conftest import Shapes
from torch import Tensor

import torch_modal as tm
from torch_modal.geometry.rotations import exp

DOUBLE = torch.float64
TIMES = torch.tensor([0.0, 1.0, 3.0], dtype=DOUBLE)
AMPLITUDES = torch.tensor([[1.0, -2.0, 3.0], [0.5, 0.0, -1.0]], dtype=DOUBLE)


def values(decoder: tm.ModalDecoder) -> Tensor:
    return decoder(AMPLITUDES[:, None], torch.tensor([0.3, 1.0, 2.2], dtype=DOUBLE))


def test_loose_pieces_come_along_with_a_loaded_state(small_bars: Shapes) -> None:
    """Of shapes of another order and size, with other modes."""
    x, modes = small_bars.keyframes, small_bars.bases[0].modes
    faces = torch.cat([small_bars.faces, small_bars.faces + x.shape[1]])
    decoder, other = (
        tm.ModalDecoder(torch.cat([y, y + 9], 1), faces, TIMES, torch.cat([y[1], y[1] + 9]), torch.cat(pair, 1))
        for y, pair in ((x, (modes, 2 * modes + 1)), (2 * x.flip(0), (modes.flip(0), -2 * modes - 2)))
    )
    values(decoder)
    decoder.load_state_dict(other.state_dict())
    torch.testing.assert_close(values(decoder), values(other), rtol=0, atol=1e-12)


@pytest.mark.parametrize("unit", [1.0, 1000.0])
def test_motions_turn_about_the_centre_and_move_by_diagonals(unit: float, small_bars: Shapes) -> None:
    """After all else, in any units; the diagonal is the reference's."""
    x, basis = unit * small_bars.keyframes, small_bars.bases[1]
    decoder = tm.ModalDecoder(x, small_bars.faces, TIMES, x[1], basis.modes)
    t, diagonal = torch.tensor([0.3, 2.2], dtype=DOUBLE), (x[1].amax(0) - x[1].amin(0)).norm()
    turn, move = torch.tensor([0.3, -0.8, 0.5], dtype=DOUBLE), torch.tensor([0.1, -0.2, 0.4], dtype=DOUBLE)
    still, found = (decoder(AMPLITUDES, t, motions) for motions in (None, torch.cat([turn, move])))
    centre = still.mean(1, keepdim=True)
    expected = (still - centre) @ exp(turn).mT + centre + diagonal * move
    torch.testing.assert_close(found, expected, rtol=0, atol=1e-12 * float(diagonal))


def exported(layer: tm.ModalDecoder, given: tuple[Tensor, ...]) -> torch.export.ExportedProgram:
    """With a batch of any size."""
    batch = {0: torch.export.Dim("batch")}
    return torch.export.export(layer, given, dynamic_shapes=(batch,) * len(given), strict=False)


@pytest.mark.parametrize(
    "n, dtype",
    [(2, torch.float32), *(pytest.param(n, DOUBLE, marks=pytest.mark.slow) for n in (2, 3))],
)
def test_an_exported_decoder_gives_the_same(n: int, dtype: torch.dtype, bars: Shapes) -> None:
    x, basis, times = bars.keyframes[:n], bars.bases[0], torch.arange(n).double() ** 2
    layer = tm.ModalDecoder(x, bars.faces, times, basis.reference, basis.modes).to(dtype)
    generator = torch.Generator().manual_seed(0)
    a = 3 * torch.randn(5, layer.n_modes, generator=generator, dtype=DOUBLE).to(dtype)
    t = torch.linspace(0, float(times[-1]), 5, dtype=dtype)
    motions = 0.1 * torch.randn(5, 6, generator=generator, dtype=DOUBLE).to(dtype)
    if n == 2:  # another program: with the tables of its intervals, which are made by a call
        layer(a, t)
    program = exported(layer, (a[:2], t[:2], motions[:2])).module()
    truth = layer(a, t, motions)
    torch.testing.assert_close(program(a, t, motions), truth, rtol=0, atol=1e-12 if dtype == DOUBLE else 1e-5)
    slopes = []
    for each in (program, layer):
        leaf = a.clone().requires_grad_()
        slopes += torch.autograd.grad(each(leaf, t, motions).square().sum(), leaf)
    torch.testing.assert_close(*slopes, rtol=1e-6 if dtype == DOUBLE else 1e-3, atol=1e-3)


@pytest.mark.slow
def test_export_of_loose_pieces_to_a_file(small_bars: Shapes, tmp_path: Path) -> None:
    x = torch.cat([small_bars.keyframes, small_bars.keyframes + 5], 1)
    faces = torch.cat([small_bars.faces, small_bars.faces + small_bars.keyframes.shape[1]])
    modes = small_bars.bases[0].modes.repeat(1, 2, 1)
    layer = tm.ModalDecoder(x, faces, [0.0, 1.0, 2.0, 3.0], x[0], modes)  # a cycle
    a, t = torch.linspace(-1, 1, 6, dtype=DOUBLE).view(2, 3), torch.tensor([2.5, 7.25], dtype=DOUBLE)
    layer(a[:1], torch.arange(3) + 0.5)
    torch.export.save(exported(layer, (a, t)), tmp_path / "decoder.pt2")
    torch.save((a, t), tmp_path / "given.pt")
    code = (
        "import torch; from torch_modal import ModalDecoder\n"
        "program = torch.export.load('decoder.pt2').module(); torch.save(program(*torch.load('given.pt')), 'x.pt')"
    )
    environment = {**os.environ, "PYTHONPATH": str(Path(tm.__file__).parents[1])}
    subprocess.run([sys.executable, "-c", code], cwd=tmp_path, env=environment, check=True, timeout=120)
    torch.testing.assert_close(torch.load(tmp_path / "x.pt"), layer(a, t), rtol=0, atol=1e-12)
