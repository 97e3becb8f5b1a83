"""Random transforms: their conventions, and what the shapes are that they give."""

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
import torch
from conftest import Shapes, random_rotation, seeded

import torch_modal as tm
from torch_modal.data.augmentation import ShapeAugmentation
from torch_modal.data.deformation import deform
from torch_modal.data.shape_batch import ShapeBatch
from torch_modal.data.strain import edge_strains
from torch_modal.geometry.canonical import size
from torch_modal.geometry.rigid import best_fit
from torch_modal.geometry.vectors import vertex_normals

F64 = torch.float64

KINDS: dict[str, Callable[..., ShapeAugmentation]] = {
    "between": tm.RandomInBetween,
    "deformation": tm.RandomModalDeformation,
    "rigid": tm.RandomRigidMotion,
    "blend": tm.RandomBlend,
}
each_kind = pytest.mark.parametrize("kind", KINDS)


def volume(x: torch.Tensor, faces: torch.Tensor) -> torch.Tensor:
    return tm.ShellEnergy(faces).measure(x).volume


def partners_of(params: dict[str, torch.Tensor], k: int = 3) -> torch.Tensor:
    """Partners of k shapes that are drawn among the others."""
    return (torch.arange(len(params["partner"])) + 1 + ((k - 1) * params["partner"]).long()) % k


# ---------------------------------------------------------------------------------------------------- conventions
@each_kind
@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_shapes_and_dtypes_follow_the_input(bars: Shapes, space: tm.ShapeSpace, kind: str, dtype: torch.dtype) -> None:
    x = bars.keyframes.to(dtype)
    augment = KINDS[kind](p=1.0, generator=seeded(), space=space)
    out = augment(x)
    assert (out.shape, out.dtype, out.requires_grad) == (x.shape, dtype, False)
    assert bool(out.isfinite().all())
    assert not torch.equal(out, x)
    pool = ShapeBatch.of_keyframes(space, x)
    assert augment(x[0], pool=pool).shape == (1, *x.shape[1:])
    single = KINDS[kind](p=1.0, keepdim=True, generator=seeded(), space=space)
    assert single(x[0], pool=pool).shape == x.shape[1:]
    # The same seed gives the same draw in either precision.
    again = KINDS[kind](p=1.0, generator=seeded(), space=space)
    torch.testing.assert_close(again(bars.keyframes).to(dtype), out, rtol=0, atol=2e-4 if dtype is torch.float32 else 0)


@each_kind
def test_parameters_can_be_read_and_replayed(bars: Shapes, space: tm.ShapeSpace, kind: str) -> None:
    x = bars.keyframes[[0, 1, 2, 0, 1, 2]]
    x = x + 0.02 * torch.arange(6)[:, None, None] * torch.sin(x)  # no two are the same
    augment = KINDS[kind](p=0.5, generator=seeded(3), space=space)
    first = augment(x)
    params = augment.params
    assert {len(value) for value in params.values()} == {6}
    chosen = params["batch_prob"]
    assert 0 < int(chosen.sum()) < 6
    # Those that the draw leaves out stay to the last bit, the others move.
    assert torch.equal(first[~chosen], x[~chosen])
    assert bool(((first - x)[chosen].abs().amax((1, 2)) > 1e-3).all())
    second = augment(x)
    assert not torch.equal(second, first)
    assert torch.equal(augment(x, params=params), first)
    assert augment.params is params
    # A shape's result does not depend on which others are transformed.
    alone = {**params, "batch_prob": torch.arange(6) == int(chosen.nonzero()[0])}
    torch.testing.assert_close(
        augment(x, params=alone)[alone["batch_prob"]], first[alone["batch_prob"]], rtol=0, atol=1e-8
    )


@each_kind
def test_same_on_batch(bars: Shapes, space: tm.ShapeSpace, kind: str) -> None:
    augment = KINDS[kind](p=1.0, same_on_batch=True, generator=seeded(), space=space)
    augment(bars.keyframes)
    for value in augment.params.values():
        assert torch.equal(value, value[:1].expand_as(value))
    assert len(augment(bars.keyframes[:0])) == 0
    if kind in ("deformation", "rigid"):
        out = augment(bars.keyframes[[1, 1, 1]])
        torch.testing.assert_close(out, out[:1].expand_as(out), rtol=0, atol=1e-9)


