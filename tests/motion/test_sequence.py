"""The main job on bars: counts, places, what stays bit for bit, and the order of modes and motions."""

from dataclasses import replace
from typing import Any

import pytest
import torch
from conftest import Shapes, modal, random_rotation
from helpers.shapes import edge_lengths, largest
from torch import Tensor

import torch_modal as tm
from torch_modal.elastic.backend import TorchBackend, WarpBackend
from torch_modal.inbetween.settings import PRESETS, Objective, Solver
from torch_modal.layers.mid_shape import MidShape
from torch_modal.motion import subdivide as sequence
from torch_modal.motion.subdivide import keyframe_places, subdivide
from torch_modal.times import fill_linear

COARSE: dict[str, Any] = {"objective": Objective(coarse_faces=200)}
PAIRED: dict[str, Any] = {"objective": Objective(space="paired", coarse_faces=200), "solver": Solver(local_steps=0)}


@pytest.fixture(scope="module")
def scattered(bars: Shapes) -> Shapes:
    """Three bars far from each other, each turned its own way, with bases that were made there."""
    generator = torch.Generator().manual_seed(2)
    keyframes, bases = [], []
    for x, basis in zip(bars.keyframes, bars.bases, strict=True):
        turn = random_rotation(generator)
        keyframes.append(x @ turn.mT + 20 * torch.randn(3, dtype=torch.float64, generator=generator))
        bases.append(replace(basis, reference=keyframes[-1], modes=basis.modes @ turn.mT))
    return Shapes(torch.stack(keyframes), bars.faces, bases)


# ------------------------------------------------------------------------------------------------------- places


@pytest.mark.parametrize(
    ("options", "places"),
    [
        ({"levels": 0}, [0, 1, 2]),
        ({"levels": 3}, [0, 8, 16]),
        ({"levels": 2, "cyclic": True}, [0, 4, 8, 12]),
        ({"n_frames": 3}, [0, 1, 2]),
        ({"n_frames": 10}, [0, 5, 9]),  # 4.5 rounds up
        ({"n_frames": 101}, [0, 50, 100]),
        ({"n_frames": 10, "cyclic": True}, [0, 3, 7, 10]),
        ({"n_frames": 3, "cyclic": True}, [0, 1, 2, 3]),
        ({"n_frames": 10, "times": [0.0, 0.1, 10.0]}, [0, 1, 9]),
        ({"n_frames": 10, "times": [0.0, 9.9, 10.0]}, [0, 8, 9]),
    ],
)
def test_places_by_hand(options: dict[str, Any], places: list[int]) -> None:
    assert keyframe_places(3, **options) == places


# ------------------------------------------------------------------------------------------ counts and keyframes


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
@pytest.mark.parametrize(
    ("options", "count"),
    [
        ({"levels": 0}, 3),
        ({"levels": 2}, 9),
        ({"levels": 1, "cyclic": True}, 6),
        ({"levels": 1, "n_frames": 12}, 12),
        ({"levels": 1, "n_frames": 12, "cyclic": True}, 12),
        ({"levels": 2, "n_frames": 4}, 4),
        ({"levels": 1, **PAIRED}, 5),
    ],
)
def test_keyframes_bit_for_bit_at_their_places(
    dtype: torch.dtype, options: dict[str, Any], count: int, scattered: Shapes
) -> None:
    keyframes = scattered.keyframes.to(dtype)
    before = keyframes.clone()
    frames = subdivide(keyframes, scattered.faces, bases=scattered.bases, progress=False, **{**COARSE, **options})
    assert frames.shape == (count, *keyframes.shape[1:])
    assert frames.dtype == dtype
    assert frames.isfinite().all()
    assert torch.equal(keyframes, before), "the input was written to"
    where = {name: options[name] for name in ("levels", "cyclic", "n_frames") if name in options}
    places = keyframe_places(3, **where)
    assert torch.equal(frames[places[:3]], keyframes)


def test_takes_arrays_and_two_keyframes(scattered: Shapes) -> None:
    pair = scattered.pick(0, 2)
    options: dict[str, Any] = {"bases": pair.bases, "progress": False, **COARSE}
    frames = subdivide(pair.keyframes, pair.faces, 1, **options)
    from_arrays = subdivide(list(pair.keyframes.numpy()), pair.faces.numpy(), 1, **options)
    assert torch.equal(frames, from_arrays)
    assert not frames.requires_grad


def test_presets_are_those_of_the_layers(scattered: Shapes) -> None:
    pair = scattered.pick(0, 1)
    for preset in PRESETS:
        found = subdivide(pair.keyframes, pair.faces, 1, bases=pair.bases, preset=preset, progress=False)[1]
        layer = MidShape(pair.bases, pair.faces, preset=preset)
        torch.testing.assert_close(found, layer(*pair.keyframes), rtol=0, atol=1e-12)


# ---------------------------------------------------------------------------------------------- the shapes between


def test_cycle_closes(scattered: Shapes) -> None:
    options: dict[str, Any] = {"smooth": False, "bases": scattered.bases, "progress": False, **COARSE}
    cycle = subdivide(scattered.keyframes, scattered.faces, 1, cyclic=True, **options)
    last = scattered.pick(2, 0)
    closing = subdivide(last.keyframes, last.faces, 1, bases=last.bases, progress=False, **COARSE)
    assert torch.equal(cycle[4:], closing[:2])


