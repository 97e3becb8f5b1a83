"""What docs/promises.md says of everything that takes shapes."""

import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import torch
from conftest import Shapes
from torch import Tensor

import torch_modal as tm

TRANSFORMS = (
    tm.RandomInBetween,
    tm.RandomExtrapolation,
    tm.RandomModalDeformation,
    tm.RandomRigidMotion,
    tm.RandomBlend,
)


@pytest.fixture(scope="module")
def space(bars: Shapes) -> tm.ShapeSpace:
    return tm.ShapeSpace(bars.bases, bars.faces)


FUNCTIONS: dict[str, Callable[[Shapes, tm.ShapeSpace, Tensor], Any]] = {
    "subdivide": lambda s, _, x: tm.subdivide(x, s.faces, 1, bases=s.bases, preset="fast", progress=False),
    "linear_sequence": lambda s, _, x: tm.linear_sequence(x, tm.keyframe_places(3, 1)),
    "fit": lambda s, space, x: space.fit(x[1, ::10], torch.arange(0, x.shape[1], 10)),
    "components": lambda s, space, x: space.components().coordinates(x),
    "self_contacts": lambda s, _, x: tm.self_contacts(x, s.faces),
}


@pytest.mark.parametrize("name", FUNCTIONS)
def test_nothing_that_is_given_changes(bars: Shapes, space: tm.ShapeSpace, name: str) -> None:
    """Layers and transforms: tests/layers/test_contract.py."""
    given, before, state = bars.keyframes.clone(), bars.keyframes.clone(), torch.get_rng_state()
    FUNCTIONS[name](bars, space, given)
    assert torch.equal(given, before)
    assert torch.equal(torch.get_rng_state(), state), "PyTorch's own random numbers were drawn"


@pytest.mark.parametrize("kind", TRANSFORMS)
def test_one_generator_decides_everything(bars: Shapes, space: tm.ShapeSpace, kind: Any) -> None:
    def drawn(seed: int) -> Tensor:
        found: Tensor = kind(p=1.0, space=space, generator=torch.Generator().manual_seed(seed))(bars.keyframes)
        return found

    torch.manual_seed(1)
    first = drawn(0)
    torch.manual_seed(2)
    assert torch.equal(drawn(0), first) and not torch.equal(drawn(1), first)
    sampled = [space.sample(2, torch.Generator().manual_seed(3)) for _ in range(2)]
    assert torch.equal(*sampled)


@pytest.mark.parametrize("kind", TRANSFORMS)
def test_sequences_are_batches(bars: Shapes, space: tm.ShapeSpace, kind: Any) -> None:
    transform = kind(p=1.0, space=space, generator=torch.Generator().manual_seed(0))
    frames = torch.lerp(bars.keyframes[0], bars.keyframes[1], torch.linspace(0, 1, 5)[:, None, None].double())
    assert transform(frames).shape == frames.shape
    labels = torch.arange(frames.shape[1]).expand(5, -1)
    both = tm.AugmentationSequential(transform, data_keys=["shapes", "vertex_labels"], space=space)
    moved, kept = both(frames, labels)
    assert moved.shape == frames.shape and torch.equal(kept, labels)


def test_the_order_of_vertices_stays(bars: Shapes) -> None:
    """Vertices and faces in any order, and vertices that no face names."""
    generator = torch.Generator().manual_seed(0)
    order, faces_order = (torch.randperm(n, generator=generator) for n in (bars.keyframes.shape[1], len(bars.faces)))
    rank = torch.empty_like(order).scatter_(0, order, torch.arange(len(order)))
    shuffled = torch.cat([bars.keyframes[:, order], torch.full((3, 2, 3), 7.0, dtype=torch.float64)], 1)
    faces = rank[bars.faces][faces_order]
    frames = tm.subdivide(shuffled, faces, 1, n_modes=6, preset="fast", progress=False)
    assert torch.equal(frames[::2], shuffled)
    plain = tm.subdivide(bars.keyframes, bars.faces, 1, n_modes=6, preset="fast", progress=False)
    torch.testing.assert_close(frames[1, rank], plain[1], rtol=0, atol=0.02)


def test_each_promise_is_kept_by_a_test() -> None:
    """The page names the tests."""
    root = Path(__file__).parents[2]
    page = (root / "docs" / "promises.md").read_text()
    named = re.findall(r"`(tests/\S+?::\w+)`", page)
    assert len(named) >= 8
    for name in named:
        file, _, test = name.partition("::")
        assert f"def {test}" in (root / file).read_text(), name