@each_kind
@pytest.mark.parametrize("scale", [2.0**-32, 1e-12, 1e12])
def test_single_precision_in_any_units(bars: Shapes, kind: str, scale: float) -> None:
    found = []
    for factor in (1.0, scale):
        bases = [tm.ModalBasis(factor * b.reference, b.eigenvalues, b.modes, b.rigid_eigenvalues) for b in bars.bases]
        space = tm.ShapeSpace(bases, bars.faces)
        augment = KINDS[kind](p=1.0, space=space, generator=seeded())
        for pool in (None, ShapeBatch.of_keyframes(space)):
            found.append(augment((factor * bars.keyframes).float(), pool=pool).double() / factor)
    for one, other in zip(found[:2], found[2:], strict=True):
        torch.testing.assert_close(one, other, rtol=0, atol=1e-4)


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: tm.RandomRigidMotion(p=1.5), "probability"),
        (lambda: tm.RandomInBetween(t=(0.2, 1.2)), r"t must be a range .* within \[0, 1\]"),
        (lambda: tm.RandomBlend(beyond=(0.3, 0.1)), "beyond is a range"),
        (lambda: tm.RandomInBetween("half"), "t must be a range"),
        (lambda: tm.RandomInBetween(0.5), "t must be a range .* got 0.5"),
        (lambda: tm.RandomModalDeformation(max_strain=1.0), "max_strain"),
        (lambda: tm.RandomModalDeformation(strain=-0.1), "strain must be a range"),
        (lambda: tm.RandomRigidMotion(degrees=270), "degrees must be a range"),
        (lambda: tm.RandomRigidMotion(axis=(0, 0, 0)), "axis must have a length"),
        (lambda: tm.RandomRigidMotion(translation=-1), "translation"),
        (lambda: tm.AugmentationSequential(data_keys=["normals"]), "include 'shapes'"),
        (lambda: tm.AugmentationSequential([tm.RandomBlend()]), r"one by one, .*\(\*transforms\); got \['list'\]"),  # type: ignore[arg-type]
        (lambda: tm.AugmentationSequential(torch.nn.ReLU()), r"got \['ReLU'\]"),  # type: ignore[arg-type]
        (lambda: tm.AugmentationSequential(data_keys=["shapes", "colours"]), "colours"),
    ],
)
def test_wrong_settings(make: Callable[[], Any], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        make()


def test_wrong_calls(bars: Shapes, space: tm.ShapeSpace) -> None:
    x = bars.keyframes
    deformation = tm.RandomModalDeformation(p=1.0)
    with pytest.raises(ValueError, match="needs key-frames"):
        deformation(x)
    with pytest.raises(ValueError, match=r"\(B, 164, 3\).*got \(3, 163, 3\)"):
        deformation(x[:, 1:], space=space)
    with pytest.raises(ValueError, match="shapes must be floating-point"):
        deformation(x.long(), space=space)
    deformation(x, space=space)
    with pytest.raises(ValueError, match="2 shapes need parameters with 2 rows"):
        deformation(x[:2], params=deformation.params, space=space)
    with pytest.raises(ValueError, match="a pool holds the 3 key-frames"):
        tm.RandomInBetween(p=1.0)(x, space=space, pool=ShapeBatch(x[:2]))
    with pytest.raises(ValueError, match="no in-between"):
        mirrored = x * torch.tensor([1.0, 1, -1], dtype=F64)
        tm.RandomInBetween(p=1.0, t=(0.5, 0.5))(torch.stack([x[0], mirrored[0]]), space=space)


# ----------------------------------------------------------------------------------------------------- in-between
def test_without_a_generator_the_global_one_is_used(bars: Shapes, space: tm.ShapeSpace) -> None:
    augment = tm.RandomRigidMotion(p=1.0)
    torch.manual_seed(5)
    first = augment(bars.keyframes)
    torch.manual_seed(5)
    assert torch.equal(augment(bars.keyframes), first)


def test_in_between_is_the_layers(bars: Shapes, space: tm.ShapeSpace) -> None:
    """Partner and time read from the parameters, the shape from the layer itself."""
    augment = tm.RandomInBetween(p=1.0, generator=seeded(), space=space)
    x = bars.keyframes + 0.01 * torch.sin(bars.keyframes)
    out = augment(x)
    for own, other in enumerate(partners_of(augment.params).tolist()):
        layer = tm.InBetween([bars.bases[own], bars.bases[other]], bars.faces, "fast")
        expected = layer(x[own], x[other], augment.params["t"][own])
        torch.testing.assert_close(out[own], expected, rtol=0, atol=1e-4)
    assert len(partners_of(augment.params).unique()) > 1


def test_a_pool_may_be_plain_shapes(bars: Shapes, space: tm.ShapeSpace) -> None:
    """Nobody needs to say which key-frame each is near to: that is found."""
    transform = tm.RandomInBetween(p=1.0)
    x = bars.keyframes[:1]
    found = transform(x, space=space, pool=ShapeBatch(bars.keyframes))
    known = transform(x, params=transform.params, space=space, pool=ShapeBatch.of_keyframes(space, x))
    torch.testing.assert_close(found, known, rtol=0, atol=1e-12)


def test_a_shape_alone_has_key_frames_as_partners(bars: Shapes, space: tm.ShapeSpace) -> None:
    """As with a pool; without other key-frames, or with labels, there are none."""
    x, pool = bars.keyframes[0], ShapeBatch.of_keyframes(space)
    given: dict[str, Any] = {"t": (0.4, 0.6), "p": 1.0, "keepdim": True}
    found = tm.RandomInBetween(**given, space=space, generator=seeded())(x)
    assert float((found - x).abs().max()) > 0.1
    assert torch.equal(tm.RandomInBetween(**given, space=space, generator=seeded())(x, pool=pool), found)
    assert torch.equal(tm.RandomInBetween(**given, space=tm.ShapeSpace(bars.bases[:1], bars.faces))(x), x)
    labelled = tm.RandomInBetween(**given, space=space, data_keys=["shapes", "shape_labels"])
    assert torch.equal(labelled(x, torch.tensor(3))[0], x)


def test_nearest_key_frame_is_found_through_rigid_motions(bars: Shapes, space: tm.ShapeSpace) -> None:
    turned = bars.keyframes @ random_rotation(seeded()).T + torch.tensor([5.0, -3.0, 1.0], dtype=F64)
    assert space.nearest(turned).tolist() == [0, 1, 2]
    between = torch.lerp(bars.keyframes[0], bars.keyframes[2], 0.8)[None]
    assert space.nearest(between).tolist() == [2]


def test_times_and_partners_are_uniform(space: tm.ShapeSpace) -> None:
    params = tm.RandomInBetween(t=(0.2, 0.6), p=0.3, space=space).forward_parameters(4000, generator=seeded())
    t = params["t"]
    assert (float(t.min()), float(t.max())) == (pytest.approx(0.2, abs=1e-3), pytest.approx(0.6, abs=1e-3))
    assert float(t.mean()) == pytest.approx(0.4, abs=0.01)
    assert float(params["batch_prob"].double().mean()) == pytest.approx(0.3, abs=0.03)


# ----------------------------------------------------------------------------------------------------- deformation
def test_amplitudes_are_thermal(bars: Shapes, space: tm.ShapeSpace) -> None:
    """Small draws, projected on the modes: variance 1 / lambda, and the edge strain that is asked for."""
    basis = bars.bases[0]
    n, strain = 2000, 1e-4
    augment = tm.RandomModalDeformation(strain=strain, p=1.0, generator=seeded(), space=space)
    x = bars.keyframes[:1].expand(n, -1, -1)
    moved = augment(x) - x
    # Aligned in the end: rigid motions are projected out beside the modes.
    columns = torch.cat([basis.modes, basis.rigid_modes]).flatten(1)
    found = torch.linalg.lstsq(columns.T, moved.flatten(1).T).solution[: basis.n_modes]
    energies = found.var(1) * basis.eigenvalues
    torch.testing.assert_close(energies / energies.mean(), torch.ones_like(energies), rtol=0, atol=0.12)
    correlation = torch.corrcoef(found) - torch.eye(basis.n_modes, dtype=F64)
    assert float(correlation.abs().max()) < 0.12
    assert float(space.strain(x + moved, x).square().mean().sqrt()) == pytest.approx(strain, rel=0.03)


def test_the_strain_of_a_sheet_is_that_of_its_sides() -> None:
    """Bent to a cylinder: half the thickness, a hundredth of the size, over the radius. One half has more rows."""
    n, rows = torch.linspace(0, 1, 31, dtype=F64), torch.cat([torch.linspace(0, 0.5, 26), torch.linspace(0.6, 1, 5)])
    x = torch.stack([*torch.meshgrid(rows.double(), n, indexing="ij"), torch.zeros(31, 31, dtype=F64)], -1).view(-1, 3)
    i = torch.arange(930).view(30, 31)[:, :30].flatten()
    faces = torch.cat([torch.stack([i, i + 31, i + 1], 1), torch.stack([i + 1, i + 31, i + 32], 1)])
    curvatures = []  # of a strain of one, where the whole is bent, and where a half is
    for bent in (x[:, 0], x[:, 0].clamp_max(0.5) - 0.5):
        mode = torch.zeros_like(x)
        mode[:, 2] = 0.5 * bent**2
        basis = tm.ModalBasis(x, torch.ones(1, dtype=F64), mode[None], torch.zeros(6, dtype=F64))
        curvatures.append(float(tm.ShapeSpace(basis, faces).mode_scales(0)))
    assert curvatures[0] * size(x.numpy(), faces.numpy()) == pytest.approx(1 / 0.005, rel=0.3)
    assert curvatures[1] == pytest.approx(2**0.5 * curvatures[0], rel=0.05)


def test_strain_is_bounded_and_the_bound_reached(bars: Shapes, space: tm.ShapeSpace) -> None:
    x = bars.keyframes[[0, 1, 2]].repeat(30, 1, 1)
    for dtype, bound in ((torch.float32, 0.15), (torch.float64, 0.4)):
        augment = tm.RandomModalDeformation(strain=0.5, max_strain=bound, p=1.0, generator=seeded(), space=space)
        y = augment(x.to(dtype))
        largest = space.strain(y, x.to(dtype)).abs().amax(1)
        assert float(largest.max()) <= bound
        assert float(largest.min()) > 0.75 * bound


def test_large_draws_bend(bars: Shapes, space: tm.ShapeSpace) -> None:
    """The straight bar along its softest mode: strains stay those of the linear estimate, which itself shears."""
    x = bars.keyframes[:1]
    displacement = bars.bases[0].modes[0].mT[:, None]
    displacement = displacement * (0.5 / edge_strains(displacement, x[0], space.reconstruction().edges).abs().max())
    bent = deform(x, displacement, x[0], space.reconstruction())
    straight = x + displacement[:, 0].mT
    initial = volume(x, bars.faces)
    assert float(volume(straight, bars.faces) / initial) > 1.35
    assert float(volume(bent, bars.faces) / initial) == pytest.approx(1, abs=0.025)
    rms = [float(space.strain(y, x).square().mean().sqrt()) for y in (straight, bent)]
    assert rms[1] < 0.65 * rms[0]
    # It really is bent far: the ends of the axis turn by a right angle against each other.
    left, right = (x[0, :, 0] < -1.6), (x[0, :, 0] > 1.6)
    turns = [best_fit(x[0, end], bent[0, end], torch.ones(int(end.sum()), dtype=F64)).rotation for end in (left, right)]
    angle = torch.arccos(((turns[0].T @ turns[1]).trace() - 1) / 2)
    assert float(angle) > 1.5


def test_deformation_moves_along_with_the_shape(bars: Shapes, space: tm.ShapeSpace) -> None:
    rotation = random_rotation(seeded())
    move = torch.tensor([3.0, -1.0, 2.0], dtype=F64)
    augment = tm.RandomModalDeformation(strain=0.03, p=1.0, generator=seeded(), space=space)
    for x in (bars.keyframes, torch.lerp(bars.keyframes, bars.keyframes.roll(1, 0), 0.2)):
        y = augment(x)
        turned = augment(x @ rotation.T + move, params=augment.params)
        torch.testing.assert_close(turned, y @ rotation.T + move)
        # It deforms only: the best rigid motion back to where it came from is none.
        back = best_fit(y, x, space.reconstruction().areas)
        torch.testing.assert_close(back.rotation, torch.eye(3, dtype=F64).expand(3, 3, 3), rtol=0, atol=1e-9)
        torch.testing.assert_close(back.source, back.target)


def test_modes_that_do_not_deform_are_left_out(bars: Shapes) -> None:
    basis = bars.bases[0]
    drift = torch.zeros_like(basis.modes[:1])
    drift[..., 0] = 1.0
    loose = tm.ModalBasis(
        basis.reference,
        torch.cat([torch.full((1,), 1e-13, dtype=F64), basis.eigenvalues]),
        torch.cat([drift, basis.modes]),
        basis.rigid_eigenvalues,
    )
    found, expected = (tm.ShapeSpace(each, bars.faces).mode_scales(0) for each in (loose, basis))
    assert found[0] == 0
    torch.testing.assert_close(found[1:], expected)


# ---------------------------------------------------------------------------------------------------- rigid motion
def test_rigid_motions_are_rigid(bars: Shapes) -> None:
    x = bars.keyframes.repeat(20, 1, 1)
    augment = tm.RandomRigidMotion(translation=0.3, p=1.0, generator=seeded())
    y = augment(x)
    torch.testing.assert_close(torch.cdist(y[:, ::9], y[:, ::9]), torch.cdist(x[:, ::9], x[:, ::9]))
    torch.testing.assert_close(volume(y, bars.faces), volume(x, bars.faces))
    moves = (y.mean(1) - x.mean(1)) / (x.amax(1) - x.amin(1)).norm(dim=1, keepdim=True)
    assert float(moves.abs().max()) <= 0.3
    assert float(moves.abs().max()) > 0.27


def rotations(augment: tm.RandomRigidMotion, n: int = 4000) -> torch.Tensor:
    x = torch.cat([torch.eye(3, dtype=F64), -torch.eye(3, dtype=F64)]).expand(n, 6, 3)
    return augment(x)[:, :3].mT


def test_rotations_are_uniform_by_default() -> None:
    """Moments of the Haar measure: E R = 0, E R_ij R_kl = delta delta / 3, and 1 + 2 cos has variance one."""
    found = rotations(tm.RandomRigidMotion(p=1.0, generator=seeded())).flatten(1)
    assert float(found.mean(0).abs().max()) < 0.03
    assert float((found.T @ found / len(found) - torch.eye(9, dtype=F64) / 3).abs().max()) < 0.03
    assert float(found[:, ::4].sum(1).var()) == pytest.approx(1, abs=0.06)


def test_rotations_about_an_axis() -> None:
    found = rotations(tm.RandomRigidMotion(degrees=(10, 50), axis=(0, 2, 0), p=1.0, generator=seeded()))
    torch.testing.assert_close(found[:, 1, 1], torch.ones(4000, dtype=F64))
    angle = torch.atan2(found[:, 0, 2], found[:, 0, 0]).rad2deg()
    assert (float(angle.min()), float(angle.max())) == (pytest.approx(10, abs=0.1), pytest.approx(50, abs=0.1))
    tilted = rotations(tm.RandomRigidMotion(degrees=30, p=1.0, generator=seeded()))
    cosine = (tilted.diagonal(dim1=1, dim2=2).sum(1) - 1) / 2
    assert float(cosine.min()) == pytest.approx(np.cos(np.pi / 6), abs=1e-3)


# ------------------------------------------------------------------------------------------------------ gradients
def test_gradients_flow_to_parameters(small_bars: Shapes) -> None:
    space = tm.ShapeSpace(small_bars.bases, small_bars.faces, dtype=F64)
    deformation = tm.RandomModalDeformation(strain=0.05, max_strain=0.9, p=1.0, generator=seeded(), space=space)
    params = deformation.forward_parameters(3)
    noise = params["noise"].clone().requires_grad_()
    x = small_bars.keyframes
    assert torch.autograd.gradcheck(
        lambda noise: deformation(x, params={**params, "noise": noise}), [noise], fast_mode=True
    )
    motion = tm.RandomRigidMotion(p=1.0, generator=seeded())
    params = motion.forward_parameters(3)
    turn = params["rotation"].clone().requires_grad_()
    assert torch.autograd.gradcheck(lambda turn: motion(x, params={**params, "rotation": turn}), [turn])


# ----------------------------------------------------------------------------------------------------- composition
def test_composition_is_its_transforms_one_after_the_other(bars: Shapes, space: tm.ShapeSpace) -> None:
    parts = [tm.RandomInBetween(p=0.7), tm.RandomModalDeformation(p=0.7), tm.RandomRigidMotion(p=0.7)]
    augment = tm.AugmentationSequential(*parts, generator=seeded(), space=space)
    x = bars.keyframes
    out = augment(x)
    step = x
    for part, params in zip(parts, augment.params, strict=True):
        step = part(step, params=params, space=space)
    torch.testing.assert_close(out, step, rtol=0, atol=1e-9)
    assert torch.equal(augment(x, params=augment.params), out)
    assert not torch.equal(augment(x), out)
    with pytest.raises(ValueError, match="3 transforms need as many"):
        augment(x, params=augment.params[:2])


def test_labels_go_along(bars: Shapes, space: tm.ShapeSpace) -> None:
    x = bars.keyframes
    v = x.shape[1]
    part = (x[0, :, 0] > 0).long().expand(3, v)
    pose = torch.tensor([10, 20, 30])
    keys = ["shape_labels", "shapes", "vertex_labels", "normals"]
    augment = tm.AugmentationSequential(
        tm.RandomInBetween(p=1.0), tm.RandomModalDeformation(p=1.0), data_keys=keys, generator=seeded(), space=space
    )
    new_pose, y, new_part, normals = augment(pose, x, part, None)
    assert torch.equal(new_part, part)
    torch.testing.assert_close(normals, vertex_normals(y, bars.faces))
    between = augment.params[0]
    expected = torch.where(between["t"] > 0.5, pose[partners_of(between)], pose)
    assert torch.equal(new_pose, expected)
    assert not torch.equal(new_pose, pose)


def test_labels_are_blended_if_asked(bars: Shapes, space: tm.ShapeSpace) -> None:
    augment = tm.AugmentationSequential(
        tm.RandomInBetween(p=1.0, blend_labels=True),
        data_keys=["shapes", "shape_labels"],
        generator=seeded(),
        space=space,
    )
    one_hot = torch.eye(3, dtype=F64)
    _, soft = augment(bars.keyframes, one_hot)
    t, partner = augment.params[0]["t"], partners_of(augment.params[0])
    torch.testing.assert_close(soft, (1 - t)[:, None] * one_hot + t[:, None] * one_hot[partner])
    with pytest.raises(ValueError, match="one-hot"):
        augment(bars.keyframes, torch.arange(3))


def test_one_shape_with_its_labels(bars: Shapes, space: tm.ShapeSpace) -> None:
    for keepdim, lead in ((True, ()), (False, (1,))):
        augment = tm.AugmentationSequential(
            tm.RandomModalDeformation(p=1.0),
            data_keys=["shapes", "vertex_labels", "shape_labels", "normals"],
            keepdim=keepdim,
            space=space,
        )
        part, pose = torch.arange(164), torch.tensor(7)
        y, new_part, new_pose, normals = augment(bars.keyframes[0], part, pose, None)
        assert y.shape == normals.shape == (*lead, 164, 3)
        assert torch.equal(new_part.reshape(-1), part)
        assert new_pose.shape == lead


def test_composition_says_what_does_not_fit(bars: Shapes, space: tm.ShapeSpace) -> None:
    augment = tm.AugmentationSequential(tm.RandomRigidMotion(), data_keys=["shapes", "vertex_labels"])
    with pytest.raises(ValueError, match="got 1 arguments"):
        augment(bars.keyframes)
    with pytest.raises(ValueError, match=r"vertex_labels begin with the shape \(3, 164\)"):
        augment(bars.keyframes, torch.zeros(3, 7))
    with pytest.raises(ValueError, match="normals need faces"):
        tm.AugmentationSequential(tm.RandomRigidMotion(), data_keys=["shapes", "normals"])(bars.keyframes, None)
    with pytest.raises(ValueError, match="one connectivity"):
        smaller = replace(bars.bases[1], reference=bars.bases[1].reference[1:], modes=bars.bases[1].modes[:, 1:])
        tm.ShapeSpace([bars.bases[0], smaller], bars.faces)
    for wrong, got in (([bars.bases[0], None], "NoneType"), ([], "none")):
        with pytest.raises(ValueError, match=f"bases, one or more, come from extract_bases; got {got}"):
            tm.ShapeSpace(wrong, bars.faces)  # type: ignore[arg-type]


# ---------------------------------------------------------------------------------------------------- many draws
def check_draws(shapes: Shapes, n: int) -> None:
    """All finite, strains within the bound, and volumes near those of what the shapes came from."""
    space = tm.ShapeSpace(shapes.bases, shapes.faces)
    pool = ShapeBatch.of_keyframes(space)
    k = len(space)
    volumes = volume(pool.shapes.double(), shapes.faces)
    for kind, make in KINDS.items():
        augment = make(p=1.0, space=space)
        generator = seeded(7)
        ratios = []
        for start in range(0, n, 50):
            rows = torch.arange(start, min(start + 50, n)) % k
            batch, params = pool.rows(rows), augment.forward_parameters(len(rows), None, generator)
            y = augment.transform(batch, params, None, pool).shapes
            assert bool(y.isfinite().all()), kind
            source = volumes[rows]
            if kind == "between":
                partner = (rows + 1 + (params["partner"] * (k - 1)).long()) % k
                source = torch.lerp(source, volumes[partner], params["t"].clamp(0, 1))
            found = volume(y.double(), shapes.faces)
            if kind == "blend":
                source = found.clamp(volumes.min(), volumes.max())
            ratios.append(found / source)
            if kind == "deformation":
                assert float(space.strain(y, batch.shapes).abs().max()) <= 0.2
        off = (torch.cat(ratios) - 1).abs()
        assert float(off.max()) < 0.13, kind
        assert float(off.median()) < 0.03, kind


def test_draws_of_bars(bars: Shapes) -> None:
    check_draws(bars, 150)


@pytest.mark.slow
@pytest.mark.parametrize(("name", "n"), [("hands", 400), ("women", 50)])
def test_many_draws(name: str, n: int, request: pytest.FixtureRequest) -> None:
    """More of each mesh."""
    check_draws(request.getfixturevalue(name), n)


class Graph:
    """A ``Data`` of PyTorch Geometric as far as a transform is concerned: attributes, and a copy of all of them."""

    def __init__(self, **values: torch.Tensor) -> None:
        self.__dict__.update(values)

    def clone(self) -> "Graph":
        return Graph(**{name: value.clone() for name, value in self.__dict__.items()})


@pytest.mark.parametrize("dtype", [torch.float32, F64])
def test_a_graph_gives_a_graph(bars: Shapes, space: tm.ShapeSpace, dtype: torch.dtype) -> None:
    """As a ``transform`` of torch_geometric, which takes and returns its ``Data``."""
    augment = tm.AugmentationSequential(
        tm.RandomModalDeformation(p=1.0), tm.RandomRigidMotion(p=1.0), generator=seeded(), space=space
    )
    data = Graph(pos=bars.keyframes[1].to(dtype), face=bars.faces.T, y=torch.tensor([3]))
    out = augment(data)
    assert type(out) is type(data) and out is not data and out.pos.dtype == dtype
    assert torch.equal(out.face, data.face) and torch.equal(out.y, data.y)
    assert torch.equal(data.pos, bars.keyframes[1].to(dtype))  # the data set's own stays
    assert torch.equal(out.pos, augment(data.pos, params=augment.params)[0]) and not torch.equal(out.pos, data.pos)
    assert torch.equal(augment(data, params=augment.params).pos, out.pos)
    with pytest.raises(ValueError, match=r"a graph takes other positions alone; of .*vertex_labels.*, pass tensors"):
        tm.RandomRigidMotion(data_keys=["shapes", "vertex_labels"])(data)
    with pytest.raises(ValueError, match="shapes"):
        augment(Graph(pos=data.pos[:-1]))
