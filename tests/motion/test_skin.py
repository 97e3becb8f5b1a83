"""Motions as bones: by motions that are known, and against the definition."""

from dataclasses import replace

import numpy as np
import pytest
import torch
import trimesh
from helpers.textured import bend, triangles_of_tube
from torch import Tensor

import torch_modal as tm
from torch_modal.data.samples import load_sample
from torch_modal.errors import MeshWarning
from torch_modal.geometry.rotations import exp, log
from torch_modal.geometry.skin import Skin
from torch_modal.motion.skin import _convex_weights, _Decomposition, _halfway_errors

X, FACES = triangles_of_tube()
BENT = torch.tensor(np.stack([bend(X, turn) for turn in np.linspace(0.01, 0.9, 7)]))


def arm(generator: torch.Generator, units: float = 1.0) -> tuple[Tensor, Tensor, Tensor]:
    """Two bones with a smooth joint between them, which also travel; frames, faces and the second bone's weights."""
    x = torch.tensor(X)
    weights = ((x[:, 2] - 2) / 2).clamp(0, 1)
    turns = exp(torch.cumsum(0.3 * torch.randn(2, 6, 3, generator=generator, dtype=torch.float64), 1))
    turns[:, 0] = torch.eye(3)
    joint = torch.tensor([[0.0, 0.0, 3.0]], dtype=torch.float64)
    first = x @ turns[0].mT
    second = (x - joint) @ (turns[0] @ turns[1]).mT + joint @ turns[0].mT
    frames = torch.lerp(first, second, weights[:, None]) + torch.arange(6.0)[:, None, None]
    return units * frames, torch.tensor(FACES), weights


def off_at_frames(skin: Skin, frames: Tensor) -> float:
    """Root mean square distance over the diagonal."""
    diagonal = (frames[0].amax(0) - frames[0].amin(0)).norm()
    return float((skin.shapes() - frames).square().sum(-1).mean().sqrt() / diagonal)


@pytest.mark.parametrize("units", [1.0, 1e-3, 1e3])
def test_bones_that_are_known_are_found(generator: torch.Generator, units: float) -> None:
    frames, faces, weights = arm(generator, units)
    skin = tm.bake(frames, faces, 2)
    assert off_at_frames(skin, frames) < 1e-4 and skin.error < 1e-3 and skin.weights.shape[1] == 2
    second = skin.weights[:, int(skin.weights[-1].argmax())]
    torch.testing.assert_close(second, weights, atol=0.01, rtol=0)
    assert (torch.linalg.det(skin.transforms[..., :3, :3]) - 1).abs().max() < 1e-9


def test_shapes_are_those_of_the_definition(generator: torch.Generator) -> None:
    frames, faces, _ = arm(generator)
    skin = tm.bake(frames, faces, 5, influences=3)
    expected = torch.zeros_like(frames)
    for j in range(skin.weights.shape[1]):
        turn, shift = skin.transforms[:, j, :3, :3], skin.transforms[:, j, :3, 3]
        expected += skin.weights[:, j, None] * (skin.rest @ turn.mT + shift[:, None])
    torch.testing.assert_close(skin.shapes(), expected)
    diagonal = float((frames[0].amax(0) - frames[0].amin(0)).norm())
    at, between = (x.square().sum(-1).mean() for x in (expected - frames, _halfway_errors(skin, frames)))
    assert skin.error_at_frames == pytest.approx(float(at.sqrt()) / diagonal)
    assert skin.error_between_frames == pytest.approx(float(between.sqrt()) / diagonal)
    assert skin.error == pytest.approx(float((0.5 * (at + between)).sqrt()) / diagonal)
    assert torch.equal(skin.rest, frames[0])
    assert (skin.weights >= 0).all() and ((skin.weights > 0).sum(1) <= 3).all()
    torch.testing.assert_close(skin.weights * 65_535, (skin.weights * 65_535).round(), atol=1e-6, rtol=0)
    torch.testing.assert_close(skin.weights.sum(1), torch.ones(len(X), dtype=torch.float64))


