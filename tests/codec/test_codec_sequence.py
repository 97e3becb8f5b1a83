"""Motions as key-frames and amplitudes: the decoder, the fit, key-frames, files."""

from pathlib import Path
from typing import Any

import pytest
import torch
from conftest import Shapes, random_rotation
from helpers.shapes import edge_lengths
from torch import Tensor

import torch_modal as tm


@pytest.fixture(scope="module")
def decoder(bars: Shapes) -> tm.ModalDecoder:
    basis = bars.bases[0]
    return tm.ModalDecoder(bars.keyframes, bars.faces, torch.tensor([0.0, 1.0, 3.0]), basis.reference, basis.modes)


@pytest.fixture(scope="module")
def motion(decoder: tm.ModalDecoder, bars: Shapes) -> Tensor:
    """Nine frames that have amplitudes of their own between the key-frames at 0, 3 and 8."""
    times = torch.tensor([0, 1 / 3, 2 / 3, 1, 1.4, 1.8, 2.2, 2.6, 3], dtype=torch.float64)
    generator = torch.Generator().manual_seed(1)
    a = 1.5 * torch.randn(9, decoder.n_modes, dtype=torch.float64, generator=generator)
    a[[0, 3, 8]] = 0
    return decoder(a, times)


@pytest.fixture(scope="module")
def encoded(motion: Tensor, bars: Shapes) -> tm.ModalSequence:
    return tm.encode(motion, bars.faces, [0, 3, 8], 12, progress=False)


# -------------------------------------------------------------------------------------------------------------- decoder
@pytest.mark.parametrize("cyclic", [False, True])
def test_no_amplitudes_are_the_path(bars: Shapes, cyclic: bool) -> None:
    times = torch.tensor([0.0, 1.0, 3.0, 4.5])[: 3 + cyclic].double()
    path = tm.Path(bars.bases, bars.faces, times, cyclic)
    basis = bars.bases[1]
    decoder = tm.ModalDecoder(bars.keyframes, bars.faces, times, basis.reference, basis.modes)
    t = torch.linspace(0, 3 + cyclic, 8).double()
    assert torch.allclose(decoder(torch.zeros(8, 8).double(), t), path(bars.keyframes, t), rtol=0, atol=1e-12)


@pytest.mark.parametrize(
    ("place", "value", "said"),
    [
        (0, torch.zeros(1, 164, 3).double(), "at least 2"),
        (0, torch.full((3, 164, 3), torch.nan).double(), "NaN"),
        (1, torch.tensor([[0, 1, 164]]), "do not exist"),
        (2, [0.0, 2.0, 1.0], "ascend"),
        (2, [0.0], "must be 3 or 4 ascending numbers, one for each key-frame"),
        (3, torch.zeros(163, 3).double(), "reference must be"),
        (4, torch.zeros(164, 3).double(), "modes must be"),
        (4, torch.full((2, 164, 3), torch.inf).double(), "modes has entries that are not finite"),
        (4, [[0.0]], "modes is a list"),
    ],
)
def test_what_does_not_fit_is_said(bars: Shapes, place: int, value: Any, said: str) -> None:
    basis = bars.bases[0]
    given = [bars.keyframes, bars.faces, [0.0, 1.0, 3.0], basis.reference, basis.modes]
    assert len(tm.ModalDecoder(*given).times) == 3
    given[place] = value
    with pytest.raises(ValueError, match=said):
        tm.ModalDecoder(*given)


def test_small_amplitudes_are_the_modes(decoder: tm.ModalDecoder, bars: Shapes) -> None:
    """Up to a rigid motion, and to what triangles that turn with their edges alone do not know of a solid's modes."""
    modes = bars.bases[0].modes
    x = decoder(1e-4 * torch.eye(8).double(), 0.0) - bars.keyframes[0]
    flat = modes.flatten(1)
    rms = modes.square().sum(-1).mean(1).sqrt()
    wanted = 1e-6 * decoder.size * flat / rms[:, None]
    rigid = torch.linalg.qr(bars.bases[0].rigid_modes.flatten(1).mT).Q
    apart = x.flatten(1) - wanted
    apart = apart - (apart @ rigid) @ rigid.mT
    assert bool((apart.norm(dim=1) < 0.02 * wanted.norm(dim=1)).all())


def test_large_amplitudes_turn_and_do_not_stretch(decoder: tm.ModalDecoder, bars: Shapes) -> None:
    """The first bend of the bar, by a fifth of its length: added linearly, its edges grow three times as much."""
    a = torch.zeros(8).double()
    a[0] = 20.0
    x = decoder(a, 0.0)
    modes = bars.bases[0].modes
    unit = 0.01 * decoder.size / modes[0].square().sum(-1).mean().sqrt()
    linear = bars.keyframes[0] + 20 * unit * modes[0]
    rest, bent, stretched = (edge_lengths(y, bars.faces) for y in (bars.keyframes[0], x, linear))
    assert abs(float((bent / rest - 1).mean())) < float((stretched / rest - 1).mean()) / 3


