"""Motions of one body on another one."""

import warnings

import numpy as np
import pytest
import torch
from helpers.bodies import bar_surface, bend
from helpers.shapes import apart, diagonal, edge_lengths, largest
from torch import Tensor

import torch_modal as tm
from torch_modal.geometry.decimation import decimate
from torch_modal.geometry.rigid import best_fit
from torch_modal.registration.report import Registration
from torch_modal.registration.surface import MeshSurface

LONG, START, STOP = 6.0, 1.0, 5.0


@pytest.fixture(scope="module")
def gallop() -> tuple[Tensor, Tensor]:
    """Six key-frames of the sample: 4,840 vertices."""
    return tm.load_sample("creature")[:2]


@pytest.fixture(scope="module")
def coarse(gallop: tuple[Tensor, Tensor]) -> tuple[Tensor, Tensor]:
    """The same motion in another triangulation: ``(6, W, 3)``, faces."""
    x, faces = gallop
    points, coarse, _ = decimate(x[0].numpy(), faces.numpy(), 4000)
    surface = MeshSurface(x[0].numpy(), faces.numpy())
    rows = surface.rows(surface.closest(points))
    return torch.stack([torch.from_numpy(rows @ shape.numpy()) for shape in x]), torch.from_numpy(coarse)


@pytest.fixture(scope="module")
def registration(gallop: tuple[Tensor, Tensor], coarse: tuple[Tensor, Tensor]) -> Registration:
    return tm.register(coarse[0][0], coarse[1], gallop[0][0], gallop[1], same_subject=False, cache=False)


def inchworm(length: float = LONG, height: float = 1.0, cells: int = 24) -> tuple[Tensor, Tensor, Tensor]:
    """A bar that stands on its left end and bends, then stands on the right end and stretches: ``(17, V, 3)``.

    Then its faces and the places of its vertices along the axis, over the length.
    """
    points, faces = bar_surface((cells, 4, 4), (length, height, height))
    scale = length / LONG
    times = np.linspace(0, 1, 9)
    shapes = [torch.from_numpy(bend(points, t, 1.5, START * scale, STOP * scale)) for t in times]
    right = torch.from_numpy(points[:, 0] > STOP * scale)
    back = [best_fit(shape[right], shapes[-1][right]).apply(shape) for shape in shapes[-2::-1]]
    return torch.stack([*shapes, *back]), torch.from_numpy(faces), torch.from_numpy(points[:, 0] / length)


def edge_change(x: Tensor, faces: Tensor) -> float:
    """Root mean square of the logarithmic change of edge lengths since the first shape."""
    lengths = edge_lengths(x, faces)
    return float((lengths[1:] / lengths[:1]).log().square().mean().sqrt())


@pytest.mark.parametrize("anchors", [True, False])
def test_a_body_moves_as_itself(gallop: tuple[Tensor, Tensor], anchors: bool) -> None:
    x, faces = gallop
    assert apart(tm.transfer(x, faces, x[0], faces, anchors=anchors), x) < 1e-9
    # Another unit, the Z axis up, elsewhere; the vertices in another order.
    order = torch.randperm(x.shape[1], generator=torch.Generator().manual_seed(0))
    other = 0.01 * x[:, order][..., [0, 2, 1]] * torch.tensor([1.0, -1, 1]) + 5
    own = order.argsort()[faces]
    moved = tm.transfer(x, faces, other[0], own, registration=x[0, order], anchors=anchors)
    assert apart(moved, other) < 1e-9


def test_another_triangulation(
    gallop: tuple[Tensor, Tensor], coarse: tuple[Tensor, Tensor], registration: Registration
) -> None:
    """With a map of its own, the motion is as near to the truth as the map is."""
    (x, faces), (truth, own) = gallop, coarse
    off = float((registration.positions - truth[0]).norm(dim=1).mean())
    assert not registration.doubtful and off < 0.01 * diagonal(truth[0])
    for anchors in (True, False):
        moved = tm.transfer(x, faces, truth[0], own, registration=registration, anchors=anchors)
        assert moved.shape == truth.shape and apart(moved[0], truth[0]) < 1e-9
        error = float((tm.align(moved, truth) - truth)[1:].norm(dim=-1).mean())
        assert error < 1.3 * off + 1e-3 * diagonal(truth[0])
        assert edge_change(moved, own) < 1.1 * edge_change(x, faces)


