"""Kornia's container manners: indexing, random_apply, transform_matrix, inverse; the names beside kornia's own."""

import itertools

import kornia.augmentation as K
import pytest
import torch
from conftest import Shapes

import torch_modal as tm


def seeded(seed: int = 0) -> torch.Generator:
    return torch.Generator().manual_seed(seed)


def motions(**options: object) -> tm.AugmentationSequential:
    return tm.AugmentationSequential(
        tm.RandomRigidMotion(180, translation=0.3, p=0.7),
        tm.RandomRigidMotion(axis=(0, 1, 0), degrees=60, p=0.5),
        tm.RandomRigidMotion(degrees=10, translation=1.0, p=1.0),
        generator=seeded(),
        **options,  # type: ignore[arg-type]
    )


@pytest.fixture
def shapes(bars: Shapes) -> torch.Tensor:
    return bars.keyframes.repeat(4, 1, 1)


# ------------------------------------------------------------------------------------------------- rigid motions
def test_matrix_does_what_the_transform_did(shapes: torch.Tensor) -> None:
    motion = tm.RandomRigidMotion(translation=0.5, p=0.6, generator=seeded(3))
    assert motion.transform_matrix is None
    moved = motion(shapes)
    matrix = motion.transform_matrix
    assert matrix is not None and matrix.shape == (12, 4, 4) and matrix.dtype == shapes.dtype
    torch.testing.assert_close(shapes @ matrix[:, :3, :3].mT + matrix[:, None, :3, 3], moved)
    stayed = ~motion.params["batch_prob"]
    assert stayed.any() and not stayed.all()
    assert torch.equal(matrix[stayed], torch.eye(4, dtype=shapes.dtype).expand(int(stayed.sum()), 4, 4))
    torch.testing.assert_close(motion.compute_transformation(shapes, motion.params), matrix)
    torch.testing.assert_close(torch.linalg.det(matrix), torch.ones(12, dtype=shapes.dtype))


@pytest.mark.parametrize("dtype", [torch.float32, torch.float64])
def test_inverse_brings_shapes_back(shapes: torch.Tensor, dtype: torch.dtype) -> None:
    x = shapes.to(dtype)
    motion = tm.RandomRigidMotion(translation=0.5, p=0.6, generator=seeded(3))
    with pytest.raises(ValueError, match="make one first"):
        motion.inverse(x)
    y = motion(x)
    tolerance = {"rtol": 0, "atol": 1e-5 if dtype == torch.float32 else 1e-12}
    torch.testing.assert_close(motion.inverse(y), x, **tolerance)
    params = motion.params
    motion(x)
    torch.testing.assert_close(motion.inverse(y, params), x, **tolerance)
    single = tm.RandomRigidMotion(p=1.0, keepdim=True)
    torch.testing.assert_close(single.inverse(single(x[0])), x[0], **tolerance)
    with pytest.raises(ValueError, match="12 rows"):
        motion.inverse(y, {name: value[:2] for name, value in params.items()})


def test_inverse_is_differentiable(shapes: torch.Tensor) -> None:
    motion = tm.RandomRigidMotion(p=1.0, translation=0.0)
    x = shapes[:2, :5].clone().requires_grad_()
    motion.inverse(motion(x)).sum().backward()
    torch.testing.assert_close(x.grad, torch.ones_like(x))


def test_deformations_have_no_inverse_and_no_matrix(bars: Shapes) -> None:
    space = tm.ShapeSpace(bars.bases, bars.faces, dtype=torch.float64)
    augment = tm.AugmentationSequential(
        tm.RandomRigidMotion(p=1.0), tm.RandomModalDeformation(p=1.0), space=space, generator=seeded()
    )
    with pytest.raises(ValueError, match="make one first"):
        augment.inverse(bars.keyframes)
    out = augment(bars.keyframes)
    with pytest.raises(NotImplementedError, match="RandomModalDeformation has no inverse"):
        augment.inverse(out)
    with pytest.raises(ValueError, match="RandomModalDeformation is no rigid motion"):
        _ = augment.transform_matrix