def test_leading_dimensions(decoder: tm.ModalDecoder, bars: Shapes) -> None:
    a = torch.randn(2, 3, 8).double()
    t = torch.tensor([0.2, 1.5, 2.9]).double()
    x = decoder(a, t)
    assert x.shape == (2, 3, *bars.keyframes.shape[1:])
    assert torch.allclose(x[1, 2], decoder(a[1, 2], t[2]), rtol=0, atol=1e-12)
    assert decoder(a[:0], t).shape == (0, 3, *bars.keyframes.shape[1:])
    with pytest.raises(ValueError, match=r"\(\.\.\., 8\)"):
        decoder(a[..., :5], t)
    with pytest.raises(ValueError, match=r"motions must be floating-point of shape \(\.\.\., 6\)"):
        decoder(torch.zeros(2, 8).double(), 0.5, torch.zeros(2, 5).double())
    with pytest.raises(ValueError, match=r"0 and 3; got 3\.5"):
        decoder(a, 3.5)


# --------------------------------------------------------------------------------------------------------------- encode
def test_frames_of_the_decoder_are_found_again(encoded: tm.ModalSequence, motion: Tensor) -> None:
    """They have other times and other modes, and yet the modes' space nearly holds them."""
    x = encoded.decode()
    assert torch.equal(x[[0, 3, 8]], motion[[0, 3, 8]])
    measured = (x - motion).norm(dim=-1).mean(1) / encoded.decoder.size
    assert torch.allclose(measured, encoded.errors, rtol=0, atol=1e-12)
    still = encoded.decoder(0 * encoded.amplitudes, encoded.times, encoded.motions)
    left = (still - motion).norm(dim=-1).mean() / encoded.decoder.size
    assert float(measured.mean()) < 0.1 * float(left)
    assert encoded.n_floats == 3 * motion[0].numel() + 3 + 6 * (12 + 7)


def test_a_rigid_motion_of_frames_goes_along(motion: Tensor, bars: Shapes, encoded: tm.ModalSequence) -> None:
    generator = torch.Generator().manual_seed(3)
    turned = motion.clone()
    for f in range(9):  # each its own
        turned[f] = motion[f] @ random_rotation(generator).mT + 100 * f
    found = tm.encode(turned, bars.faces, [0, 3, 8], 12, progress=False)
    assert float(found.errors.max()) < 1.5 * float(encoded.errors.max()) + 1e-4


@pytest.mark.parametrize("scale", [1e-3, 1e3])
def test_units_do_not_matter(motion: Tensor, bars: Shapes, encoded: tm.ModalSequence, scale: float) -> None:
    found = tm.encode(scale * motion, bars.faces, [0, 3, 8], 12, progress=False)
    assert torch.allclose(found.errors, encoded.errors, rtol=0.02, atol=1e-6)


def test_times_between_frames(encoded: tm.ModalSequence) -> None:
    x = encoded.decode([0.5, 4.25])
    assert x.shape[0] == 2 and bool(x.isfinite().all())
    assert torch.allclose(encoded.decode(4.0)[0], encoded.decode()[4], rtol=0, atol=1e-12)
    with pytest.raises(ValueError, match="0 and 8"):
        encoded.decode(9.0)


def test_other_frames_are_fitted_beside_the_same_path(encoded: tm.ModalSequence, motion: Tensor) -> None:
    found = encoded.fit(motion[[2, 5]], [2.0, 5.0])
    assert torch.allclose(found.amplitudes, encoded.amplitudes[[2, 5]], rtol=0, atol=0.05)
    x = encoded.decoder(found.amplitudes, torch.tensor([2.0, 5.0]), found.motions)
    measured = (x - motion[[2, 5]]).norm(dim=-1).mean(1) / encoded.decoder.size
    assert torch.allclose(measured, found.errors, rtol=0, atol=1e-12)
    at_key = encoded.fit(motion[3:4], 3.0)  # no key-frame of another motion is known
    assert float(at_key.amplitudes.abs().max()) < 1e-6
    with pytest.raises(ValueError, match="one time for each frame"):
        encoded.fit(motion, [0.0])
    with pytest.raises(ValueError, match="0 and 8"):
        encoded.fit(motion[:1], 9.0)


def test_frames_of_a_cycle_are_encoded_and_decoded(bars: Shapes) -> None:
    basis = bars.bases[0]
    decoder = tm.ModalDecoder(bars.keyframes, bars.faces, [0.0, 2.0, 4.0, 6.0], basis.reference, basis.modes)
    frames = decoder(torch.zeros(6, 8).double(), torch.arange(6).double())
    found = tm.encode(frames, bars.faces, [0, 2, 4], 8, cyclic=True, progress=False)
    assert found.cyclic and float(found.errors.max()) < 1e-10
    assert torch.allclose(found.decode([6.5, -5.5]), found.decode([0.5, 0.5]), rtol=0, atol=1e-12)