def test_a_rigid_body_has_one_bone_and_two_pieces_have_two(generator: torch.Generator) -> None:
    turns = exp(torch.randn(2, 5, 3, generator=generator, dtype=torch.float64))
    shape, faces = BENT[0], torch.tensor(FACES)
    pieces = [shape @ turn.mT + 4 * k for k, turn in enumerate(turns)]
    one = tm.bake(pieces[0], faces)
    assert one.weights.shape[1] == 1 and one.error < 1e-6
    # A third piece that moves as the first, though it lies elsewhere, shares its bone.
    third = (shape + torch.tensor([0.0, 9.0, 0.0])) @ turns[0].mT
    three = torch.cat([*pieces, third], 1)
    skin = tm.bake(three, torch.cat([faces + k * len(X) for k in range(3)]))
    assert skin.weights.shape[1] == 2 and skin.error < 1e-5
    assert torch.equal(skin.weights[: len(X)], skin.weights[2 * len(X) :])


def test_convex_weights_beat_all_on_a_grid(generator: torch.Generator) -> None:
    a = torch.randn(20, 9, 4, generator=generator, dtype=torch.float64)
    x = torch.randn(20, 9, generator=generator, dtype=torch.float64)
    square, product = a.mT @ a, (a.mT @ x[:, :, None])[..., 0]
    weights, error = _convex_weights(square, product, torch.arange(4).expand(20, 4))
    torch.testing.assert_close(weights.sum(1), torch.ones(20, dtype=torch.float64))
    assert (weights >= 0).all()
    off = (torch.einsum("nij,nj->ni", a, weights) - x).square().sum(1)
    torch.testing.assert_close(error + x.square().sum(1), off)
    grid = torch.cartesian_prod(*[torch.arange(11)] * 4)
    grid = grid[grid.sum(1) == 10].double() / 10
    assert (off[:, None] <= (torch.einsum("nij,gj->ngi", a, grid) - x[:, None]).square().sum(2) + 1e-9).all()


def test_bones_turn_no_more_than_the_body() -> None:
    ball = trimesh.creation.icosphere(3)
    angles = np.linspace(0, np.pi, 17)[:, None] * ball.vertices[:, 2] / 2
    across, along = np.exp(1j * angles) * (ball.vertices @ [1, 1j, 0]), np.tile(ball.vertices[:, 2], (17, 1))
    frames = torch.tensor(np.stack([across.real, across.imag, along], -1))
    skin = tm.bake(frames, ball.faces)
    turns = skin.transforms[1:, :, :3, :3] @ skin.transforms[:-1, :, :3, :3].mT
    assert log(turns).norm(dim=-1).max() < np.radians(20) + np.pi / 32  # that is the largest turn of a triangle
    assert off_at_frames(skin, frames) < 1.1e-4 and skin.error < 1.1e-4


def test_ties_leave_a_rigid_motion_as_it_is(generator: torch.Generator) -> None:
    turns = exp(torch.randn(5, 3, generator=generator, dtype=torch.float64))
    turns[0] = torch.eye(3)
    fit = _Decomposition(BENT[0] @ turns.mT, 1)
    weights = torch.ones(len(X), 1, dtype=torch.float64)
    free = fit._fit_bones(fit.still, weights)
    tied = fit._fit_bones(free, weights, torch.tensor([1e6], dtype=torch.float64))
    # The turns of the vertices have a small part of the identity.
    torch.testing.assert_close(tied, free, atol=0.01, rtol=0)
    torch.testing.assert_close(free[:, 0, :, :3], turns)


def test_errors_half_way_between_frames_by_hand() -> None:
    """One bone: the body turns by 80 degrees and moves; then the bone alone has a wrong place in the last frame."""
    turns = exp(torch.tensor([[0.0, 0, 0], [0, 1.4, 0], [0, 2.8, 0]], dtype=torch.float64))
    frames = BENT[0] @ turns.mT + torch.tensor([[[0.0, 0, 0]], [[5, 0, 0]], [[5, 5, 0]]])
    maps = torch.eye(4, dtype=torch.float64).repeat(3, 1, 1, 1)
    maps[:, 0, :3, :3], maps[1:, 0, 0, 3], maps[2, 0, 1, 3] = turns, 5, 5
    skin = Skin(BENT[0], torch.ones(len(X), 1, dtype=torch.float64), maps, 0.0, 0.0)
    assert _halfway_errors(skin, frames).abs().max() < 1e-9
    wrong = skin.transforms.clone()
    wrong[2, 0, 2, 3] += 0.5
    off = _halfway_errors(replace(skin, transforms=wrong), frames).norm(dim=-1)
    torch.testing.assert_close(off, torch.tensor([[0.0], [0.25]], dtype=torch.float64).expand_as(off))