# --------------------------------------------------------------------------------------------------- the container
def test_container_composes_matrices_and_inverses(shapes: torch.Tensor) -> None:
    augment = motions()
    with pytest.raises(ValueError, match="make one first"):
        _ = augment.transform_matrix
    y = augment(shapes)
    matrix = augment.transform_matrix
    torch.testing.assert_close(shapes @ matrix[:, :3, :3].mT + matrix[:, None, :3, 3], y)
    torch.testing.assert_close(augment.inverse(y), shapes)


def test_indexing_like_a_list(shapes: torch.Tensor) -> None:
    augment = motions(keepdim=True, same_on_batch=True)
    assert len(augment) == 3 and list(augment) == [augment[0], augment[1], augment[2]] and augment[-1] is augment[2]
    part = augment[1:]
    assert isinstance(part, tm.AugmentationSequential) and list(part) == [augment[1], augment[2]]
    assert part.keepdim and part.same_on_batch and part.generator is augment.generator
    part(shapes)
    rotation = part.transform_matrix[:, :3, :3]  # about each shape's own centre
    assert torch.equal(rotation, rotation[:1].expand(12, 3, 3))
    with pytest.raises(IndexError):
        _ = augment[3]


@pytest.mark.parametrize(
    ("random_apply", "counts"), [(True, {3}), (2, {2}), ((1,), {1, 2, 3}), ((0, 2), {0, 1, 2}), (0, {0})]
)
def test_random_apply_draws_what_it_says(shapes: torch.Tensor, random_apply: object, counts: set[int]) -> None:
    augment = motions(random_apply=random_apply)
    seen = set()
    for _ in range(40):
        y = augment(shapes)
        order = augment.order(augment.params)
        assert len(set(order)) == len(order)
        seen.add(order)
        torch.testing.assert_close(augment.inverse(y), shapes)
        torch.testing.assert_close(augment(shapes, params=augment.params), y)
    assert {len(order) for order in seen} == counts
    for count in counts:
        wanted = set(itertools.permutations(range(3), count))
        assert {order for order in seen if len(order) == count} == wanted or len(counts) > 1


def test_random_apply_follows_weights_and_the_generator() -> None:
    augment = motions(random_apply=1, random_apply_weights=[1.0, 1.0, 8.0])
    x = torch.randn(1, 5, 3, dtype=torch.float64)
    orders = [augment(x) is not None and augment.order(augment.params)[0] for _ in range(300)]
    assert 210 < orders.count(2) < 270  # 240 expected, five standard deviations
    again = motions(random_apply=1, random_apply_weights=[1.0, 1.0, 8.0])
    assert orders == [again(x) is not None and again.order(again.params)[0] for _ in range(300)]
    assert augment[:2].random_apply is True


@pytest.mark.parametrize("given", [4, -1, (2, 1), (1, 2, 3), "two", (0, 4), 1.5])
def test_random_apply_that_means_nothing(given: object) -> None:
    with pytest.raises(ValueError, match="random_apply is a bool"):
        motions(random_apply=given)


def test_weights_that_do_not_fit() -> None:
    for weights in ([1.0], [1.0, 0.0, 1.0]):
        with pytest.raises(ValueError, match="positive weights"):
            motions(random_apply=2, random_apply_weights=weights)


def test_the_names_are_kornias() -> None:
    theirs = K.AugmentationSequential(K.RandomHorizontalFlip(), K.RandomRotation(10.0), random_apply=1)
    for name in ("transform_matrix", "inverse", "random_apply", "random_apply_weights", "same_on_batch", "keepdim"):
        assert hasattr(type(theirs), name) or hasattr(theirs, name), name
        assert hasattr(tm.AugmentationSequential, name) or hasattr(motions(), name), name
    assert len(theirs) == 2 and isinstance(theirs[0], K.RandomHorizontalFlip)


def test_samples_of_a_dataset_with_random_apply(bars: Shapes, tmp_path) -> None:  # type: ignore[no-untyped-def]
    """Each sample has its own choice, the same alone and in a batch."""
    tm.write_set(tmp_path / "a", *bars, ["0", "1", "2"])
    data = tm.ShapeDataset(tmp_path, motions(random_apply=(0, 3)), samples_per_set=8)
    batch = data.__getitems__(range(8))
    for number, sample in enumerate(batch):
        assert torch.equal(sample["vertices"], data[number]["vertices"])
    moved = [not torch.equal(s["vertices"], data.space(0).keyframes()[s["keyframe"]]) for s in batch]
    assert any(moved) and not all(moved)