def test_proportions_stay(gallop: tuple[Tensor, Tensor], coarse: tuple[Tensor, Tensor]) -> None:
    """A body of half the height moves as the source does, and its edges change no more."""
    (x, faces), (rests, own) = gallop, coarse
    low = rests[0] * torch.tensor([1, 0.5, 0.8], dtype=torch.float64)
    moved = tm.transfer(x, faces, low, own, registration=rests[0])
    copied = low + (rests - rests[0])
    assert edge_change(moved, own) < 1.1 * edge_change(x, faces) < edge_change(copied, own)


def test_what_stands_stays() -> None:
    """Ends of another bar stand while the source's ends do, on their places; it goes as far as its length allows."""
    x, faces, _ = inchworm()
    truth, own, along = inchworm(9.0, 1.2, 30)
    places = truth[0] * torch.tensor([LONG / 9, 1 / 1.2, 1 / 1.2], dtype=torch.float64)
    moved = tm.transfer(x, faces, truth[0], own, registration=places)
    free = tm.transfer(x, faces, truth[0], own, registration=places, anchors=False)
    (left, right), n = (along < 0.1, along > 0.9), len(x) // 2
    stride = float((truth[-1, left] - truth[0, left]).norm(dim=-1).mean())

    def slip(shapes: Tensor) -> float:
        standing = shapes[: n + 1, left], shapes[n:, right]
        return max(float((part - part[:1]).norm(dim=-1).max()) for part in standing) / stride

    assert slip(truth) < 1e-9 and slip(moved) < 0.005 < 0.03 < slip(free)
    far = (moved - truth)[-1, left].mean(0)
    assert float(far.norm()) < 0.1 * stride and abs(far[2]) < 1e-6 * stride
    assert edge_change(moved, own) < 1.1 * edge_change(x, faces)


def test_paths_do_not_drift() -> None:
    """Eight strides of the inchworm: each is as long as the first, in its direction."""
    x, faces, _ = inchworm()
    _, own, along = inchworm(9.0, 1.2, 30)
    truth = inchworm(9.0, 1.2, 30)[0]
    forth = [x]
    for _ in range(7):  # the pose after a stride is the first one, moved
        motion = best_fit(x[0], forth[-1][-1])
        forth.append(motion.apply(x[1:]))
    places = truth[0] * torch.tensor([LONG / 9, 1 / 1.2, 1 / 1.2], dtype=torch.float64)
    moved = tm.transfer(torch.cat(forth), faces, truth[0], own, registration=places)
    feet = moved[:: len(x) - 1, along < 0.1].mean(1)
    steps = feet.diff(dim=0).norm(dim=-1)
    assert len(steps) == 8 and largest(steps / steps.mean() - 1) < 0.03
    assert largest(moved[..., 2].mean(1)) < 1e-6


def test_parts_without_a_counterpart_are_rigid(
    gallop: tuple[Tensor, Tensor], coarse: tuple[Tensor, Tensor], registration: Registration
) -> None:
    """The tail, whose map is wrong: it follows the trunk."""
    (x, faces), (truth, own) = gallop, coarse
    tail = truth[0, :, 0] < truth[0, :, 0].quantile(0.06)
    places = truth[0].clone()
    places[tail] = places[~tail & (truth[0, :, 0] < truth[0, :, 0].quantile(0.07))].mean(0)
    confidence = torch.where(tail, 0.0, 1.0).double()
    found = registration._replace(positions=places, vertex_confidence=confidence, confidence=0.9)
    moved = tm.transfer(x, faces, truth[0], own, registration=found)
    inside = tail[own].all(1)
    lengths = edge_lengths(moved, own[inside])
    changes = (lengths / lengths[0]).log().abs()
    assert inside.sum() > 50 and changes.max() < 0.1 and changes.mean() < 0.01
    assert apart(tm.align(moved, truth)[:, ~tail], truth[:, ~tail]) < 0.05