def test_weights_are_the_best_of_all_pairs(generator: torch.Generator) -> None:
    frames, _, _ = arm(generator)
    fit = _Decomposition(frames, 1)
    bones = tm.bake(frames, FACES, 3).transforms[:, :, :3]
    weights, error = fit._fit_weights(bones, 1)
    off = (torch.einsum("tjab,vb->tjva", bones, fit.rest) - frames[:, None]).square().sum(-1).mean(0)
    torch.testing.assert_close(error, off.min(0).values, atol=1e-9, rtol=1e-6)
    assert torch.equal(weights.argmax(1), off.argmin(0))


def test_samples_are_followed() -> None:
    hand = load_sample("hand")
    frames = torch.cat([hand.keyframes[:1], hand.truth, hand.keyframes[1:]])
    assert tm.bake(frames, hand.faces, 20).error < 5e-4


def test_fewest_bones_of_a_tolerance() -> None:
    errors = {n: tm.bake(BENT, FACES, n).error for n in range(1, 9)}
    skin = tm.bake(BENT, FACES, 8, tolerance=0.01)
    n = skin.weights.shape[1]
    assert skin.error == errors[n] <= 0.01 < errors[n - 1]
    with pytest.warns(MeshWarning, match="2 bones leave an error of .*, above the tolerance of 1e-06"):
        assert tm.bake(BENT, FACES, 2, tolerance=1e-6).weights.shape[1] == 2


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_dtype_gradients_and_determinism(dtype: torch.dtype) -> None:
    given = BENT.to(dtype, copy=True).requires_grad_()
    skin, again = tm.bake(given, FACES, 4), tm.bake(given.detach().numpy(), FACES, 4)
    for one, other in zip(*((x.weights, x.transforms, x.shapes()) for x in (skin, again)), strict=True):
        assert one.dtype == dtype and not one.requires_grad and torch.equal(one, other)
    assert abs(skin.error - tm.bake(BENT, FACES, 4).error) < 1e-5


def test_copies_along_seams_stay_together() -> None:
    faces = torch.tensor(FACES)
    copied = torch.cat([BENT, BENT], 1)  # each triangle of the second half has vertices of its own
    far = len(X)
    halves = torch.where((BENT[0, faces, 2].mean(1) > 3)[:, None], faces + far, faces)
    skin = tm.bake(copied, halves, 6)
    shared = np.intersect1d(halves[halves < far].numpy(), halves[halves >= far].numpy() - far)
    assert len(shared) >= 12
    assert torch.equal(skin.weights[shared], skin.weights[shared + far])


def test_open_and_ugly_meshes_in_millimetres() -> None:
    mesh = load_sample("creature")
    frames = 1000 * mesh.keyframes + 1e5
    faces = mesh.faces[: len(mesh.faces) // 2]  # open, and half of the vertices are in no face
    skin = tm.bake(frames, torch.cat([faces, faces[:5], faces[:1, [0, 0, 1]]]), 12)
    assert skin.error < 0.01 and skin.shapes().isfinite().all()


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"frames": BENT[:1]}, "2 frames and 4 vertices or more, got 1 of 98"),
        ({"frames": BENT[:, :2], "faces": [[0, 1, 1]]}, "2 frames and 4 vertices or more, got 7 of 2"),
        ({"frames": BENT * torch.tensor([1, 1, float("nan")])}, "frames must hold finite numbers"),
        ({"frames": BENT[0]}, r"frames must have shape \(N, V, 3\)"),
        ({"frames": 0 * BENT}, "frame 0, the rest shape, is a single point"),
        ({"faces": [[0, 1, 98]]}, "faces must index the 98 vertices"),
        ({"bones": 99}, "bones must be a whole number from 1 to the number of vertices, 98; got 99"),
        ({"influences": 5}, "influences must be 1, 2, 3 or 4"),
        *(({"tolerance": x}, "tolerance must be a positive part") for x in (0.0, float("nan"))),
        *(({"bones": bones}, "bones must be") for bones in (0, 2.5)),
        ({"times": [0, 1, 2]}, "times must be 7 or 8 ascending numbers, one for each frame"),
    ],
)
def test_what_cannot_be_baked(changes: dict, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        tm.bake(**{"frames": BENT, "faces": FACES, "bones": 4} | changes)