def test_loose_pieces_follow(motion: Tensor, bars: Shapes) -> None:
    """A second, smaller bar inside of the first."""
    inner = 0.3 * motion + 0.7 * motion.mean(1, keepdim=True)
    both = torch.cat([motion, inner], 1)
    faces = torch.cat([bars.faces, bars.faces + motion.shape[1]])
    found = tm.encode(both, faces, [0, 3, 8], 20, progress=False)
    still = found.decoder(0 * found.amplitudes, found.times, found.motions)
    left = float((still - both).norm(dim=-1).mean() / found.decoder.size)
    assert float(found.errors.mean()) < 0.5 * left


def test_bad_input_is_refused(motion: Tensor, bars: Shapes) -> None:
    def refused(match: str, **changes: Any) -> None:
        arguments = {"frames": motion, "faces": bars.faces, "keyframes": [0, 8], "n_modes": 4, **changes}
        with pytest.raises(ValueError, match=match):
            tm.encode(**arguments, progress=False)

    refused("with {0, 8}", keyframes=[0, 4])
    refused("ascending", keyframes=[0, 5, 5, 8])
    refused("ascending", keyframes=[0])
    refused("from 2 to the number of frames, 9", keyframes=10)
    refused("n_modes is 0", n_modes=0)
    refused("fraction of the diagonal", error=0.0)
    refused("ascend", times=[0.0] * 9)
    refused("NaN", frames=torch.full_like(motion, torch.nan))
    refused("faces", faces=bars.faces + 1000)


# ----------------------------------------------------------------------------------------------------------- key-frames
def test_key_frames_for_an_error(motion: Tensor, bars: Shapes) -> None:
    few = tm.encode(motion, bars.faces, None, 4, error=0.05, progress=False)
    many = tm.encode(motion, bars.faces, None, 4, error=0.0005, progress=False)
    assert len(few.keyframes) < len(many.keyframes)
    assert float(many.errors.max()) <= 0.0005 and float(few.errors.max()) <= 0.05


def test_chosen_key_frames_are_no_worse_than_even_ones(bars: Shapes) -> None:
    """Much happens early: a motion through the three poses in the first third, and then hardly any."""
    basis = bars.bases[0]
    decoder = tm.ModalDecoder(bars.keyframes, bars.faces, [0.0, 1.0, 2.0], basis.reference, basis.modes)
    t = 2 * (1 - (1 - torch.linspace(0, 1, 16).double()) ** 4)
    frames = decoder(torch.zeros(16, 8).double(), t)
    even, chosen = (tm.encode(frames, bars.faces, each, 4, progress=False) for each in ([0, 5, 10, 15], 4))
    assert float(chosen.errors.mean()) < 0.6 * float(even.errors.mean())
    assert torch.equal(chosen.keyframes, frames[chosen.keyframe_times.long()])


# ---------------------------------------------------------------------------------------------------------------- files
def test_saved_and_loaded(encoded: tm.ModalSequence, tmp_path: Path) -> None:
    encoded.save(tmp_path / "a.safetensors")
    found = tm.ModalSequence.load(tmp_path / "a.safetensors")
    moved = (found.decode() - encoded.decode()).norm(dim=-1).mean(1) / encoded.decoder.size
    assert float(moved.max()) < 0.06 * float(encoded.errors.max())
    assert bool((found.errors >= encoded.errors).all()) and found.n_modes < encoded.n_modes
    size = (tmp_path / "a.safetensors").stat().st_size
    assert torch.equal(found.is_keyframe, encoded.is_keyframe) and torch.equal(found.faces, encoded.faces)
    found.save(tmp_path / "b.safetensors")
    again = tm.ModalSequence.load(tmp_path / "b.safetensors").decode()
    assert float((again - found.decode()).norm(dim=-1).mean(1).max()) < 0.06 * float(
        found.errors.max() * found.decoder.size
    )
    assert (tmp_path / "b.safetensors").stat().st_size <= size


def test_a_file_of_exact_frames_keeps_float32(bars: Shapes, tmp_path: Path) -> None:
    """Far from the origin, too, where float32 of the coordinates themselves would not do."""
    frames = bars.keyframes + torch.tensor([1e5, 0.0, 0.0], dtype=torch.float64)
    tm.encode(frames, bars.faces, [0, 1, 2], 4, progress=False).save(tmp_path / "a.safetensors")
    found = tm.ModalSequence.load(tmp_path / "a.safetensors").decode()
    torch.testing.assert_close(found, frames, rtol=0, atol=1e-6)


def test_derivatives_are_those_of_the_shapes(encoded: tm.ModalSequence) -> None:
    decoder, t = encoded.decoder, encoded.times[1] + 0.3
    zero, step = torch.zeros(encoded.n_modes).double(), 1e-4
    x = decoder(zero, t)
    wanted = (decoder(step * torch.eye(len(zero)).double(), t) - x) / step
    errors = (decoder.tangents(zero, t) - wanted).flatten(1).norm(dim=1) / wanted.flatten(1).norm(dim=1)
    assert float(errors.max()) < 0.01