def test_gradients_agree_with_differences(gallop: tuple[Tensor, Tensor], coarse: tuple[Tensor, Tensor]) -> None:
    (x, faces), (truth, own) = gallop, coarse
    generator = torch.Generator().manual_seed(1)
    drawn = [torch.randn(like.shape, generator=generator, dtype=torch.float64) for like in (truth, x, truth[0])]
    for anchors in (True, False):
        leaves = [each.clone().requires_grad_() for each in (x, truth[0])]

        def value(frames: Tensor, target: Tensor, anchors: bool = anchors) -> Tensor:
            options = {"rest": x[0], "registration": truth[0], "anchors": anchors}
            return (drawn[0] * tm.transfer(frames, faces, target, own, **options)).sum()

        value(*leaves).backward()
        for k, leaf in enumerate(leaves):
            assert leaf.grad is not None
            along, ends = float((leaf.grad * drawn[1 + k]).sum()), []
            for step in (1e-7, -1e-7):
                near = [x, truth[0]]
                near[k] = near[k] + step * drawn[1 + k]
                ends.append(float(value(*near)))
            assert (ends[0] - ends[1]) / 2e-7 == pytest.approx(along, rel=1e-5)


def test_inputs_of_all_kinds(gallop: tuple[Tensor, Tensor], coarse: tuple[Tensor, Tensor]) -> None:
    """Batches, float32, arrays, a path at times between its key-frames, texture seams in the target."""
    (x, faces), (truth, own) = gallop, coarse
    given = {"registration": truth[0]}
    moved = tm.transfer(x, faces, truth[0], own, **given)
    both = tm.transfer(torch.stack([x, x.flip(0)]), faces, truth[0], own, rest=x[0], **given)
    assert both.shape == (2, *moved.shape) and largest(both[0] - moved) < 1e-12
    single = tm.transfer(x.float(), faces, truth[0].float(), own, **given)
    assert single.dtype == torch.float32 and apart(single.double(), moved) < 1e-5
    arrays = tm.transfer(x.numpy(), faces.numpy(), truth[0].numpy(), own.numpy(), **given)
    assert largest(arrays - moved) == 0
    path = tm.Path(x, faces)
    assert apart(tm.transfer(path, faces, truth[0], own, **given), moved) < 1e-9
    assert tm.transfer(path, faces, truth[0], own, times=[0.0, 0.5], **given).shape == (2, *truth.shape[1:])
    # Every face apart: without welding it would fall to pieces.
    split, soup = truth[0][own.flatten()], torch.arange(own.numel()).view(-1, 3)
    torn = tm.transfer(x, faces, split, soup, registration=split)
    assert apart(torn, moved[:, own.flatten()]) < 1e-6


def test_what_cannot_work_says_why(
    gallop: tuple[Tensor, Tensor], coarse: tuple[Tensor, Tensor], registration: Registration
) -> None:
    (x, faces), (truth, own) = gallop, coarse
    broken = x.clone()
    broken[2, 7, 1] = torch.nan
    for message, arguments, options in (
        ("the frames: 1 vertices have NaN", (broken, faces, truth[0], own), {}),
        ("the frames: .* faces use vertices that do not exist", (x[:, :-1], faces, truth[0], own), {}),
        ("the target: .* faces use vertices that do not exist", (x, faces, truth[0, :-1], own), {}),
        ("the frames: .* faces use vertices that do not exist", (truth, faces, truth[0], own), {}),
        ("rest has shape .* one body only", (x, faces, truth[0], own), {"rest": truth[0]}),
        (r"\(T, V, 3\) is needed", (x[0], faces, truth[0], own), {}),
        ("the target is the template", (x, faces, truth[0], own), {"registration": x[0]}),
        ("off the source at rest", (x, faces, truth[0], own), {"registration": truth[0] + 1}),
        ("--landmarks", (x, faces, truth[0], own), {"registration": registration._replace(confidence=0.2)}),
    ):
        with pytest.raises(tm.MeshError, match=message):
            tm.transfer(*arguments, **options)
    doubtful = registration._replace(confidence=0.2)
    with pytest.warns(tm.MeshWarning, match="doubtful"):
        insisted = tm.transfer(x, faces, truth[0], own, registration=doubtful, keep_doubtful=True)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert largest(tm.transfer(x, faces, truth[0], own, registration=registration) - insisted) == 0