def test_paired_space_borrows_the_nearest_modes(scattered: Shapes) -> None:
    pair = scattered.pick(0, 1)
    frames = subdivide(pair.keyframes, pair.faces, 2, bases=pair.bases, progress=False, **PAIRED)
    middle, *ends = (edge_lengths(x, pair.faces) for x in (frames[2], *pair.keyframes))
    nearest = pair.bases[int((middle - ends[1]).norm() < (middle - ends[0]).norm())]
    for frame, bases, shapes in (
        (frames[1], [pair.bases[0], nearest], (pair.keyframes[0], frames[2])),
        (frames[3], [nearest, pair.bases[1]], (frames[2], pair.keyframes[1])),
    ):
        assert largest(frame - MidShape(bases, pair.faces, "paired", **PAIRED)(*shapes)) < 1e-9


def test_regions_are_those_of_the_key_frames_in_all_levels(scattered: Shapes) -> None:
    pair = scattered.pick(0, 1)
    options: Any = {"preset": "paper", "progress": False}
    plain, whole = (subdivide(pair.keyframes, pair.faces, 2, bases=pair.bases, **options, regions=n) for n in (0, 2))
    region = MidShape(pair.bases, pair.faces, preset="paper", regions=2).in_between.core.local.region
    moved = (edge_lengths(whole, pair.faces) - edge_lengths(plain, pair.faces)).abs() > 1e-6
    assert moved[1:4].any(1).all() and not moved[[0, 4]].any()
    assert largest((whole[2] - plain[2])[~region]) < 1e-9 < 1e-3 < largest((whole[2] - plain[2])[region])
    other = subdivide(pair.keyframes, pair.faces, 1, bases=pair.bases, **options, regions=2, mu=30.0)
    assert largest(other[1] - whole[2]) > 1e-3


def test_makes_bases_where_none_are_given(scattered: Shapes, monkeypatch: pytest.MonkeyPatch) -> None:
    pair = scattered.pick(0, 1)
    options: dict[str, Any] = modal(local=True, coarse_faces=200)
    asked: list[Any] = []
    loaded: list[bool] = []

    def extract(keyframes: Tensor, faces: Tensor, n_modes: int, **options: Any) -> list[tm.ModalBasis]:
        asked.append((len(keyframes), n_modes))
        return pair.bases

    monkeypatch.setattr(sequence, "bases_of_checked", extract)
    monkeypatch.setattr(TorchBackend, "load", lambda self: loaded.append(True))
    monkeypatch.setattr(WarpBackend, "load", TorchBackend.load)
    frames = subdivide(pair.keyframes, pair.faces, 1, n_modes=7, progress=False, **options)
    assert asked == [(2, 7)]
    assert loaded == [True]
    for bases in (pair.bases, lambda *_: pair.bases):
        given = subdivide(pair.keyframes, pair.faces, 1, bases=bases, progress=False, **options)
        assert torch.equal(frames, given)
    asked.clear()
    plain = subdivide(pair.keyframes, pair.faces, 1, progress=False)
    assert not asked and not torch.equal(frames, plain)
    assert torch.equal(plain, subdivide(pair.keyframes, pair.faces, 1, bases=pair.bases, progress=False))


# ----------------------------------------------------------------------------------------------- linear, for comparison
def test_linear_between_key_frames(scattered: Shapes) -> None:
    x = scattered.keyframes
    straight = fill_linear(x, [0, 4, 6])
    assert straight.shape == (7, *x.shape[1:])
    assert torch.equal(straight[[0, 4, 6]], x)
    torch.testing.assert_close(straight[1], 0.75 * x[0] + 0.25 * x[1])
    torch.testing.assert_close(straight[5], 0.5 * x[1] + 0.5 * x[2])
    cycle = fill_linear(x, [0, 4, 6, 8])
    assert cycle.shape == (8, *x.shape[1:])
    torch.testing.assert_close(cycle[7], 0.5 * x[2] + 0.5 * x[0])


# ------------------------------------------------------------------------------------------------------- exceptions


@pytest.mark.parametrize(
    ("options", "message"),
    [
        *(({"levels": n}, f"levels is a whole number from 0 to 12 .*got {n}") for n in (-1, 13, 1.5)),
        ({"n_frames": 2}, "2 frames leave no room for 3 key-frames"),
        ({"bases": []}, "got 0 bases for 3 key-frames"),
        ({"mu": 0.5}, "mu weighs the similarity of the two shapes"),
        ({"regions": 2}, "which only preset='paper' has"),
        *(({"preset": "paper"} | more, "the middle of a pair only") for more in ({"smooth": True}, {"n_frames": 9})),
    ],
)
def test_what_subdivide_refuses(options: dict[str, Any], message: str, scattered: Shapes) -> None:
    with pytest.raises(ValueError, match=message):
        subdivide(scattered.keyframes, scattered.faces, **{"bases": scattered.bases, "levels": 1, **options})
